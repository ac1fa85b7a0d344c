"""Systems of FMUs: order, loops and wiring by enumeration; solved and flown as their recursion says."""

from dataclasses import replace
from itertools import pairwise, permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.sparse.csgraph import connected_components, shortest_path

from fmu_asset import errors
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.schedule import algebraic_loops, schedule, strong_components
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SystemStructure,
)
from fmu_asset.coupling.structure import expand_connection as expand
from fmu_asset.coupling.wiring import Wiring
from tests.fmu_asset.client.kinds import BINDINGS
from tests.fmu_asset.coupling.reference import PARTS, SYSTEMS, coupled, linear, of_ours, recursion
from tests.fmu_asset.making import bound, changed, system, tables, watch
from tests.fmu_asset.ours import OurFmus
from tests.refusals import refused as in_one_sentence

JACOBI = {"algorithm": "jacobi"}


@pytest.mark.parametrize(("name", "order", "delayed", "options"), SYSTEMS["flights"])
def test_a_system_does_what_its_recursion_says(foreign_fmu, name, order, delayed, options) -> None:
    """In the order that follows from dependencies; settled, each has the others' values of the step's end.

    With inputs held, an exact component comes to the same place in one step and in four.
    """
    given, parts, pushes = dict(options), order.split(), [0.7, -1.0, 0.0, 2.0, 0.5]
    structure = coupled(name, foreign_fmu, given.pop("substeps", 1)).delayed(delayed)
    inputs = ["push"] if any(connector.kind == "input" for connector in structure.connectors) else []
    ends = [f"{part}.y{number}" for part in parts for number in (1, 2)]
    binding = watch(*ends, inputs=inputs, step_size=0.1)
    with CoupledAsset(structure, binding, isolated=False, **given) as asset:
        assert [*asset.schedule.order] == parts
        begin = asset.observe().values
        steps = [asset.step(dict.fromkeys(inputs, push)).values for push in pushes]
    wanted = recursion(
        name, parts, 0.1, pushes,
        jacobi="algorithm" in options, delayed=delayed, sweeps=options.get("iterations", 1),
    )  # fmt: skip
    np.testing.assert_allclose(
        [begin, *steps], np.hstack([wanted[part] for part in parts]), rtol=1e-9, atol=1e-12
    )


def test_an_algebraic_loop_is_reported(foreign_fmu) -> None:
    loop = coupled("loop", foreign_fmu)
    with pytest.raises(errors.CouplingError) as caught:
        CoupledAsset(loop, watch("left.y1"))
    assert "left.y1 -> right.u1 -> right.y1 -> left.u1" in str(caught.value)
    words = "delay one of its connections, allow iterations, or take the algorithm jacobi"
    assert words in str(caught.value)
    words = r"ends at left\.u2.*connections end at right\.u1, left\.u1"
    with pytest.raises(errors.CouplingError, match=words):
        loop.delayed(["left.u2"])
    with CoupledAsset(coupled("circle", foreign_fmu), watch("left.y2"), isolated=False) as asset:
        assert asset.schedule.loops == ()
        assert [str(link.source) for link in asset.schedule.held] == ["right.y1"]


def test_iterations_that_do_not_settle_or_cannot_be_made(foreign_fmu, spring_mass) -> None:
    words = r"left, right did not settle in 8 iterations.*still changes by"
    stiff = coupled("stiff", foreign_fmu)
    asset = CoupledAsset(stiff, watch("left.y1"), iterations=8, isolated=False)
    with asset, pytest.raises(errors.IterationError, match=words):
        asset.step()
    parts = [Component("spring", spring_mass), linear("law", foreign_fmu("linear2"), d=np.eye(2))]
    joined = system(parts, [("spring.position", "law.u1"), ("law.y1", "spring.force")])
    with pytest.raises(errors.CouplingError, match="component 'spring' cannot save and restore its state"):
        CoupledAsset(joined, watch("law.y1"), iterations=3)


def test_a_binding_of_several_fmus_keeps_its_ranges_and_has_no_decimation(foreign_fmu) -> None:
    structure, push = coupled("oscillator", foreign_fmu), {"push": ("push", "1", -1.0, 2.0)}
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
    structure, seen = of_ours(ours), []
    direct = [read_fmu(ours(PARTS[name])).feedthrough for name in ("damage", "gauges")]
    assert (direct[0]["z1"], direct[1]["reading[2]"]) == (set(), {"strain[2]"})
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


# ---------------------------------------------------------------------- inputs in straight lines

END = 2.0
# x1' = -x1 - 2 x2, x2' = 1.5 x1 - x2: a circle.
EXACT = expm(np.array([[-1.0, -2.0], [1.5, -1.0]]) * END) @ [1.0, 0.0]


def circle(fmu: Any, *, exchange: bool = False, delayed: bool = False, substeps: int = 1) -> SystemStructure:
    """Return two followers x' = u - x that feed each other."""
    joined = (
        Connection(Endpoint("first", "x"), Endpoint("second", "u"), factor=1.5),
        Connection(Endpoint("second", "x"), Endpoint("first", "u"), factor=-2.0, delayed=delayed),
    )
    second = Component("second", fmu, {}, substeps, "model-exchange" if exchange else "co-simulation")
    first = Component("first", fmu, {"start": ComponentSetting(1.0)}, interface="co-simulation")
    return SystemStructure("circle", (first, second), (), joined)


COUPLED = [({}, {}), ({"exchange": True}, {}), ({"substeps": 3}, {}), ({"delayed": True}, {}), ({}, JACOBI),
           ({"exchange": True, "substeps": 3}, JACOBI), ({}, {"iterations": 50})]  # fmt: skip


@pytest.mark.parametrize(("system_options", "asset_options"), COUPLED)
def test_the_error_of_a_system_falls_with_the_square_of_the_step(
    foreign_fmu, system_options, asset_options
) -> None:
    structure, apart = circle(foreign_fmu("follow2"), **system_options), {}
    for kind in ("zero-order", "linear"):
        for steps in (20, 40):
            header = {"step_size": END / steps, "interpolation": kind, "tolerance": 1e-10}
            binding = watch("first.x", "second.x", **header)
            with CoupledAsset(structure, binding, isolated=False, **asset_options) as asset:
                seen = asset.simulate(steps=steps).values[-1]
            apart[kind, steps] = np.abs(seen - EXACT).max()
    assert 1.7 < apart["zero-order", 20] / apart["zero-order", 40] < 2.4
    assert 3.3 < apart["linear", 20] / apart["linear", 40] < 4.8
    assert apart["linear", 40] < 0.3 * apart["zero-order", 40]


# ---------------------------------------------------------------------- wiring


@pytest.fixture(scope="module")
def base(ours: OurFmus) -> SystemStructure:
    ends = Connector("push", "input"), Connector("seen", "output"), Connector("percent", "output", "%")
    return SystemStructure("base", tuple(Component(name, ours(file)) for name, file in PARTS.items()), ends)


def link(source: str, target: str, **options: Any) -> Connection:
    return replace(expand(source, target, tuple(PARTS))[0], **options)


REFUSED = tables(__file__)


def test_what_does_not_fit_is_one_sentence(base, foreign_fmu, tmp_path) -> None:
    first = base.components[0]
    refused = [({"connections": [link(*ends) for ends in joined]}, w) for joined, w in REFUSED["unjoined"]]
    for name, key, value, words in REFUSED["unset"]:
        part = base.component(name) if name in PARTS else Component(name, foreign_fmu(name))
        settled = replace(part, settings={key: ComponentSetting(*value)})
        refused += [({"components": [settled]}, words)]
    refused += [
        ({"components": []}, "has no component"),
        ({"components": [*base.components, first]}, "two components named 'damage'"),
        ({"components": [replace(first, substeps=0)]}, "at least one step"),
        ({"components": [Component("a", tmp_path / "none.fmu")]}, r"no FMU .*none\.fmu"),
    ]
    for changes, words in refused:
        with in_one_sentence((errors.CouplingError, errors.FmuFileError), words):
            Wiring(replace(base, **{name: tuple(items) for name, items in changes.items()}))
    for source, target, sentence in REFUSED["unexpanded"]:
        with pytest.raises(errors.CouplingError, match=sentence):
            expand(source, target, ["a", "b"])


def test_units_and_types_are_converted(base, foreign_fmu) -> None:
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
    given = {
        "mass.servo": ComponentSetting(150.0, "g"),
        "response": ComponentSetting("transient"),
        "health.z1": ComponentSetting(0.2),
    }
    wiring = Wiring(replace(base, components=(replace(base.component("wing"), settings=given),)))
    assert wiring.settings["wing"] == {"mass.servo": pytest.approx(0.15), "response": 2.0, "health.z1": 0.2}
    switched = Component("a", foreign_fmu("array3"), {"active": ComponentSetting(False)})
    assert Wiring(SystemStructure("one", (switched,))).settings == {"a": {"active": 0.0}}
    # An enumeration and an integer feed each other.
    joined = Wiring(replace(base, connections=(link("damage.status", "spring.misbehaviour"),)))
    assert next(iter(joined.feeds.values())).conversion == (1.0, 0.0)


def test_bindings_that_do_not_fit(base) -> None:
    ends = ("push", "wing.load_factor"), ("damage.z1", "wing.health.z1"), ("damage.z1", "percent")
    wiring = Wiring(replace(base, connections=tuple(link(*pair) for pair in ends)))
    observed = {"y": ("damage.z1", "1")}
    for role, end, words in REFUSED["unbound"]:
        given = {"observation": observed} | {role: {"x": end}}
        with pytest.raises(ValueError, match=words):
            CoupledAsset(wiring, bound(1.0, **given))
    right = bound(1.0, observed, control={"x": ("push", "1")})
    with pytest.raises(ValueError, match="algorithm must be one of gauss_seidel, jacobi"):
        CoupledAsset(wiring, right, algorithm="newton")  # type: ignore[arg-type]


NAMES = "abcd"


links_strategy = st.lists(
    st.tuples(st.sampled_from(NAMES), st.sampled_from("xy"), st.sampled_from(NAMES), st.sampled_from("uv")),
    max_size=6,
    unique=True,
)
through = st.fixed_dictionaries(
    {name: st.fixed_dictionaries({out: st.sets(st.sampled_from("uv")) for out in "xy"}) for name in NAMES}
)


@settings(max_examples=300)
@given(links_strategy, through)
def test_the_order_by_enumeration(pairs, feedthrough) -> None:
    """Where some order puts every component after all that it depends on directly, ours is such an order."""
    links = [Connection(Endpoint(a, x), Endpoint(b, u)) for a, x, b, u in pairs]
    plan = schedule(NAMES, links, feedthrough)
    assert sorted(plan.order) == sorted(NAMES)
    assert plan.order == tuple(name for group in plan.groups for name in group)
    directly = {(a, b) for a, _, b, u in pairs if any(u in inputs for inputs in feedthrough[b].values())}
    follows = {(a, b) for a, _, b, _ in pairs}
    orders = [*permutations(NAMES)]

    def keeping(wanted: set[tuple[str, str]]) -> list[tuple[str, ...]]:
        return [order for order in orders if all(order.index(a) < order.index(b) for a, b in wanted)]

    assert plan.order in (keeping(directly) or orders)
    if keeping(follows):
        assert not plan.held
        assert not plan.circles
    place = {name: index for index, name in enumerate(plan.order)}
    assert {*plan.held} == {k for k in links if place[k.source.component] >= place[k.target.component]}


@settings(max_examples=300)
@given(links_strategy, through)
def test_algebraic_loops_by_enumeration(pairs, feedthrough) -> None:
    """A shortest one for each class of variables that depend on each other."""
    links = [Connection(Endpoint(a, x), Endpoint(b, u)) for a, x, b, u in pairs]
    graph: dict[Endpoint, set[Endpoint]] = {Endpoint(name, end): set() for name in NAMES for end in "xyuv"}
    for link in links:
        graph[link.source].add(link.target)
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            for variable in inputs:
                graph[Endpoint(name, variable)].add(Endpoint(name, output))
    joined = np.array([[int(other in successors) for other in graph] for successors in graph.values()])
    _, labels = connected_components(joined, connection="strong")
    ways = shortest_path(joined, unweighted=True)
    nodes = list(graph)
    shortest: dict[int, float] = {}
    for node, successors in graph.items():
        for other in successors:
            a, b = nodes.index(node), nodes.index(other)
            if np.isfinite(ways[b, a]):
                shortest[labels[a]] = min(1.0 + ways[b, a], shortest.get(labels[a], np.inf))
    loops = algebraic_loops(links, feedthrough)
    for loop in loops:
        assert loop[0] == loop[-1]
        assert all(b in graph[a] for a, b in pairwise(loop))
    assert {labels[nodes.index(loop[0])]: len(loop) - 1 for loop in loops} == shortest
    assert len(loops) == len(shortest)


def test_a_long_chain_is_put_in_order_and_the_rest_stays_as_it_stood() -> None:
    count = 30_000
    chain = {node: [node - 1] if node else [] for node in range(count)}
    found = strong_components(chain | {-1: [], -2: [-1]})
    assert found == [(node,) for node in (*reversed(range(count)), -2, -1)]
