"""What the report shows, and its figures with their captions, as far as the data allow them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from discrepancy.document import Origin
from discrepancy.files.verdict import PrimitiveInterval
from discrepancy.judgement.separability import CONFUSED, DETECTED, Separability
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.port_force import MissingForce
from discrepancy.proof_record import Scores
from discrepancy.self_calibration import SelfCalibration
from discrepancy.workflow import Investigation
from fe.wing.design import WingDesign
from reporting import figures as style
from reporting.page import ReportFigure
from reporting.words import listing

from . import residual_figures
from .motion_figures import backbone_figure, history_figure, spectrum_figure, worst_record
from .text import WORDS, added_label, force_sentence, motion_of, scored

_LARGEST_DISTANCE = 1e4


def pit_figure(scores: Mapping[str, Scores]) -> Figure | None:
    """Draw histograms of probability integral transforms; keys are titles, in order before and after."""
    if not scores:
        return None
    figure, grid = residual_figures.panels(1, 2, 1.9)
    cells = zip(style.keep_first_panels(grid, len(scores)), scores.items(), strict=True)
    top = max(max(item.pit) for item in scores.values())
    for number, (axes, (title, item)) in enumerate(cells):
        count = len(item.pit)
        axes.bar(
            (np.arange(count) + 0.5) / count, item.pit, 0.94 / count,
            color=style.PREDICTION if number == 0 and len(scores) > 1 else style.PAST, alpha=0.75,
        )  # fmt: skip
        axes.axhline(1.0 / count, color=style.OBSERVED, lw=0.9, ls="--")
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.1 * max(top, 0.16)), xlabel="probability integral transform")
        axes.set_ylabel("share of samples" if number == 0 else "")
        axes.set_title(f"{'ab'[number]}  {title}" if len(scores) > 1 else title)
    return figure


def _map_of_names(
    values: FloatArray, rows: Sequence[str], columns: Sequence[str], norm: Normalize,
    texts: NDArray[np.str_] | None = None,
) -> tuple[Figure, Axes, AxesImage]:  # fmt: skip
    """Return a figure with a map of square cells between names of effects."""
    figure, ((axes,),) = residual_figures.panels(1, 1, 0.175 * len(rows) + 1.6)
    words = ([name.replace("_", " ") for name in names] for names in (rows, columns))
    image = residual_figures.heat_map(axes, values, (next(words), next(words)), norm, 55, texts)
    axes.set_aspect("equal", anchor="W")
    axes.tick_params(labelsize=6.5)
    return figure, axes, image


def separability_figure(found: Separability) -> Figure | None:
    """Draw how well each effect can be told from each other one; None with fewer than two effects."""
    names = found.identifiers
    if len(names) < 2:
        return None
    # Members of a confusion group stand side by side.
    number = {name: at for at, group in reversed([*enumerate(found.groups)]) for name in group}
    order = sorted(range(len(names)), key=lambda n: (number.get(names[n], len(found.groups)), n))
    distance = found.distance[np.ix_(order, order)]
    table = np.clip(distance, 0.3, _LARGEST_DISTANCE)
    np.fill_diagonal(table, np.nan)
    labels = [names[n] for n in order]
    figure, axes, image = _map_of_names(table, labels, labels, LogNorm(1.0, _LARGEST_DISTANCE))
    for row, column in zip(*np.nonzero(distance < CONFUSED), strict=True):
        if row != column:
            axes.plot(column, row, "x", color=style.PREDICTION, ms=4.0, mew=1.1)
    cell = 1.0 / len(names)
    beside = axes.inset_axes((1.0 + 0.4 * cell, 0.0, 0.4 * cell, 1.0))
    bar = style.color_bar(figure, image, "squared distance d²", cax=beside)
    style.plain_powers(bar.yaxis, (1.0,))
    bar.axhline(CONFUSED, color=style.PREDICTION, lw=1.2)
    bar.axhline(DETECTED, color="white", lw=1.2)
    return figure


def confusion_figure(found: SelfCalibration) -> Figure:
    """Draw the confusion matrix of the workflow on simulated campaigns of this geometry."""
    rows, columns, counts = found.confusion()
    share = np.where(counts > 0, counts / np.maximum(counts.sum(axis=1, keepdims=True), 1), np.nan)
    texts = np.where(counts > 0, counts.astype(str), "")
    figure, axes, _ = _map_of_names(share, rows, columns, Normalize(0.0, 1.0), texts)
    axes.set(xlabel="verdict", ylabel="what was hidden")
    return figure


MOST_DOTS = 3000
"""Dots of a panel; of longer records some are left out evenly."""
MOST_TURNS = 400
"""Samples of the course in time: the stretch where the force is largest."""


def missing_force_figure(missing: MissingForce) -> Figure:
    """Draw a missing force and what is told of it, with its law and what is left where there is one."""
    parts = [("missing force", "force"), ("what is left", "left")][: 2 if missing.law else 1]
    what, place, rate = motion_of(missing.at_port)
    integral, state = ("displacement", "speed") if place else ("integral of the state", "state")
    along = (("position", ", ".join(filter(None, (integral, place)))), ("speed", f"{state}, {rate}"))
    every = slice(None, None, -(-sum(len(item.time) for item in missing.courses) // MOST_DOTS))
    strongest = max(missing.courses, key=lambda one: float(np.max(np.abs(one.force))))
    first = int(np.argmax(np.abs(strongest.force))) - MOST_TURNS // 2
    first = max(min(first, len(strongest.time) - MOST_TURNS), 0)
    stretch = slice(first, first + MOST_TURNS)
    figure, rows = residual_figures.panels(len(parts), 3, 2.4 * len(parts) + 0.5, sharey=True)
    for number, (row, (title, name)) in enumerate(zip(rows, parts, strict=True)):
        law = "law" if missing.law and name == "force" else ""
        for axes, (motion, label) in zip(row[:2], along, strict=True):
            _draw_over(axes, missing, motion, name, law, every)
            axes.set_xlabel(label)
        time, values = strongest.time[stretch], getattr(strongest, name)[stretch]
        reach = 2.0 * strongest.deviation[stretch]
        style.band(row[2], time, values - reach, values + reach, style.OBSERVED)
        row[2].plot(time, values, color=style.OBSERVED, lw=0.9)
        if law and strongest.law is not None:
            row[2].plot(time, strongest.law[stretch], "--", color=style.PREDICTION, lw=0.9)
        row[2].set_xlabel(f"time in {strongest.trial}, s")
        row[0].set_ylabel(f"{what}, {missing.at_port.unit}")
        for column, axes in enumerate(row):
            axes.axhline(0.0, color=style.REFERENCE, lw=0.6, zorder=0)
            axes.locator_params(axis="x", nbins=4)  # the integral of a state may have six digits
            axes.tick_params(labelleft=True)
            style.panel_label(axes, "abcdef"[3 * number + column], title)
    drawn = rows[0][0].get_legend_handles_labels()
    figure.legend(*drawn, loc="outside upper right", ncols=2, markerscale=3.0)
    return figure


def _draw_over(axes: Axes, missing: MissingForce, motion: str, name: str, law: str, every: slice) -> None:
    """Draw a force over a motion of its port, and its law where it has one."""

    def joined(key: str) -> FloatArray:
        parts = (getattr(item, key) for item in missing.courses)
        return np.concatenate([values[every] for values in parts if values is not None])

    along, values, deviation = map(joined, (motion, name, "deviation"))
    axes.vlines(
        along, values - deviation, values + deviation, color=style.OBSERVED, lw=0.4, alpha=style.BAND_OPACITY
    )
    axes.plot(along, values, ".", color=style.OBSERVED, ms=2.6, alpha=0.6, label="seen, ± 1 deviation")
    if law:
        axes.plot(along, joined(law), ".", color=style.PREDICTION, ms=1.2, alpha=0.7, label=missing.law)


Pack = Callable[[Path, Path], str]
"""(patch.json, FMU to be written) -> what to say about it."""


@dataclass(frozen=True)
class ReportInput:
    """All that the report shows, and what is written beside it.

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
    pack : callable, optional
        Makes the patched FMU, of patch.json and its own file, and says what of it; called where an effect is
        named.
    """

    investigation: Investigation
    origin: Origin
    separability: Separability | None = None
    self_calibration: SelfCalibration | None = None
    design: WingDesign | None = None
    intervals: Sequence[Sequence[PrimitiveInterval]] = ()
    fmu: str = ""
    pack: Pack | None = None


def _unit_of_noise(before: ResidualSet) -> str:
    """Return what the unit of sizes of residuals is."""
    unknown = [name for name in before.measured if name not in before.recorded]
    if not unknown:
        return "1 is noise."
    return (
        f"1 is noise; of {listing(unknown)}, whose noise is not recorded, what the model as it was leaves in "
        "fitted trials."
    )


@style.publication_style()
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
    if missing is not None:
        add("missing_force", missing_force_figure(missing), sentence=force_sentence(missing.at_port))
    if before is not None:
        names = [item.trial.name for item in before.trials if item.trial.held_out]
        scale = {
            "beside": WORDS.say("beside", names=names, both=after is not None),
            "unit": _unit_of_noise(before),
        }
        if content.design is not None:
            add("residual_map", residual_figures.planform_figure(before, after, content.design), **scale)
        add("residual_table", residual_figures.heat_figure(before, after), **scale)
        add("load", residual_figures.load_figure(before, after))
        with_effect = any(item.with_effect for item in verdict.windows)
        left = " The thin bars below are what the hypothesis leaves." if with_effect else ""
        add("time_line", residual_figures.time_line_figure(verdict.windows), left=left)
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
        add("pit", pit_figure(scores), where=where)
    if content.separability is not None:
        add("separability", separability_figure(content.separability), confused=CONFUSED)
    if content.self_calibration is not None:
        add("self_calibration", confusion_figure(content.self_calibration))
    return found
