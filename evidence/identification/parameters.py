"""Free numbers of a wing design: their location in the design and their prior.

A parameter reads and writes one number in the content of a design, a nested dictionary as TOML
gives it. Most parameters are at a path, and one number may stand at several places, as that of all
webs does. The positions of the gauges follow from a few numbers: two straight rows, the second with
two clusters.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.wing.design import WingDesign, parse_design

from .errors import IdentificationError

FloatArray = NDArray[np.float64]
Content = dict[str, object]
Path = tuple[str | int, ...]

GAUGE_COUNT = 24
ROW_A_COUNT = 16
"""Gauges 0 to 15 lie in one row along the span, in two groups of eight; the others beside it."""
ROW_A_GROUP = ROW_A_COUNT // 2
"""Number of gauges of row A before its gap."""
EVERY_ITEM = "*"
"""Step of a path to every item of a list."""


class GaugeCluster(NamedTuple):
    """Cluster of neighbouring gauges of row B.

    Attributes
    ----------
    first_gauge : int
        Number of its first gauge.
    row_a_gauge : int
        Number of the gauge of row A against which the first gauge is staggered.
    """

    first_gauge: int
    row_a_gauge: int


CLUSTERS = (
    GaugeCluster(first_gauge=16, row_a_gauge=4),
    GaugeCluster(first_gauge=20, row_a_gauge=8),
)
CLUSTER_SIZE = 4


@dataclass(frozen=True)
class FreeParameter:
    """A free number of the design.

    Attributes
    ----------
    name : str
        Name in records and reports.
    unit : str
        Unit; "1" for a fraction.
    mean, standard_deviation : float
        Normal distribution before the fit.
    lower, upper : float
        Bounds.
    why : str
        Reason why the number is free.
    path : tuple
        Keys that lead to the number in a design; "*" means every item of a list. Empty for a number
        of the gauge layout.
    stride : float
        Fraction of the largest step of an iteration that the parameter may move. It is small for
        positions: near an edge, the strain of a gauge soon departs from its derivative.
    """

    name: str
    unit: str
    mean: float
    standard_deviation: float
    lower: float
    upper: float
    why: str
    path: Path = ()
    stride: float = 1.0

    @property
    def place(self) -> str:
        """Dotted keys of the number in a design file; those of the gauges for their layout."""
        path = self.path or ("gauges", "positions")
        return ".".join(map(str, path))

    def read(self, content: Content) -> float:
        """Return the value of the parameter in the content of a design.

        Raises
        ------
        IdentificationError
            If the design lacks the number, or holds different numbers at the places that share it.
        """
        if not self.path:
            return layout_of(content)[self.name]
        try:
            values = [entry.value for entry in _entries(content, self.path)]
        except LookupError:
            values = []
        if not values or any(value != values[0] for value in values):
            finding = "different values" if values else "nothing"
            raise IdentificationError(
                f"the free number '{self.name}' stands at {self.place} of a design, but the start "
                "has "
                f"{finding} there; begin with a design laid out as the shipped one."
            )
        return _number(values[0])

    def write(self, content: Content, value: float) -> None:
        """Put a value of the parameter into the content of a design."""
        if self.path:
            for entry in _entries(content, self.path):
                entry.replace(value)
        else:
            set_layout(content, {**layout_of(content), self.name: value})


@dataclass(frozen=True)
class _Entry:
    """An entry of a table or a list in the content of a design.

    Attributes
    ----------
    holder : dict or list
        Table or list that holds the entry.
    key : str or int
        Key or number of the entry.
    """

    holder: object
    key: str | int

    @property
    def value(self) -> object:
        """The value.

        Raises
        ------
        LookupError
            If the holder has no such entry.
        """
        if isinstance(self.holder, dict):
            return self.holder[self.key]
        if isinstance(self.holder, list) and isinstance(self.key, int):
            return self.holder[self.key]
        raise LookupError(self.key)

    def replace(self, value: float) -> None:
        """Replace the value."""
        holder = self.holder
        if isinstance(holder, dict):
            holder[self.key] = value
        if isinstance(holder, list) and isinstance(self.key, int):
            holder[self.key] = value


def _entries(content: object, path: Path) -> Iterator[_Entry]:
    """Yield the entries of a design's content to which a path leads.

    Raises
    ------
    LookupError
        If the content has no such entry.
    """
    key, *further_keys = path
    if not further_keys:
        yield _Entry(content, key)
        return
    if key != EVERY_ITEM:
        members = [_Entry(content, key).value]
    elif isinstance(content, list):
        members = content
    else:
        raise LookupError(key)
    for member in members:
        yield from _entries(member, tuple(further_keys))


def _number(value: object) -> float:
    """Return an entry of a design as a number.

    Raises
    ------
    IdentificationError
        If the entry is not a number.
    """
    if not isinstance(value, int | float):
        raise IdentificationError(
            f"a free number of a design must be a number, but {value!r} stands in its place; begin "
            "with a "
            "design laid out as the shipped one."
        )
    return float(value)


def _table(content: Content, name: str) -> Content:
    """Return a table of a design's content."""
    table = content[name]
    if not isinstance(table, dict):
        raise IdentificationError(f"'{name}' of a design must be a table, not {table!r}.")
    return table


def layout_of(content: Content) -> dict[str, float]:
    """Return the numbers of the gauge layout that is nearest to the positions of a design.

    Nearest is meant in the sense of least squares.

    Raises
    ------
    IdentificationError
        If the design does not have 24 gauges.
    """
    positions = np.array(_table(content, "gauges")["positions"], dtype=float)
    if positions.shape != (GAUGE_COUNT, 2):
        raise IdentificationError(
            "a start with 24 gauges is needed, in the order of the published library; it has "
            f"{len(positions)}."
        )
    span = _number(_table(content, "planform")["semi_span"])

    # Row A: equal distances with one gap, on a straight line
    distance, chord = positions[:ROW_A_COUNT].T
    index = np.arange(ROW_A_COUNT)
    after_gap = index >= ROW_A_GROUP
    basis = np.column_stack([np.ones(ROW_A_COUNT), index, after_gap])
    first, pitch, gap = np.linalg.lstsq(basis, distance, rcond=None)[0].tolist()
    middle, slope = _straight_line(distance / span - 0.5, chord)
    layout = {
        "row A first": first,
        "row A pitch": pitch,
        "row A gap": gap,
        "row A chord": middle,
        "row A chord slope": slope,
    }

    # Clusters: shifted from gauges of row A, on straight lines of their own
    for number, cluster in enumerate(CLUSTERS, start=1):
        end = cluster.first_gauge + CLUSTER_SIZE
        distance, chord = positions[cluster.first_gauge : end].T
        row_index = cluster.row_a_gauge + np.arange(CLUSTER_SIZE)
        row_distance = first + pitch * row_index
        if cluster.row_a_gauge >= ROW_A_GROUP:
            row_distance = row_distance + gap
        middle, slope = _straight_line((distance - distance.mean()) / span, chord)
        layout[f"cluster {number} stagger"] = float(np.mean(distance - row_distance))
        layout[f"cluster {number} chord"] = middle
        layout[f"cluster {number} chord slope"] = slope
    return layout


def _straight_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return value at zero and slope of the straight line through points (n,) by least squares."""
    basis = np.column_stack([np.ones(len(x)), x])
    value, slope = np.linalg.lstsq(basis, y, rcond=None)[0].tolist()
    return value, slope


def set_layout(content: Content, layout: Mapping[str, float]) -> None:
    """Place the 24 gauges of a design's content by the numbers of the layout."""
    span = _number(_table(content, "planform")["semi_span"])
    index = np.arange(ROW_A_COUNT)
    gap = np.where(index >= ROW_A_GROUP, layout["row A gap"], 0.0)
    row_distance = layout["row A first"] + layout["row A pitch"] * index + gap
    row_chord = layout["row A chord"] + layout["row A chord slope"] * (row_distance / span - 0.5)
    positions = [np.column_stack([row_distance, row_chord])]
    for number, cluster in enumerate(CLUSTERS, start=1):
        end = cluster.row_a_gauge + CLUSTER_SIZE
        distance = row_distance[cluster.row_a_gauge : end] + layout[f"cluster {number} stagger"]
        slope = layout[f"cluster {number} chord slope"]
        offset = slope * (distance - distance.mean()) / span
        chord = layout[f"cluster {number} chord"] + offset
        positions.append(np.column_stack([distance, chord]))
    pairs = [tuple(pair) for pair in np.vstack(positions).tolist()]
    _table(content, "gauges")["positions"] = pairs


def values_of(design: WingDesign, parameters: Sequence[FreeParameter]) -> FloatArray:
    """Return the values (P,) that the parameters have in a design, each in its unit."""
    content = _content_of(design)
    return np.array([parameter.read(content) for parameter in parameters])


def with_values(
    design: WingDesign, parameters: Sequence[FreeParameter], values: FloatArray
) -> WingDesign:
    """Return the design with other values (P,) of the parameters.

    Raises
    ------
    InvalidDesignError
        If such a wing cannot be built.
    """
    content = _content_of(design)
    for parameter, value in zip(parameters, values, strict=True):
        parameter.write(content, float(value))
    return parse_design(content, source="a design of the identification")


def _content_of(design: WingDesign) -> Content:
    """Return the content of a design with lists for tuples, so that items can be replaced."""
    tables = design.model_dump(mode="python")
    return {name: _with_lists(table) for name, table in tables.items()}


def _with_lists(value: object) -> object:
    """Return a copy of a value of a design, with lists for tuples at every depth."""
    if isinstance(value, dict):
        return {key: _with_lists(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_with_lists(entry) for entry in value]
    return value


def scaled(parameters: Sequence[FreeParameter], values: FloatArray) -> FloatArray:
    """Return values (P,) in prior standard deviations from the prior mean."""
    return np.asarray((values - prior_means(parameters)) / deviations(parameters))


def prior_means(parameters: Sequence[FreeParameter]) -> FloatArray:
    """Return the prior means (P,), each in the unit of its parameter."""
    return np.array([parameter.mean for parameter in parameters])


def deviations(parameters: Sequence[FreeParameter]) -> FloatArray:
    """Return the prior standard deviations (P,), each in the unit of its parameter."""
    return np.array([parameter.standard_deviation for parameter in parameters])
