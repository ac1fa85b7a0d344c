"""Coupled systems against closed forms, and what cannot be joined in one sentence each.

The contract of all assets has their recursion written by hand.
"""

import itertools
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Connection, Connector, Setting, SystemStructure
from fmu_asset.coupling.structure import expand_connection as expand
from fmu_asset.coupling.wiring import Wiring
from tests.fmu_asset.door import kinds
from tests.fmu_asset.door.kinds import BINDINGS, OSCILLATOR, held, oscillator, three
from tests.fmu_asset.making import bound, changed, linear, system, watch
from tests.fmu_asset.ours import OurFmus

NAN, DIE = 1.0, 3.0


def flown(
    structure: SystemStructure, *ends: str, steps: int = 1, step_size: float = 1.0, **options: Any
) -> Any:
    """Return what ends of a system without inputs show at the start and after each step."""
    with CoupledAsset(structure, watch(*ends, step_size=step_size), isolated=False, **options) as asset:
        return np.array([asset.observe().values, *(asset.step().values for _ in range(steps))])


def test_the_order_follows_from_the_dependencies(state_fmu, linear_fmu) -> None:
    asset = CoupledAsset(oscillator(state_fmu, linear_fmu), watch("first.y1"), isolated=False)
    assert asset.schedule.order == ("first", "second")
    assert asset.schedule.loops == ()
    # With inputs held, an exact component comes to the same place in one step and in four.
    one, four = (
        flown(oscillator(state_fmu, linear_fmu, substeps), "first.y1", steps=10, step_size=0.1)
        for substeps in (1, 4)
    )
    np.testing.assert_allclose(one, four, rtol=1e-12)


def test_the_face_is_that_of_one_fmu(linear_fmu) -> None:
    one = system([linear("one", linear_fmu, d=[[2.0, 0.0], [0.0, 1.0]])], [("push", "one.u1")])
    with CoupledAsset(one, watch("one.y1", inputs=["push"], step_size=0.1), isolated=False) as asset:
        assert asset.describe()["order"] == ["one"]
        for steps in (0, -1):
            with pytest.raises(errors.FmuInputError, match=f"steps must be at least 1, but is {steps}"):
                asset.simulate(steps=steps)
        assert asset.simulate({"push": 3.0}, steps=1).values.tolist() == [[6.0]]
        with pytest.raises(TypeError, match="Inputs are control, health, load, port, and 'contrl' came"):
            asset.reset(contrl={})
        assert asset.step_index == 1
        asset.reset(control={"push": 1.0})
        assert asset.observe().values.tolist() == [2.0]


def test_a_chain_gives_in_one_step_what_one_system_would(linear_fmu) -> None:
    """Direct feedthrough through three FMUs, written backwards, arrives in the same step."""
    gains = {"third": 5.0, "second": 3.0, "first": 2.0}
    parts = [linear(name, linear_fmu, d=np.diag([gain, 1.0])) for name, gain in gains.items()]
    ends = [("push", "first.u1"), ("first.y1", "second.u1"), ("second.y1", "third.u1"), ("third.y1", "out")]
    chain, binding = system(parts, ends), watch("out", inputs=["push"])
    with CoupledAsset(chain, binding, isolated=False) as asset:
        assert asset.schedule.order == ("first", "second", "third")
        assert asset.step({"push": 0.7}).values[0] == 2.0 * 0.7 * 3.0 * 5.0
    with CoupledAsset(chain, binding, algorithm="jacobi", isolated=False) as asset:
        seen = [asset.step({"push": 0.7}).values[0] for _ in range(3)]
    np.testing.assert_allclose(seen, [0.0, 0.0, 21.0])  # one FMU further in each step
    delayed = system(parts[::-1], ends).delayed(["second.u1"])  # though the first one stands before it
    with CoupledAsset(delayed, binding, isolated=False) as asset:
        np.testing.assert_allclose([asset.step({"push": 0.7}).values[0] for _ in range(2)], [0.0, 21.0])


def loop_of(linear_fmu: Path, gain: float) -> SystemStructure:
    """y = gain u' + 1 and u' = -0.3 y + 2: the constants are states that do not move."""
    first = np.diag([1.0, 0.0])
    left = linear("left", linear_fmu, c=first, d=gain * first, initial=(1.0, 0.0))
    right = linear("right", linear_fmu, c=first, d=-0.3 * first, initial=(2.0, 0.0))
    return system([left, right], [("left.y1", "right.u1"), ("right.y1", "left.u1")])


def test_an_algebraic_loop_is_reported_and_broken_by_a_delay_or_by_jacobi(linear_fmu) -> None:
    """y = 0.5 u + 1, u of the last step; u = 2 - 0.3 y, y of this step, but of the last one by Jacobi."""
    loop = loop_of(linear_fmu, 0.5)
    with pytest.raises(errors.AlgebraicLoopError) as caught:
        CoupledAsset(loop, watch("left.y1"))
    assert "left.y1 -> right.u1 -> right.y1 -> left.u1" in str(caught.value)
    words = "delay one of its connections, allow iterations, or take the algorithm jacobi"
    assert words in str(caught.value)
    for structure, algorithm, lag in ((loop.delayed(["left.u1"]), "gauss_seidel", 0), (loop, "jacobi", 1)):
        seen = flown(structure, "left.y1", "right.y1", steps=5, algorithm=algorithm)
        for (before_y, before_u), (y, u) in itertools.pairwise(seen):
            np.testing.assert_allclose([y, u], [1.0 + 0.5 * before_u, 2.0 - 0.3 * (before_y if lag else y)])
    words = r"ends at left\.u2.*connections end at right\.u1, left\.u1"
    with pytest.raises(errors.CouplingError, match=words):
        loop.delayed(["left.u2"])


@pytest.mark.parametrize("algorithm", ["gauss_seidel", "jacobi"])
def test_iterations_solve_an_algebraic_loop_and_make_the_coupling_implicit(
    state_fmu, linear_fmu, algorithm
) -> None:
    """Settled, each FMU has the other's values of the end of the step, whichever algorithm led there."""
    settled = {"algorithm": algorithm, "iterations": 80, "tolerance": 1e-13}
    y = (1.0 + 0.5 * 2.0) / (1.0 + 0.5 * 0.3)
    seen = flown(loop_of(linear_fmu, 0.5), "left.y1", "right.y1", **settled)[1]
    np.testing.assert_allclose(seen, [y, 2.0 - 0.3 * y], rtol=1e-11)
    pair, ends = oscillator(state_fmu, linear_fmu), ("first.y1", "first.y2", "second.y1")
    (p1, q1), (p2, q2) = held(kinds.A1, kinds.B1, 0.1), held(kinds.A2, kinds.B2, 0.1)
    c, d = kinds.C2[0], kinds.D2[0]
    x, z = OSCILLATOR[:2], OSCILLATOR[2:]
    for row in flown(pair, *ends, steps=5, step_size=0.1, **settled)[1:]:
        # x' = P1 x + q F', z' = P2 z + Q2 x', F' = C z' + D x': a linear system for F'.
        free = c @ (p2 @ z + q2 @ p1 @ x) + d @ p1 @ x
        force = free / (1.0 - (c @ q2 + d) @ q1[:, 0])
        x = p1 @ x + q1[:, 0] * force
        z = p2 @ z + q2 @ x
        np.testing.assert_allclose(row, [*x, force], rtol=1e-9)


def test_iterations_that_do_not_settle_or_cannot_be_made(spring_mass, linear_fmu) -> None:
    words = r"left, right did not settle in 8 iterations.*still changes by"
    with pytest.raises(errors.IterationError, match=words):
        flown(loop_of(linear_fmu, -7.0), "left.y1", iterations=8)
    parts = [Component("spring", spring_mass), linear("law", linear_fmu, d=np.eye(2))]
    joined = system(parts, [("spring.position", "law.u1"), ("law.y1", "spring.force")])
    with pytest.raises(errors.CouplingError, match="component 'spring' cannot save and restore its state"):
        CoupledAsset(joined, watch("law.y1"), iterations=3)


def test_components_in_a_circle_without_a_loop_of_variables(crossed_fmu) -> None:
    """Two FMUs that feed each other through different variables: no loop, but one value is a step old."""
    parts = [linear("left", crossed_fmu, d=np.diag([2, 3])), linear("right", crossed_fmu, d=np.diag([5, 1]))]
    joined = system(parts, [("push", "left.u1"), ("left.y1", "right.u1"), ("right.y1", "left.u2")])
    with CoupledAsset(joined, watch("left.y2", inputs=["push"]), isolated=False) as asset:
        assert asset.schedule.loops == ()
        assert [str(link.source) for link in asset.schedule.held] == ["right.y1"]
        assert [asset.step({"push": 1.0}).values[0] for _ in range(2)] == [0.0, 30.0]
    with CoupledAsset(joined, watch("left.y2", inputs=["push"]), iterations=5, isolated=False) as asset:
        assert asset.step({"push": 1.0}).values[0] == 30.0


def test_a_binding_of_several_fmus_keeps_its_ranges_and_has_no_decimation(state_fmu, linear_fmu) -> None:
    structure, push = oscillator(state_fmu, linear_fmu, pushed=True), {"push": ("push", "1", -1.0, 2.0)}
    ranged = bound(1.0, {"y": ("first.y1", "1")}, control=push)
    with CoupledAsset(structure, ranged, isolated=False) as asset:
        before = asset.step({"push": 2.0}).values
        with pytest.raises(errors.FmuInputError, match=r"push = 2\.5 lies outside .* 'push', -1 to 2"):
            asset.step({"push": 2.5})
        assert asset.step_index == 1
        np.testing.assert_array_equal(asset.observe().values, before)
    with pytest.raises(errors.BindingError, match="bound of several FMUs has a decimation"):
        CoupledAsset(structure, changed(ranged, header={"decimation": 2}), isolated=False)


def test_parameters_and_refusals_are_those_of_the_components(ours) -> None:
    structure, seen = three(ours), []
    for seed in (5.0, 6.0):
        options = {"isolated": False, "parameters": {"seed": seed}}
        with CoupledAsset(structure, BINDINGS["three"], **options) as asset:
            assert asset.schedule.order == ("damage", "wing", "gauges")
            seen.append(asset.simulate({"load_factor": 2.0}, steps=3).values)
            state = asset.save_state()
            with pytest.raises(errors.FmuInputError, match=r"component (damage|wing): load.load_factor = 99"):
                asset.step({"load_factor": 99.0})
            with pytest.raises(errors.FmuStateError, match="no longer stand at the same time"):
                asset.step({"load_factor": 2.0})
            asset.reset()
            asset.step({"load_factor": 2.0})
    assert not np.array_equal(*seen)
    delayed = tuple(replace(c, delayed=bool(c.source.component)) for c in structure.connections)
    other = CoupledAsset(replace(structure, connections=delayed), BINDINGS["three"], isolated=False)
    with other, pytest.raises(errors.FmuStateError, match="another FMU than the system test"):
        other.restore_state(state)


def test_what_an_fmu_does_wrong_names_its_component(spring_mass, linear_fmu) -> None:
    law = linear("law", linear_fmu, d=np.eye(2))
    joined = system([Component("spring", spring_mass), law], [("spring.position", "law.u1")])
    binding = bound(0.1, {"y": ("law.y1", "1")}, load={"misbehaviour": ("spring.misbehaviour", "1")})
    for behaviour, kind, words in (
        (NAN, errors.FmuOutputError, "component spring: .*not finite.*position"),
        (DIE, errors.FmuWorkerError, "component spring: .*ended by signal"),
    ):
        with CoupledAsset(joined, binding) as asset:
            asset.step()
            with pytest.raises(kind, match=words):
                asset.step(load={"misbehaviour": behaviour})


def test_fmus_of_model_exchange_are_solved_by_us_and_coupled_as_any(foreign_fmu) -> None:
    """x' = u - k x of FMI 1.0, the second fed by the first: exact between the moments of exchange."""
    fmu, step, slow = foreign_fmu("decay1"), 0.25, 0.5
    second = Component("second", fmu, {"k": Setting(slow)}, interface="model-exchange")
    chain = system([Component("first", fmu), second], [("first.x", "second.u")])
    x = y = 1.0
    with CoupledAsset(chain, watch("first.x", "second.x", step_size=step, tolerance=1e-10)) as asset:
        for _ in range(8):
            x *= np.exp(-step)
            y = y * np.exp(-slow * step) + x * (1.0 - np.exp(-slow * step)) / slow
            np.testing.assert_allclose(asset.step().values, [x, y], rtol=1e-8)
    only = Component("ball", foreign_fmu("ball2"), interface="co-simulation")
    words = r"offers model-exchange only, but .* for co-simulation"
    with pytest.raises(errors.FmuUnsupportedError, match=words):
        CoupledAsset(system([only], []), watch("ball.h"))


# ---------------------------------------------------------------------- wiring

FILES = {"damage": "damage_growth", "wing": "python", "gauges": "strain_gauges", "spring": "spring_mass"}


@pytest.fixture(scope="module")
def base(ours: OurFmus) -> SystemStructure:
    ends = Connector("push", "input"), Connector("seen", "output"), Connector("percent", "output", "%")
    return SystemStructure("base", tuple(Component(name, ours(file)) for name, file in FILES.items()), ends)


def link(source: str, target: str, **options: Any) -> Connection:
    return replace(expand(source, target, tuple(FILES))[0], **options)


REFUSED = tomllib.loads(Path(__file__).with_name("refused.toml").read_text("utf-8"))


def test_what_does_not_fit_is_one_sentence(base, tmp_path) -> None:
    first = base.components[0]
    refused = [({"connections": [link(*ends) for ends in joined]}, w) for joined, w in REFUSED["unjoined"]]
    for name, key, value, words in REFUSED["unset"]:
        settled = replace(base.component(name), settings={key: Setting(*value)})
        refused += [({"components": [settled]}, words)]
    refused += [
        ({"components": []}, "has no component"),
        ({"components": [*base.components, first]}, "two components named 'damage'"),
        ({"components": [replace(first, substeps=0)]}, "at least one step"),
        ({"components": [Component("a", tmp_path / "none.fmu")]}, r"no FMU .*none\.fmu"),
    ]
    for changes, words in refused:
        with pytest.raises((errors.CouplingError, errors.FmuFileError), match=words) as caught:
            Wiring(replace(base, **{name: tuple(items) for name, items in changes.items()}))
        assert "\n" not in str(caught.value)
    for source, target, sentence in (
        ("wnig.strain", "a.x", r"'wnig\.strain' begins with no component; the components are a, b"),
        ("a.x[{1..3}]", "b.y[{1..2}]", "joins 3 ends to 2"),
        ("a.x[{3..1}]", "b.y[{1..2}]", "is empty or longer"),
    ):
        with pytest.raises(errors.CouplingError, match=sentence):
            expand(source, target, ["a", "b"])


def test_units_and_types_are_converted(base) -> None:
    """The value of a connection is converted first, and transformed in the unit of the target."""
    seen = link("wing.tip_displacement", "seen", factor=2.0, offset=0.5)
    for options, conversion in (
        ({}, (100.0, 0.0)),
        ({"factor": 0.5, "offset": 0.1}, (50.0, 0.1)),
        ({"convert_units": False}, (1.0, 0.0)),
    ):
        joined = (link("damage.z1", "percent", **options), link("damage.z1", "wing.health.z1"), seen)
        wiring = Wiring(replace(base, connections=joined))
        assert wiring.ends["percent"][0].conversion == conversion
        assert next(iter(wiring.feeds.values())).conversion == (1.0, 0.0)
        assert (wiring.ends["seen"][0].conversion, wiring.units["seen"]) == ((2.0, 0.5), "m")
    given = {"mass.servo": Setting(150.0, "g"), "response": Setting("transient"), "health.z1": Setting(0.2)}
    wiring = Wiring(replace(base, components=(replace(base.component("wing"), settings=given),)))
    assert wiring.settings["wing"] == {"mass.servo": pytest.approx(0.15), "response": 2.0, "health.z1": 0.2}
    # An enumeration and an integer feed each other.
    joined = Wiring(replace(base, connections=(link("damage.status", "spring.misbehaviour"),)))
    assert next(iter(joined.feeds.values())).conversion == (1.0, 0.0)


def test_an_input_that_is_only_set_keeps_its_value(base) -> None:
    """A start value of an input that nothing feeds holds; without one it is the FMU's own."""
    wing, shown = base.component("wing"), []
    for given in ({"health.z1": Setting(0.4)}, {}):
        structure = replace(base, components=(replace(wing, settings=given),))
        binding = bound(1.0, {"tip": ("wing.tip_displacement", "mm")})
        with CoupledAsset(structure, binding, isolated=False) as asset:
            shown.append((asset.observe().values[0], asset.step().values[0]))
    assert shown[0][0] == shown[0][1]
    assert shown[0][1] > 1.03 * shown[1][1]


def test_bindings_that_do_not_fit(base) -> None:
    ends = ("push", "wing.load_factor"), ("damage.z1", "wing.health.z1"), ("damage.z1", "percent")
    wiring = Wiring(replace(base, connections=tuple(link(*pair) for pair in ends)))
    observed = {"y": ("damage.z1", "1")}
    for role, end, words in REFUSED["unbound"]:
        given = {"observation": observed} | {role: {"x": end}}
        with pytest.raises(ValueError, match=words):
            CoupledAsset(wiring, bound(1.0, **given))
    right = bound(1.0, observed, control={"x": ("push", "1")})
    with pytest.raises(ValueError, match="has no parameter 'q'"):
        CoupledAsset(wiring, right, parameters={"q": 1.0})
    with pytest.raises(ValueError, match="algorithm must be one of gauss_seidel, jacobi"):
        CoupledAsset(wiring, right, algorithm="newton")  # type: ignore[arg-type]
    asset = CoupledAsset(wiring, right, isolated=False)
    with asset, pytest.raises(ValueError, match="has no control 'pull'; it has x"):
        asset.step({"pull": 1.0})
