"""In which order coupled FMUs are evaluated, and where the order must break: pure functions on names.

Two graphs decide. In the graph of *components*, a connection leads from one to another. In the graph of
*variables*, a connection leads from an output to an input, and direct feedthrough from an input to an output
of the same FMU; a circle in it is an algebraic loop. A circle of components alone is none: somewhere on it
stands a state, whose value at the beginning of the step can be used.
"""

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .structure import Endpoint

Node = TypeVar("Node", bound=Hashable)
Feedthrough = Mapping[str, Mapping[str, Collection[str]]]
"""For each component, for each output, the inputs that it depends on directly."""


class Link(NamedTuple):
    """A connection between components whose value is wanted from the same moment, not delayed."""

    source: Endpoint
    target: Endpoint


@dataclass(frozen=True)
class Schedule:
    """How a step goes through the components.

    Attributes
    ----------
    order : tuple of str
        The components: each one after those that it depends on directly, as far as that is possible.
    groups : tuple of tuple of str
        The same order, cut into what depends on itself in a circle (more than one name, or one that is
        connected to itself) and what does not.
    circular : tuple of bool
        For each group, whether it is such a circle.
    held : tuple of Link
        Connections that, in one pass in this order, carry the value of the beginning of the step.
    loops : tuple of tuple of Endpoint
        Algebraic loops, each as a shortest circle of variables.
    """

    order: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    circular: tuple[bool, ...]
    held: tuple[Link, ...]
    loops: tuple[tuple[Endpoint, ...], ...]


def schedule(names: Sequence[str], links: Sequence[Link], feedthrough: Feedthrough) -> Schedule:
    """Return the order of components, and the algebraic loops.

    Equal cases keep the order of `names`.

    Parameters
    ----------
    names : sequence of str
        The components.
    links : sequence of Link
        Connections between them that are not delayed.
    feedthrough : mapping
        Direct dependencies of outputs on inputs.
    """
    follows: dict[str, set[str]] = {name: set() for name in names}
    directly: dict[str, set[str]] = {name: set() for name in names}
    for link in links:
        a, b = link.source.component, link.target.component
        follows[a].add(b)
        if any(link.target.variable in inputs for inputs in feedthrough[b].values()):
            directly[a].add(b)
    groups = []
    for group in strong_components(follows):
        inside = {name: [other for other in directly[name] if other in group] for name in group}
        # What even direct feedthrough joins in a circle stays in the order of the names.
        groups.append(tuple(name for part in strong_components(inside) for name in part))
    order = tuple(name for group in groups for name in group)
    place = {name: index for index, name in enumerate(order)}
    return Schedule(
        order=order,
        groups=tuple(groups),
        circular=tuple(len(group) > 1 or group[0] in follows[group[0]] for group in groups),
        held=tuple(link for link in links if place[link.source.component] >= place[link.target.component]),
        loops=algebraic_loops(links, feedthrough),
    )


def algebraic_loops(links: Iterable[Link], feedthrough: Feedthrough) -> tuple[tuple[Endpoint, ...], ...]:
    """Return one shortest circle of variables for each set of variables that depend on each other."""
    graph: dict[Endpoint, set[Endpoint]] = {}
    for link in links:
        graph.setdefault(link.source, set()).add(link.target)
        graph.setdefault(link.target, set())
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            for variable in inputs:
                begin, end = Endpoint(name, variable), Endpoint(name, output)
                if begin in graph and end in graph:
                    graph[begin].add(end)
    found = []
    for part in strong_components(graph):
        if len(part) > 1 or part[0] in graph[part[0]]:
            found.append(shortest_circle(graph, part))
    return tuple(found)


def strong_components(graph: Mapping[Node, Collection[Node]]) -> list[tuple[Node, ...]]:
    """Return the strongly connected components of a graph in topological order.

    Nodes that may stand in any order keep that of the mapping.

    Parameters
    ----------
    graph : mapping
        Successors by node; every successor is a node of the mapping.
    """
    nodes = list(graph)
    number = {node: index for index, node in enumerate(nodes)}
    edges = [(number[node], number[successor]) for node in nodes for successor in graph[node]]
    begins, ends = zip(*edges, strict=True) if edges else ((), ())
    matrix = coo_array((np.ones(len(edges)), (begins, ends)), shape=(len(nodes), len(nodes)))
    part_of = connected_components(matrix, connection="strong")[1].tolist()
    parts: dict[int, list[Node]] = {}
    first: dict[int, int] = {}  # place of a part's first node
    for index, (node, part) in enumerate(zip(nodes, part_of, strict=True)):
        parts.setdefault(part, []).append(node)
        first.setdefault(part, index)
    behind: dict[int, set[int]] = {part: set() for part in parts}
    for begin, end in edges:
        behind[part_of[begin]].add(part_of[end])
    before = dict.fromkeys(parts, 0)
    for part, others in behind.items():
        others.discard(part)
        for other in others:
            before[other] += 1
    ready = [(first[part], part) for part, count in before.items() if not count]
    order = []
    while ready:  # in the order of the mapping, and so a heap
        _, part = heappop(ready)
        order.append(tuple(parts[part]))
        for other in behind[part]:
            before[other] -= 1
            if not before[other]:
                heappush(ready, (first[other], other))
    return order


def shortest_circle(graph: Mapping[Node, Collection[Node]], part: Sequence[Node]) -> tuple[Node, ...]:
    """Return a shortest circle inside a strongly connected component, its first node repeated at the end."""
    inside = set(part)
    position = {node: index for index, node in enumerate(graph)}
    best: tuple[Node, ...] = ()
    for start in part:
        trails: list[tuple[Node, ...]] = [(start,)]
        seen: set[Node] = set()
        while trails and not (best and len(trails[0]) + 1 >= len(best)):
            trail = trails.pop(0)
            for successor in sorted(graph[trail[-1]], key=position.__getitem__):
                if successor == start:
                    best = (*trail, start)
                    trails = []
                    break
                if successor in inside and successor not in seen:
                    seen.add(successor)
                    trails.append((*trail, successor))
    return best


def loop_sentence(loops: Sequence[Sequence[Endpoint]]) -> str:
    """Return the sentence that reports algebraic loops."""
    shown = "; ".join(" -> ".join(str(end) for end in loop) for loop in loops[:3])
    more = f" and {len(loops) - 3} more" if len(loops) > 3 else ""
    return (
        "The connections close "
        f"{'an algebraic loop' if len(loops) == 1 else f'{len(loops)} algebraic loops'} ({shown}{more}): "
        "every value in it depends on itself at the same moment; delay one of its connections, allow "
        "iterations, or take the algorithm jacobi, which delays all of them."
    )
