"""In which order coupled FMUs are evaluated, and where the order must break: pure functions on names.

Two graphs decide. In the graph of *components*, a connection leads from one to another. In the graph of
*variables*, a connection leads from an output to an input, and direct feedthrough from an input to an output
of the same FMU; a circle in it is an algebraic loop. A circle of components alone is none: somewhere on it
stands a state, whose value at the beginning of the step can be used.
"""

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
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
    groups : tuple of tuple of str
        The components: each one after those that it depends on directly, as far as that is possible; cut into
        what depends on itself in a circle (more than one name, or one that is connected to itself) and what
        does not.
    circles : frozenset of tuple of str
        Those of the groups that are such a circle.
    held : tuple of Link
        Connections that, in one pass in this order, carry the value of the beginning of the step.
    loops : tuple of tuple of Endpoint
        Algebraic loops, each as a shortest circle of variables.
    """

    groups: tuple[tuple[str, ...], ...]
    circles: frozenset[tuple[str, ...]]
    held: tuple[Link, ...]
    loops: tuple[tuple[Endpoint, ...], ...]

    @property
    def order(self) -> tuple[str, ...]:
        """The components in their order."""
        return tuple(name for group in self.groups for name in group)


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
    place = {name: index for index, name in enumerate(name for group in groups for name in group)}
    return Schedule(
        groups=tuple(groups),
        circles=frozenset(group for group in groups if len(group) > 1 or group[0] in follows[group[0]]),
        held=tuple(link for link in links if place[link.source.component] >= place[link.target.component]),
        loops=algebraic_loops(links, feedthrough),
    )


def algebraic_loops(links: Sequence[Link], feedthrough: Feedthrough) -> tuple[tuple[Endpoint, ...], ...]:
    """Return one shortest circle of variables for each set of variables that depend on each other."""
    graph: dict[Endpoint, set[Endpoint]] = {end: set() for link in links for end in link}
    for link in links:
        graph[link.source].add(link.target)
    for name, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            end = Endpoint(name, output)
            for begin in (Endpoint(name, variable) for variable in inputs) if end in graph else ():
                if begin in graph:
                    graph[begin].add(end)
    return tuple(filter(None, (shortest_circle(graph, part) for part in strong_components(graph))))


def strong_components(graph: Mapping[Node, Collection[Node]]) -> list[tuple[Node, ...]]:
    """Return the strongly connected components of a graph in topological order.

    Nodes that may stand in any order keep that of the mapping.

    Parameters
    ----------
    graph : mapping
        Successors by node; every successor is a node of the mapping.
    """
    number = {node: index for index, node in enumerate(graph)}
    edges = [(number[node], number[successor]) for node, others in graph.items() for successor in others]
    begins, ends = zip(*edges, strict=True) if edges else ((), ())
    matrix = coo_array((np.ones(len(edges)), (begins, ends)), shape=(len(number), len(number)))
    parts: dict[int, list[Node]] = {}
    labels = connected_components(matrix, connection="strong")[1].tolist()
    for node, label in zip(graph, labels, strict=True):
        parts.setdefault(label, []).append(node)
    place = {label: index for index, label in enumerate(parts)}  # by their first nodes
    sorter = TopologicalSorter[int](dict.fromkeys(place.values(), ()))
    for begin, end in edges:
        if labels[begin] != labels[end]:
            sorter.add(place[labels[end]], place[labels[begin]])
    sorter.prepare()
    found, ready, order = list(parts.values()), list[int](), []
    while sorter.is_active():  # in the order of the mapping, and so a heap
        for index in sorter.get_ready():
            heappush(ready, index)
        index = heappop(ready)
        order.append(tuple(found[index]))
        sorter.done(index)
    return order


def shortest_circle(graph: Mapping[Node, Collection[Node]], part: Sequence[Node]) -> tuple[Node, ...]:
    """Return a shortest circle inside a strongly connected component, its first node repeated at the end.

    Empty for a node alone that has no connection to itself.
    """
    inside = set(part)
    position = {node: index for index, node in enumerate(graph)}
    best: tuple[Node, ...] = ()
    for start in part:
        trails: list[tuple[Node, ...]] = [(start,)]
        seen: set[Node] = set()
        for trail in trails:  # to which longer ones are added on the way
            if best and len(trail) + 1 >= len(best):
                break
            if start in graph[trail[-1]]:
                best = (*trail, start)
            following = sorted(inside.intersection(graph[trail[-1]]) - seen, key=position.__getitem__)
            seen.update(following)
            trails += [(*trail, node) for node in following]
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
