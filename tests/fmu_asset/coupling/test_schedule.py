"""Order of components and algebraic loops, against enumeration and SciPy's graphs."""

from collections.abc import Mapping, Set
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, shortest_path

from fmu_asset.coupling.structure import Endpoint
from fmu_asset.coupling.wiring import Link, algebraic_loops, schedule, strong_components

NAMES = "abcd"
edges = st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=16)


def analysed(graph: Mapping[Any, Set[Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the label of each node's strong component, and the lengths of the shortest ways."""
    joined = np.array([[int(other in successors) for other in graph] for successors in graph.values()])
    _, labels = connected_components(joined, connection="strong")
    return labels, shortest_path(joined, unweighted=True)


@given(edges)
def test_strong_components_are_the_classes_of_mutual_reachability(pairs) -> None:
    graph: dict[object, set[object]] = {node: {b for a, b in pairs if a == node} for node in range(7)}
    labels, ways = analysed(graph)
    parts = strong_components(graph)
    assert sorted(node for part in parts for node in part) == list(range(7))  # type: ignore[type-var]
    place = np.array([next(k for k, part in enumerate(parts) if node in part) for node in range(7)])
    np.testing.assert_array_equal(place[:, np.newaxis] == place, labels[:, np.newaxis] == labels)
    assert not (np.isfinite(ways) & (place[:, np.newaxis] > place)).any()  # sources first


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
    links = [Link(Endpoint(a, x), Endpoint(b, u)) for a, x, b, u in pairs]
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
    links = [Link(Endpoint(a, x), Endpoint(b, u)) for a, x, b, u in pairs]
    graph: dict[Endpoint, set[Endpoint]] = {Endpoint(name, end): set() for name in NAMES for end in "xyuv"}
    for link in links:
        graph[link.source].add(link.target)
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            for variable in inputs:
                graph[Endpoint(name, variable)].add(Endpoint(name, output))
    labels, ways = analysed(graph)
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


def test_equal_cases_keep_the_order_that_was_written() -> None:
    joined = [Link(Endpoint("b", "x"), Endpoint("a", "u"))]
    assert schedule(("c", "a", "b"), joined, {key: {} for key in "cab"}).order == ("c", "b", "a")


def test_a_long_chain_is_put_in_order_and_the_rest_stays_as_it_stood() -> None:
    count = 30_000
    chain = {node: [node - 1] if node else [] for node in range(count)}
    found = strong_components(chain | {-1: [], -2: [-1]})
    assert found == [(node,) for node in (*reversed(range(count)), -2, -1)]
