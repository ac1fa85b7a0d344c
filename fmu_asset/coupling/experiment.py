"""A system of FMUs flown without a binding: all outputs, and values set by the names of its ends."""

from collections.abc import Mapping

from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector
from fmu_asset.door.experiment import Experiment, steps_to
from fmu_asset.errors import BindingError

from .structure import Endpoint, listed
from .wiring import Wiring


def system_experiment(
    wiring: Wiring,
    *,
    span: tuple[float | None, float | None] = (None, None),
    step_size: float | None = None,
    values: Mapping[str, float] | None = None,
) -> Experiment:
    """Return the simulation of a system from its start, with everything that it gives.

    Parameters
    ----------
    wiring : Wiring
        The system.
    span : (float or None, float or None)
        Start and end [s]; zero, and a second after the start.
    step_size : float, optional
        Communication step size [s]; the smallest that a component declares, or a 500th of the span.
    values : mapping of str to float, optional
        Parameters and inputs: connectors of the system, or `component.variable`, in their units.

    Raises
    ------
    BindingError
        If the system gives no number, or has no such parameter or input.
    FmuInputError
        If the end does not come after the start, or the steps are too many.
    CouplingError
        If a value is of no component.
    """
    declared_step = min(
        (
            size
            for d in wiring.declared.values()
            for size in (d.fixed_step or d.step_size,)
            if size is not None
        ),
        default=None,
    )
    start, steps, size = steps_to(span[0] or 0.0, span[1], step_size or declared_step)
    observed = every_output(wiring)
    if not observed:
        raise BindingError(f"The system {wiring.structure.name} gives no number that could be observed.")
    parameters, inputs = {}, {}
    for name in values or {}:
        kind, unit = _settable(wiring, name)
        if kind == "parameter":
            parameters[name] = Parameter(variable=name, unit=unit)
        else:
            inputs[name] = Input(variable=name, unit=unit)
    binding = Binding(
        binding=Header(name=wiring.structure.name, step_size=size, start_time=start),
        observation={name: Vector(variables=(name,), unit=unit) for name, unit in observed.items()},
        parameter=parameters,
        load=inputs,
    )
    given = values or {}
    held = {name: given[name] for name in inputs}
    return Experiment(binding, steps, {name: given[name] for name in parameters}, {"load": held})


def every_output(wiring: Wiring) -> dict[str, str]:
    """Return the units of all outputs of a system, and of those of its components that it does not show."""
    observed = {name: wiring.units[name] or "1" for name in wiring.outward}
    shown = {port.end for port in wiring.outward.values()}
    for component, item in wiring.declared.items():
        for variable in item.variables:
            own = Endpoint(component, variable.name) not in shown
            if own and variable.causality == "output" and variable.single:
                observed[f"{component}.{variable.name}"] = variable.unit or "1"
    return observed


def _settable(wiring: Wiring, name: str) -> tuple[str, str]:
    """Return whether an end is a parameter or an input, and its unit."""
    end: Endpoint = wiring.structure.locate(name)
    if not end.component:
        kinds = {wiring.variable(port.end).causality for port in wiring.inward.get(name, ())}
        if len(kinds) == 1:
            return kinds.pop(), wiring.units[name] or "1"
        raise BindingError(
            f"{name!r} is no parameter or input of the system {wiring.structure.name} that goes to "
            f"variables of one kind; it has {listed(wiring.inward)}."
        )
    variable = wiring.variable(end)
    return variable.causality, variable.unit or "1"
