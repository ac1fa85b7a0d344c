"""The figures of the report with their captions, as far as the data allow them."""

from collections.abc import Callable, Collection, Sequence

from matplotlib.figure import Figure

from discrepancy.judgement.separability import CONFUSED
from discrepancy.location.residuals import ResidualSet
from discrepancy.report.content import ReportFigure, ReportInput
from discrepancy.report.evidence_figures import (
    confusion_figure,
    evidence_figure,
    pit_figure,
    separability_figure,
    shares_figure,
)
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.report.law_figures import backbone_figure, force_figure
from discrepancy.report.motion_figures import (
    history_figure,
    spectrum_figure,
    worst_record,
)
from discrepancy.report.residual_figures import heat_figure, load_figure, planform_figure
from discrepancy.report.time_line import time_line_figure
from discrepancy.workflow import Investigation
from reporting.figures import to_svg
from reporting.words import listing


def report_figures(content: ReportInput) -> dict[str, ReportFigure]:
    """Draw every figure that these data allow, by name.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    """
    found: dict[str, ReportFigure] = {}

    def add(name: str, figure: Figure | None, title: str, caption: str) -> None:
        if figure is not None:
            found[name] = ReportFigure(name, figure, title, caption)

    missing = content.investigation.missing
    if missing is not None:
        add(
            "missing_force", missing_force_figure(missing), "The missing force",
            f"{missing.sentence} Dots and line: what a Kalman smoother sees of it in the fitted trials, with "
            "its deviation; in time two deviations, in the trial where it is largest. Laws of a displacement "
            "or of a speed show as lines in their panels, friction as a step, hysteresis as a loop.",
        )  # fmt: skip
    before, after = content.investigation.before, after_of(content.investigation)
    if before is not None:
        both = after is not None
        scale = " Both panels have one scale." if both else ""
        if content.design is not None:
            add(
                "residual_map", planform_figure(before, after, content.design),
                "Residuals on the wing",
                "Seen from above, root on the left. Circles are strain gauges, squares displacements; the "
                "colour is "
                "the root mean square of the residual over all trials, in units of what noise would "
                "leave: 1 is "
                f"noise. {_held_out_words(before)}{scale} Broken outlines are the regions whose "
                "stiffness loss the model knows.",
            )  # fmt: skip
        add(
            "residual_table", heat_figure(before, after), "Residuals by channel and trial",
            "Root mean square of the residual in units of what noise would leave: 1 is noise. "
            f"{_held_out_words(before)}{scale}",
        )  # fmt: skip
        add(
            "load", load_figure(before, after), "Residuals over the load",
            "Static trials and flights, all channels of a quantity in one panel; open marks are held-out "
            "trials. A "
            "slope is a stiffness or a gain, an offset a zero, a bend a nonlinearity.",
        )  # fmt: skip
        windows = content.investigation.verdict.windows
        left = " The thin bars below are what the hypothesis leaves." if any(
            item.with_effect for item in windows
        ) else ""  # fmt: skip
        add(
            "time_line", time_line_figure(windows), "When the gap is there",
            "Bars: something acts that the model lacks; the colour is the root mean square of what it does "
            f"to the readings over the noise. Brackets are 90 % intervals of begin and end.{left}",
        )  # fmt: skip
        _add_worst_record(before, after, add)
        _add_motion(before, after, add, found)
    _add_evidence(content, add)
    explained = content.investigation.verdict.explained
    if explained is not None:
        add(
            "shares", shares_figure(explained), "What the gap is made of",
            f"Mean square of the residuals of the model as it was on {explained.trials} trials, all channels "
            "in units of their noise: what the hypothesis takes off, what it leaves without a name, noise.",
        )  # fmt: skip
    return found


def _add_worst_record(
    before: ResidualSet, after: ResidualSet | None, add: Callable[[str, Figure | None, str, str], None]
) -> None:
    worst = worst_record(before)
    if worst is not None:
        trial = before.trials[worst.trial].trial
        role = "held out" if trial.held_out else "fitted"
        add(
            "history", history_figure(before, after, worst), "The record with the largest gap",
            f"Channel {worst.channel} in the trial {trial.name} ({role}). The grey band is two "
            "standard deviations of the noise record.",
        )  # fmt: skip
        add(
            "spectrum", spectrum_figure(before, after, worst), "Spectra of the residuals",
            "Power relative to white noise of the stated size; peaks at the modes are missing "
            "dynamics, single "
            "lines elsewhere come from outside.",
        )  # fmt: skip


def _add_motion(
    before: ResidualSet,
    after: ResidualSet | None,
    add: Callable[[str, Figure | None, str, str], None],
    shown: Collection[str],
) -> None:
    backbone = backbone_figure(before, after)
    if backbone is not None:
        add(
            "backbone", backbone[0], "Frequency and damping over the amplitude",
            f"All ring-downs, channel {backbone[1]}, windows of four periods. Viscous damping and a "
            "linear "
            "spring are flat; Coulomb friction gives a damping ratio that falls as 1/A, quadratic "
            "damping one "
            "that rises with A, a cubic spring a frequency that goes with A squared; under micro-slip "
            "the "
            "frequency falls and the damping rises with A.",
        )  # fmt: skip
    force = None if "missing_force" in shown else force_figure(before, after)
    if force is not None:
        add(
            "restoring_force", force[0], "Restoring force of the first mode",
            f"What is left of the force per modal mass after the best straight line in displacement and "
            f"velocity, in percent of the largest elastic force; {force[1]}. Measured and predicted "
            "signals are "
            "filtered and evaluated alike; means in bins with standard errors.",
        )  # fmt: skip


def _add_evidence(content: ReportInput, add: Callable[[str, Figure | None, str, str], None]) -> None:
    verdict, proof = content.investigation.verdict, content.investigation.proof
    if verdict.hypotheses:
        add(
            "evidence", evidence_figure(verdict.hypotheses), "Evidence",
            "The best hypotheses and their probabilities (p) on a logarithmic scale; ln B is the "
            "logarithm of the "
            "evidence over that of nothing missing (for the best place of the effect, before prior "
            "probabilities).",
        )  # fmt: skip
    if proof is not None:
        pairs = (
            (proof.held_out_before, proof.held_out_after)
            if proof.held_out_after is not None
            else (proof.fitted_before, proof.fitted_after)
        )
        scores = {
            title: item
            for title, item in zip(("model as it was", "with the effect"), pairs, strict=True)
            if item is not None and item.pit
        }
        where = "Held-out trials." if proof.held_out_after is not None else "Fitted trials: none is held out."
        if scores:
            add(
                "pit", pit_figure(scores), "Calibration of the predictions",
                f"{where} A right model gives a flat histogram; full ends mean intervals that are too "
                "narrow.",
            )  # fmt: skip
    if content.separability is not None:
        add(
            "separability", separability_figure(content.separability), "What this campaign can tell apart",
            "Squared distance, in noise deviations and with all nuisances adapted, of the effect of the "
            "row at its prior median (or where it is not seen there, as large as it must be to be seen) from "
            f"the nearest that the effect of the column can do. Crosses: closer than {CONFUSED:g}, so that "
            "the column's effect can pass for the row's. Made before the data were looked at.",
        )  # fmt: skip
    if content.self_calibration is not None:
        add(
            "self_calibration", confusion_figure(content.self_calibration),
            "The workflow on simulated campaigns",
            "What was hidden and what the verdict was, on campaigns simulated with this model, these inputs, "
            "channels and noise; counts.",
        )  # fmt: skip


def _held_out_words(residuals: ResidualSet) -> str:
    """Return a sentence on which trials are held out."""
    names = [item.trial.name for item in residuals.trials if item.trial.held_out]
    if not names:
        return "No trial is held out."
    return f"Held out: {listing(names)}; nothing but release and zero was fitted to {_them(names)}."


def _them(names: Sequence[str]) -> str:
    return "it" if len(names) == 1 else "them"


def after_of(investigation: Investigation):  # type: ignore[no-untyped-def]
    """Return the residuals with the effect where one was added, else None."""
    if investigation.fit is None or not investigation.fit.candidate.terms:
        return None
    return investigation.after


def draw(figures: dict[str, ReportFigure]) -> dict[str, bytes]:
    """Return the figures as SVG."""
    return {name: to_svg(item.figure) for name, item in figures.items()}
