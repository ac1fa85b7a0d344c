"""Simulation of an FMU without a binding file: its default experiment, or under given histories."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuInputError

from .binding import Binding, BindingHeader
from .bound_variables import InputBinding, ParameterBinding, VectorBinding
from .draft import bindable, observable
from .history_files import InputHistories
from .observations import ObservationHistory
from .session import FmiAsset
from .values import PlainValue

_DEFAULT_STEPS = 500
_MOST_STEPS = 10_000_000
_ROUNDING = 1e-6
"""Share of a step that its end may miss the end of the experiment by."""

_Bound = TypeVar("_Bound", InputBinding, ParameterBinding)


class FmuExperiment(NamedTuple):
    """A simulation of an FMU with constant inputs.

    Attributes
    ----------
    binding : Binding
        Binding of all outputs of the FMU or system, in its units.
    steps : int
        Number of communication steps.
    parameters : dict of str to float or list
        Parameters by the binding's names.
    inputs : dict of str to dict of str to float or list
        Inputs by role and name, constant throughout.
    """

    binding: Binding
    steps: int
    parameters: dict[str, PlainValue]
    inputs: dict[str, dict[str, PlainValue]]


def default_experiment(
    description: FmuDescription,
    *,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: Mapping[str, PlainValue] | None = None,
) -> FmuExperiment:
    """Return the default experiment of an FMU with the caller's changes.

    Parameters
    ----------
    stop_time : float, optional
        The end [s]. By default it is the FMU's own, or one second after the start.
    step_size : float, optional
        The communication step size [s]. By default it is the FMU's own, or a 500th of the duration.
    values : mapping of str to float, str or list, optional
        Parameters (also structural ones) and inputs by the names of the FMU's variables, in its
        units. A text is converted by `value_of_text`.

    Raises
    ------
    BindingError
        If the FMU has no number to observe, or no parameter or input of a name, or the step is not
        positive.
    FmuInputError
        If the end does not come after the start, the steps are too many, or a text is not a value.
    """
    start = description.start_time or 0.0
    end = description.stop_time if stop_time is None else stop_time
    if end is None:
        end = start + 1.0
    steps, size = _steps_until(start, end, description.step_of(step_size))
    binding = whole_binding(description, step_size=size)
    structural_names = [
        v.name for v in description.variables if v.causality == "structuralParameter"
    ]
    settable_names = [*binding.parameter, *binding.load, *structural_names]
    plain_values = _values_of_variables(description, values or {}, settable_names)
    # The last step ends after the end if the duration is not a whole number of steps. The FMU is
    # then told the later end.
    end_of_last_step = start + steps * size
    is_beyond = end_of_last_step > end + _ROUNDING * size
    binding = binding.with_header(
        structural_parameters=_selected(plain_values, structural_names),
        stop_time=end_of_last_step if is_beyond else end,
    )
    return FmuExperiment(
        binding=binding,
        steps=steps,
        parameters=_selected(plain_values, binding.parameter),
        inputs={"load": _selected(plain_values, binding.load)},
    )


def _values_of_variables(
    description: FmuDescription, values: Mapping[str, PlainValue], settable: Sequence[str]
) -> dict[str, PlainValue]:
    """Return the values by variable name, with texts converted; refuse an unknown variable."""
    plain_values: dict[str, PlainValue] = {}
    for name, value in values.items():
        variable = description.variable(name)
        if name not in settable or variable is None:
            raise BindingError(
                f"{description.label} has no parameter or input {name!r} that can be set; it has "
                f"{', '.join(settable) or 'none'}."
            )
        plain_values[name] = value_of_text(variable, value) if isinstance(value, str) else value
    return plain_values


def _selected(values: Mapping[str, PlainValue], names: Collection[str]) -> dict[str, PlainValue]:
    """Return the values whose names are among some names."""
    return {name: value for name, value in values.items() if name in names}


def value_of_text(variable: VariableInfo, text: str) -> PlainValue:
    """Convert a text, such as a user's input, to a value of a parameter or input.

    Parameters
    ----------
    text : str
        A number, true or false, or the name of an enumeration's item. For an array, several of
        these separated by commas. For a text parameter, the text itself.

    Raises
    ------
    FmuInputError
        If the text is not a value of the variable's type.
    """
    if variable.is_text_parameter or text in variable.items:
        return text
    numbers = []
    for entry in text.split(","):
        number_text = entry.strip()
        number_text = {"true": "1", "false": "0"}.get(number_text, number_text)
        try:
            numbers.append(float(variable.items.get(number_text, number_text)))
        except ValueError:
            expected_value = f"one of {variable.item_list}" if variable.items else "a number"
            raise FmuInputError(
                f"{variable.name} must be {expected_value}, but is {text!r}."
            ) from None
    return numbers[0] if len(numbers) == 1 else numbers


def whole_binding(description: FmuDescription, *, step_size: float | None = None) -> Binding:
    """Return a binding of all numbers and text parameters of an FMU, under their own names.

    Parameters
    ----------
    step_size : float, optional
        The communication step size [s]. By default it is that of the FMU's default experiment, or
        1.

    Raises
    ------
    BindingError
        If the FMU has no number to observe.
    """
    numeric_variables = [variable for variable in description.variables if bindable(variable)]
    text_parameters = [variable for variable in description.variables if variable.is_text_parameter]
    settable_variables = [
        v for v in [*numeric_variables, *text_parameters] if v.variability != "constant"
    ]
    observation = {}
    for variable in observable(description, numeric_variables):
        unit = variable.unit or "1"
        observation[variable.name] = VectorBinding(variables=(variable.name,), unit=unit)
    return Binding(
        binding=BindingHeader(
            name=description.model_name or "fmu",
            step_size=description.step_of(step_size) or 1.0,
            start_time=description.start_time or 0.0,
            interface=description.interface,
        ),
        load=_bound_variables(settable_variables, "input", InputBinding),
        parameter=_bound_variables(settable_variables, "parameter", ParameterBinding),
        observation=observation,
    )


def _bound_variables(
    variables: Sequence[VariableInfo], causality: str, kind: type[_Bound]
) -> dict[str, _Bound]:
    """Return the variables of a causality, bound under their own names and units."""
    bound_variables = {}
    for variable in variables:
        if variable.causality == causality:
            bound_variables[variable.name] = kind(variable=variable.name, unit=variable.unit or "1")
    return bound_variables


def _steps_until(start: float, end: float, size: float | None) -> tuple[int, float]:
    """Return the number of steps from `start` to `end` [s], and their size [s].

    If no size is given, there are `_DEFAULT_STEPS` steps.
    """
    if not (math.isfinite(end) and end > start):
        raise FmuInputError(
            f"The simulation starts at {start:g} s and cannot end at {end:g} s; give a later end."
        )
    size = size or (end - start) / _DEFAULT_STEPS
    steps = max(1, round((end - start) / size))
    if steps > _MOST_STEPS:
        raise FmuInputError(
            f"From {start:g} to {end:g} s there are {steps} steps of {size:g} s, more than "
            f"{_MOST_STEPS}; give another step size or end."
        )
    return steps, size


# ---------------------------------------------------------------------- simulation


def ending_with_histories(binding: Binding, steps: int) -> Binding:
    """Return the binding with the stop time at which input histories of so many rows end.

    A binding that states its own stop time is returned as it is.
    """
    header = binding.binding
    # A row is constant over a step; under linear interpolation a step leads from one row to the
    # next.
    steps_made = steps if header.interpolation == "zero-order" else steps - 1
    if header.stop_time is not None or steps_made < 1:
        return binding
    return binding.with_header(stop_time=header.start_time + steps_made * binding.interval)


def run_histories(asset: FmiAsset, steps: int, histories: InputHistories) -> ObservationHistory:
    """Simulate an asset under the input histories of a file, and return its outputs.

    Without interpolation, a row is constant over the step that begins at its time. Under linear
    interpolation, the inputs change linearly from row to row: the asset is initialised with the
    first row, and there is an output for each row.

    Parameters
    ----------
    steps : int
        The number of rows, N.
    histories : dict of str to dict of str to (N,) or (N, n) ndarray
        Inputs as `read_histories` returns them.

    Raises
    ------
    FmuInputError
        If there is only one row under linear interpolation.
    FmuError
        As `FmiAsset.simulate`.
    """
    if asset.binding.binding.interpolation == "zero-order":
        return asset.simulate(**histories, steps=steps, progress=None)
    if steps < 2:
        raise FmuInputError(
            "Linear interpolation leads from one row of the inputs to the next: give two or more."
        )
    first_row = {}
    later_rows = {}
    for role, table in histories.items():
        first_row[role] = {name: values[0] for name, values in table.items()}
        later_rows[role] = {name: values[1:] for name, values in table.items()}
    asset.reset(**first_row)
    return simulate_from_now(asset, steps - 1, later_rows)


def simulate_from_now(asset: FmiAsset, steps: int, histories: InputHistories) -> ObservationHistory:
    """Return the present outputs of an asset, and those after each further step.

    Parameters
    ----------
    histories : dict of str to dict of str to (N,) or (N, n) ndarray
        Inputs of the steps by role and name.

    Returns
    -------
    ObservationHistory
        N + 1 times; fewer if the FMU ends the simulation by itself.

    Raises
    ------
    FmuError
        As `FmiAsset.simulate`.
    """
    present_outputs = asset.observe()
    later_outputs = asset.simulate(**histories, steps=steps, progress=None)
    extra_histories = {}
    for name, values in later_outputs.extra.items():
        extra_histories[name] = np.concatenate(([present_outputs.extra[name]], values))
    return ObservationHistory(
        time=np.concatenate(([present_outputs.time], later_outputs.time)),
        values=np.vstack((present_outputs.values, later_outputs.values)),
        extra=extra_histories,
        ended=later_outputs.ended,
    )


def run_experiment(asset: FmiAsset, experiment: FmuExperiment) -> ObservationHistory:
    """Run an experiment, and return the outputs at its start and after each step.

    Parameters
    ----------
    experiment : FmuExperiment
        Steps, parameters, and inputs, which hold already during the initialisation.

    Returns
    -------
    ObservationHistory
        N + 1 times; fewer if the FMU ends the simulation by itself.

    Raises
    ------
    FmuError
        As `FmiAsset.simulate`.
    """
    asset.reset(experiment.parameters, **experiment.inputs)
    return simulate_from_now(asset, experiment.steps, {})
