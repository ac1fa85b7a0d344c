"""An FMU with ports: its linear system, identified from responses, and its communication step."""

from collections.abc import Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar
from scipy.signal import periodogram

from discrepancy.campaign.records import FloatArray, Hold, Trial
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.fmu_excitation import FmuExcitation
from discrepancy.fmu_models.system_motion import MOST_SYSTEMS, system_motion
from discrepancy.fmu_models.variables import FmuVariables
from discrepancy.system.excitation import Excitation, Load
from discrepancy.system.time_history import RecordedHistory, equivalent_ramps
from fmu_asset.client.runs import FmuRun, FmuRuns, OperatingPoint
from fmu_asset.client.state_space import FmuStateSpace, realise_state_space
from fmu_asset.errors import FmuError
from reporting.system.memory import ResultCache

LINEARITY_TOLERANCE = 1e-6
"""Largest deviation from superposition of a linear FMU, as a share of the motion."""
LARGEST_STEP_PHASE = 0.1
"""Longest communication step without laws, as a phase of the first mode [rad]."""
LEAST_RECORDED_STEPS = 64
"""Least number of steps of a recorded response to a force or a release."""
MOST_RECORDED_STEPS = 600
"""Largest number of steps of such a response: enough for many periods of the first modes."""
LARGEST_MODE_PHASE = 0.8 * np.pi
"""Largest phase of a mode in a step that stays below pi as parameters change [rad]."""
MOST_PARTS = 16
"""Largest number of parts of a sampling interval at which a linear system is looked for."""
ALIASING_TOLERANCE = 1e-2
"""Largest difference, relative to the motion, between the linear system and the FMU at half the
step. A mode whose phase grows by more than pi in a step is aliased to a slower one, and differs
more."""
PROBING_DISPLACEMENT = 1e-3
"""Displacement from which an FMU without ports is released to find its first mode [m]."""


class StepChoice(NamedTuple):
    """Angular frequency [rad/s] of the first mode, and the communication step [s]."""

    angular_frequency: float
    step: float


class SampledSystem(NamedTuple):
    """The linear system at a step that shows all modes.

    Attributes
    ----------
    system : FmuStateSpace or None
        The system; None if the FMU is not linear.
    excitation : FmuExcitation
        The excitation, with that step.
    parts : int
        Number of steps in a sampling interval.
    """

    system: FmuStateSpace | None
    excitation: FmuExcitation
    parts: int


class IdentifiedFmu(FmuRuns):
    """An FMU with ports, its linear system and its communication step.

    Parameters
    ----------
    description : FmuModelDescription
        Content of the model's file.
    folder : Path
        Its folder, where relative names begin.

    Attributes
    ----------
    nominal_point : OperatingPoint
        State of motions at the means of the parameters; set by the model.
    ports, port_inputs : list of str
        Names of the ports, and inputs of their forces.
    displacement_columns, velocity_columns : list of int
        Columns of the ports' displacements and velocities; -1 for a velocity that is not an output.
    release_variables : list of str
        Parameter or input that releases the FMU, and the parameter of its velocity.
    """

    nominal_point = OperatingPoint()

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        self.description = description
        static = description.static
        with self.refusal_context():
            self.variables = FmuVariables(description, folder)
            super().__init__(
                self.variables.path,
                self.variables.binding,
                description.isolated,
                static.limit,
                static.tolerance,
            )
            self._check_parameters()
        names = self.variables
        self.ports = [port.name for port in description.port]
        self.port_inputs = [names.variable(port.force) for port in description.port]
        columns = names.columns
        self.displacement_columns = [columns[f"port.{port}.displacement"] for port in self.ports]
        self.velocity_columns = [columns.get(f"port.{port}.velocity", -1) for port in self.ports]
        self.release_variables = self._find_release_variables()
        self._is_linear: dict[tuple[Hashable, ...], bool] = {}
        self._release_amplitudes: dict[str, float] = {}
        self._systems = ResultCache(MOST_SYSTEMS)
        self._step_choices = ResultCache()

    def _check_parameters(self) -> None:
        """Raise an error if the FMU does not allow a value that the file may set.

        The checked values are the bounds of calibrated parameters, the switches of effects, and the
        parameters of trials at rest and in motion. A bound outside the range of an FMU parameter
        would cut off the posterior.
        """
        description = self.description
        settings: list[Mapping[str, float]] = []
        for parameter in description.parameter:
            settings.append({parameter.variable: parameter.low})
            settings.append({parameter.variable: parameter.high})
        for effect in description.effects.values():
            settings.append({f"effect.{effect}.active": 1.0})
        settings += [description.static.parameters, description.motion.parameters]
        for setting in settings:
            by_key = {self.variables.parameter(name): value for name, value in setting.items()}
            self.asset.check_parameters(by_key)

    def _find_release_variables(self) -> list[str]:
        """Return the variables that the file names in [release], which begin a ring-down.

        These variables are the parameters of displacement and velocity, and the input of a holding
        force.
        """
        release = self.description.release
        if release is None:
            return []
        parameters = [name for name in (release.displacement, release.velocity) if name is not None]
        variables = [self.variables.parameter(name) for name in parameters]
        if release.hold is not None:
            variables.append(self.variables.variable(release.hold))
        return variables

    def refusal_context(self) -> AbstractContextManager[None]:
        """Return the context that adds the model's name to what the FMU refuses."""
        return ModelError.instead_of(FmuError, before=f"The FMU model {self.description.name!r}: ")

    def excitation_of(
        self,
        trial: Trial,
        state: OperatingPoint,
        ports: Sequence[str],
        force_factors: Mapping[str, float] | None = None,
    ) -> FmuExcitation:
        """Return the inputs and the step of a trial's run; the force or release is added later.

        Parameters
        ----------
        trial : Trial
            A dynamic trial.
        state : OperatingPoint
            Parameters and constant inputs.
        ports : sequence of str
            Ports at which laws act.
        force_factors : mapping of str to float, optional
            For each input that the recorded force drives, the factor on this force.
        """
        force_factors = force_factors or {}
        law_inputs = [self.port_inputs[self.ports.index(name)] for name in ports]
        inputs = tuple(dict.fromkeys([*force_factors, *law_inputs]))
        step = self.nominal_step_choice(trial).step
        return FmuExcitation(state, step, recorded_step_count(trial), inputs, force_factors)

    # ------------------------------------------------------------ its linear system

    def linear_system(self, excitation: FmuExcitation) -> FmuStateSpace | None:
        """Return the FMU as a linear system; None if it is not linear.

        The system is identified from the responses to one force or release at a time. The FMU
        counts as linear if such a system exists and also predicts the response to all forces and
        releases together. This prediction is tested once for each set of inputs and releases, at
        the first operating point. The result is also None if the file of the model forbids
        superposition, or if there is no input or release to excite the FMU.
        """
        has_excitation = bool(excitation.inputs or excitation.releases)
        if not self.description.superposition or not has_excitation:
            return None
        linearity_key = excitation.linearity_key
        if not self._is_linear.get(linearity_key, True):
            return None
        system_key = (linearity_key, *excitation.recording_arguments)
        system: FmuStateSpace | None = self._systems.get(
            system_key, lambda: self._identify_system(excitation)
        )
        if system is None:
            return None
        if linearity_key not in self._is_linear:
            is_linear = self._predicts_motion(system, excitation, LINEARITY_TOLERANCE)
            self._is_linear[linearity_key] = is_linear
        return system if self._is_linear[linearity_key] else None

    def _identify_system(self, excitation: FmuExcitation) -> FmuStateSpace | None:
        """Return the linear system that has the FMU's responses to unit forces and releases.

        The result is None if no system of moderate order has them.
        """
        responses = [self._response_to_force(excitation, name) for name in excitation.inputs]
        responses += [self._response_to_release(excitation, name) for name in excitation.releases]
        # (steps, outputs, inputs and releases), without the sample at the start
        records = np.stack(responses, axis=2)[1:]
        return realise_state_space(records, len(excitation.inputs), excitation.step)

    def _response_to_force(self, excitation: FmuExcitation, name: str) -> FloatArray:
        """Return the response (recorded_steps + 1, C) of the outputs to a unit force in one step.

        A force of the input's probing amplitude acts during the first step. The outputs without it
        are subtracted, and the difference is divided by the amplitude.
        """
        amplitude = self.probing_amplitude(name)
        force_by_step = np.zeros(excitation.recorded_steps)
        force_by_step[:1] = amplitude  # empty if no step is recorded
        run = FmuRun(
            operating_point=excitation.state,
            step=excitation.step,
            steps=excitation.recorded_steps,
            offsets={name: force_by_step},
        )
        is_release = False
        key = (*excitation.recording_arguments, name, is_release)
        return self.cached(key, lambda: self._motion_of_run(excitation, run) / amplitude)

    def _response_to_release(self, excitation: FmuExcitation, name: str) -> FloatArray:
        """Return the response (recorded_steps + 1, C) of the outputs to a release from one unit.

        The FMU is released from some amplitude: that of the excitation, or for an input its probing
        amplitude. The outputs without a release are subtracted, and the difference is divided by
        the amplitude. Later calls for the same variable use the amplitude of the first call.
        """
        nominal_amplitude = excitation.releases[name] or 1.0
        if self._is_input(name):
            nominal_amplitude = self.probing_amplitude(name)
        amplitude = self._release_amplitudes.setdefault(name, nominal_amplitude)
        run = self._run_of_excitation(excitation._replace(force=None), {name: amplitude})
        is_release = True
        key = (*excitation.recording_arguments, name, is_release)
        return self.cached(key, lambda: self._motion_of_run(excitation, run) / amplitude)

    def _is_input(self, name: str) -> bool:
        """Return whether a name is an input of the FMU, not a parameter."""
        return name in self.variables.binding.load

    def _motion_of_run(self, excitation: FmuExcitation, run: FmuRun) -> FloatArray:
        """Return the outputs (steps + 1, C) of a run, less those of the undisturbed FMU."""
        return self.outputs_of_run(run) - self._undisturbed_outputs(excitation)

    def _undisturbed_outputs(self, excitation: FmuExcitation) -> FloatArray:
        """Return the outputs (C,) at the start if nothing moves the FMU."""
        state, step, _ = excitation.recording_arguments
        run = FmuRun(state, step, 0)
        return self.cached((state, step), lambda: self.start_run(run)[1])

    def _predicts_motion(
        self, system: FmuStateSpace, excitation: FmuExcitation, tolerance: float
    ) -> bool:
        """Return whether a linear system predicts the FMU's response to all inputs at once.

        In this test the releases and the recorded force act, and random forces (of a fixed seed) on
        all other inputs. The prediction is good enough if the largest error of each output is at
        most `tolerance` times its largest value.
        """
        release_values = self._release_values_of_system(excitation)
        run = self._run_of_excitation(excitation, release_values)
        generator = np.random.default_rng(0)
        forces = {
            name: self.probing_amplitude(name) * generator.uniform(-1.0, 1.0, run.steps)
            for name in excitation.inputs
        }
        forces |= run.offsets
        motion = self._motion_of_run(excitation, run._replace(offsets=forces))  # (steps + 1, C)
        # the same motion by the linear system; each force is constant during a step
        time = excitation.step * np.arange(run.steps + 1.0)
        loads = []
        for direction, values in zip(np.eye(len(forces)), forces.values(), strict=True):
            history = RecordedHistory(time, np.append(values, 0.0), Hold.ZERO_ORDER)
            loads.append(Load(direction, history))
        start = self._start_state(system, excitation, release_values)
        states, acting = system_motion(system, Excitation(time, time, loads), start)
        outputs_of_states = states @ system.output_matrix.T
        outputs_of_inputs = acting @ system.feedthrough.T
        prediction_error = motion - outputs_of_states - outputs_of_inputs
        # the first row, before any step, does not count
        largest_error = np.max(np.abs(prediction_error)[1:], axis=0)  # (C,)
        largest_motion = np.max(np.abs(motion), axis=0)
        # the tiny summand lets an output pass that never moves
        return bool(np.all(largest_error <= tolerance * largest_motion + 1e-300))

    # ------------------------------------------------------------ releases

    def _release_values_of_system(self, excitation: FmuExcitation) -> dict[str, float]:
        """Return the values of the release variables that give a linear FMU its displacement.

        Only the first value is computed: the stated displacement of the release point over its
        displacement by a unit value. If no output shows the release point, the values of the
        excitation are returned.
        """
        release_values = dict(excitation.releases)
        column = self.variables.columns.get("release")
        if self.description.release is None or column is None or not release_values:
            return release_values
        name, displacement = next(iter(release_values.items()))
        if displacement != 0.0:
            response = self._response_to_release(excitation, name)
            release_values[name] = displacement / float(response[0, column])
        return release_values

    def _find_release_values(self, excitation: FmuExcitation) -> dict[str, float]:
        """Return the values of the release variables that give any FMU its displacement.

        Only the first value is computed, by the secant method, with the FMU at the start of a run.
        If no output shows the release point, the values of the excitation are returned.

        Raises
        ------
        ModelError
            If no amount gives the displacement.
        """
        release_values = dict(excitation.releases)
        column = self.variables.columns.get("release")
        release = self.description.release
        if release is None or column is None or not release_values:
            return release_values
        name, displacement = next(iter(release_values.items()))
        if displacement == 0.0:
            return release_values

        def missing_displacement(amount: float) -> float:
            """Return the displacement that an amount causes, minus the stated one [m]."""
            at_begin = excitation._replace(force=None, recorded_steps=0)
            run = self._run_of_excitation(at_begin, {name: amount})
            key = (excitation.state, excitation.step, name, amount, "begin")
            outputs = self.cached(key, lambda: self.start_run(run)[1])
            displaced = float((outputs - self._undisturbed_outputs(excitation))[column])
            return displaced - displacement

        guess = self.probing_amplitude(name) if self._is_input(name) else displacement
        solution = root_scalar(missing_displacement, x0=0.0, x1=guess, rtol=1e-10, maxiter=20)
        amount = float(solution.root)
        if not abs(missing_displacement(amount)) <= 1e-6 * abs(displacement):
            raise ModelError(
                f"No parameter or force in [release] moves {release.output!r} of the FMU model "
                f"{self.description.name!r} to {displacement:g} m; correct displacement, hold or "
                "output in [release]."
            )
        return release_values | {name: amount}

    def _run_of_excitation(
        self, excitation: FmuExcitation, release_values: Mapping[str, float]
    ) -> FmuRun:
        """Return the settings of the FMU's run under an excitation.

        A release variable that is an input of the FMU is set before the start; any other is a
        parameter of the operating point. If a recorded force acts, the FMU starts at rest under the
        force of the first sample.
        """
        initial_loads = {
            name: amount for name, amount in release_values.items() if self._is_input(name)
        }
        parameters = {
            name: amount for name, amount in release_values.items() if name not in initial_loads
        }
        if excitation.force is not None:
            for name, factor in excitation.force_factors.items():
                initial_loads[name] = factor * excitation.first_force
        run = FmuRun(
            operating_point=excitation.state.with_parameters(parameters),
            step=excitation.step,
            steps=excitation.recorded_steps,
            initial_offsets=initial_loads,
        )
        if excitation.force is None:
            return run
        # inputs are held constant over a step: they get the mean force of each step
        time = excitation.step * np.arange(excitation.recorded_steps + 1.0)
        at_begin, at_end = equivalent_ramps(excitation.force.values_at, time)
        loads_by_input = {
            name: 0.5 * factor * (at_begin + at_end)
            for name, factor in excitation.force_factors.items()
        }
        return run._replace(offsets=loads_by_input)

    def _start_state(
        self, system: FmuStateSpace, excitation: FmuExcitation, release_values: Mapping[str, float]
    ) -> FloatArray:
        """Return the state (n,) at the start of a trial.

        The state is the released one, plus the equilibrium under the recorded force at the first
        sample.
        """
        start: FloatArray = system.release_states @ np.array([*release_values.values()])
        first_force = excitation.first_force
        if first_force:
            return start + system.state_at_rest(first_force * excitation.force_factor_values)
        return start

    # ------------------------------------------------------------ communication step

    def choose_step(self, trial: Trial, state: OperatingPoint) -> StepChoice:
        """Return the angular frequency of the FMU's first mode, and the time step for a trial.

        The file of the model may state both. Otherwise the first mode is the one with the largest
        flexibility at the first port; without ports, or if the FMU is not linear, it is the one
        with the highest peak in the spectrum. The step is an integer fraction of the sampling
        interval, small enough that no mode is aliased and that the phase of the first mode grows by
        at most `LARGEST_STEP_PHASE` in a step.
        """
        interval = trial.interval
        system, excitation, steps_per_sample = self._system_that_shows_all_modes(
            self._probing_excitation(trial, state), interval
        )
        angular_frequency = self.description.scales.angular_frequency
        if not angular_frequency:
            mode = None
            if system is not None and self.ports:
                mode = system.most_flexible_mode(self.displacement_columns[0], 0)
            if mode is not None:
                angular_frequency = mode.angular_frequency
            else:
                angular_frequency = self._dominant_angular_frequency(excitation)
        step = self.description.motion.step
        if not step:
            phase_in_interval = angular_frequency * interval
            step = interval / max(steps_per_sample, ceil(phase_in_interval / LARGEST_STEP_PHASE))
        return StepChoice(angular_frequency, step)

    def _probing_excitation(self, trial: Trial, state: OperatingPoint) -> FmuExcitation:
        """Return the excitation that shows the modes of the FMU at the sampling of a trial.

        The excitation has a force at each port; without ports, a release; without both, a load on
        the first input, since any input shows how fast the FMU moves.
        """
        inputs = tuple(dict.fromkeys(self.port_inputs))
        releases = {}
        if self.release_variables and not self.ports:
            releases = {self.release_variables[0]: PROBING_DISPLACEMENT}
        if not inputs and not releases:
            inputs = tuple(self.variables.binding.load)[:1]
        return FmuExcitation(
            state, trial.interval, recorded_step_count(trial), inputs, releases=releases
        )

    def _system_that_shows_all_modes(
        self, excitation: FmuExcitation, interval: float
    ) -> SampledSystem:
        """Return the system identified at a time step that samples all modes without aliasing.

        The first step is the sampling interval. It is halved until the phase of no mode grows by
        more than `LARGEST_MODE_PHASE` in a step and the system also predicts the FMU at half the
        step. The halving ends early if the FMU is not linear, has a fixed step, or if the sampling
        interval is divided into more than `MOST_PARTS` steps.
        """
        fixed_step = self.description.motion.step
        steps_per_interval = 1
        while True:
            excitation = excitation._replace(step=fixed_step or interval / steps_per_interval)
            system = self.linear_system(excitation)
            if system is None or fixed_step or steps_per_interval > MOST_PARTS:
                break
            rates, _ = system.modes
            largest_phase = np.max(np.abs(rates.imag)) * excitation.step
            half_step = excitation._replace(step=0.5 * excitation.step)
            if largest_phase <= LARGEST_MODE_PHASE and self._predicts_motion(
                system, half_step, ALIASING_TOLERANCE
            ):
                break
            steps_per_interval *= 2
        return SampledSystem(system, excitation, steps_per_interval)

    def _dominant_angular_frequency(self, excitation: FmuExcitation) -> float:
        """Return the angular frequency of the highest peak in the spectrum of a record [rad/s].

        Raises
        ------
        ModelError
            If the FMU does not move.
        """
        if excitation.releases:
            motion = self._response_to_release(excitation, next(iter(excitation.releases)))
        else:
            motion = self._response_to_force(excitation, excitation.inputs[0])
        # vibration (steps + 1, C) about the final position
        last_quarter = motion[-len(motion) // 4 :]
        motion = motion - last_quarter.mean(axis=0)
        frequencies, power = periodogram(
            motion,
            1.0 / excitation.step,
            window="hann",
            nfft=4 * len(motion),
            detrend=False,
            axis=0,
        )
        if not np.any(power):
            raise ModelError(
                f"The FMU model {self.description.name!r} does not move; state angular_frequency "
                "in [scales]."
            )
        peak_frequency = frequencies[np.argmax(power.max(axis=1))]
        # a peak at zero is not a vibration: the first frequency above zero is the least
        return 2.0 * np.pi * float(max(frequencies[1], peak_frequency))

    def nominal_step_choice(self, trial: Trial) -> StepChoice:
        """Return the step of a trial in the nominal state, kept while parameters are fitted."""
        step_choice: StepChoice = self._step_choices.get(
            trial.interval, lambda: self.choose_step(trial, self.nominal_point)
        )
        return step_choice


def recorded_step_count(trial: Trial) -> int:
    """Return how many steps are recorded for a trial: one for each sample, within limits."""
    return min(max(len(trial.time), LEAST_RECORDED_STEPS), MOST_RECORDED_STEPS)
