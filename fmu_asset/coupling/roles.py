"""A binding resolved against a system of FMUs: which ends its roles stand for, and in which units."""

from collections.abc import Mapping
from typing import NamedTuple

from fmu_asset.archive.declared import READABLE, UnitInfo
from fmu_asset.door.binding import INPUT_ROLES, Binding
from fmu_asset.door.units import Conversion, between
from fmu_asset.errors import BindingError

from .structure import Endpoint, listed
from .wiring import ConnectedVariable, Wiring, composed


class Roles(NamedTuple):
    """What a binding's names stand for in a system.

    Attributes
    ----------
    inputs : dict of str to dict of str to tuple of ConnectedVariable
        For each role, for each name, where a value goes; each conversion is from the binding's unit.
    parameters : dict of str to tuple of ConnectedVariable
        The same for parameters.
    observations : tuple of ConnectedVariable
        Where observed values come from, in order; each conversion is to the binding's unit.
    monitors : dict of str to ConnectedVariable
        The same for monitors.
    """

    inputs: dict[str, dict[str, tuple[ConnectedVariable, ...]]]
    parameters: dict[str, tuple[ConnectedVariable, ...]]
    observations: tuple[ConnectedVariable, ...]
    monitors: dict[str, ConnectedVariable]


def resolve_roles(wiring: Wiring, binding: Binding) -> Roles:
    """Return what the names of a binding stand for.

    A variable of the binding is a connector of the system, or `component.variable`.

    Raises
    ------
    BindingError
        If a variable does not exist, is of another kind, or has another unit.
    CouplingError
        If a component does not exist.
    """
    for what, given in (
        ("a decimation", binding.binding.decimation != 1),
        ("ports", bool(binding.port)),
        ("a table `record`", bool(binding.record.variables)),
    ):
        if given:
            raise BindingError(
                f"The binding {binding.name} of several FMUs has {what}, which only a binding of one FMU can "
                "have; leave it out."
            )
    return Roles(
        inputs={
            role: {
                name: _targets(wiring, scalar.variable, scalar.unit, f"{role}.{name}", "input")
                for name, scalar in binding.inputs(role).items()
            }
            for role in INPUT_ROLES
        },
        parameters={
            name: _targets(wiring, scalar.variable, scalar.unit, f"parameter.{name}", "parameter")
            for name, scalar in binding.parameter.items()
        },
        observations=tuple(
            _source(wiring, variable, unit, f"observation.{name}")
            for name, vector in binding.observation.items()
            for variable, unit in zip(vector.variables, vector.units, strict=True)
        ),
        monitors={
            name: _source(wiring, scalar.variable, scalar.unit, f"monitor.{name}")
            for name, scalar in binding.monitor.items()
        },
    )


def parameter_values(
    binding: Binding, roles: Roles, given: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Return the parameters that binding and caller set, by component and variable, in the FMUs' units.

    Raises
    ------
    BindingError
        If the binding has no such parameter.
    """
    for name in given:
        if name not in roles.parameters:
            raise BindingError(
                f"The binding {binding.name} has no parameter {name!r}; it has {listed(roles.parameters)}."
            )
    fixed = {key: item.value for key, item in binding.parameter.items() if item.value is not None}
    values: dict[str, dict[str, float]] = {}
    for key, value in {**fixed, **given}.items():
        for port in roles.parameters[key]:
            own = values.setdefault(port.end.component, {})
            own[port.end.variable] = port.conversion.to_fmu(float(value))
    return values


def _targets(wiring: Wiring, name: str, unit: str, where: str, kind: str) -> tuple[ConnectedVariable, ...]:
    end = wiring.structure.locate(name)
    if not end.component:
        if name not in wiring.inward:
            raise BindingError(
                f"{where} names {name!r}, which is an output of the system; an {kind} is needed."
            )
        ports = wiring.inward[name]
        if not ports:
            raise BindingError(
                f"{where} names {name!r}, an {kind} of the system that is connected to nothing."
            )
        own = _unit(unit, wiring.units[name], wiring, Endpoint("", name), where, outward=False)
        wrong = [p.end for p in ports if wiring.variable(p.end).causality != kind]
        if wrong:
            raise BindingError(f"{where} names {name!r}, which goes to {listed(wrong)}; {kind}s are needed.")
        return tuple(port._replace(conversion=composed(own, port.conversion)) for port in ports)
    variable = wiring.variable(end)
    if variable.causality != kind or not variable.single:
        raise BindingError(
            f"{where} names {name!r}, which is declared as {variable.causality} of the type {variable.kind}; "
            f"a numeric {kind} is needed."
        )
    if end in wiring.feeds:
        raise BindingError(f"{where} names {name!r}, which is fed by a connection already.")
    return (ConnectedVariable(end, _unit(unit, variable.unit, wiring, end, where, outward=False), False),)


def _source(wiring: Wiring, name: str, unit: str, where: str) -> ConnectedVariable:
    end = wiring.structure.locate(name)
    if not end.component:
        port = wiring.outward.get(name)
        if port is None:
            raise BindingError(
                f"{where} names {name!r}, which is no output of the system that something is connected to; "
                f"its outputs are {listed(wiring.outward)}."
            )
        own = _unit(unit, wiring.units[name], wiring, Endpoint("", name), where, outward=True)
        return port._replace(conversion=composed(port.conversion, own))
    variable = wiring.variable(end)
    if variable.causality not in READABLE or not variable.single:
        raise BindingError(
            f"{where} names {name!r}, which is declared as {variable.causality} of the type {variable.kind}; "
            "a numeric output is needed."
        )
    return ConnectedVariable(end, _unit(unit, variable.unit, wiring, end, where, outward=True), False)


def _unit(
    unit: str, other: str | None, wiring: Wiring, end: Endpoint, where: str, *, outward: bool
) -> Conversion:
    """Return the conversion from the binding's unit to the system's, or the other way if `outward`."""
    known = (
        wiring.declared[end.component].units
        if end.component
        else (*wiring.structure.units, *_defined(wiring, end))
    )
    found = between(other, known, unit, known) if outward else between(unit, known, other, known)
    if found is None:
        raise BindingError(
            f"{where} is in {unit!r}, but the system has {str(end)!r} in {other!r}, and there is no "
            f"conversion between the two; state the value in {other!r}."
        )
    return found


def _defined(wiring: Wiring, end: Endpoint) -> tuple[UnitInfo, ...]:
    """Return the unit definitions of the FMUs behind a connector, which may have lent it its unit."""
    ports = [*wiring.inward.get(end.variable, ()), *filter(None, [wiring.outward.get(end.variable)])]
    return tuple(unit for port in ports for unit in wiring.declared[port.end.component].units)
