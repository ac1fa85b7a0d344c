"""A system of FMUs checked against the FMUs themselves: every end exists, fits, and has one source.

First in which order they are evaluated, and where the order must break, by two graphs. In the graph of
*components*, a connection leads from one to another. In the graph of *variables*, a connection leads from an
output to an input, and direct feedthrough from an input to an output of the same FMU; a circle in it is an
algebraic loop. A circle of components alone is none: somewhere on it stands a state, whose value at the
beginning of the step can be used.
"""

import math
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from graphlib import TopologicalSorter
from heapq import heappop, heappush
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fmu_asset.archive.declared import READABLE, FmuDescription, UnitInfo, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.units import IDENTITY, Conversion, between
from fmu_asset.errors import CouplingError, FmuError, said

from .structure import Component, Connection, Endpoint, Setting, SystemStructure

Node = TypeVar("Node", bound=Hashable)
Feedthrough = Mapping[str, Mapping[str, Collection[str]]]
"""For each component, for each output, the inputs that it depends on directly."""


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
    held : tuple of Connection
        Connections that, in one pass in this order, carry the value of the beginning of the step.
    loops : tuple of tuple of Endpoint
        Algebraic loops, each as a shortest circle of variables.
    """

    groups: tuple[tuple[str, ...], ...]
    circles: frozenset[tuple[str, ...]]
    held: tuple[Connection, ...]
    loops: tuple[tuple[Endpoint, ...], ...]

    @property
    def order(self) -> tuple[str, ...]:
        """The components in their order."""
        return tuple(name for group in self.groups for name in group)


def schedule(names: Sequence[str], links: Sequence[Connection], feedthrough: Feedthrough) -> Schedule:
    """Return the order of components, and the algebraic loops.

    Equal cases keep the order of `names`.

    Parameters
    ----------
    names : sequence of str
        The components.
    links : sequence of Connection
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


def algebraic_loops(
    links: Sequence[Connection], feedthrough: Feedthrough
) -> tuple[tuple[Endpoint, ...], ...]:
    """Return one shortest circle of variables for each set of variables that depend on each other."""
    graph = {end: set[Endpoint]() for link in links for end in (link.source, link.target)}
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


_FITS = {
    "Real": {"Real"},
    "Integer": {"Integer", "Real", "Enumeration"},
    "Boolean": {"Boolean"},
    "Enumeration": {"Enumeration", "Integer"},
}
"""For each type of a source, the types of targets that can take it."""


class ConnectedVariable(NamedTuple):
    """A variable of a component as it is seen elsewhere, its units resolved.

    variable = factor * connector + offset for inputs and parameters, and the other way round for outputs and
    what feeds other components.
    """

    end: Endpoint
    conversion: Conversion
    delayed: bool


def read_component(component: Component) -> FmuDescription:
    """Return what the FMU of a component declares; sentences call it as the component does.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the FMU cannot be used.
    """
    try:
        description = read_fmu(component.fmu, component.interface)
    except FmuError as error:
        if not component.shown_as:
            raise
        sentence = error.sentence.replace(str(component.fmu), component.shown_as)
        raise type(error)(sentence, error.messages, error.time) from error
    return replace(description, shown_as=component.shown_as)


class Wiring:
    """A system whose connections were checked.

    Parameters
    ----------
    structure : SystemStructure
        The system.
    leave_out_unknown : bool
        Whether settings of variables that the FMU does not have are left out instead of refused.

    Attributes
    ----------
    structure : SystemStructure
        As given.
    left_out : list of str
        The names of these settings.
    declared : dict of str to FmuDescription
        The FMUs by component.
    feeds : dict of Endpoint to ConnectedVariable
        Connections between components.
    ends : dict of str to tuple of ConnectedVariable
        For each input and parameter of the system where it goes, for each output where it comes from.
    units : dict of str to (str or None)
        Unit of each connector: its own, or that of what it is connected to.
    settings : dict of str to (dict of str to float or str)
        Parameters and start values of each component, in the FMU's units; a text of a parameter that is one.
    schedule : Schedule
        Order of the components, and algebraic loops.

    Raises
    ------
    CouplingError
        If something does not exist, does not fit, or has two sources.
    FmuFileError, FmuUnsupportedError
        If an FMU cannot be used.
    """

    def __init__(self, structure: SystemStructure, *, leave_out_unknown: bool = False) -> None:
        names = [component.name for component in structure.components]
        if not names:
            raise CouplingError(f"The system {structure.name} has no component; name at least one FMU.")
        for name in names:
            if names.count(name) > 1:
                raise CouplingError(said("coupling.two_names", structure=structure, name=name))
        self.declared: dict[str, FmuDescription] = {
            component.name: read_component(component) for component in structure.components
        }
        self.left_out: list[str] = []
        self.structure = structure
        self.settings = {c.name: self._settings(c, leave_out_unknown) for c in structure.components}
        self._kinds = {connector.name: connector.kind for connector in structure.connectors}
        self.units: dict[str, str | None] = {c.name: c.unit for c in structure.connectors}
        self.feeds: dict[Endpoint, ConnectedVariable] = {}
        self.ends: dict[str, tuple[ConnectedVariable, ...]] = dict.fromkeys(self._kinds, ())
        taken: dict[Endpoint, Endpoint] = {}
        for connection in structure.connections:
            self._connect(connection, taken)
        links = [Connection(port.end, target) for target, port in self.feeds.items() if not port.delayed]
        self.schedule: Schedule = schedule(names, links, self._feedthrough())

    def _feedthrough(self) -> dict[str, dict[str, frozenset[str]]]:
        """Return the direct dependencies that count: those of outputs, and of other variables in use."""
        used = {connection.source for connection in self.structure.connections}
        return {
            name: {
                output: inputs
                for output, inputs in declared.feedthrough.items()
                if self.variable(end := Endpoint(name, output)).causality == "output" or end in used
            }
            for name, declared in self.declared.items()
        }

    # ------------------------------------------------------------------ ends

    def variable(self, end: Endpoint) -> VariableInfo:
        """Return the FMU variable at an end.

        Raises
        ------
        CouplingError
            If there is no such component or variable.
        """
        self.structure.component(end.component)
        declared = self.declared[end.component]
        variable = declared.variable(end.variable)
        if variable is None:
            hint = declared.hint(end.variable)
            file = declared.shown_as or declared.path.name
            raise CouplingError(said("coupling.no_variable", end=end, file=file, hint=hint))
        return variable

    def _connector(self, end: Endpoint, kinds: tuple[str, ...], verb: str) -> VariableInfo:
        """Return a connector of the system, which has one of these kinds and fits any type."""
        kind = self._kinds.get(end.variable)
        if kind is None:
            raise CouplingError(said("coupling.no_connector", self=self, end=end, known=self._kinds))
        if kind not in kinds:
            raise CouplingError(said("coupling.connector_kind", end=end, kind=kind, verb=verb))
        return VariableInfo(end.variable, 0, kind="", causality=kind, unit=self.units[end.variable])

    def _connect(self, connection: Connection, taken: dict[Endpoint, Endpoint]) -> None:
        source, target = connection.source, connection.target
        if target in taken:
            raise CouplingError(said("coupling.two_sources", target=target, given=(taken[target], source)))
        taken[target] = source
        if not (math.isfinite(connection.factor) and math.isfinite(connection.offset)):
            raise CouplingError(f"The transformation from {source} to {target} must be finite.")
        if not (source.component or target.component):
            raise CouplingError(said("coupling.two_connectors", source=source, target=target))
        causalities: tuple[str, ...] = ("input",)
        if source.component:
            needed = "an output of a single number is needed"
            gives = self._single(source, READABLE, "the source of a connection", needed)
        else:
            gives = self._connector(source, ("input", "parameter"), "the source")
            causalities = tuple(dict.fromkeys([gives.causality, "input"]))
            if connection.delayed:
                raise CouplingError(f"The connection from the input {source} cannot be delayed.")
        if target.component:
            needed = f"a single number is needed as {' or '.join(causalities)}"
            takes = self._single(target, causalities, "the target of this connection", needed)
        else:
            takes = self._connector(target, ("output",), "the target")
        own, other = (source, target) if source.component else (target, source)
        port = ConnectedVariable(own, self._converted(connection, gives, takes), connection.delayed)
        if other.component:
            self.feeds[target] = port
            return
        self.ends[other.variable] += (port,)
        if self.units[other.variable] is None:
            self.units[other.variable] = takes.unit if gives.unit is None else gives.unit

    def _single(self, end: Endpoint, causalities: tuple[str, ...], what: str, needed: str) -> VariableInfo:
        """Return the variable at an end, which must be a single number of one of these causalities."""
        variable = self.variable(end)
        if variable.causality not in causalities or not variable.single:
            raise CouplingError(said("coupling.causality", end=end, what=what, found=variable, needed=needed))
        return variable

    def _converted(self, connection: Connection, gives: VariableInfo, takes: VariableInfo) -> Conversion:
        """Return what becomes of a value on its way, if the types of both ends fit."""
        source, target, own = connection.source, connection.target, connection.scale
        if gives.kind and takes.kind:
            if takes.base_type not in _FITS[gives.base_type]:
                ends = f"{source} is of the type {gives.kind} and cannot feed {target}"
                raise CouplingError(said("coupling.types", ends=ends, takes=takes))
            if own != IDENTITY and takes.base_type != "Real":
                raise CouplingError(said("coupling.scaled", source=source, target=target, takes=takes))
        if not connection.convert_units:
            return own
        unit = between(gives.unit, self._definitions(source), takes.unit, self._definitions(target))
        if unit is None:
            raise CouplingError(said("coupling.units", source=source, gives=gives, to=target, takes=takes))
        return unit.then(own)

    def _definitions(self, end: Endpoint) -> tuple[UnitInfo, ...]:
        return self.declared[end.component].units if end.component else self.structure.units

    # ------------------------------------------------------------------ parameters

    def _settings(self, component: Component, leave_out_unknown: bool) -> dict[str, float | str]:
        if component.substeps < 1:
            raise CouplingError(said("coupling.substeps", component=component))
        settings: dict[str, float | str] = {}
        for name, setting in component.settings.items():
            if leave_out_unknown and self.declared[component.name].variable(name) is None:
                self.left_out.append(f"{component.name}.{name}")
            else:
                settings[name] = self.start_value(Endpoint(component.name, name), setting)
        return settings

    def start_value(self, end: Endpoint, setting: Setting) -> float | str:
        """Return a parameter or start value: a number in the FMU's unit, or the text of a text parameter.

        Raises
        ------
        CouplingError
            If there is no such parameter or input, or the value is of another type or unit.
        """
        variable = self.variable(end)
        if not variable.is_text_parameter:
            return self._start_number(end, variable, setting)
        if not isinstance(setting.value, str):
            raise CouplingError(
                said("coupling.setting", end=end, value=setting.value, found=variable, wanted="a text")
            )
        return setting.value

    def _start_number(self, end: Endpoint, variable: VariableInfo, setting: Setting) -> float:
        """Return a parameter or start value as a number in the FMU's unit."""
        if variable.causality not in ("parameter", "input") and not variable.startable:
            raise CouplingError(f"{end} cannot be set: it is declared as {variable.causality}.")
        if not variable.single:
            text = f"is of the type {variable.kind}"
            what = "is an array" if variable.shape else "changes with a clock" if variable.clocked else text
            raise CouplingError(f"{end} cannot be set: it {what}; only single numbers are set in a system.")
        value, own = setting.value, self.declared[end.component].units
        if isinstance(value, str | bytes):
            if isinstance(value, str) and value in variable.items:
                return float(variable.items[value])
            wanted = variable.items or "a number"
            raise CouplingError(said("coupling.setting", end=end, value=value, found=variable, wanted=wanted))
        units = (*setting.units, *self.structure.units, *own)
        conversion = between(setting.unit, units, variable.unit, own)
        if conversion is None:
            raise CouplingError(said("coupling.setting_unit", end=end, setting=setting, variable=variable))
        number = conversion.then(setting.scale).to_fmu(float(value))
        if variable.kind == "Boolean":
            fits = value in (0, 1)
        else:
            whole = variable.base_type == "Real" or number.is_integer()
            fits = whole and math.isfinite(number) and not isinstance(value, bool)
        if not fits:
            raise CouplingError(f"{end} cannot be set to {value!r}: it is of the type {variable.kind}.")
        if variable.items and number not in variable.items.values():
            raise CouplingError(
                f"{end} cannot be set to {value!r}: it is an enumeration of {variable.item_list}."
            )
        return number
