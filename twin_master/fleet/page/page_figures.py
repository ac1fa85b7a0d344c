"""Figures of groups of assets: maps of their health, its course over time, their returns."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from reporting.arrays import Float
from reporting.pages import figures as style
from twin_master.fleet.reading import severity
from twin_master.pictures import draw_states_of_twins
from twin_master.report.reading import NORMAL_95, printed_factors
from twin_master.scenario.schema import Scenario

_LETTERS = "abcdefgh"
_MAPS_IN_A_ROW = 2


@style.publication_style()
def map_figure(scenario: Scenario, mean: Float, failed: int) -> Figure:
    """Draw a group's assets as a map, with a panel for each factor of the state.

    In each panel one cell for each asset has the colour of the factor's value. The cells are in
    descending order of severity of damage, row by row; assets that failed in flight, and assets
    without an estimated state, are grey.

    Parameters
    ----------
    mean : (B, F) array
        The last mean states, in SI units; NaN if no state of the model explains the observations of
        an asset.
    failed : int
        The number of assets that failed in flight.
    """
    factors = printed_factors(scenario)
    count = len(mean) + failed
    # More columns than rows, because a panel is wider than it is high.
    columns = max(1, int(np.ceil(np.sqrt(1.6 * count))))
    rows = -(-count // columns)  # rounded up
    order = np.argsort(-severity(scenario, mean), kind="stable")
    is_asset = np.where(np.arange(rows * columns) < count, 1.0, np.nan).reshape(rows, columns)
    panel_rows = -(-len(factors) // _MAPS_IN_A_ROW)
    figure, grid = style.panels(
        panel_rows,
        min(len(factors), _MAPS_IN_A_ROW),
        0.4 + 1.9 * panel_rows,
        0.3,
        0.1,
        left=0.06,
        right=0.99,
        hspace=0.25,
        wspace=0.2,
    )
    panels = style.keep_first_panels(grid, len(factors))
    for number, (factor, axes) in enumerate(zip(factors, panels, strict=True)):
        cells = np.full(rows * columns, np.nan)
        cells[: len(mean)] = factor.scale * mean[order, number]
        axes.imshow(
            is_asset, cmap="Greys", vmin=0.0, vmax=2.0, aspect="auto", interpolation="nearest"
        )  # the grey background
        image = axes.imshow(
            np.ma.masked_invalid(cells.reshape(rows, columns)),
            cmap=style.LEVELS,
            vmin=factor.levels[0],
            vmax=factor.levels[-1],
            aspect="auto",
            interpolation="nearest",
        )
        axes.set_xticks([])
        axes.set_yticks([])
        style.panel_label(axes, _LETTERS[number % len(_LETTERS)], factor.title)
        # The scale stands on the left, where a narrow screen shows it.
        style.color_bar(
            figure, image, factor.unit, ax=axes, location="left", pad=0.02, fraction=0.03
        )
    return figure


@style.publication_style()
def course_figure(scenario: Scenario, mean: Float, state: Float) -> Figure:
    """Draw the states of B assets over T steps, with a panel for each factor of the state.

    Parameters
    ----------
    mean : (B, T, F) array
        The mean states, in SI units; NaN in steps that were not flown.
    state : (B, T, F) array
        The true states, in SI units; NaN where they are not known.
    """
    factors = printed_factors(scenario)
    figure, (panels,) = style.panels(1, len(factors), 2.4, 0.3, 0.45, wspace=0.25)
    for number, (factor, axes) in enumerate(zip(factors, panels, strict=True)):
        draw_states_of_twins(
            axes, factor.scale * mean[:, :, number], factor.scale * state[:, :, number]
        )
        axes.set_xlabel(scenario.mission.step_name)
        axes.set_ylabel(f"{factor.title} ({factor.unit})")
        style.panel_label(axes, _LETTERS[number % len(_LETTERS)])
    return figure


_HEIGHT_OF_GROUP = 0.42
"""Height of the row of a group in the figure of returns [in]."""
_LEAST_WIDTH = 1e-3
"""Half the width of the figure of returns, as a fraction of the returns, at least."""


@style.publication_style()
def returns_figure(returns: Mapping[str, Float]) -> Figure:
    """Draw the discounted returns of the flights of groups, with a row for each group.

    Bands hold 90 % and 50 % of the flights, the mean has its 95 % interval. Groups without a return
    are left out.

    Parameters
    ----------
    returns : mapping of str to (B,) array
        The returns of the flights of each group by its name.
    """
    groups = {name: values for name, values in returns.items() if len(values)}
    height = 0.75 + _HEIGHT_OF_GROUP * len(groups)
    figure, ((axes,),) = style.panels(1, 1, height, 0.2, 0.45, left=0.3)
    axes.use_sticky_edges = False  # else the leftmost band would end at the axis
    for row, values in enumerate(groups.values()):
        low, lower_quartile, upper_quartile, high = np.quantile(values, [0.05, 0.25, 0.75, 0.95])
        # both bands are transparent: where they overlap, the central half of the flights is darker
        for begin, end in ((low, high), (lower_quartile, upper_quartile)):
            axes.barh(row, end - begin, left=begin, height=0.6, color=style.PRESENT, alpha=0.2)
        mean = float(values.mean())
        half_width = NORMAL_95 * float(values.std()) / np.sqrt(len(values))
        axes.errorbar(mean, row, xerr=half_width, fmt="D", color=style.PRESENT, capsize=3)
    axes.set_yticks(range(len(groups)), list(groups))
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_xlabel("return: rewards of a flight, discounted")
    axes.grid(axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    # widen the axis if it is so narrow that its numbers would hardly differ
    low, high = axes.get_xlim()
    middle = 0.5 * (low + high)
    half_width = max(0.5 * (high - low), _LEAST_WIDTH * abs(middle))
    axes.set_xlim(middle - half_width, middle + half_width)
    return figure
