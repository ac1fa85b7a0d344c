"""An FMU flown without a binding: its default experiment, and values set by the names of its variables."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.sentences import said
from reporting.progress import Progress

from .binding import Binding, Header, Input, Parameter, Vector
from .draft import bindable, observable
from .history_file import InputHistories, Roles
from .layout import ObservationHistory
from .session import FmiAsset

_STEPS = 500
_MOST_STEPS = 10_000_000

Value = float | list[float]
Bound = TypeVar("Bound", Input, Parameter)


class Experiment(NamedTuple):
    """What is simulated.

    Attributes
    ----------
    binding : Binding
        All outputs of the FMU or system, in its units.
    steps : int
        Number of communication steps.
    parameters : dict of str to float or list
        By the binding's names.
    inputs : dict of str to dict of str to float or list
        By role and name; held from the start to the end.
    """

    binding: Binding
    steps: int
    parameters: dict[str, Value]
    inputs: dict[str, Any]


def default_experiment(
    description: FmuDescription,
    *,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: Mapping[str, Value] | None = None,
) -> Experiment:
    """Return the default experiment of an FMU, or what is wanted instead.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    stop_time : float, optional
        End [s]; the FMU's own, or one second after its start.
    step_size : float, optional
        Communication step size [s]; the FMU's own, or a 500th of the time to the end.
    values : mapping of str to float or list, optional
        Parameters (structural ones, too) and inputs by the names of the FMU's variables, in its units.

    Raises
    ------
    BindingError
        If the FMU has no number to observe, or no parameter or input of a name.
    FmuInputError
        If the end does not come after the start, or the steps are too many.
    """
    end = description.stop_time if stop_time is None else stop_time
    size = step_size or description.fixed_step or description.step_size
    steps, size = _steps_to(description.start_time or 0.0, end, size)
    binding = whole_binding(description, step_size=size)
    structural = [v.name for v in description.variables if v.causality == "structuralParameter"]
    values = values or {}
    known = [*binding.parameter, *binding.load, *structural]
    for name in values:
        if name not in known:
            raise BindingError(said("inputs.no_variable", fmu=description, name=name, known=known))
    parameters, load, sizes = (
        {name: value for name, value in values.items() if name in names}
        for names in (binding.parameter, binding.load, structural)
    )
    binding = binding.with_header(structural_parameters=sizes)
    return Experiment(binding, steps, parameters, {"load": load})


def whole_binding(description: FmuDescription, *, step_size: float | None = None) -> Binding:
    """Return a binding of all numbers of an FMU, by their own names and in its units.

    Parameters
    ----------
    description : FmuDescription
        The FMU, or a system of several.
    step_size : float, optional
        Communication step size [s]; that of the FMU's default experiment, or 1.

    Raises
    ------
    BindingError
        If the FMU has no number to observe.
    """
    usable = [v for v in description.variables if bindable(v)]

    def of(causality: str, kind: type[Bound]) -> dict[str, Bound]:
        found = [v for v in usable if v.causality == causality and v.variability != "constant"]
        return {v.name: kind(variable=v.name, unit=v.unit or "1") for v in found}

    return Binding(
        binding=Header(
            name=description.model_name or "fmu",
            step_size=step_size or description.fixed_step or description.step_size or 1.0,
            start_time=description.start_time or 0.0,
            interface=description.interface,
        ),
        load=of("input", Input),
        parameter=of("parameter", Parameter),
        observation={
            v.name: Vector(variables=(v.name,), unit=v.unit or "1") for v in observable(description, usable)
        },
    )


def _steps_to(start: float, end: float | None, size: float | None) -> tuple[int, float]:
    """Return number and size of the steps to an end: a second, and 500 steps, where nothing says more.

    Raises
    ------
    FmuInputError
        If the end does not come after the start, or the steps are too many.
    """
    end = start + 1.0 if end is None else end
    if not (math.isfinite(end) and end > start):
        raise FmuInputError(said("inputs.end", start=start, end=end))
    size = size or (end - start) / _STEPS
    steps = max(1, round((end - start) / size))
    if steps > _MOST_STEPS:
        ends = start, end
        raise FmuInputError(said("inputs.most_steps", ends=ends, steps=steps, size=size, most=_MOST_STEPS))
    return steps, size


def fly_histories(asset: FmiAsset, given: InputHistories, progress: Progress) -> ObservationHistory:
    """Simulate an asset under the histories of a file.

    Each row holds over the step that begins at its time. Under linear interpolation lines lead from row to
    row: the first is where the asset starts, and there is a moment for each row.

    Raises
    ------
    FmuInputError
        If there is nothing to lead a line to.
    FmuError
        As `FmiAsset.simulate`.
    """
    if asset.binding.binding.interpolation == "zero-order":
        return asset.simulate(**given.roles, steps=given.steps, progress=progress)
    if given.steps < 2:
        raise FmuInputError(said("inputs.one_row"))
    first = {role: {name: v[0] for name, v in table.items()} for role, table in given.roles.items()}
    rest = {role: {name: v[1:] for name, v in table.items()} for role, table in given.roles.items()}
    asset.reset(**first)
    return _from_here(asset, given.steps - 1, progress, rest)


def _from_here(asset: FmiAsset, steps: int, progress: Progress, roles: Roles) -> ObservationHistory:
    """Return this moment and what comes out of the steps after it."""
    first, then = asset.observe(), asset.simulate(**roles, steps=steps, progress=progress)
    return ObservationHistory(
        np.concatenate(([first.time], then.time)),
        np.vstack((first.values, then.values)),
        {name: np.concatenate(([first.extra[name]], values)) for name, values in then.extra.items()},
        then.ended,
    )


def fly(asset: FmiAsset, experiment: Experiment, progress: Progress) -> ObservationHistory:
    """Start an asset, and return its start and what came out of the steps after it.

    Parameters
    ----------
    asset : FmiAsset or CoupledAsset
        The asset.
    experiment : Experiment
        Steps, parameters and inputs, which hold already in the initialisation.
    progress : Progress
        Where progress is shown.

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
    return _from_here(asset, experiment.steps, progress, {})
