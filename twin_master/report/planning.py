"""Figures of plans: the controls that a policy chooses for beliefs, and a choice of sensors."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from reporting.arrays import Float
from reporting.pages import figures as style
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy

_CONTROL_COLORS = (
    "#56B4E9",
    "#E69F00",
    style.PRESENT,
    style.DECISION,
    style.PREDICTION,
    "#F0E442",
    style.PAST,
)
_POINT_ROWS = 60
"""Number of intervals into which each side of a triangle of beliefs is divided."""
_MOST_FACTORS = 3
"""Largest number of factors that are drawn, each in its own triangle."""
_TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.866]])
"""Plane coordinates of the corners of a triangle: lowest level, highest level, level not known."""


def corner_beliefs(model: GraphicalModel, factor: int) -> Float:
    """Return the beliefs (3, S) at the corners of the triangle that is drawn for a factor.

    At the first corner the factor is certainly at its lowest level, at the second at its highest,
    and at the third all of its levels are equally probable. The other factors are at their lowest
    levels.

    Parameters
    ----------
    factor : int
        The index of the factor.
    """
    levels_of_factor: tuple[int | slice, ...] = (0, -1, slice(None))
    corners = []
    for level in levels_of_factor:
        belief = np.zeros(model.states.shape)
        possible_levels: list[int | slice] = [0] * belief.ndim
        possible_levels[factor] = level
        belief[tuple(possible_levels)] = 1.0
        corners.append(belief.ravel() / belief.sum())
    return np.array(corners)


@style.publication_style()
def plan_figure(policy: BeliefPolicy, model: GraphicalModel) -> Figure:
    """Draw the control that a policy chooses for each belief in a triangle of beliefs.

    A point of the triangle is a mixture of the beliefs at its corners; see `corner_beliefs`. Each
    of the first `_MOST_FACTORS` factors of the state has a triangle.

    Parameters
    ----------
    policy : BeliefPolicy
        The policy that chooses the control for a belief.
    """
    names = model.states.names[:_MOST_FACTORS]
    count = len(model.controls)
    colors = [_CONTROL_COLORS[number % len(_CONTROL_COLORS)] for number in range(count)]
    weights = _triangle_weights()
    x, y = (weights @ _TRIANGLE).T
    mesh = Triangulation(x, y)
    cell_weights = weights[mesh.triangles].mean(axis=1)  # (cells, 3), at the centres
    figure, (row,) = style.panels(1, len(names), 3.2, 0.4, 0.45, left=0.03, right=0.97)
    for factor, (axes, name) in enumerate(zip(row, names, strict=True)):
        chosen_controls = policy.decide(cell_weights @ corner_beliefs(model, factor))
        axes.tripcolor(
            mesh,
            facecolors=chosen_controls,
            edgecolors="face",
            cmap=ListedColormap(colors),
            vmin=-0.5,
            vmax=count - 0.5,
        )
        # The corners stand for the levels of the factor.
        axes.text(0.0, -0.06, "lowest", ha="center", va="top")
        axes.text(1.0, -0.06, "highest", ha="center", va="top")
        axes.text(0.5, 0.9, "not known", ha="center", va="bottom")
        axes.set_aspect("equal")
        axes.set_axis_off()
        style.panel_label(axes, "abc"[factor], f"Belief of {name}")
    handles = style.swatches(model.controls, colors)
    figure.legend(handles=handles, loc="lower center", ncols=count, handlelength=1.4)
    return figure


def _triangle_weights() -> Float:
    """Return the weights of the three corners at N points of a regular grid, an (N, 3) array."""
    fractions = []
    for i in range(_POINT_ROWS + 1):
        fractions += [(i, j) for j in range(_POINT_ROWS + 1 - i)]
    weights_of_two = np.array(fractions) / _POINT_ROWS
    return np.column_stack((1.0 - weights_of_two.sum(axis=1), weights_of_two))


@style.publication_style()
def design_figure(
    information: Sequence[float],
    information_of_all: float,
    names: Sequence[str],
    places: Float | None,
    chosen_sensors: Sequence[int],
    outlines: Sequence[Float],
) -> Figure:
    """Draw how much information chosen sensors give, and where they are on the structure.

    Parameters
    ----------
    information : sequence of float
        The expected information of the first chosen sensor, of the first two, and so on [bit].
    information_of_all : float
        The expected information of all candidates together [bit].
    names : sequence of str
        The names of the chosen sensors.
    places : (G, 2) array or None
        The positions of all sensors [m]; None if they are not known.
    chosen_sensors : sequence of int
        The indices of the chosen sensors, from 0.
    outlines : sequence of (N, 2) array
        The outlines that are drawn below the sensors [m].
    """
    figure = style.new_figure(2.6)
    width_ratios = [1] if places is None else [2, 3]
    panels = figure.subplots(1, len(width_ratios), squeeze=False, width_ratios=width_ratios)[0]

    # The information of the first n chosen sensors over n, and of all candidates
    axes = panels[0]
    number = np.arange(1, len(information) + 1)
    axes.plot(number, information, "o-", color=style.PRESENT)
    axes.axhline(information_of_all, color=style.REFERENCE, linestyle="--", label="all candidates")
    axes.set(xlabel="sensors", ylabel="expected information [bit]", ylim=(0.0, None))
    axes.set_xticks(number, names, rotation=60)
    axes.legend(loc="lower right")
    if places is not None:
        _draw_chosen_sensors(panels[1], places, chosen_sensors, outlines)
    figure.tight_layout()
    return figure


def _draw_chosen_sensors(
    axes: Axes, positions: Float, chosen_sensors: Sequence[int], outlines: Sequence[Float]
) -> None:
    """Draw sensors at positions (G, 2) [m] and outlines; chosen sensors have their ranks."""
    for outline in outlines:
        x, y = outline.T
        axes.fill(x, y, facecolor="none", edgecolor=style.REFERENCE, linewidth=0.8)
    x, y = positions.T
    axes.plot(x, y, "o", color=style.REFERENCE, markersize=3.5)
    x, y = positions[list(chosen_sensors)].T
    axes.plot(x, y, "o", color=style.PRESENT, markersize=6)
    for rank, sensor in enumerate(chosen_sensors, start=1):
        axes.annotate(str(rank), positions[sensor], (3, 3), textcoords="offset points")
    axes.set_aspect("equal")
    axes.set_axis_off()
