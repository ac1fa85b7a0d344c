"""What a trial asks of an FMU: parameters and constant inputs, loads at rest, what excites a motion."""

from math import ceil

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_excitation import Excitation, Run, State
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_patch import SortedPatch
from discrepancy.models.fmu_runs import FmuRuns
from discrepancy.models.input_course import Course, acting_force
from discrepancy.models.interface import DEFAULT_PLACE, Conditions

FloatArray = NDArray[np.float64]


class FmuTrials:
    """Trials in the names and units of an FMU.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    runs : FmuRuns
        Its FMU.
    """

    def __init__(self, description: FmuModelDescription, runs: FmuRuns) -> None:
        self._description, self._runs, self._name = description, runs, description.name
        self._keys = [runs.parameter(item.variable or item.name) for item in description.parameter]
        self._forces = {place: runs.variable(name) for place, name in description.inputs.forces.items()}
        self._inputs = {item.name: runs.variable(item.variable or item.name) for item in description.input}

    @property
    def forces(self) -> tuple[str, ...]:
        """The FMU's inputs of applied forces."""
        return tuple(self._forces.values())

    def run(
        self, trial: Trial, conditions: Conditions, patch: SortedPatch, motion: FmuMotion, refinement: int
    ) -> Run:
        """Return the run by which the FMU follows a dynamic trial."""
        step = motion.step(trial, refinement)
        rate, zero = conditions.clock
        end = max((1.0 + rate) * float(trial.time[-1]) + zero, float(trial.time[-1]))
        # a little longer, so that a clock that is being fitted does not ask for another run
        steps = ceil(end / step * (1.0 + 2e-9) - 1e-6) + (0 if (rate, zero) == (0.0, 0.0) else 1)
        if trial.kind is TrialKind.RINGDOWN:
            loads = self._release(trial, conditions, motion)
        else:
            loads = self._forced(trial, patch, step, steps)
        return Run(self.state(trial, conditions, patch.settings, 0), step, steps, loads)

    def _release(
        self, trial: Trial, conditions: Conditions, motion: FmuMotion
    ) -> list[tuple[Excitation, float]]:
        release, way = trial.release, self._description.release
        if release is None:
            raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
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
        speed = motion.angular_frequency(trial)
        return [
            (Excitation("displacement"), unit * float(first[0])),
            (Excitation("velocity"), unit * speed * float(first[1])),
        ]

    def _forced(
        self, trial: Trial, patch: SortedPatch, step: float, steps: int
    ) -> list[tuple[Excitation, float]]:
        begins, ends = Course.of_force(trial).ends(np.linspace(0.0, steps * step, steps + 1))
        held, first = 0.5 * (begins + ends), float(trial.force[0])
        on = ((begins != 0.0) | (ends != 0.0)).astype(float)
        loads = []
        gain, tare, *_ = patch.load
        for variable, lever in self._pushed(trial, patch):
            loads.append((Excitation("input", variable, held, first), (1.0 + gain) * lever))
            if tare:
                loads.append((Excitation("input", variable, on, float(first != 0.0)), tare * lever))
        return loads

    def _pushed(self, trial: Trial, patch: SortedPatch) -> list[tuple[str, float]]:
        """Return the inputs that a force at a place of a patch pushes, each with its lever."""
        inputs = self._description.inputs
        moments = ((inputs.bending_moment, patch.load.along_span), (inputs.torque, patch.load.along_chord))
        return [
            (self._input_of(trial), 1.0),
            *((self._runs.variable(name), lever) for name, lever in moments if name is not None and lever),
        ]

    def loads_at_rest(
        self, trial: Trial, patch: SortedPatch, conditions: Conditions
    ) -> list[dict[str, float]]:
        """Return the inputs of each row of a static trial or a flight.

        Raises
        ------
        ModelError
            If the FMU has no input for the load.
        """
        inputs = self._description.inputs
        flight = trial.kind is TrialKind.FLIGHT
        if flight and inputs.load_factor is None:
            raise ModelError(
                f"The trial {trial.name!r} is a flight, but the FMU model {self._name!r} names no "
                f"load_factor in [inputs]; leave it out."
            )
        count = len(trial.force)
        held, acting = self._held(trial, conditions), acting_force(trial, patch.load.gain, patch.load.tare)
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

    def state(
        self, trial: Trial, conditions: Conditions, settings: tuple[tuple[str, float], ...], row: int
    ) -> State:
        """Return parameters and constant inputs of a row of a trial."""
        wanted = self._description.inputs
        inputs: dict[str, float] = {}
        health = conditions.health[min(row, len(conditions.health) - 1)]
        for name, value in ((wanted.z1, health[0]), (wanted.z2, health[1])):
            if name is not None:
                inputs[self._runs.variable(name)] = float(value)
        if wanted.temperature is not None:
            base = wanted.temperature_reference or 0.0
            at = 0 if trial.is_dynamic else row
            inputs[self._runs.variable(wanted.temperature)] = base + float(trial.temperature[at])
        table = self._description.motion if trial.is_dynamic else self._description.static
        parameters = {self._runs.parameter(name): value for name, value in table.parameters.items()}
        for key, value in zip(self._keys, conditions.parameters, strict=True):
            parameters[key] = float(value)
        parameters |= dict(settings)
        return State(tuple(sorted(parameters.items())), tuple(sorted(inputs.items())))

    def _input_of(self, trial: Trial) -> str:
        place = trial.load_place
        if place == DEFAULT_PLACE and place not in self._forces and len(self._forces) == 1:
            return next(iter(self._forces.values()))
        if not isinstance(place, str) or place not in self._forces:
            known = ", ".join(self._forces) or "none"
            said = "says no load_place" if place == DEFAULT_PLACE else f"is loaded at {place!r}"
            raise ModelError(
                f"The trial {trial.name!r} {said}, and the FMU model {self._name!r} takes forces at {known}: "
                + ("name one of these as its load_place." if self._forces else "name an input in [inputs].")
            )
        return self._forces[place]
