"""Why this name: evidence, what the campaign separates, calibration of predictions and workflow."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from discrepancy.judgement.separability import CONFUSED, DETECTED, Separability
from discrepancy.report.kit import name_cells, panels
from discrepancy.report.text import hypothesis_name, probability_text
from discrepancy.self_calibration import SelfCalibration
from discrepancy.verdict import ExplainedShare, Hypothesis, Scores
from reporting.figures import LEVELS, OBSERVED, PAST, PREDICTION, REFERENCE, new_figure, publication_style

SHOWN_HYPOTHESES = 8
LEAST_PROBABILITY = 1e-12
"""Probabilities below are drawn at the left end of the scale."""
_LARGEST_DISTANCE = 1e4


def evidence_figure(hypotheses: Sequence[Hypothesis]) -> Figure:
    """Draw the probabilities of the best hypotheses on a logarithmic scale, 'none' always among them."""
    shown = list(hypotheses[:SHOWN_HYPOTHESES])
    none = next((item for item in hypotheses if not item.effects), None)
    if none is not None and none not in shown:
        shown.append(none)
    names = [hypothesis_name(item) for item in shown]
    names = [name.replace(" + ", "\n+ ", 1) if len(name) > 38 else name for name in names]  # in two lines
    height = 0.3 * len(shown) + 0.8
    with publication_style():
        figure = new_figure(height)
        longest = max(len(line) for name in names for line in name.split("\n"))
        left = min(0.03 + 0.0092 * longest, 0.5)
        axes = figure.add_axes((left, 0.46 / height, 0.80 - left, 1.0 - 0.76 / height))
        columns = axes.get_yaxis_transform()
        reach = 1.0 / (0.80 - left)  # of the figure's width, in widths of the axes
        for row, item in enumerate(shown):
            value = max(item.probability, LEAST_PROBABILITY)
            colour = PAST if row == 0 else OBSERVED
            axes.plot([LEAST_PROBABILITY, value], [row, row], color=colour, lw=1.6 if row == 0 else 1.0)
            beyond = item.probability < LEAST_PROBABILITY
            axes.plot(value, row, "<" if beyond else "o", color=colour, ms=5.0, clip_on=False)
            gain = "" if none is None else _signed(item.log_evidence - none.log_evidence)
            for place, text in ((0.095, probability_text(item.probability)), (0.185, gain)):
                axes.text(
                    1.0 + reach * place, row, text, transform=columns, va="center", ha="right", fontsize=7.0
                )
        for place, text in ((0.095, "p"), (0.185, "ln B")):
            axes.text(
                1.0 + reach * place, -0.95, text, transform=columns, va="center", ha="right", fontsize=7.0,
                fontweight="bold",
            )  # fmt: skip
        axes.axvline(0.95, color=REFERENCE, lw=0.8, ls=":")
        axes.set_xscale("log")
        axes.set_xlim(LEAST_PROBABILITY, 1.0)
        axes.set_ylim(len(shown) - 0.5, -0.6)
        axes.set_yticks(range(len(shown)), names)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("probability among the hypotheses compared")
    return figure


def _signed(value: float) -> str:
    if value == 0.0:
        return "0"
    text = f"{value:+,.0f}" if abs(value) >= 1000.0 else f"{value:+.1f}"
    return text.replace("-", "\N{MINUS SIGN}")


def shares_figure(explained: ExplainedShare) -> Figure:
    """Draw one bar of the shares of effect, remainder and noise."""
    rows = (
        ("effect", explained.effect, PREDICTION),
        ("remainder", explained.remainder, PAST),
        ("noise", explained.noise, REFERENCE),
    )
    with publication_style():
        figure = new_figure(0.9)
        axes = figure.add_axes((0.03, 0.45, 0.94, 0.25))
        at = 0.0
        for name, share, colour in rows:
            label = f"{name} {100.0 * share:.0f} %"
            axes.barh(0.0, share, left=at, color=colour, height=1.0, label=label)
            at += share
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False, fontsize=7.0)
        axes.set_xlim(0.0, 1.0)
        axes.set_ylim(-0.5, 0.5)
        axes.set_yticks([])
        axes.set_xlabel("share of the mean square")
    return figure


def pit_figure(scores: Mapping[str, Scores]) -> Figure:
    """Draw histograms of probability integral transforms; keys are titles, in order before and after."""
    with publication_style():
        figure, (row,) = panels(1, 2, 1.9, 0.87, 0.22, left=0.09, wspace=0.18)
        for spare in row[len(scores) :]:
            spare.remove()
        top = max(max(item.pit) for item in scores.values())
        for number, (axes, (title, item)) in enumerate(zip(row, scores.items(), strict=False)):
            count = len(item.pit)
            axes.bar(
                (np.arange(count) + 0.5) / count, item.pit, 0.94 / count,
                color=PREDICTION if number == 0 and len(scores) > 1 else PAST, alpha=0.75,
            )  # fmt: skip
            axes.axhline(1.0 / count, color=OBSERVED, lw=0.9, ls="--")
            axes.set_ylim(0.0, 1.1 * max(top, 0.16))
            axes.set_xlim(0.0, 1.0)
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.set_xlabel("probability integral transform")
            axes.set_ylabel("share of samples" if number == 0 else "")
            axes.set_title(f"{'ab'[number]}  {title}" if len(scores) > 1 else title, loc="left")
    return figure


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
    labels = [names[n].replace("_", " ") for n in order]
    height = 0.175 * len(labels) + 1.55
    with publication_style():
        figure = new_figure(height)
        width = min(0.175 * len(labels) / 7.2 + 0.02, 0.6)
        axes = figure.add_axes((0.26, 1.3 / height, width, 1.0 - 1.4 / height))
        image = axes.imshow(np.ma.masked_invalid(table), cmap=LEVELS, norm=LogNorm(1.0, _LARGEST_DISTANCE))
        name_cells(axes, labels, labels, 55)
        axes.tick_params(labelsize=6.5)
        for row, column in zip(*np.nonzero(distance < CONFUSED), strict=True):
            if row != column:
                axes.plot(column, row, "x", color=PREDICTION, ms=4.0, mew=1.1)
        box = axes.get_position()
        side = figure.add_axes((box.x1 + 0.03, box.y0, 0.018, min(box.height, 2.2 / height)))
        bar = figure.colorbar(image, cax=side)
        bar.set_label("d², squared distance in noise deviations")
        bar.outline.set_linewidth(0.5)
        bar.ax.axhline(CONFUSED, color=PREDICTION, lw=1.2)
        bar.ax.axhline(DETECTED, color="white", lw=1.2)
    return figure


def confusion_figure(found: SelfCalibration) -> Figure:
    """Draw the confusion matrix of the workflow on simulated campaigns of this geometry."""
    rows, columns, counts = found.confusion()
    height = 0.19 * len(rows) + 1.75
    with publication_style():
        figure = new_figure(height)
        width = min(0.0268 * len(columns), 0.66)
        axes = figure.add_axes((0.27, 1.35 / height, width, 1.0 - 1.5 / height))
        share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        axes.imshow(np.where(counts > 0, share, np.nan), cmap=LEVELS, vmin=0.0, vmax=1.0, aspect="auto")
        for (row, column), value in np.ndenumerate(counts):
            if value:
                axes.text(
                    column, row, str(value), ha="center", va="center", fontsize=6.5,
                    color="white" if share[row, column] < 0.6 else "black",
                )  # fmt: skip
        name_cells(
            axes, (name.replace("_", " ") for name in rows), (name.replace("_", " ") for name in columns), 55
        )
        axes.tick_params(labelsize=6.5)
        axes.set_ylabel("what was hidden")
        axes.set_xlabel("verdict")
    return figure
