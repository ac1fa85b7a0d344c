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
        A binding of all outputs of the FMU or system, in its units.
    steps : int
        Number of communication steps.
    parameters : dict of str to float or list
        Parameters by the binding's names.
    inputs : dict of str to dict of str to float or list
        Inputs by role and name, held from start to end.
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
    """Return the default experiment of an FMU, with the changes that the caller asks for.

    Parameters
    ----------
    description : FmuDescription
        The variables and abilities that the FMU declares.
    stop_time : float, optional
        The end [s]. By default it is the FMU's own, or one second after the start.
    step_size : float, optional
        The communication step size [s]. By default it is the FMU's own, or a 500th of the duration.
    values : mapping of str to float, str or list, optional
        Parameters (also structural ones) and inputs by the names of the FMU's variables, in its
        units. A text is read as `value_of_text` does.

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
    """Return the values by variable name, with texts converted.

    Parameters
    ----------
    description : FmuDescription
        The variables and abilities that the FMU declares.
    values : mapping of str to float, str or list
        The values or their texts, by variable name.
    settable : sequence of str
        The names of the variables that can be set.

    Raises
    ------
    BindingError
        If a variable cannot be set.
    FmuInputError
        If a text is not a value of its variable.
    """
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
    """Return the values of some names."""
    return {name: value for name, value in values.items() if name in names}


def value_of_text(variable: VariableInfo, text: str) -> PlainValue:
    """Convert a text, such as a user's input, to a value of a variable.

    Parameters
    ----------
    variable : VariableInfo
        The parameter or input. If it is a text parameter, the text itself is its value.
    text : str
        A number, true or false, or the name of an enumeration's item; for an array several of them,
        separated by commas.

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
    description : FmuDescription
        The FMU, or a system of several.
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
    settable = [v for v in [*numeric_variables, *text_parameters] if v.variability != "constant"]
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
        load=_bound_variables(settable, "input", InputBinding),
        parameter=_bound_variables(settable, "parameter", ParameterBinding),
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
    """Return the number and the size of the steps from a start to an end.

    Parameters
    ----------
    start, end : float
        The start and the end [s].
    size : float or None
        The communication step size [s]; None for 500 steps.

    Raises
    ------
    FmuInputError
        If the end does not come after the start, or the steps are too many.
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
    """Return a binding whose simulation ends with the input histories of a file.

    A binding that states its own end is returned as it is.

    Parameters
    ----------
    binding : Binding
        The binding of the FMU.
    steps : int
        The number of rows of the file.
    """
    header = binding.binding
    # A row is constant over a step; under linear interpolation a step leads from one row to the
    # next.
    steps_made = steps if header.interpolation == "zero-order" else steps - 1
    if header.stop_time is not None or steps_made < 1:
        return binding
    return binding.with_header(stop_time=header.start_time + steps_made * binding.interval)


def run_histories(asset: FmiAsset, steps: int, histories: InputHistories) -> ObservationHistory:
    """Return the outputs of an asset under the input histories of a file.

    Without interpolation, a row is constant over the step that begins at its time. Under linear
    interpolation, the inputs change linearly from row to row: the asset is initialised with the
    first row, and there is an output for each row.

    Parameters
    ----------
    asset : FmiAsset
        The asset, which steps the FMU.
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
    """Return the present outputs of an asset, and those after each of the following steps.

    Parameters
    ----------
    asset : FmiAsset
        The asset, which has been started.
    steps : int
        Number of steps, N.
    histories : dict of str to dict of str to (N,) or (N, n) ndarray
        Inputs of the steps by role and name.

    Returns
    -------
    ObservationHistory
        N + 1 moments; fewer if the FMU ends the simulation by itself.

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
    """Return the outputs of an asset at the start of an experiment, and after each step.

    Parameters
    ----------
    asset : FmiAsset or CoupledAsset
        The asset, which steps the FMU.
    experiment : FmuExperiment
        Steps, parameters and inputs; the inputs hold already during the initialisation.

    Returns
    -------
    ObservationHistory
        N + 1 moments; fewer if the FMU ends the simulation by itself.

    Raises
    ------
    FmuError
        As `FmiAsset.simulate`.
    """
    asset.reset(experiment.parameters, **experiment.inputs)
    return simulate_from_now(asset, experiment.steps, {})
