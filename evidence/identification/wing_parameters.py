"""The free numbers of the UAV wing, each with location, prior, bounds, and its reason."""

from collections.abc import Iterator

from fe.wing.design import WingDesign

from .parameters import FreeParameter

PLACE_STRIDE = 0.25
"""Fraction of the largest step for places of edges and gauges; see `FreeParameter.stride`."""


def wing_parameters(design: WingDesign) -> tuple[FreeParameter, ...]:
    """Return the free numbers of the UAV wing; the skin has a modulus at each station."""
    return (
        *_skin(design),
        *_webs_and_ribs(),
        *_root(),
        *_mass(),
        *_load(),
        *_defects(),
        *_gauges(),
    )


def _skin(design: WingDesign) -> Iterator[FreeParameter]:
    """Yield a modulus of the skin for each station of the design, and its shear ratio."""
    for number, skin_station in enumerate(design.skin.stations):
        yield FreeParameter(
            name=f"skin modulus at {skin_station.station:g}",
            unit="Pa",
            mean=9e9,
            standard_deviation=1.2e9,
            lower=4e9,
            upper=16e9,
            why="lay-up along the span is not published",
            path=("skin", "stations", number, "young_modulus"),
        )
    yield FreeParameter(
        name="skin shear ratio",
        unit="1",
        mean=0.45,
        standard_deviation=0.1,
        lower=0.15,
        upper=0.9,
        why="share of the fibres at 45 degrees is not published",
        path=("skin", "in_plane_shear_ratio"),
    )


def _webs_and_ribs() -> Iterator[FreeParameter]:
    """Yield the moduli of webs and ribs."""
    yield FreeParameter(
        name="web modulus",
        unit="Pa",
        mean=0.9e9,
        standard_deviation=0.4e9,
        lower=0.05e9,
        upper=4e9,
        why="webs stand for spars and rods, and carry what e does not scale",
        path=("webs", "*", "young_modulus"),
    )
    yield FreeParameter(
        name="web shear modulus",
        unit="Pa",
        mean=0.2e9,
        standard_deviation=0.08e9,
        lower=0.03e9,
        upper=1e9,
        why="plywood with lightening holes",
        path=("webs", "*", "shear_modulus"),
    )
    yield FreeParameter(
        name="rib modulus",
        unit="Pa",
        mean=6e9,
        standard_deviation=2e9,
        lower=1e9,
        upper=15e9,
        why="plywood with holes",
        path=("ribs", "*", "young_modulus"),
    )


def _root() -> Iterator[FreeParameter]:
    """Yield the springs of the root."""
    yield FreeParameter(
        name="transverse root spring",
        unit="N/m",
        mean=48e3,
        standard_deviation=10e3,
        lower=15e3,
        upper=150e3,
        why="flexibility of the fuselage and the rods is not published",
        path=("root", "transverse_spring"),
    )
    yield FreeParameter(
        name="flap root spring",
        unit="N m/rad",
        mean=4.8e4,
        standard_deviation=1e4,
        lower=1.5e4,
        upper=2e5,
        why="flexibility of the fuselage and the rods is not published",
        path=("root", "flap_spring"),
    )


def _mass() -> Iterator[FreeParameter]:
    """Yield densities and the stations of the servos."""
    yield FreeParameter(
        name="skin density",
        unit="kg/m^3",
        mean=800.0,
        standard_deviation=60.0,
        lower=400.0,
        upper=1600.0,
        why="resin and paint",
        path=("skin", "density"),
    )
    yield FreeParameter(
        name="added density",
        unit="kg/m^3",
        mean=120.0,
        standard_deviation=50.0,
        lower=0.0,
        upper=500.0,
        why="mounts and wiring of the outer half",
        path=("added_density", 0, "density"),
    )
    for number, (name, station) in enumerate((("inner", 0.643), ("outer", 0.9075))):
        yield FreeParameter(
            name=f"{name} servo station",
            unit="1",
            mean=station,
            standard_deviation=0.015,
            lower=0.5,
            upper=0.99,
            why="stations of the servos are not published",
            path=("point_masses", number, "station"),
        )


def _load() -> Iterator[FreeParameter]:
    """Yield the numbers of the lift."""
    yield FreeParameter(
        name="net lift at 3g",
        unit="N",
        mean=370.0,
        standard_deviation=20.0,
        lower=250.0,
        upper=500.0,
        why="weight of the aircraft is not published",
        path=("lift", "force"),
    )
    yield FreeParameter(
        name="forward force at 3g",
        unit="N",
        mean=25.0,
        standard_deviation=15.0,
        lower=0.0,
        upper=90.0,
        why="lift is normal to the flow and leans forward on the wing",
        path=("lift", "forward_force"),
    )
    yield FreeParameter(
        name="chordwise exponent of the lift",
        unit="1",
        mean=1.0,
        standard_deviation=0.3,
        lower=0.2,
        upper=4.0,
        why="pressure along the chord; 1 puts the centre at a third, 2 at a quarter of the chord",
        path=("lift", "chordwise_exponent"),
    )


def _defects() -> Iterator[FreeParameter]:
    """Yield the edges of the damage regions."""
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
                name=f"defect {number + 1} {key.replace('_', ' ')}",
                unit=unit,
                mean=mean,
                standard_deviation=deviation,
                lower=max(mean - 5.0 * deviation, 0.005),
                upper=mean + 5.0 * deviation,
                why="edges of the regions are drawn, not dimensioned",
                path=("defects", number, key),
                stride=PLACE_STRIDE,
            )


def _gauges() -> Iterator[FreeParameter]:
    """Yield the numbers of the gauge layout and the averaging length."""
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
            name=name,
            unit=unit,
            mean=mean,
            standard_deviation=deviation,
            lower=mean - 5.0 * deviation,
            upper=mean + 5.0 * deviation,
            why="places of the gauges are drawn, not dimensioned",
            stride=PLACE_STRIDE,
        )
    yield FreeParameter(
        name="averaging along the span",
        unit="m",
        mean=0.02,
        standard_deviation=0.004,
        lower=0.006,
        upper=0.05,
        why=(
            "the cells of the published model, over which its strains are averaged, "
            "are not published"
        ),
        path=("gauges", "averaging_spanwise"),
    )


def fixed_parameters() -> tuple[FreeParameter, ...]:
    """Return fixed numbers, which the data cannot separate from the free ones."""
    return (
        FreeParameter(
            name="skin thickness",
            unit="m",
            mean=6e-4,
            standard_deviation=6e-5,
            lower=3e-4,
            upper=1e-3,
            why="not published",
            path=("skin", "thickness"),
        ),
        FreeParameter(
            name="section thickness",
            unit="1",
            mean=0.125,
            standard_deviation=0.005,
            lower=0.09,
            upper=0.16,
            why="not published",
            path=("airfoil", "thickness_ratio"),
        ),
        FreeParameter(
            name="yaw root spring",
            unit="N m/rad",
            mean=3.09e4,
            standard_deviation=1e4,
            lower=1e3,
            upper=1e6,
            why="the lag frequency is not published",
            path=("root", "yaw_spring"),
        ),
        FreeParameter(
            name="web and rib density",
            unit="kg/m^3",
            mean=530.0,
            standard_deviation=60.0,
            lower=200.0,
            upper=1000.0,
            why="plywood",
            path=("webs", "*", "density"),
        ),
        FreeParameter(
            name="straight chord line",
            unit="1",
            mean=0.30,
            standard_deviation=0.03,
            lower=0.2,
            upper=0.4,
            why="sweep is not published",
            path=("planform", "straight_chord_line"),
        ),
    )
