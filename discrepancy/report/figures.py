"""What the report shows, and its figures with their captions, as far as the data allow them."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from discrepancy.files.document import Origin
from discrepancy.files.patch import PrimitiveInterval
from discrepancy.judgement.separability import CONFUSED, Separability
from discrepancy.location.residuals import ResidualSet
from discrepancy.report.evidence_figures import confusion_figure, pit_figure, separability_figure
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.report.motion_figures import backbone_figure, history_figure, spectrum_figure, worst_record
from discrepancy.report.residual_figures import heat_figure, load_figure, planform_figure, time_line_figure
from discrepancy.report.text import WORDS, added_label, force_sentence, scored
from discrepancy.self_calibration import SelfCalibration
from discrepancy.workflow import Investigation
from fe.wing.design import WingDesign
from reporting.page import ReportFigure
from reporting.words import listing


@dataclass(frozen=True)
class ReportInput:
    """All that the report shows.

    Attributes
    ----------
    investigation : Investigation
        What came out.
    origin : Origin
        What it came from.
    separability : Separability or None
        What the campaign can decide.
    self_calibration : SelfCalibration or None
        Where it was asked for.
    design : WingDesign or None
        Of a wing, for the map.
    intervals : sequence of sequence of PrimitiveInterval
        Of the patch, by effect; empty without a patch.
    fmu : str
        Name of the patched FMU, or why there is none; empty if none is due.
    """

    investigation: Investigation
    origin: Origin
    separability: Separability | None = None
    self_calibration: SelfCalibration | None = None
    design: WingDesign | None = None
    intervals: Sequence[Sequence[PrimitiveInterval]] = ()
    fmu: str = ""


def report_figures(content: ReportInput) -> dict[str, ReportFigure]:
    """Draw every figure that these data allow, by name; their words are in `words.toml`.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    """
    found: dict[str, ReportFigure] = {}

    def add(name: str, figure: Figure | None, **words: object) -> None:
        if figure is not None:
            found[name] = WORDS.figure(name, figure, **words)

    investigation = content.investigation
    verdict, proof, missing = investigation.verdict, investigation.proof, investigation.missing
    before, after = investigation.before, investigation.after if added_label(investigation) else None
    if missing is not None and verdict.force is not None:
        figure = missing_force_figure(missing, verdict.force)
        add("missing_force", figure, sentence=force_sentence(verdict.force))
    if before is not None:
        scale = {
            "held_out": _held_out_words(before),
            "scale": " Both panels have one scale." if after is not None else "",
        }
        if content.design is not None:
            add("residual_map", planform_figure(before, after, content.design), **scale)
        add("residual_table", heat_figure(before, after), **scale)
        add("load", load_figure(before, after))
        with_effect = any(item.with_effect for item in verdict.windows)
        left = " The thin bars below are what the hypothesis leaves." if with_effect else ""
        add("time_line", time_line_figure(verdict.windows), left=left)
        if (worst := worst_record(before.trials)) is not None:
            trial = before.trials[worst.trial].trial
            role = "held out" if trial.held_out else "fitted"
            figure = history_figure(before, after, worst)
            add("history", figure, channel=worst.channel, trial=trial.name, role=role)
            add("spectrum", spectrum_figure(before, after, worst))
        if (backbone := backbone_figure(before, after)) is not None:
            add("backbone", backbone[0], channel=backbone[1])
    if proof is not None:
        *pair, trials = scored(proof)
        shown = zip(("model as it was", "with the effect"), pair, strict=True)
        scores = {title: item for title, item in shown if item.pit}
        where = "Held-out trials." if trials == "held-out" else "Fitted trials: none is held out."
        add("pit", pit_figure(scores) if scores else None, where=where)
    if content.separability is not None:
        add("separability", separability_figure(content.separability), confused=CONFUSED)
    if content.self_calibration is not None:
        add("self_calibration", confusion_figure(content.self_calibration))
    return found


def _held_out_words(residuals: ResidualSet) -> str:
    """Return a sentence on which trials are held out."""
    names = [item.trial.name for item in residuals.trials if item.trial.held_out]
    if not names:
        return "No trial is held out."
    them = "them" if names[1:] else "it"
    return f"Held out: {listing(names)}; nothing but release and zero was fitted to {them}."
