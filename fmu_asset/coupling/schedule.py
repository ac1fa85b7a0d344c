"""The order in which the components of a system are evaluated, and where the order must break.

Both follow from two graphs. In the graph of *components*, a connection leads from one to another.
In the graph of *variables*, a connection leads from an output to an input, and direct feedthrough
from an input to an output of the same FMU; a cycle in it is an algebraic loop. A cycle of
components alone is not one: somewhere on it stands a state, whose value at the beginning of the
step can be used.
"""

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from heapq import heappop, heappush
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .structure import Connection, Endpoint

Node = TypeVar("Node", bound=Hashable)


Feedthrough = Mapping[str, Mapping[str, Collection[str]]]
"""For each component, for each output, the inputs that it depends on directly."""


_SHOWN_LOOPS = 3


@dataclass(frozen=True)
class Schedule:
    """The order in which a step evaluates the components.

    Attributes
    ----------
    groups : tuple of tuple of str
        The components, each one after those that it depends on directly, as far as that is
        possible. A group is one component, or the components of a cycle.
    cycles : frozenset of tuple of str
        The groups that are a cycle: several components, or one that is connected to itself.
    held : tuple of Connection
        The connections against this order, which carry the value from the beginning of the step.
    loops : tuple of tuple of Endpoint
        The algebraic loops, each as a shortest cycle of variables.
    """

    groups: tuple[tuple[str, ...], ...]
    cycles: frozenset[tuple[str, ...]]
    held: tuple[Connection, ...]
    loops: tuple[tuple[Endpoint, ...], ...]

    @property
    def order(self) -> tuple[str, ...]:
        """The components in their order."""
        return tuple(name for group in self.groups for name in group)


def schedule(
    names: Sequence[str], connections: Sequence[Connection], feedthrough: Feedthrough
) -> Schedule:
    """Return the order of the components, and the algebraic loops.

    Components that may stand in any order keep that of `names`.

    Parameters
    ----------
    connections : sequence of Connection
        The connections between components that are not delayed.
    feedthrough : mapping
        The inputs that each output depends on directly.
    """
    followers: dict[str, set[str]] = {name: set() for name in names}
    direct_followers: dict[str, set[str]] = {name: set() for name in names}
    for connection in connections:
        source, target = connection.source.component, connection.target.component
        followers[source].add(target)
        inputs_of_outputs = feedthrough[target].values()
        if any(connection.target.variable in inputs for inputs in inputs_of_outputs):
            direct_followers[source].add(target)
    groups = []
    for group in strong_components(followers):
        # Within a cycle, direct feedthrough says the order; what even it joins in a cycle keeps
        # its order.
        direct_inside = {
            name: [follower for follower in direct_followers[name] if follower in group]
            for name in group
        }
        ordered_names: list[str] = []
        for component_group in strong_components(direct_inside):
            ordered_names += component_group
        groups.append(tuple(ordered_names))
    cycles = []
    for group in groups:
        first_name = group[0]
        if len(group) > 1 or first_name in followers[first_name]:
            cycles.append(group)
    position: dict[str, int] = {}
    for group in groups:
        for name in group:
            position[name] = len(position)
    held_connections = []
    for connection in connections:
        if position[connection.source.component] >= position[connection.target.component]:
            held_connections.append(connection)
    return Schedule(
        groups=tuple(groups),
        cycles=frozenset(cycles),
        held=tuple(held_connections),
        loops=algebraic_loops(connections, feedthrough),
    )


def algebraic_loops(
    connections: Sequence[Connection], feedthrough: Feedthrough
) -> tuple[tuple[Endpoint, ...], ...]:
    """Return one shortest cycle for each set of variables that depend on each other.

    Parameters
    ----------
    connections : sequence of Connection
        The connections between components that are not delayed.
    feedthrough : mapping
        The inputs that each output depends on directly.
    """
    successors: dict[Endpoint, set[Endpoint]] = {}
    for connection in connections:
        successors.setdefault(connection.source, set())
        successors.setdefault(connection.target, set())
        successors[connection.source].add(connection.target)
    for component, inputs_by_output in feedthrough.items():
        for output, inputs in inputs_by_output.items():
            output_end = Endpoint(component, output)
            if output_end not in successors:
                continue
            for variable in inputs:
                input_end = Endpoint(component, variable)
                if input_end in successors:
                    successors[input_end].add(output_end)
    loops = []
    for strong_component in strong_components(successors):
        cycle = shortest_cycle(successors, strong_component)
        if cycle:
            loops.append(cycle)
    return tuple(loops)


def strong_components(graph: Mapping[Node, Collection[Node]]) -> list[tuple[Node, ...]]:
    """Return the strongly connected components of a graph in topological order.

    Nodes that may stand in any order keep that of the mapping.

    Parameters
    ----------
    graph : mapping
        The successors by node; every successor is a node of the mapping.
    """
    # strongly connected components, by SciPy
    number = {node: index for index, node in enumerate(graph)}
    begins: list[int] = []
    ends: list[int] = []
    for node, successors in graph.items():
        for successor in successors:
            begins.append(number[node])
            ends.append(number[successor])
    shape = (len(number), len(number))
    matrix = coo_array((np.ones(len(begins)), (begins, ends)), shape=shape)
    labels = connected_components(matrix, connection="strong")[1].tolist()
    members: dict[int, list[Node]] = {}
    for node, label in zip(graph, labels, strict=True):
        members.setdefault(label, []).append(node)
    # graph of the components, numbered by their first nodes
    position = {label: index for index, label in enumerate(members)}
    sorter = TopologicalSorter[int](dict.fromkeys(position.values(), ()))
    for begin, end in zip(begins, ends, strict=True):
        if labels[begin] != labels[end]:
            sorter.add(position[labels[end]], position[labels[begin]])
    # topological order; a heap gives the first in the order of the mapping of those that are ready
    sorter.prepare()
    components = list(members.values())
    ready: list[int] = []
    order = []
    while sorter.is_active():
        for index in sorter.get_ready():
            heappush(ready, index)
        index = heappop(ready)
        order.append(tuple(components[index]))
        sorter.done(index)
    return order


def shortest_cycle(
    graph: Mapping[Node, Collection[Node]], strong_component: Sequence[Node]
) -> tuple[Node, ...]:
    """Return a shortest cycle inside a strongly connected component of a graph.

    Parameters
    ----------
    graph : mapping
        The successors by node.

    Returns
    -------
    tuple
        The nodes of the cycle, the first repeated at the end; empty for a node alone that has no
        connection to itself.
    """
    members = set(strong_component)
    position = {node: index for index, node in enumerate(graph)}
    shortest: tuple[Node, ...] = ()
    for start in strong_component:
        # breadth-first search; the loop goes on to the longer trails that it appends
        trails: list[tuple[Node, ...]] = [(start,)]
        visited: set[Node] = set()
        for trail in trails:
            if shortest and len(trail) + 1 >= len(shortest):
                break
            successors = graph[trail[-1]]
            if start in successors:
                shortest = (*trail, start)
            unvisited = members.intersection(successors) - visited
            visited.update(unvisited)
            for node in sorted(unvisited, key=position.__getitem__):
                trails.append((*trail, node))
    return shortest


def loop_sentence(loops: Sequence[Sequence[Endpoint]]) -> str:
    """Return the sentence that reports algebraic loops."""
    cycles = []
    for loop in loops[:_SHOWN_LOOPS]:
        cycles.append(" -> ".join(str(end) for end in loop))
    cycle_list = "; ".join(cycles)
    if len(loops) > _SHOWN_LOOPS:
        cycle_list += f" and {len(loops) - _SHOWN_LOOPS} more"
    subject = "an algebraic loop" if len(loops) == 1 else f"{len(loops)} algebraic loops"
    return (
        f"The connections close {subject} ({cycle_list}): every value in it depends on itself at "
        "the same moment; delay one of its connections, allow iterations, or take the algorithm "
        "jacobi, which delays all of them."
    )
