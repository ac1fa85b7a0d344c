"""The order of a system's components, and its algebraic loops, by enumeration."""

from itertools import pairwise, permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, shortest_path

from fmu_asset.coupling.schedule import Schedule, algebraic_loops, schedule, strong_components
from fmu_asset.coupling.structure import Connection, Endpoint

NAMES = "abcd"
"""Components, each with the outputs x and y and the inputs u and v."""
ORDERS = [*permutations(NAMES)]


def connect_all(ends: list[tuple[str, str, str, str]]) -> list[Connection]:
    """Return connections, given component and variable of each source and target."""
    return [
        Connection(Endpoint(source, output), Endpoint(target, variable))
        for source, output, target, variable in ends
    ]


connection_lists = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.sampled_from("xy"),
        st.sampled_from(NAMES),
        st.sampled_from("uv"),
    ),
    max_size=6,
    unique=True,
).map(connect_all)
feedthroughs = st.fixed_dictionaries(
    {
        name: st.fixed_dictionaries({output: st.sets(st.sampled_from("uv")) for output in "xy"})
        for name in NAMES
    }
)
"""The inputs that each output depends on directly."""


def orders_that_keep(pairs: set[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Return the orders in which the first of each pair stands before the second."""
    keeping = []
    for order in ORDERS:
        if all(order.index(first) < order.index(second) for first, second in pairs):
            keeping.append(order)
    return keeping


def pairs_of(connections: list[Connection]) -> set[tuple[str, str]]:
    return {(each.source.component, each.target.component) for each in connections}


def depends_directly(connection: Connection, feedthrough) -> bool:
    """Return whether some output of the target depends on the input that is fed."""
    inputs_of_outputs = feedthrough[connection.target.component].values()
    return any(connection.target.variable in inputs for inputs in inputs_of_outputs)


# ---------------------------------------------------------------------- order


@settings(max_examples=300)
@given(connection_lists, feedthroughs)
def test_the_order_puts_components_behind_what_they_depend_on_directly(connections, feedthrough):
    """If there is such an order; connections against the order are held."""
    direct = [each for each in connections if depends_directly(each, feedthrough)]

    plan = schedule(NAMES, connections, feedthrough)

    assert plan.order in (orders_that_keep(pairs_of(direct)) or ORDERS)
    assert_complete(plan)
    assert_held(plan, connections)


def assert_complete(plan: Schedule) -> None:
    """Assert that each component stands once in the order and in the groups."""
    assert sorted(plan.order) == sorted(NAMES)
    assert plan.order == tuple(name for group in plan.groups for name in group)


def assert_held(plan: Schedule, connections: list[Connection]) -> None:
    """Assert that connections against the order are held; none if some order follows all."""
    rank = {name: number for number, name in enumerate(plan.order)}
    against_order = {
        each for each in connections if rank[each.source.component] >= rank[each.target.component]
    }
    assert {*plan.held} == against_order
    if orders_that_keep(pairs_of(connections)):
        assert not plan.held
        assert not plan.cycles


def test_a_long_chain_is_put_in_order_and_what_was_in_order_stays():
    count = 30_000
    chain = {node: [node - 1] if node else [] for node in range(count)}

    components = strong_components(chain | {-1: [], -2: [-1]})

    assert components == [(node,) for node in (*reversed(range(count)), -2, -1)]


# ---------------------------------------------------------------------- algebraic loops

Graph = dict[Endpoint, set[Endpoint]]


def graph_of_variables(connections, feedthrough) -> Graph:
    """Return the variables that depend on each variable directly."""
    graph: Graph = {Endpoint(name, variable): set() for name in NAMES for variable in "xyuv"}
    for connection in connections:
        graph[connection.source].add(connection.target)
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            for variable in inputs:
                graph[Endpoint(name, variable)].add(Endpoint(name, output))
    return graph


def classes_of(graph: Graph) -> dict[Endpoint, int]:
    """Return the number of the class of variables that depend on each other, for each variable."""
    _, labels = connected_components(adjacency(graph), connection="strong")
    return dict(zip(graph, labels.tolist(), strict=True))


def adjacency(graph: Graph) -> np.ndarray:
    return np.array(
        [[int(other in successors) for other in graph] for successors in graph.values()]
    )


def shortest_loops(graph: Graph) -> dict[int, float]:
    """Return the length of the shortest loop of each class that has one."""
    nodes = list(graph)
    classes = classes_of(graph)
    distances = shortest_path(adjacency(graph), unweighted=True)
    lengths: dict[int, float] = {}
    for node, successors in graph.items():
        for successor in successors:
            way_back = distances[nodes.index(successor), nodes.index(node)]
            if np.isfinite(way_back):
                label = classes[node]
                lengths[label] = min(1.0 + way_back, lengths.get(label, np.inf))
    return lengths


def assert_closed(loop, graph: Graph) -> None:
    """Assert that a loop ends where it begins, and follows the graph."""
    assert loop[0] == loop[-1]
    assert all(second in graph[first] for first, second in pairwise(loop))


@settings(max_examples=300)
@given(connection_lists, feedthroughs)
def test_there_is_a_shortest_loop_for_each_class_of_variables(connections, feedthrough):
    graph = graph_of_variables(connections, feedthrough)
    classes = classes_of(graph)

    loops = algebraic_loops(connections, feedthrough)

    for loop in loops:
        assert_closed(loop, graph)
    lengths = {classes[loop[0]]: len(loop) - 1 for loop in loops}
    assert lengths == shortest_loops(graph)
    assert len(loops) == len(lengths)
