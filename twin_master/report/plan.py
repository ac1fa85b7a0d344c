"""Pictures of plans: what is done where on triangles of beliefs, and which sensors tell most."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.tri import Triangulation

from reporting import figures as style
from reporting.arrays import Float
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy

_COLORS = ("#56B4E9", "#E69F00", style.PRESENT, style.DECISION, style.PREDICTION, "#F0E442", style.PAST)
_ROWS = 60
"""Rows of points in a triangle."""


def triangle_of(model: GraphicalModel, place: int) -> Float:
    """Return three beliefs (3, S) of one factor: at its lowest level, at its highest, and not known.

    The other factors are at their lowest levels.
    """
    corners = []
    for own in (0, -1, slice(None)):
        belief = np.zeros(model.states.shape)
        levels: list[Any] = [0] * belief.ndim
        levels[place] = own
        belief[tuple(levels)] = 1.0
        corners.append(belief.ravel() / belief.sum())
    return np.array(corners)


@style.publication_style()
def plan_figure(policy: BeliefPolicy, model: GraphicalModel) -> Figure:
    """Draw for each factor of the state what a policy does between three beliefs, the control by colour."""
    factors, count = model.states.names[:3], len(model.controls)
    share = np.array([(i, j) for i in range(_ROWS + 1) for j in range(_ROWS + 1 - i)]) / _ROWS
    weight = np.column_stack((1.0 - share.sum(axis=1), share))
    x, y = (weight @ np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.866]])).T
    mesh = Triangulation(x, y)
    colors = [_COLORS[number % len(_COLORS)] for number in range(count)]
    figure, (row,) = style.panels(1, len(factors), 3.2, 0.4, 0.45, left=0.03, right=0.97)
    centre = weight[mesh.triangles].mean(axis=1)
    for place, (axes, name) in enumerate(zip(row, factors, strict=True)):
        chosen = policy.decide(centre @ triangle_of(model, place))
        axes.tripcolor(mesh, facecolors=chosen, cmap=ListedColormap(colors), vmin=-0.5, vmax=count - 0.5)
        for text, at in (("lowest", (0.0, -0.06)), ("highest", (1.0, -0.06)), ("not known", (0.5, 0.9))):
            axes.text(*at, text, ha="center", va="top" if at[1] < 0.0 else "bottom")
        axes.set_aspect("equal")
        axes.set_axis_off()
        style.panel_label(axes, "abc"[place], f"Belief of {name}")
    handles = [
        Rectangle((0, 0), 1, 1, facecolor=color, label=name)
        for name, color in zip(model.controls, colors, strict=True)
    ]
    figure.legend(handles=handles, loc="lower center", ncols=count, handlelength=1.4)
    return figure


@style.publication_style()
def design_figure(
    information: Sequence[float], of_all: float, names: Sequence[str], places: Float | None,
    chosen: Sequence[int], outlines: Sequence[Float],
) -> Figure:  # fmt: skip
    """Draw what the chosen sensors tell together, and where they are on a wing from above.

    Parameters
    ----------
    information : sequence of float
        Of the first, the first two, ... of them [bit].
    of_all : float
        Of all candidates [bit].
    names : sequence of str
        Of the chosen sensors.
    places : (G, 2) or None
        Of all sensors [m]; None where they are not known.
    chosen : sequence of int
        Sensors, from 0.
    outlines : sequence of (N, 2)
        What is drawn below the sensors [m].
    """
    figure = style.new_figure(2.6)
    ratios = [1] if places is None else [2, 3]
    panels = figure.subplots(1, len(ratios), squeeze=False, width_ratios=ratios)[0]
    number = np.arange(1, len(information) + 1)
    panels[0].plot(number, information, "o-", color=style.PRESENT)
    panels[0].axhline(of_all, color=style.REFERENCE, linestyle="--", label="all candidates")
    panels[0].set(xlabel="sensors", ylabel="expected information [bit]", ylim=(0.0, None))
    panels[0].set_xticks(number, names, rotation=60)
    panels[0].legend(loc="lower right")
    if places is not None:
        for outline in outlines:
            panels[1].fill(*outline.T, facecolor="none", edgecolor=style.REFERENCE, linewidth=0.8)
        panels[1].plot(*places.T, "o", color=style.REFERENCE, markersize=3.5)
        panels[1].plot(*places[list(chosen)].T, "o", color=style.PRESENT, markersize=6)
        for rank, sensor in enumerate(chosen, start=1):
            panels[1].annotate(str(rank), places[sensor], (3, 3), textcoords="offset points")
        panels[1].set_aspect("equal")
        panels[1].set_axis_off()
    figure.tight_layout()
    return figure
