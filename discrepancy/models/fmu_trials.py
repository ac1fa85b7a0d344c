"""What a trial asks of an FMU: parameters, inputs, loads, what excites a motion; and its samples then."""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course
from discrepancy.models.fmu_ports import FmuPorts
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Run, State
from discrepancy.models.interface import Conditions, Response
from discrepancy.models.questions import LoadChange, losses_of, place_among, release_of
from fe.runtime.motion import NO_LAWS, Laws

SLOPES = (
    np.array(
        [
            [-25, 48, -36, 16, -3],
            [-3, -10, 18, -6, 1],
            [1, -8, 0, 8, -1],
            [-1, 6, -18, 10, 3],
            [3, -16, 36, -48, 25],
        ]
    )
    / 12.0
)
"""Weights by which five values on an even grid give the slope at each of them, of fourth order."""


class FmuPatch(NamedTuple):
    """A patch by what is done with it.

    Attributes
    ----------
    laws : Laws
        Internal forces at ports.
    settings : tuple of (str, float)
        Parameters that the FMU itself has for primitives, sorted by name.
    load : LoadChange
        Of the recorded force.
    """

    laws: Laws = NO_LAWS
    settings: tuple[tuple[str, float], ...] = ()
    load: LoadChange = LoadChange()


class Asked(NamedTuple):
    """What is asked of the FMU: a trial, in conditions and under a patch."""

    trial: Trial
    conditions: Conditions
    patch: FmuPatch = FmuPatch()


class FmuTrials:
    """Trials in the names and units of an FMU.

    Parameters
    ----------
    runs : FmuRuns
        The FMU.

    Attributes
    ----------
    forces : dict of str to str
        The FMU's inputs of applied forces, by load place.
    """

    def __init__(self, runs: FmuRuns) -> None:
        description = runs.description
        self._description, self._runs, self._name = description, runs, description.name
        self._keys = [runs.parameter(item.variable or item.name) for item in description.parameter]
        self.forces = {place: runs.variable(name) for place, name in description.inputs.forces.items()}
        self._inputs = {item.name: runs.variable(item.variable or item.name) for item in description.input}

    def run(self, asked: Asked, ports: FmuPorts, refinement: int) -> Run:
        """Return the run by which the FMU follows a dynamic trial."""
        trial, conditions, _ = asked
        step = ports.step(trial, refinement)
        rate, zero = conditions.clock
        end = max((1.0 + rate) * float(trial.time[-1]) + zero, float(trial.time[-1]))
        # a little longer, so that a clock that is being fitted does not ask for another run
        steps = ceil(end / step * (1.0 + 2e-9) - 1e-6) + (0 if (rate, zero) == (0.0, 0.0) else 1)
        if trial.kind is TrialKind.RINGDOWN:
            loads = self._release(trial, conditions, ports)
        else:
            loads = self._forced(asked, step, steps)
        return Run(self.state(asked), step, steps, loads)

    def _release(
        self, trial: Trial, conditions: Conditions, ports: FmuPorts
    ) -> list[tuple[Excitation, float]]:
        release, way = release_of(trial), self._description.release
        if way is None:
            raise ModelError(
                f"The FMU model {self._name!r} cannot ring down: state in [release] the FMU's parameter of "
                f"the release displacement, or the force that holds it."
            )
        first = conditions.initial[0] if len(conditions.initial) else np.zeros(2)
        if release.at_rest:
            size = release.displacement * (1.0 + float(first[0]))
            kind = "hold" if way.displacement is None else "displacement"
            return [(Excitation(kind), size)]
        if way.displacement is None or way.velocity is None:
            raise ModelError(
                f"The ring-down {trial.name!r} does not begin at rest, which the FMU model {self._name!r} "
                f"can follow only if [release] names parameters of displacement and velocity."
            )
        unit = release.displacement
        speed = ports.angular_frequency(trial)
        return [
            (Excitation("displacement"), unit * float(first[0])),
            (Excitation("velocity"), unit * speed * float(first[1])),
        ]

    def _forced(self, asked: Asked, step: float, steps: int) -> list[tuple[Excitation, float]]:
        trial, _, patch = asked
        course = Course.of(trial.time, trial.force, trial.hold)
        begins, ends = course.ends(np.linspace(0.0, steps * step, steps + 1))
        held, first = 0.5 * (begins + ends), float(trial.force[0])
        on = ((begins != 0.0) | (ends != 0.0)).astype(float)
        loads = []
        gain, tare, *_ = patch.load
        for variable, lever in self._pushed(trial, patch):
            loads.append((Excitation("input", variable, held, first), (1.0 + gain) * lever))
            if tare:
                loads.append((Excitation("input", variable, on, float(first != 0.0)), tare * lever))
        return loads

    def _pushed(self, trial: Trial, patch: FmuPatch) -> list[tuple[str, float]]:
        """Return the inputs that a force at a place of a patch pushes, each with its lever."""
        inputs = self._description.inputs
        moments = ((inputs.bending_moment, patch.load.along_span), (inputs.torque, patch.load.along_chord))
        what, where = f"the FMU model {self._name!r}", f"the trial {trial.name!r}"
        place = place_among([*self.forces], trial.load_place, what, where)
        return [
            (self.forces[place], 1.0),
            *((self._runs.variable(name), lever) for name, lever in moments if name is not None and lever),
        ]

    def loads_at_rest(self, asked: Asked) -> list[dict[str, float]]:
        """Return the inputs of each row of a static trial or a flight.

        Raises
        ------
        ModelError
            If the FMU has no input for the load.
        """
        trial, conditions, patch = asked
        inputs = self._description.inputs
        flight = trial.kind is TrialKind.FLIGHT
        if flight and inputs.load_factor is None:
            raise ModelError(
                f"The trial {trial.name!r} is a flight, but the FMU model {self._name!r} names no "
                f"load_factor in [inputs]; leave it out."
            )
        count = len(trial.force)
        held, acting = self._held(trial, conditions), patch.load.changed(trial.force, trial.force)
        loads: list[dict[str, float]] = []
        for row in range(count):
            if flight:
                loads.append({self._runs.variable(str(inputs.load_factor)): float(trial.load_factor[row])})
                continue
            given = {name: float(values[row]) for name, values in held.items()}
            if not held or np.any(trial.force):
                given |= {name: float(acting[row]) * lever for name, lever in self._pushed(trial, patch)}
            loads.append(given)
        return loads

    def _held(self, trial: Trial, conditions: Conditions) -> dict[str, FloatArray]:
        """Return the inputs (N,) that a static trial holds, by the FMU's names."""
        offsets = conditions.offset or (0.0,) * len(trial.inputs)
        found = {}
        for item, offset in zip(trial.inputs, offsets, strict=True):
            if item.name not in self._inputs:
                raise ModelError(
                    f"The trial {trial.name!r} holds the input {item.name!r}, which the FMU model "
                    f"{self._name!r} does not have; it has {', '.join(self._inputs) or 'none'}: name it in "
                    "[[input]]."
                )
            variable = self._inputs[item.name]
            found[variable] = self._runs.input_factors[variable] * (item.values + offset)
        return found

    def state(self, asked: Asked, row: int = 0) -> State:
        """Return parameters and constant inputs of a row of a trial."""
        (trial, conditions, patch), wanted = asked, self._description.inputs
        losses = losses_of(trial, conditions.health, [*wanted.regions], f"the FMU model {self._name!r}")
        health = zip(wanted.regions.values(), losses[min(row, len(losses) - 1)], strict=True)
        inputs = {self._runs.variable(name): value for name, value in health}
        if wanted.temperature is not None:
            base = wanted.temperature_reference or 0.0
            at = 0 if trial.is_dynamic else row
            inputs[self._runs.variable(wanted.temperature)] = base + float(trial.temperature[at])
        table = self._description.motion if trial.is_dynamic else self._description.static
        parameters = {self._runs.parameter(name): value for name, value in table.parameters.items()}
        for key, value in zip(self._keys, conditions.parameters, strict=True):
            parameters[key] = float(value)
        parameters |= dict(patch.settings)
        return State(tuple(sorted(parameters.items())), tuple(sorted(inputs.items())))


def sampled(values: FloatArray, step: float, times: FloatArray, derivatives: Sequence[int]) -> Response:
    """Return values and rates at times, from values on an even grid.

    Parameters
    ----------
    values : (K, C) ndarray
        Outputs at 0, `step`, 2 `step`, ...
    step : float
        Of the grid [s].
    times : (N,) ndarray
        Times of the samples [s]; before zero the first value holds.
    derivatives : sequence of int
        For each column, how often it is derived in the response: 0, 1 or 2.
    """
    before = times < 0.0
    index = np.round(times / step)
    on_grid = bool(np.all(np.abs(times / step - index) < 1e-6))
    if on_grid and len(values) >= len(SLOPES) and not any(derivatives):
        at_index = np.clip(index.astype(int), 0, len(values) - 1)
        first = np.clip(at_index - len(SLOPES) // 2, 0, len(values) - len(SLOPES))
        around = values[first[:, np.newaxis] + np.arange(len(SLOPES))]
        rates = np.einsum("nk,nkc->nc", SLOPES[at_index - first] / step, around)
        rates[before] = 0.0
        return Response(values[at_index], rates)
    grid = step * np.arange(len(values))
    curve = CubicSpline(grid, values)
    at = np.clip(times, 0.0, grid[-1])
    shown, rates = curve(at), curve(at, 1)
    if on_grid:
        shown = values[np.clip(index.astype(int), 0, len(values) - 1)]
    rates[before] = 0.0
    for column, order in enumerate(derivatives):
        if order > 0:
            shown = shown if shown.flags.owndata else shown.copy()
            # derivatives of the derivative's own spline keep the order of the first one
            slope = curve.derivative()(grid)[:, column]
            own = CubicSpline(grid, slope)
            shown[:, column] = own(at, order - 1)
            rates[:, column] = own(at, order)
            shown[before, column] = rates[before, column] = 0.0
    return Response(np.ascontiguousarray(shown), np.ascontiguousarray(rates))
