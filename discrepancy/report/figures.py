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
from discrepancy.judgement.separability import CONFUSION_DISTANCE, DETECTION_DISTANCE, Separability
from discrepancy.location.residuals import ResidualSet
from discrepancy.proof_record import Scores
from discrepancy.report import residual_figures
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.report.load_and_time_figures import load_figure, time_line_figure
from discrepancy.report.motion_figures import (
    backbone_figure,
    history_figure,
    spectrum_figure,
    worst_record,
)
from discrepancy.report.text import (
    WORDS,
    added_label,
)
from discrepancy.report.verdict_sentences import force_sentence, proof_scores
from discrepancy.self_calibration import SelfCalibration
from discrepancy.workflow import Investigation
from fe.wing.design import WingDesign
from reporting.pages import figures as style
from reporting.pages.page import ReportFigure
from reporting.words import listing

_LARGEST_DISTANCE = 1e4


def pit_figure(scores: Mapping[str, Scores]) -> Figure | None:
    """Draw histograms of probability integral transforms, a panel for each model; None without any.

    Parameters
    ----------
    scores : mapping of str to Scores
        The scores of one or two models, by the title of the panel.
    """
    if not scores:
        return None
    figure, grid = residual_figures.new_panels(1, 2, 1.9)
    all_axes = style.keep_first_panels(grid, len(scores))
    highest = max(max(score.pit) for score in scores.values())
    has_two_panels = len(scores) > 1
    for panel, (axes, (title, score)) in enumerate(zip(all_axes, scores.items(), strict=True)):
        bin_count = len(score.pit)
        is_before = panel == 0 and has_two_panels
        axes.bar(
            (np.arange(bin_count) + 0.5) / bin_count,
            score.pit,
            0.94 / bin_count,
            color=style.PREDICTION if is_before else style.PAST,
            alpha=0.75,
        )
        axes.axhline(1.0 / bin_count, color=style.OBSERVED, lw=0.9, ls="--")
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.set(
            xlim=(0.0, 1.0),
            ylim=(0.0, 1.1 * max(highest, 0.16)),
            xlabel="probability integral transform",
        )
        axes.set_ylabel("share of samples" if panel == 0 else "")
        axes.set_title(f"{'ab'[panel]}  {title}" if has_two_panels else title)
    return figure


def _heat_map_figure(
    values: FloatArray,
    row_identifiers: Sequence[str],
    column_identifiers: Sequence[str],
    norm: Normalize,
    texts: NDArray[np.str_] | None = None,
) -> tuple[Figure, Axes, AxesImage]:
    """Return a figure with a heat map of square cells, its axes, and the image for a colour bar.

    Parameters
    ----------
    values : (R, C) ndarray
        Values of the cells, which are shown as colours; nan for an empty cell.
    row_identifiers, column_identifiers : sequence of str
        Identifiers of the R rows and the C columns, such as "dry_friction"; the labels of the axes
        show a space for each underscore.
    norm : Normalize
        Colour scale.
    texts : (R, C) ndarray of str, optional
        Texts that are written into the cells.
    """
    # in inches: a row must hold its label, the margin the slanted labels of the columns
    height = 0.175 * len(row_identifiers) + 1.6
    figure, ((axes,),) = residual_figures.new_panels(1, 1, height)
    row_labels = [identifier.replace("_", " ") for identifier in row_identifiers]
    column_labels = [identifier.replace("_", " ") for identifier in column_identifiers]
    image = residual_figures.draw_heat_map(
        axes, values, (row_labels, column_labels), norm, slant=55, texts=texts
    )
    axes.set_aspect("equal", anchor="W")
    axes.tick_params(labelsize=6.5)
    return figure, axes, image


def separability_figure(separability: Separability) -> Figure | None:
    """Draw a map of the squared distances between effects, which say how well data tell them apart.

    A cross marks each pair that these data cannot tell apart. The result is None with fewer than
    two effects.
    """
    names = separability.identifiers
    if len(names) < 2:
        return None
    # sort the effects so that members of a confusion group are next to each other
    group_numbers: dict[str, int] = {}
    for group_number, group in enumerate(separability.groups):
        for name in group:
            group_numbers.setdefault(name, group_number)
    no_group = len(separability.groups)
    order = sorted(
        range(len(names)), key=lambda index: (group_numbers.get(names[index], no_group), index)
    )
    distance = separability.distance[np.ix_(order, order)]
    cells = np.clip(distance, 0.3, _LARGEST_DISTANCE)
    np.fill_diagonal(cells, np.nan)
    labels = [names[index] for index in order]
    figure, axes, image = _heat_map_figure(cells, labels, labels, LogNorm(1.0, _LARGEST_DISTANCE))
    for row, column in zip(*np.nonzero(distance < CONFUSION_DISTANCE), strict=True):
        if row != column:
            axes.plot(column, row, "x", color=style.PREDICTION, ms=4.0, mew=1.1)
    cell_width = 1.0 / len(names)
    bar_axes = axes.inset_axes((1.0 + 0.4 * cell_width, 0.0, 0.4 * cell_width, 1.0))
    bar = style.color_bar(figure, image, "squared distance d²", cax=bar_axes)
    style.plain_powers(bar.yaxis, (1.0,))
    bar.axhline(CONFUSION_DISTANCE, color=style.PREDICTION, lw=1.2)
    bar.axhline(DETECTION_DISTANCE, color="white", lw=1.2)
    return figure


def confusion_figure(self_calibration: SelfCalibration) -> Figure:
    """Draw the confusion matrix of the workflow: hidden effects (rows) against verdicts (columns).

    Colours show the fraction of each row, texts the numbers of simulated campaigns.
    """
    rows, columns, counts = self_calibration.confusion()
    row_sums = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    fractions = np.where(counts > 0, counts / row_sums, np.nan)
    texts = np.where(counts > 0, counts.astype(str), "")
    figure, axes, _ = _heat_map_figure(fractions, rows, columns, Normalize(0.0, 1.0), texts)
    axes.set(xlabel="verdict", ylabel="what was hidden")
    return figure


Pack = Callable[[Path, Path], str]
"""Function that packs an FMU: from `patch.json` and the FMU's path to a sentence about it."""


@dataclass(frozen=True)
class ReportInput:
    """Content of the report and of the files that are written with it.

    Attributes
    ----------
    investigation : Investigation
        The investigation with its verdict.
    origin : Origin
        Model, campaign and program that it comes from.
    separability : Separability or None
        Which effects the campaign can distinguish.
    self_calibration : SelfCalibration or None
        The workflow on simulated campaigns, if it was asked for.
    design : WingDesign or None
        Design of a wing, for the map of residuals.
    intervals : sequence of sequence of PrimitiveInterval
        Intervals of the patch's numbers, by effect; empty without a patch.
    fmu : str
        Name of the patched FMU, or why there is none; empty if none is needed.
    pack : callable, optional
        Makes the patched FMU, and returns a sentence about it; called if an effect is named.
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
    """Return the sentence on the unit of the rms residuals in figures: the noise, if recorded."""
    unknown = [name for name in before.channel_names if name not in before.recorded_channels]
    if not unknown:
        return "1 is noise."
    return (
        f"1 is noise; for {listing(unknown)}, without a noise record, 1 is the residual of the "
        "unchanged model in fitted trials."
    )


def _sentence_on_held_out_trials(names: Sequence[str], *, has_both: bool) -> str:
    """Return which trials are held out, and that two panels have one scale if there are two."""
    if names:
        them = "them" if len(names) > 1 else "it"
        text = f"Held out: {listing(names)}; only release and zero were fitted to {them}."
    else:
        text = "No trial is held out."
    return f"{text} Both panels have one scale." if has_both else text


@style.publication_style()
def report_figures(content: ReportInput) -> dict[str, ReportFigure]:
    """Draw every figure that these data allow, by name; their captions are in `words.toml`.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    """
    figures: dict[str, ReportFigure] = {}
    investigation = content.investigation
    missing = investigation.missing
    if missing is not None:
        sentence = force_sentence(missing.at_port)
        law = "The law is the orange line. " if missing.law else ""
        drawing = missing_force_figure(missing)
        _add_figure(figures, "missing_force", drawing, sentence=sentence, law=law)
    if investigation.before is not None:
        _add_residual_figures(figures, content, investigation.before)
    if investigation.proof is not None:
        before, after, trials = proof_scores(investigation.proof)
        scores = {"unchanged model": before, "with the effect": after}
        scores_with_pit = {title: score for title, score in scores.items() if score.pit}
        trials_text = (
            "Held-out trials." if trials == "held-out" else "Fitted trials: none is held out."
        )
        _add_figure(figures, "pit", pit_figure(scores_with_pit), where=trials_text)
    if content.separability is not None:
        figure = separability_figure(content.separability)
        _add_figure(figures, "separability", figure, confused=f"{CONFUSION_DISTANCE:g}")
    if content.self_calibration is not None:
        _add_figure(figures, "self_calibration", confusion_figure(content.self_calibration))
    return figures


def _add_figure(
    figures: dict[str, ReportFigure], name: str, figure: Figure | None, **fields: object
) -> None:
    """Add a figure, if there is one, with the caption that these fields fill in."""
    if figure is not None:
        figures[name] = WORDS.figure(name, figure, **fields)


def _add_residual_figures(
    figures: dict[str, ReportFigure], content: ReportInput, before: ResidualSet
) -> None:
    """Add the figures of the residuals of the model without and with the added effect."""
    investigation = content.investigation
    after = investigation.after if added_label(investigation) else None
    held_out = [fitted.trial.name for fitted in before.trials if fitted.trial.held_out]
    scale = {
        "beside": _sentence_on_held_out_trials(held_out, has_both=after is not None),
        "unit": _unit_of_noise(before),
    }
    if content.design is not None:
        figure = residual_figures.planform_figure(before, after, content.design)
        _add_figure(figures, "residual_map", figure, **scale)
    _add_figure(figures, "residual_table", residual_figures.heat_figure(before, after), **scale)
    _add_figure(figures, "load", load_figure(before, after))
    windows = investigation.verdict.windows
    remark = ""
    if any(window.with_effect for window in windows):
        remark = " The thin bars below are the residuals of the hypothesis."
    _add_figure(figures, "time_line", time_line_figure(windows), left=remark)
    worst = worst_record(before.trials)
    if worst is not None:
        trial = before.trials[worst.trial].trial
        role = "held out" if trial.held_out else "fitted"
        figure = history_figure(before, after, worst)
        _add_figure(figures, "history", figure, channel=worst.channel, trial=trial.name, role=role)
        _add_figure(figures, "spectrum", spectrum_figure(before, after, worst))
    backbone = backbone_figure(before, after)
    if backbone is not None:
        figure, channel = backbone
        _add_figure(figures, "backbone", figure, channel=channel)
