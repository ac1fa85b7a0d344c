"""The dynamic decision network for a few steps (Kapteyn et al. 2021, Fig. 2 and eqs. (1)-(4), (37)-(39))."""

from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon, Rectangle

from reporting import figures as style

_PAST_SLICES = 2
_SLICES = 4
_SPACING = 2.45
_RADIUS = 0.30
_SEEN = "#dddddd"
_PLACES = {
    "S": (0.0, 2.3),
    "O": (0.0, 1.2),
    "D": (0.0, 0.0),
    "Q": (0.75, -1.15),
    "R": (0.0, -2.3),
    "U": (1.0, 1.2),
}
_LANES = {
    "S": "physical state\n(not seen)",
    "O": "observation",
    "D": "digital state",
    "Q": "quantity\nof interest",
    "R": "reward",
}


@dataclass(frozen=True)
class Edge:
    """An arrow of the network from one node to another, each named by letter and slice.

    A decision follows the policy: in the mission a control is decided in the step before, as it is flown; in
    the prediction by the state of its own step.
    """

    start: tuple[str, int]
    end: tuple[str, int]
    decision: bool = False

    @property
    def flown(self) -> bool:
        """Whether it is a decision of the mission, not of the prediction."""
        return self.decision and self.start[1] < self.end[1]


def network_nodes() -> list[tuple[str, int]]:
    """Return letter and slice of each node; slice 1 is the present, where physical state and data end."""
    return [
        (letter, number)
        for number in range(_SLICES)
        for letter in _PLACES
        if number < _PAST_SLICES or letter in "DQRU"
    ]


def network_edges() -> list[Edge]:
    """Return the arrows: one for each dependence in the factors of the joint distribution."""
    nodes = set(network_nodes())
    edges = []
    for number in range(_SLICES):
        candidates = [
            Edge(("S", number), ("O", number)),
            Edge(("O", number), ("D", number)),
            Edge(("D", number), ("Q", number)),
            Edge(("D", number), ("R", number)),
            Edge(("Q", number), ("R", number)),
            Edge(("U", number), ("O", number)),
            Edge(("U", number), ("Q", number)),
            Edge(("U", number), ("R", number)),
            Edge(("O", number), ("R", number)),
            Edge(("D", number), ("U", number + (number < _PAST_SLICES)), decision=True),
            Edge(("S", number), ("S", number + 1)),
            Edge(("D", number), ("D", number + 1)),
            Edge(("U", number), ("S", number + 1)),
            Edge(("U", number), ("D", number + 1)),
        ]
        edges += [edge for edge in candidates if edge.start in nodes and edge.end in nodes]
    return edges


def network_figure() -> Figure:
    """Draw the network for the last past step, the present and two predicted steps."""
    with style.publication_style():
        figure = style.new_figure(4.55)
        axes = figure.add_axes((0.0, 0.075, 1.0, 0.925))
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(-2.35, _SPACING * (_SLICES - 1) + 1.75)
        axes.set_ylim(-2.85, 3.3)
        _background(axes)
        for edge in network_edges():
            _arrow(axes, edge)
        for letter, number in network_nodes():
            _node(axes, letter, number)
        handles: list[Patch | Line2D] = [
            Patch(facecolor=_SEEN, edgecolor=style.TRUTH, label="known"),
            Patch(facecolor="white", edgecolor=style.TRUTH, label="inferred"),
            Line2D(
                [], [], color=style.OBSERVED, marker=">", markersize=3.5, linewidth=1.0, label="depends on"
            ),
            Line2D(
                [],
                [],
                color=style.DECISION,
                linestyle=(0, (3, 2)),
                linewidth=1.3,
                label="policy in the prediction",
            ),
            Line2D([], [], color=style.DECISION, linewidth=1.3, label="decides what is flown next"),
        ]
        figure.legend(handles=handles, loc="lower center", ncols=len(handles), bbox_to_anchor=(0.5, 0.0))
    return figure


def _position(letter: str, number: int) -> tuple[float, float]:
    x, y = _PLACES[letter]
    return x + _SPACING * number, y


def _color(number: int) -> str:
    if number < _PAST_SLICES - 1:
        return style.PAST
    return style.PRESENT if number == _PAST_SLICES - 1 else style.PREDICTION


def _background(axes: Axes) -> None:
    border = _SPACING * (_PAST_SLICES - 0.5) + 0.16
    right = axes.get_xlim()[1]
    axes.add_patch(
        Rectangle((border, -2.85), right - border, 6.15, facecolor=style.PREDICTION, alpha=0.06, linewidth=0)
    )
    names = ("past", "present", "prediction", "prediction")
    steps = (r"$t_c - 1$", r"$t_c$", r"$t_c + 1$", r"$t_c + 2$")
    for number, (name, step) in enumerate(zip(names, steps, strict=True)):
        x = _SPACING * number
        axes.text(
            x,
            2.95,
            f"{name}, {step}",
            ha="center",
            va="center",
            color=_color(number),
            fontweight="bold",
            parse_math=True,
        )
    for letter, lane in _LANES.items():
        axes.text(-2.28, _PLACES[letter][1], lane, ha="left", va="center", color=style.OBSERVED)
    axes.text(_position("U", 1)[0], 1.68, "control", ha="center", va="center", color=style.OBSERVED)


def _arrow(axes: Axes, edge: Edge) -> None:
    curvature = 0.0
    if edge.start[0] == "O" and edge.end[0] == "R":
        curvature = 0.70
    if edge.flown:
        curvature = 0.12  # clear of the observation
    axes.add_patch(
        FancyArrowPatch(
            _position(*edge.start), _position(*edge.end), arrowstyle="-|>", mutation_scale=8.0,
            connectionstyle=f"arc3,rad={curvature}", shrinkA=15.5, shrinkB=16.5,
            linewidth=1.3 if edge.decision else 0.9,
            linestyle=(0, (3, 2)) if edge.decision and not edge.flown else "-",
            color=style.DECISION if edge.decision else style.OBSERVED, zorder=1.0,
        )
    )  # fmt: skip


def _node(axes: Axes, letter: str, number: int) -> None:
    x, y = _position(letter, number)
    known = letter == "O" or (letter == "U" and number < _PAST_SLICES)
    hidden = letter == "S"
    outline: dict[str, Any] = {
        "facecolor": _SEEN if known else "white",
        "edgecolor": style.TRUTH if hidden else _color(number),
        "linewidth": 1.0 if hidden else 1.7,
        "linestyle": ":" if hidden else "-",
        "zorder": 2.0,
    }
    if letter == "U":
        side = 0.27
        axes.add_patch(Rectangle((x - side, y - side), 2 * side, 2 * side, **outline))
    elif letter == "R":
        tip = 0.37
        axes.add_patch(Polygon([(x - tip, y), (x, y + tip), (x + tip, y), (x, y - tip)], **outline))
    else:
        axes.add_patch(Circle((x, y), _RADIUS, **outline))
    offset = number - (_PAST_SLICES - 1)
    index = "t_c" if offset == 0 else f"t_c{offset:+d}"
    axes.text(
        x,
        y - 0.01,
        f"${letter}_{{{index}}}$",
        ha="center",
        va="center",
        fontsize=6.8,
        zorder=3.0,
        parse_math=True,
    )
