"""Systems of FMUs: solved and flown as their recursion says, refusals, and wiring."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from fmu_asset import errors
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SystemStructure,
    expand_connection,
)
from fmu_asset.coupling.wiring import Wiring
from tests.fmu_asset.client.kinds import BINDINGS
from tests.fmu_asset.coupling.reference import PARTS, SYSTEMS, coupled, linear, of_ours, recursion
from tests.fmu_asset.making import bound, changed, system, tables, watch
from tests.fmu_asset.ours import OurFmus
from tests.refusals import refused

JACOBI = {"algorithm": "jacobi"}
PUSHES = [0.7, -1.0, 0.0, 2.0, 0.5]

# ---------------------------------------------------------------------- the recursion


@pytest.mark.parametrize(("name", "order", "delayed", "options"), SYSTEMS["flights"])
def test_a_system_does_what_its_recursion_says(foreign_fmu, name, order, delayed, options):
    """In the order that follows from dependencies.

    If a loop has settled, each component has the values of the others at the end of the step. With
    inputs held, an exact component comes to the same place in one step and in four.
    """
    asset_options = dict(options)
    substeps = asset_options.pop("substeps", 1)
    components = order.split()
    structure = coupled(name, foreign_fmu, substeps).delayed(delayed)
    has_input = any(connector.kind == "input" for connector in structure.connectors)
    inputs = ["push"] if has_input else []
    outputs = [f"{component}.y{number}" for component in components for number in (1, 2)]
    binding = watch(*outputs, inputs=inputs, step_size=0.1)

    with CoupledAsset(structure, binding, isolated=False, **asset_options) as asset:
        order_of_asset = list(asset.schedule.order)
        rows = [asset.observe().values]
        for push in PUSHES:
            rows.append(asset.step(dict.fromkeys(inputs, push)).values)

    expected = recursion(
        name,
        components,
        0.1,
        PUSHES,
        jacobi="algorithm" in options,
        delayed=delayed,
        sweeps=options.get("iterations", 1),
    )
    expected_rows = np.hstack([expected[component] for component in components])
    assert order_of_asset == components
    np.testing.assert_allclose(rows, expected_rows, rtol=1e-9, atol=1e-12)


# ---------------------------------------------------------------------- algebraic loops


def test_an_algebraic_loop_is_refused_with_its_ends_and_what_to_do(foreign_fmu):
    remedy = "delay one of its connections, allow iterations, or take the algorithm jacobi"

    with pytest.raises(errors.CouplingError) as caught:
        CoupledAsset(coupled("loop", foreign_fmu), watch("left.y1"))

    assert "left.y1 -> right.u1 -> right.y1 -> left.u1" in str(caught.value)
    assert remedy in str(caught.value)


def test_a_delay_of_an_end_without_a_connection_is_refused(foreign_fmu):
    sentence = r"ends at left\.u2.*connections end at right\.u1, left\.u1"

    with pytest.raises(errors.CouplingError, match=sentence):
        coupled("loop", foreign_fmu).delayed(["left.u2"])


def test_a_cycle_without_an_algebraic_loop_holds_one_connection(foreign_fmu):
    structure = coupled("circle", foreign_fmu)

    with CoupledAsset(structure, watch("left.y2"), isolated=False) as asset:
        held = [str(connection.source) for connection in asset.schedule.held]

        assert asset.schedule.loops == ()
        assert held == ["right.y1"]


def test_iterations_that_do_not_settle_are_refused(foreign_fmu):
    sentence = r"left, right did not settle in 8 iterations.*still changes by"
    structure = coupled("stiff", foreign_fmu)

    with (
        CoupledAsset(structure, watch("left.y1"), iterations=8, isolated=False) as asset,
        pytest.raises(errors.IterationError, match=sentence),
    ):
        asset.step()


def test_iterations_need_components_that_can_save_their_state(foreign_fmu, spring_mass):
    components = [
        Component("spring", spring_mass),
        linear("law", foreign_fmu("linear2"), d=np.eye(2)),
    ]
    connections = [("spring.position", "law.u1"), ("law.y1", "spring.force")]
    structure = system(components, connections)

    sentence = "component 'spring' cannot save and restore its state"
    with pytest.raises(errors.CouplingError, match=sentence):
        CoupledAsset(structure, watch("law.y1"), iterations=3)


# ---------------------------------------------------------------------- bindings of systems


RANGED = bound(1.0, {"y": ("first.y1", "1")}, control={"push": ("push", "1", -1.0, 2.0)})
"""A binding with the range -1 to 2 of the push."""


def test_a_binding_of_several_fmus_keeps_its_ranges(foreign_fmu):
    with CoupledAsset(coupled("oscillator", foreign_fmu), RANGED, isolated=False) as asset:
        before = asset.step({"push": 2.0}).values

        with pytest.raises(
            errors.FmuInputError, match=r"push = 2\.5 lies outside .* 'push', -1 to 2"
        ):
            asset.step({"push": 2.5})

        assert asset.step_index == 1
        np.testing.assert_array_equal(asset.observe().values, before)


def test_a_binding_of_several_fmus_has_no_decimation(foreign_fmu):
    decimated = changed(RANGED, header={"decimation": 2})

    with pytest.raises(errors.BindingError, match="bound of several FMUs has a decimation"):
        CoupledAsset(coupled("oscillator", foreign_fmu), decimated, isolated=False)


# ---------------------------------------------------------------------- damage, wing and gauges


def couple_three(ours: OurFmus, seed: float = 5.0) -> CoupledAsset:
    """Return the wing with damage before it and gauges behind it."""
    return CoupledAsset(of_ours(ours), BINDINGS["three"], isolated=False, parameters={"seed": seed})


def test_outputs_say_on_which_inputs_they_depend(ours):
    damage = read_fmu(ours(PARTS["damage"])).feedthrough
    gauges = read_fmu(ours(PARTS["gauges"])).feedthrough

    assert damage["z1"] == set()
    assert gauges["reading[2]"] == {"strain[2]"}


def test_components_are_in_the_order_of_their_connections(ours):
    with couple_three(ours) as asset:
        assert asset.schedule.order == ("damage", "wing", "gauges")


def test_parameters_are_those_of_the_components(ours):
    readings = []
    for seed in (5.0, 6.0):
        with couple_three(ours, seed) as asset:
            readings.append(asset.simulate({"load_factor": 2.0}, steps=3).values)

    assert not np.array_equal(*readings)


def test_a_step_that_one_component_refuses_ends_the_flight(ours):
    sentence = r"component (damage|wing): load.load_factor = 99"

    with couple_three(ours) as asset:
        with pytest.raises(errors.FmuInputError, match=sentence):
            asset.step({"load_factor": 99.0})
        with pytest.raises(errors.FmuStateError, match="no longer stand at the same time"):
            asset.step({"load_factor": 2.0})
        asset.reset()
        asset.step({"load_factor": 2.0})


def test_a_state_of_a_system_with_other_connections_is_refused(ours):
    structure = of_ours(ours)
    connections = tuple(
        replace(connection, delayed=bool(connection.source.component))
        for connection in structure.connections
    )
    delayed = replace(structure, connections=connections)
    with couple_three(ours) as asset:
        asset.simulate({"load_factor": 2.0}, steps=3)
        state = asset.save_state()

    with (
        CoupledAsset(delayed, BINDINGS["three"], isolated=False) as other,
        pytest.raises(errors.FmuStateError, match="another FMU than the system test"),
    ):
        other.restore_state(state)


# ---------------------------------------------------------------------- inputs in straight lines

END = 2.0
# x1' = -x1 - 2 x2, x2' = 1.5 x1 - x2: a cycle.
EXACT = expm(np.array([[-1.0, -2.0], [1.5, -1.0]]) * END) @ [1.0, 0.0]


def cycle(
    fmu: Any, *, exchange: bool = False, delayed: bool = False, substeps: int = 1
) -> SystemStructure:
    """Return two followers x' = u - x that feed each other."""
    interface = "model-exchange" if exchange else "co-simulation"
    start = {"start": ComponentSetting(1.0)}
    first = Component("first", fmu, start, interface="co-simulation")
    second = Component("second", fmu, {}, substeps, interface)
    connections = (
        Connection(Endpoint("first", "x"), Endpoint("second", "u"), factor=1.5),
        Connection(Endpoint("second", "x"), Endpoint("first", "u"), factor=-2.0, delayed=delayed),
    )
    return SystemStructure("cycle", (first, second), (), connections)


@dataclass(frozen=True)
class CycleErrors:
    """Errors of a cycle in 20 and in 40 steps, with held inputs and with linear ones."""

    held_20: float
    held_40: float
    linear_20: float
    linear_40: float


CYCLES = {
    "plain": ({}, {}),
    "model exchange": ({"exchange": True}, {}),
    "substeps": ({"substeps": 3}, {}),
    "delayed": ({"delayed": True}, {}),
    "Jacobi": ({}, JACOBI),
    "Jacobi with substeps of model exchange": ({"exchange": True, "substeps": 3}, JACOBI),
    "iterations": ({}, {"iterations": 50}),
}
"""Options of the cycle and of its asset."""


@pytest.fixture(scope="module", params=CYCLES)
def cycle_errors(request, foreign_fmu):
    cycle_options, asset_options = CYCLES[request.param]
    structure = cycle(foreign_fmu("follow2"), **cycle_options)

    def error_of(interpolation: str, steps: int) -> float:
        binding = watch(
            "first.x",
            "second.x",
            step_size=END / steps,
            interpolation=interpolation,
            tolerance=1e-10,
        )
        with CoupledAsset(structure, binding, isolated=False, **asset_options) as asset:
            last = asset.simulate(steps=steps).values[-1]
        return float(np.abs(last - EXACT).max())

    return CycleErrors(
        held_20=error_of("zero-order", 20),
        held_40=error_of("zero-order", 40),
        linear_20=error_of("linear", 20),
        linear_40=error_of("linear", 40),
    )


def test_the_error_of_held_inputs_falls_with_the_step(cycle_errors):
    assert 1.7 < cycle_errors.held_20 / cycle_errors.held_40 < 2.4


def test_the_error_of_linear_inputs_falls_with_the_square_of_the_step(cycle_errors):
    assert 3.3 < cycle_errors.linear_20 / cycle_errors.linear_40 < 4.8
    assert cycle_errors.linear_40 < 0.3 * cycle_errors.held_40


# ---------------------------------------------------------------------- wiring


@pytest.fixture(scope="module")
def base(ours: OurFmus) -> SystemStructure:
    """Components that are not joined, and connectors."""
    components = tuple(Component(name, ours(file)) for name, file in PARTS.items())
    connectors = (
        Connector("push", "input"),
        Connector("seen", "output"),
        Connector("percent", "output", "%"),
    )
    return SystemStructure("base", components, connectors)


def connect(source: str, target: str, **options: Any) -> Connection:
    """Return a connection of the components of `base`."""
    connection, *_ = expand_connection(source, target, tuple(PARTS))
    return replace(connection, **options)


REFUSED = tables(__file__)
WIRING_ERRORS = (errors.CouplingError, errors.FmuFileError)


@pytest.mark.parametrize(("ends", "sentence"), REFUSED["unjoined"])
def test_connections_that_do_not_fit_are_refused(base, ends, sentence):
    connections = tuple(connect(*pair) for pair in ends)

    with refused(WIRING_ERRORS, sentence):
        Wiring(replace(base, connections=connections))


@pytest.mark.parametrize(("name", "key", "value", "sentence"), REFUSED["unset"])
def test_settings_that_do_not_fit_are_refused(base, foreign_fmu, name, key, value, sentence):
    component = base.component(name) if name in PARTS else Component(name, foreign_fmu(name))
    changed_component = replace(component, settings={key: ComponentSetting(*value)})

    with refused(WIRING_ERRORS, sentence):
        Wiring(replace(base, components=(changed_component,)))


def test_a_system_without_components_is_refused(base):
    with refused(WIRING_ERRORS, "has no component"):
        Wiring(replace(base, components=()))


def test_two_components_of_one_name_are_refused(base):
    with refused(WIRING_ERRORS, "two components named 'damage'"):
        Wiring(replace(base, components=(*base.components, base.component("damage"))))


def test_a_component_without_steps_is_refused(base):
    without_steps = replace(base.component("damage"), substeps=0)

    with refused(WIRING_ERRORS, "at least one step"):
        Wiring(replace(base, components=(without_steps,)))


def test_a_component_without_its_fmu_is_refused(base, tmp_path):
    missing = Component("a", tmp_path / "none.fmu")

    with refused(WIRING_ERRORS, r"no FMU .*none\.fmu"):
        Wiring(replace(base, components=(missing,)))


@pytest.mark.parametrize(("source", "target", "sentence"), REFUSED["unexpanded"])
def test_ends_that_do_not_match_are_refused(source, target, sentence):
    with pytest.raises(errors.CouplingError, match=sentence):
        expand_connection(source, target, ["a", "b"])


# ---------------------------------------------------------------------- units and types


@pytest.mark.parametrize(
    ("options", "factor_and_offset"),
    [
        ({}, (100.0, 0.0)),
        ({"factor": 0.5, "offset": 0.1}, (50.0, 0.1)),
        ({"convert_units": False}, (1.0, 0.0)),
    ],
)
def test_a_value_is_converted_and_then_transformed_in_the_unit_of_the_target(
    base, options, factor_and_offset
):
    connections = (connect("damage.z1", "percent", **options),)

    wiring = Wiring(replace(base, connections=connections))

    (end,) = wiring.ends["percent"]
    assert end.conversion == factor_and_offset


def test_equal_units_are_not_converted(base):
    connections = (connect("damage.z1", "wing.health.z1"),)

    wiring = Wiring(replace(base, connections=connections))

    (feed,) = wiring.feeds.values()
    assert feed.conversion == (1.0, 0.0)


def test_a_connector_without_a_unit_has_that_of_its_source(base):
    connections = (connect("wing.tip_displacement", "seen", factor=2.0, offset=0.5),)

    wiring = Wiring(replace(base, connections=connections))

    (end,) = wiring.ends["seen"]
    assert end.conversion == (2.0, 0.5)
    assert wiring.units["seen"] == "m"


def test_settings_are_converted_into_numbers_in_the_units_of_the_fmu(base):
    settings = {
        "mass.servo": ComponentSetting(150.0, "g"),
        "response": ComponentSetting("transient"),
        "health.z1": ComponentSetting(0.2),
    }
    wing = replace(base.component("wing"), settings=settings)

    wiring = Wiring(replace(base, components=(wing,)))

    expected = {"mass.servo": pytest.approx(0.15), "response": 2.0, "health.z1": 0.2}
    assert wiring.settings["wing"] == expected


def test_a_boolean_setting_is_a_number(foreign_fmu):
    switched = Component("a", foreign_fmu("array3"), {"active": ComponentSetting(False)})

    wiring = Wiring(SystemStructure("one", (switched,)))

    assert wiring.settings == {"a": {"active": 0.0}}


def test_an_enumeration_feeds_an_integer(base):
    connections = (connect("damage.status", "spring.misbehaviour"),)

    wiring = Wiring(replace(base, connections=connections))

    (feed,) = wiring.feeds.values()
    assert feed.conversion == (1.0, 0.0)


# ---------------------------------------------------------------------- bindings that do not fit

OBSERVED = {"y": ("damage.z1", "1")}


@pytest.fixture(scope="module")
def joined(base) -> Wiring:
    connections = (
        connect("push", "wing.load_factor"),
        connect("damage.z1", "wing.health.z1"),
        connect("damage.z1", "percent"),
    )
    return Wiring(replace(base, connections=connections))


@pytest.mark.parametrize(("role", "end", "sentence"), REFUSED["unbound"])
def test_a_binding_that_does_not_fit_is_refused(joined, role, end, sentence):
    roles = {"observation": OBSERVED} | {role: {"x": end}}

    with pytest.raises(ValueError, match=sentence):
        CoupledAsset(joined, bound(1.0, **roles))


def test_an_unknown_algorithm_is_refused(joined):
    binding = bound(1.0, OBSERVED, control={"x": ("push", "1")})

    with pytest.raises(ValueError, match="algorithm must be one of gauss_seidel, jacobi"):
        CoupledAsset(joined, binding, algorithm="newton")  # type: ignore[arg-type]
