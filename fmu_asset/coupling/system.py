"""A system of FMUs as the description of one: its connectors, and the variables of its components."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.door.binding import Binding
from fmu_asset.door.units import IDENTITY
from fmu_asset.instances.plan import Settings

from .structure import Connector, Endpoint
from .wiring import ConnectedVariable, Wiring


@dataclass(frozen=True)
class SystemDescription(FmuDescription):
    """What a system offers.

    Attributes
    ----------
    ends : dict of str to tuple of ConnectedVariable
        For each variable where it goes, or where it comes from.
    definitions : dict of str to tuple of UnitInfo
        For each variable the definitions that its unit is one of: FMUs may differ in them.
    """

    ends: dict[str, tuple[ConnectedVariable, ...]] = field(default_factory=dict)
    definitions: dict[str, tuple[UnitInfo, ...]] = field(default_factory=dict)

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the definitions of units that hold for a variable."""
        return self.definitions[variable.name]

    def of_components(self, settings: Settings) -> dict[str, dict[str, float]]:
        """Return what is set in the system by component and variable, in the FMUs' units."""
        found: dict[str, dict[str, float]] = {}
        for _, reference, (value,) in settings:
            for port in self.ends[self.variables[reference].name]:
                own = found.setdefault(port.end.component, {})
                own[port.end.variable] = port.conversion.to_fmu(value)
        return found


def system_description(
    wiring: Wiring, sha256: str = "", span: tuple[float | None, float | None] = (None, None)
) -> SystemDescription:
    """Return a system as the description of one FMU, all of whose variables are real numbers.

    Outputs of components that a connector shows are local variables; the ranges and types of inputs are
    those of the components, which see to them.

    Parameters
    ----------
    wiring : Wiring
        The system.
    sha256 : str
        Stands for all that the meaning of a state depends on.
    span : (float or None, float or None)
        Start and end of the default experiment [s].
    """
    shown = {port.end for port in wiring.outward.values()}
    found = [_of_connector(wiring, connector) for connector in wiring.structure.connectors]
    for component, declared in wiring.declared.items():
        for variable in declared.variables:
            end = Endpoint(component, variable.name)
            causality = variable.causality
            if end in wiring.feeds:
                causality = "an input that is fed by a connection already"
            elif end in shown:
                causality = "local"
            if variable.single:
                own = replace(variable, name=str(end), causality=causality)
                found.append((own, (ConnectedVariable(end, IDENTITY, False),), declared.units))
    steps = [declared.fixed_step or declared.step_size for declared in wiring.declared.values()]
    return SystemDescription(
        path=Path(f"the system {wiring.structure.name}"),
        sha256=sha256,
        file_size=0,
        fmi_version="2.0",
        model_name=wiring.structure.name,
        model_identifier="",
        guid="",
        description="",
        generation_tool="",
        platforms=(),
        can_get_and_set_state=True,
        can_serialise_state=True,
        can_vary_step=True,
        # An input that nobody gives keeps the start value of its FMU.
        variables=tuple(
            replace(
                variable,
                reference=number,
                kind="Real",
                minimum=None,
                maximum=None,
                start="nan" if variable.causality == "input" else None,
            )
            for number, (variable, _, _) in enumerate(found)
        ),
        units=(),
        start_time=span[0],
        stop_time=span[1],
        step_size=min((size for size in steps if size is not None), default=None),
        ends={variable.name: ends for variable, ends, _ in found},
        definitions={variable.name: units for variable, _, units in found},
    )


def _of_connector(
    wiring: Wiring, connector: Connector
) -> tuple[VariableInfo, tuple[ConnectedVariable, ...], tuple[UnitInfo, ...]]:
    there = wiring.outward.get(connector.name)
    ends = wiring.inward.get(connector.name, ()) if there is None else (there,)
    causality = "output"
    if there is None:
        causalities = {wiring.variable(port.end).causality for port in ends} or {"connected to nothing"}
        causality = " and ".join(sorted(causalities))
    units = tuple(unit for port in ends for unit in wiring.declared[port.end.component].units)
    variable = VariableInfo(
        name=connector.name,
        reference=0,
        kind="Real",
        causality=causality,
        variability="continuous",
        description="",
        unit=wiring.units[connector.name],
        display_unit=None,
        minimum=None,
        maximum=None,
        start=None,
    )
    return variable, ends, (*wiring.structure.units, *units)


def wiring_hash(wiring: Wiring, binding: Binding, *algorithm: str | float) -> str:
    """Return the SHA-256 of all that the meaning of a state depends on; places of files do not count."""

    def told(ports: tuple[ConnectedVariable, ...]) -> Iterator[list[str | float | bool]]:
        return ([str(port.end), *port.conversion, port.delayed] for port in ports)

    record = {
        "components": [
            [c.name, wiring.declared[c.name].sha256, wiring.settings[c.name], c.substeps, c.interface]
            for c in wiring.structure.components
        ],
        "feeds": [[str(target), *told((port,))] for target, port in wiring.feeds.items()],
        "inward": {name: [*told(ports)] for name, ports in wiring.inward.items()},
        "outward": {name: [*told((port,))] for name, port in wiring.outward.items()},
        "binding": binding.model_dump(mode="json", exclude={"limits"}),
        "algorithm": algorithm,
    }
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
