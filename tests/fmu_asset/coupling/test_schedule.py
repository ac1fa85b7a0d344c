"""Order of components and algebraic loops, against enumeration."""

from itertools import pairwise, permutations

from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.coupling.schedule import Link, algebraic_loops, schedule, strong_components
from fmu_asset.coupling.structure import Endpoint

NAMES = "abcd"
edges = st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=16)


def reachable(graph: dict[object, set[object]]) -> dict[object, set[object]]:
    """Return what can be reached from each node in one step or more, by plain repetition."""
    closure = {node: set(successors) for node, successors in graph.items()}
    for _ in graph:
        for node in graph:
            closure[node] |= {far for near in closure[node] for far in closure[near]}
    return closure


@given(edges)
def test_strong_components_are_the_classes_of_mutual_reachability(pairs) -> None:
    graph: dict[object, set[object]] = {node: {b for a, b in pairs if a == node} for node in range(7)}
    closure = reachable(graph)
    parts = strong_components(graph)
    assert sorted(node for part in parts for node in part) == list(range(7))  # type: ignore[type-var]
    place = {node: index for index, part in enumerate(parts) for node in part}
    for a in range(7):
        for b in range(7):
            together = a == b or (b in closure[a] and a in closure[b])
            assert (place[a] == place[b]) == together
            if b in closure[a] and not together:
                assert place[a] < place[b]  # sources first


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

    def keeps(order: tuple[str, ...]) -> bool:
        return all(order.index(a) < order.index(b) for a, b in directly)

    if any(keeps(order) for order in permutations(NAMES)):
        assert keeps(plan.order)
    follows = {(a, b) for a, _, b, _ in pairs}
    if any(all(o.index(a) < o.index(b) for a, b in follows) for o in permutations(NAMES)):
        assert not plan.held
        assert not plan.circles
    late = {
        link for link in links if plan.order.index(link[0].component) >= plan.order.index(link[1].component)
    }
    assert set(plan.held) == late


@settings(max_examples=300)
@given(links_strategy, through)
def test_algebraic_loops_by_enumeration(pairs, feedthrough) -> None:
    links = [Link(Endpoint(a, x), Endpoint(b, u)) for a, x, b, u in pairs]
    graph: dict[object, set[object]] = {
        Endpoint(name, variable): set() for name in NAMES for variable in "xyuv"
    }
    for link in links:
        graph[link.source].add(link.target)
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            for variable in inputs:
                graph[Endpoint(name, variable)].add(Endpoint(name, output))
    closure = reachable(graph)
    in_a_loop = {node for node in graph if node in closure[node]}
    loops = algebraic_loops(links, feedthrough)
    assert bool(loops) == bool(in_a_loop)
    for loop in loops:
        assert loop[0] == loop[-1]
        assert len(set(loop)) == len(loop) - 1
        assert all(b in graph[a] for a, b in pairwise(loop))
    # One loop for each class of variables that depend on each other.
    classes = {frozenset(n for n in in_a_loop if n in closure[m] and m in closure[n]) for m in in_a_loop}
    assert len(loops) == len(classes)


def test_equal_cases_keep_the_order_that_was_written() -> None:
    plan = schedule(
        ("c", "a", "b"), [Link(Endpoint("b", "x"), Endpoint("a", "u"))], {key: {} for key in "cab"}
    )
    assert plan.order == ("c", "b", "a")


def test_a_shortest_loop_is_named() -> None:
    through_all = {name: {"x": {"u", "v"}, "y": {"u", "v"}} for name in "abc"}
    links = [
        Link(Endpoint("a", "x"), Endpoint("b", "u")),
        Link(Endpoint("b", "x"), Endpoint("c", "u")),
        Link(Endpoint("c", "x"), Endpoint("a", "u")),
        Link(Endpoint("b", "y"), Endpoint("a", "v")),
    ]
    (loop,) = algebraic_loops(links, through_all)
    assert {end.component for end in loop} == {"a", "b"}
    assert len(loop) == 5


def test_a_long_chain_is_put_in_order_and_the_rest_stays_as_it_stood() -> None:
    count = 30_000
    chain = {node: [node - 1] if node else [] for node in range(count)}
    found = strong_components(chain | {-1: [], -2: [-1]})
    assert found == [(node,) for node in (*reversed(range(count)), -2, -1)]
