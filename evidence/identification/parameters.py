"""The free numbers of the wing design: where each stands, what is believed of it beforehand, and why.

A parameter reads and writes one number in the content of a design (a nested dictionary as TOML gives it).
Most are a path, and one number may stand at several places (all webs). The places of the gauges follow from
a few numbers: two straight rows, the second of two clusters.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.wing.design import WingDesign, parse_design

from .errors import IdentificationError

FloatArray = NDArray[np.float64]
Content = dict[str, Any]
Path = tuple[str | int, ...]

ROW_A = 16
"""Gauges 0 to 15 lie in one row along the span, in two groups of eight; 16 to 19 and 20 to 23 beside it."""
CLUSTERS = ((16, 4), (20, 8))
"""First gauge of each cluster of row B, and the gauge of row A that it is staggered against."""
CLUSTER_SIZE = 4
PLACE_STRIDE = 0.25


@dataclass(frozen=True)
class FreeParameter:
    """A free number of the design.

    Attributes
    ----------
    name : str
        Its name in records and reports.
    unit : str
        "1" for a fraction.
    mean, standard_deviation : float
        What is believed before the fit: a normal distribution.
    lower, upper : float
        Bounds.
    why : str
        Why it is free.
    path : tuple
        Where it stands in a design; "*" means every item of a list. Empty for a number of the gauge layout.
    stride : float
        Share of the largest step of an iteration that it may move: places change the strain of a gauge near
        an edge in a way that derivatives do not tell far.
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

    def read(self, content: Content) -> float:
        """Return its value in a design's content.

        Raises
        ------
        IdentificationError
            If the design has no such place, or different numbers at the places that share it.
        """
        if not self.path:
            return layout_of(content)[self.name]
        try:
            values = [holder[key] for holder, key in _places(content, self.path)]
        except (KeyError, IndexError, TypeError):
            values = []
        if not values or any(value != values[0] for value in values):
            found = "different values" if values else "nothing"
            raise IdentificationError(
                f"the free number '{self.name}' stands at {'.'.join(map(str, self.path))} of a design, but "
                f"the start has {found} there; begin with a design laid out as the shipped one."
            )
        return float(values[0])

    def write(self, content: Content, value: float) -> None:
        """Put a value into a design's content."""
        if self.path:
            for holder, key in _places(content, self.path):
                holder[key] = value
        else:
            set_layout(content, {**layout_of(content), self.name: value})


def _places(content: Any, path: Path) -> Iterator[tuple[Any, str | int]]:
    head, *rest = path
    if not rest:
        yield content, head
    elif head == "*":
        for item in content:
            yield from _places(item, tuple(rest))
    else:
        yield from _places(content[head], tuple(rest))


def layout_of(content: Content) -> dict[str, float]:
    """Return the numbers of the gauge layout that is nearest to the positions of a design.

    Raises
    ------
    IdentificationError
        If the design does not have 24 gauges.
    """
    positions = np.array(content["gauges"]["positions"], dtype=float)
    if positions.shape != (24, 2):
        raise IdentificationError(
            "a start with 24 gauges is needed, in the order of the published library; it has "
            f"{len(positions)}."
        )
    span = float(content["planform"]["semi_span"])
    place, chord = positions[:ROW_A, 0], positions[:ROW_A, 1]
    index = np.arange(ROW_A)
    basis = np.column_stack([np.ones(ROW_A), index, index >= ROW_A // 2])
    first, pitch, gap = np.linalg.lstsq(basis, place, rcond=None)[0].tolist()
    line = np.column_stack([np.ones(ROW_A), place / span - 0.5])
    middle, slope = np.linalg.lstsq(line, chord, rcond=None)[0].tolist()
    found = {"row A first": first, "row A pitch": pitch, "row A gap": gap}
    found |= {"row A chord": middle, "row A chord slope": slope}
    for number, (start, beside) in enumerate(CLUSTERS, start=1):
        own = positions[start : start + CLUSTER_SIZE]
        row = first + pitch * (beside + np.arange(CLUSTER_SIZE)) + gap * (beside >= ROW_A // 2)
        along = (own[:, 0] - own[:, 0].mean()) / span
        line = np.column_stack([np.ones(CLUSTER_SIZE), along])
        middle, slope = np.linalg.lstsq(line, own[:, 1], rcond=None)[0].tolist()
        found[f"cluster {number} stagger"] = float(np.mean(own[:, 0] - row))
        found |= {f"cluster {number} chord": middle, f"cluster {number} chord slope": slope}
    return found


def set_layout(content: Content, layout: Mapping[str, float]) -> None:
    """Place the 24 gauges of a design's content by the numbers of the layout."""
    span = float(content["planform"]["semi_span"])
    index = np.arange(ROW_A)
    place = layout["row A first"] + layout["row A pitch"] * index
    place = place + layout["row A gap"] * (index >= ROW_A // 2)
    chord = layout["row A chord"] + layout["row A chord slope"] * (place / span - 0.5)
    positions = [np.column_stack([place, chord])]
    for number, (_, beside) in enumerate(CLUSTERS, start=1):
        own = place[beside : beside + CLUSTER_SIZE] + layout[f"cluster {number} stagger"]
        slope = layout[f"cluster {number} chord slope"]
        row = layout[f"cluster {number} chord"] + slope * (own - own.mean()) / span
        positions.append(np.column_stack([own, row]))
    content["gauges"]["positions"] = [tuple(pair) for pair in np.vstack(positions).tolist()]


def values_of(design: WingDesign, parameters: Sequence[FreeParameter]) -> FloatArray:
    """Return the values (P,) that the parameters have in a design, each in its unit."""
    content = design.model_dump(mode="python")
    return np.array([parameter.read(_lists(content)) for parameter in parameters])


def with_values(design: WingDesign, parameters: Sequence[FreeParameter], values: FloatArray) -> WingDesign:
    """Return the design with other values (P,) of the parameters.

    Raises
    ------
    InvalidDesignError
        If such a wing cannot be built.
    """
    content = _lists(design.model_dump(mode="python"))
    for parameter, value in zip(parameters, values, strict=True):
        parameter.write(content, float(value))
    return parse_design(content, source="a design of the identification")


def _lists(content: Any) -> Any:
    """Return a copy whose tuples are lists, so that their items can be replaced."""
    if isinstance(content, dict):
        return {key: _lists(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_lists(value) for value in content]
    return content


def scaled(parameters: Sequence[FreeParameter], values: FloatArray) -> FloatArray:
    """Return values (P,) in prior standard deviations from the prior mean."""
    mean = np.array([parameter.mean for parameter in parameters])
    return np.asarray((values - mean) / deviations(parameters))


def deviations(parameters: Sequence[FreeParameter]) -> FloatArray:
    """Return the prior standard deviations (P,), each in the unit of its parameter."""
    return np.array([parameter.standard_deviation for parameter in parameters])


def wing_parameters(design: WingDesign) -> tuple[FreeParameter, ...]:
    """Return the free numbers of the UAV wing; the skin's modulus has one for each station of the design."""
    return tuple(parameter for group in _GROUPS for parameter in group(design))


def _skin(design: WingDesign) -> Iterator[FreeParameter]:
    for number, place in enumerate(design.skin.stations):
        yield FreeParameter(
            f"skin modulus at {place.station:g}", "Pa", 9e9, 1.2e9, 4e9, 16e9,
            "lay-up along the span is not published",
            ("skin", "stations", number, "young_modulus"),
        )  # fmt: skip
    yield FreeParameter(
        "skin shear ratio", "1", 0.45, 0.1, 0.15, 0.9,
        "share of the fibres at 45 degrees is not published", ("skin", "in_plane_shear_ratio"),
    )  # fmt: skip


def _inside(design: WingDesign) -> Iterator[FreeParameter]:
    yield FreeParameter(
        "web modulus", "Pa", 0.9e9, 0.4e9, 0.05e9, 4e9,
        "webs stand for spars and rods, and carry what e does not scale", ("webs", "*", "young_modulus"),
    )  # fmt: skip
    yield FreeParameter(
        "web shear modulus", "Pa", 0.2e9, 0.08e9, 0.03e9, 1e9,
        "plywood with lightening holes", ("webs", "*", "shear_modulus"),
    )  # fmt: skip
    yield FreeParameter(
        "rib modulus", "Pa", 6e9, 2e9, 1e9, 15e9, "plywood with holes", ("ribs", "*", "young_modulus")
    )


def _root(design: WingDesign) -> Iterator[FreeParameter]:
    yield FreeParameter(
        "transverse root spring", "N/m", 48e3, 10e3, 15e3, 150e3,
        "flexibility of the fuselage and the rods is not published", ("root", "transverse_spring"),
    )  # fmt: skip
    yield FreeParameter(
        "flap root spring", "N m/rad", 4.8e4, 1e4, 1.5e4, 2e5,
        "flexibility of the fuselage and the rods is not published", ("root", "flap_spring"),
    )  # fmt: skip


def _mass(design: WingDesign) -> Iterator[FreeParameter]:
    yield FreeParameter(
        "skin density", "kg/m^3", 800.0, 60.0, 400.0, 1600.0, "resin and paint", ("skin", "density")
    )
    yield FreeParameter(
        "added density", "kg/m^3", 120.0, 50.0, 0.0, 500.0,
        "mounts and wiring of the outer half", ("added_density", 0, "density"),
    )  # fmt: skip
    for number, (name, station) in enumerate((("inner", 0.643), ("outer", 0.9075))):
        yield FreeParameter(
            f"{name} servo station", "1", station, 0.015, 0.5, 0.99,
            "stations of the servos are not published", ("point_masses", number, "station"),
        )  # fmt: skip


def _load(design: WingDesign) -> Iterator[FreeParameter]:
    yield FreeParameter(
        "net lift at 3g", "N", 370.0, 20.0, 250.0, 500.0, "weight of the aircraft is not published",
        ("lift", "force"),
    )  # fmt: skip
    yield FreeParameter(
        "forward force at 3g", "N", 25.0, 15.0, 0.0, 90.0,
        "lift is normal to the flow and leans forward on the wing", ("lift", "forward_force"),
    )  # fmt: skip
    yield FreeParameter(
        "chordwise exponent of the lift", "1", 1.0, 0.3, 0.2, 4.0,
        "pressure along the chord; 1 puts the centre at a third, 2 at a quarter of the chord",
        ("lift", "chordwise_exponent"),
    )  # fmt: skip


def _defects(design: WingDesign) -> Iterator[FreeParameter]:
    edges = (
        ("span_start", "m", (0.035, 0.966), 0.006),
        ("span_end", "m", (0.405, 1.590), 0.015),
        ("chord_start", "1", (0.130, 0.030), 0.010),
        ("chord_end", "1", (0.342, 0.135), 0.010),
    )
    for number in range(2):
        for key, unit, means, deviation in edges:
            if number == 1 and key == "chord_start":
                continue  # the front of the box
            mean = means[number]
            yield FreeParameter(
                f"defect {number + 1} {key.replace('_', ' ')}", unit, mean, deviation,
                max(mean - 5.0 * deviation, 0.005), mean + 5.0 * deviation,
                "edges of the regions are drawn, not dimensioned", ("defects", number, key), PLACE_STRIDE,
            )  # fmt: skip


def _gauges(design: WingDesign) -> Iterator[FreeParameter]:
    prior = {
        "row A first": ("m", 0.138, 0.005),
        "row A pitch": ("m", 0.0635, 0.0005),
        "row A gap": ("m", 0.171, 0.006),
        "row A chord": ("1", 0.508, 0.015),
        "row A chord slope": ("1", -0.224, 0.05),
        "cluster 1 stagger": ("m", -0.038, 0.004),
        "cluster 1 chord": ("1", 0.361, 0.015),
        "cluster 1 chord slope": ("1", 0.6, 0.3),
        "cluster 2 stagger": ("m", 0.0145, 0.002),
        "cluster 2 chord": ("1", 0.145, 0.015),
        "cluster 2 chord slope": ("1", -1.0, 0.3),
    }
    for name, (unit, mean, deviation) in prior.items():
        yield FreeParameter(
            name, unit, mean, deviation, mean - 5.0 * deviation, mean + 5.0 * deviation,
            "places of the gauges are drawn, not dimensioned", stride=PLACE_STRIDE,
        )  # fmt: skip
    yield FreeParameter(
        "averaging along the span", "m", 0.02, 0.004, 0.006, 0.05,
        "the cells of the published model, over which its strains are averaged, are not published",
        ("gauges", "averaging_spanwise"),
    )  # fmt: skip


_GROUPS: tuple[Callable[[WingDesign], Iterator[FreeParameter]], ...] = (
    _skin, _inside, _root, _mass, _load, _defects, _gauges,
)  # fmt: skip


def fixed_parameters() -> tuple[FreeParameter, ...]:
    """Return numbers that are held, because the data cannot tell them from the free ones."""
    return (
        FreeParameter(
            "skin thickness", "m", 6e-4, 6e-5, 3e-4, 1e-3, "not published", ("skin", "thickness")
        ),
        FreeParameter(
            "section thickness", "1", 0.125, 0.005, 0.09, 0.16, "not published",
            ("airfoil", "thickness_ratio"),
        ),
        FreeParameter(
            "yaw root spring", "N m/rad", 3.09e4, 1e4, 1e3, 1e6, "the lag frequency is not published",
            ("root", "yaw_spring"),
        ),
        FreeParameter(
            "web and rib density", "kg/m^3", 530.0, 60.0, 200.0, 1000.0, "plywood", ("webs", "*", "density")
        ),
        FreeParameter(
            "straight chord line", "1", 0.30, 0.03, 0.2, 0.4, "sweep is not published",
            ("planform", "straight_chord_line"),
        ),
    )  # fmt: skip
