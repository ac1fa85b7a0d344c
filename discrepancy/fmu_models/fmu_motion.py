"""Motion of an FMU with laws at its ports: by its linear system if it has one, else in steps."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.fmu_excitation import FmuExcitation
from discrepancy.fmu_models.fmu_rest import FmuAtRest
from discrepancy.fmu_models.port_coupling import PortCoupling
from discrepancy.fmu_models.readout import Readout, SampledOutputs, sample_by_splines
from discrepancy.fmu_models.system_motion import LawPorts, system_motion
from discrepancy.system.excitation import Excitation, Load
from fe.compilation import compiled_kernel
from fe.runtime.motion import static_solution
from fe.runtime.port_laws import PortLaws
from fe.runtime.time_steps import LENGTH_TOLERANCE
from fmu_asset.client.runs import FmuRun
from fmu_asset.client.state_space import FmuStateSpace

CONVERGENCE_TOLERANCE = 1e-4
"""Largest rms change of a motion with laws if steps are halved, relative to the motion."""
MOST_REFINEMENT = 64
"""Largest number of parts of a step in the search for convergence."""


class FmuSimulator(FmuAtRest):
    """Rest and motion of an FMU with laws at its ports.

    Parameters
    ----------
    description : FmuModelDescription
        Content of the model's file.
    folder : Path
        Its folder, where relative names begin.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        self._refinements: dict[Hashable, Refinement] = {}

    def simulate_motion(
        self,
        excitation: FmuExcitation,
        trial: Trial,
        laws: PortLaws,
        readout: Readout,
        refinement: int = 1,
    ) -> SampledOutputs:
        """Return outputs (N, C) and their rates in a dynamic trial.

        If the FMU is linear and no force makes the speed of a port jump, its identified linear
        system is solved. Otherwise the FMU itself is stepped, and its outputs are interpolated by
        splines at the N times.

        Parameters
        ----------
        excitation : FmuExcitation
            The state, force, releases and inputs of the FMU.
        trial : Trial
            The trial, for its length and name.
        laws : PortLaws
            Internal forces.
        readout : Readout
            The C outputs, and the N times at which they are read.
        refinement : int
            The factor by which all steps are smaller.

        Raises
        ------
        ModelError
            If the FMU refuses an input; or if it has to be stepped, but a port has no velocity
            output or the steps do not converge.
        """
        times = readout.times
        end = max(float(times[-1]), float(trial.time[-1]))
        ports = self._ports_of_laws(excitation, laws)
        system = self.linear_system(excitation)
        if system is not None and not system.has_jumping_speed(ports.columns, ports.force_indices):
            return self._motion_of_system(
                system, excitation, trial, laws, ports, readout, end, refinement
            )
        if times[-1] != trial.time[-1]:
            # A fit varies the clock: with one more interval, the same cached run serves them all.
            end += trial.interval
        stepped = self._stepped_motion(excitation, trial, end, laws, readout.columns, refinement)
        return sample_by_splines(stepped.values, stepped.step, readout, readout.derivatives)

    def _ports_of_laws(self, excitation: FmuExcitation, laws: PortLaws) -> LawPorts:
        """Return the displacement outputs and force inputs at which laws act.

        The positions at rest are zero, as outputs count from those of the undisturbed FMU.
        """
        ports = [self.ports.index(name) for name in laws.ports]
        columns = [self.displacement_columns[port] for port in ports]
        input_indices = [excitation.inputs.index(self.port_inputs[port]) for port in ports]
        return LawPorts(
            np.array(columns, dtype=np.int64),
            np.array(input_indices, dtype=np.int64),
            np.zeros(len(columns)),
        )

    # ------------------------------------------------------------ by its linear system

    def _motion_of_system(
        self,
        system: FmuStateSpace,
        excitation: FmuExcitation,
        trial: Trial,
        laws: PortLaws,
        ports: LawPorts,
        readout: Readout,
        end: float,
        refinement: int,
    ) -> SampledOutputs:
        """Return outputs (N, C) and their rates, computed with the linear system of the FMU.

        If the samples are not evenly spaced, the system is stepped evenly until `end` [s], and
        splines lead to the samples. Before time zero the outputs rest.
        """
        undisturbed = self._undisturbed_outputs(excitation)  # of all outputs of the FMU
        release_values = self._release_values_of_system(excitation)
        columns = list(readout.columns)
        is_derivative = np.array(readout.derivatives) > 0  # (C,)
        # Steps end at the samples if these are even. Otherwise steps of one length are made, since
        # each length of step costs a matrix exponential, and splines lead to the samples.
        times = readout.times
        stamps, sample_rows = np.unique(np.append(np.maximum(times, 0.0), 0.0), return_inverse=True)
        is_even = len(stamps) > 2 and np.ptp(np.diff(stamps[1:])) <= LENGTH_TOLERANCE * stamps[-1]
        if not is_even:
            stamps = excitation.step * np.arange(ceil(end / excitation.step - 1e-6) + 1.0)
        start, memory = self._start_with_laws(system, excitation, laws, ports, release_values)
        # motion and outputs
        loads = []
        if excitation.force is not None:
            loads.append(Load(excitation.force_factor_values, excitation.force))
        ports_from_undisturbed = LawPorts(
            ports.columns, ports.force_indices, undisturbed[ports.columns]
        )
        states, forces = system_motion(
            system,
            Excitation(trial.time, stamps, loads),
            start,
            laws,
            ports_from_undisturbed,
            refinement,
            memory,
        )
        # matrices (C, n) and (C, E) from states and forces to the outputs or their derivatives
        by_state, by_force = system.output_rows(columns, readout.derivatives)
        constant = np.where(is_derivative, 0.0, undisturbed[columns])
        values = states @ by_state.T + forces @ by_force.T + constant
        if excitation.releases:
            # the first sample is that of the held FMU: the holding force may act on outputs
            # directly
            held_outputs = undisturbed + self._held_outputs(excitation, release_values)
            values[0] = np.where(is_derivative, values[0], held_outputs[columns])
        if not is_even:
            return sample_by_splines(values, excitation.step, readout, [0] * len(columns))
        rates = (states @ system.state_matrix.T + forces @ system.input_matrix.T) @ by_state.T
        if by_force.any():
            rates += np.gradient(forces, stamps, axis=0) @ by_force.T
        # the last entry of `sample_rows` is time zero, which was added to the samples
        values = values[sample_rows[:-1]]
        rates = rates[sample_rows[:-1]]
        is_before = times < 0.0
        rates[is_before] = 0.0
        values[np.ix_(is_before, is_derivative)] = 0.0
        return SampledOutputs(values, rates)

    def _held_outputs(
        self, excitation: FmuExcitation, release_values: Mapping[str, float]
    ) -> FloatArray:
        """Return by how much the outputs (C,) of a held, linear FMU differ from undisturbed ones.

        The responses to unit values of the release variables are superposed.
        """
        return np.asarray(
            sum(
                self._response_to_release(excitation, name)[0] * value
                for name, value in release_values.items()
            )
        )

    def _start_with_laws(
        self,
        system: FmuStateSpace,
        excitation: FmuExcitation,
        laws: PortLaws,
        ports: LawPorts,
        release_values: Mapping[str, float],
    ) -> "StartState":
        """Return the state of the linear system at the start of a trial, and the laws' memory.

        The J laws are internal forces at ports, such as friction. The memory holds what they need
        of earlier displacements.

        - With laws and a recorded force, the trial starts at rest, in equilibrium with the first
          value of the recorded force and the forces of the laws. A positive force of a law acts
          against the displacement of its port.
        - Otherwise it starts in the state given by `release_values`, the values of the release
          variables, and the laws have no memory.

        The linear system has C outputs and E force inputs.
        """
        if not len(laws) or excitation.force is None:
            return StartState(self._start_state(system, excitation, release_values), None)
        first_forces = excitation.first_force * excitation.force_factor_values  # (E,)
        static_gain = system.gain  # (C, E), outputs at rest under unit forces
        outputs = self._undisturbed_outputs(excitation) + static_gain @ first_forces
        positions_without_laws = outputs[ports.columns]  # (J,), of the port of each law
        # the static gains from forces to displacements of ports are their compliance (J, J)
        compliance = static_gain[np.ix_(ports.columns, ports.force_indices)]
        solution = static_solution(
            laws, positions_without_laws[None], compliance, kernel=compiled_kernel()
        )
        # several laws may act at one port: the sum of their forces on each of the E inputs
        law_forces = np.bincount(ports.force_indices, solution.forces[0], len(first_forces))
        return StartState(system.state_at_rest(first_forces - law_forces), solution.memory)

    # ------------------------------------------------------------ step by step

    def _stepped_motion(
        self,
        excitation: FmuExcitation,
        trial: Trial,
        end: float,
        laws: PortLaws,
        columns: Sequence[int],
        refinement: int,
    ) -> "SteppedOutputs":
        """Return the outputs of the FMU, stepped until `end` [s] and coupled with the laws.

        With laws, steps are halved until the outputs that are read have converged, and are then
        `refinement` times smaller than that. An FMU with a fixed step is always stepped by it.
        """
        fixed_step = self.description.motion.step
        release_values = self._find_release_values(excitation)
        # the FMU holds inputs constant over a step, so that a recorded force needs half the step
        longest_step = excitation.step if excitation.force is None else 0.5 * excitation.step

        def outputs_by(parts: int) -> FloatArray:
            """Return the outputs (K, C) with the longest step divided into `parts` steps."""
            step = fixed_step or longest_step / parts
            refined_excitation = excitation._replace(
                step=step, recorded_steps=ceil(end / step - 1e-6)
            )
            run = self._run_of_excitation(refined_excitation, release_values)
            if len(laws):
                # an unstable coupling grows beyond all numbers
                with np.errstate(all="ignore"):
                    return self._outputs_with_laws(run, laws, trial.name)
            load_bytes = [values.tobytes() for values in run.offsets.values()]
            key = (
                run.operating_point,
                run.step,
                run.steps,
                *run.initial_offsets.items(),
                *load_bytes,
            )
            return self.cached(key, lambda: self.outputs_of_run(run))

        parts = 1
        if len(laws) and fixed_step is None:
            # only the outputs that are read have to converge: others may need far smaller steps
            compared_columns = sorted({*columns, *self.displacement_columns})
            motion_key = (*compared_columns, trial.kind, trial.interval)
            parts = self._find_converged_parts(
                laws,
                motion_key,
                longest_step,
                lambda parts: outputs_by(parts)[::parts, compared_columns],
            )
        parts *= refinement
        outputs = outputs_by(parts)[:, list(columns)]
        return SteppedOutputs(outputs, fixed_step or longest_step / parts)

    def _settled_with_laws(self, run: FmuRun, laws: PortLaws, trial: str) -> "SettledRun":
        """Return the run with such loads at its start that FMU and laws are then in equilibrium.

        The J laws are internal forces at ports, such as friction. The run starts at rest under the
        loads `initial_offsets`, from which the forces of the laws are subtracted. The result also
        has what the laws remember of the displacements up to there.

        If the run has no loads in its steps (`offsets`), or if no port of a law is displaced at the
        start, the run is returned as it is, and the memory is None.
        """
        outputs_without_laws = self._outputs_at_begin(run)
        columns = [self.displacement_columns[self.ports.index(name)] for name in laws.ports]
        if not run.offsets or not np.any(outputs_without_laws[:, columns]):
            return SettledRun(run, None)

        def run_under(law_forces: FloatArray) -> FmuRun:
            """Return the run that starts under its loads minus the forces (1, J) of the laws."""
            loads = {name: np.full(1, value) for name, value in run.initial_offsets.items()}
            remaining_loads = self.subtract_law_forces(loads, laws, law_forces)
            return run._replace(
                initial_offsets={name: float(load[0]) for name, load in remaining_loads.items()}
            )

        def outputs_under(law_forces: FloatArray) -> FloatArray:
            """Return the outputs (1, C) at the start under forces (1, J) of the laws."""
            return self._outputs_at_begin(run_under(law_forces))

        _, solution = self.find_equilibrium_with_laws(
            laws, outputs_under, outputs_without_laws, run.operating_point, trial
        )
        return SettledRun(run_under(solution.forces), solution.memory)

    def _outputs_at_begin(self, run: FmuRun) -> FloatArray:
        """Return the outputs (1, C) at the start of a run."""
        _, outputs, _ = self.start_run(run)
        return outputs[None]

    def _outputs_with_laws(self, run: FmuRun, laws: PortLaws, trial: str) -> FloatArray:
        """Step the FMU with laws at its ports; return the outputs (K, C) at K step boundaries.

        All outputs are NaN if the explicit coupling of FMU and laws is unstable. Raises
        `ModelError` if a port of a law has no velocity output.
        """
        run, memory = self._settled_with_laws(run, laws, trial)
        ports = [self.ports.index(name) for name in dict.fromkeys(laws.ports)]
        names = [self.ports[port] for port in ports]
        inputs = [self.port_inputs[port] for port in ports]
        position_columns = [self.displacement_columns[port] for port in ports]
        speed_columns = [self.velocity_columns[port] for port in ports]
        if min(speed_columns) < 0:
            port = names[speed_columns.index(-1)]
            raise ModelError(
                f"The FMU model {self.description.name!r} is not linear, or the speed of a port "
                f"jumps with a force, so its port {port!r} needs a velocity output; name it in "
                "[[port]]."
            )
        first_step, speed_gain = self._probe_port_speeds(run, inputs, speed_columns)
        coupling = PortCoupling(laws, names, speed_gain, run.step, memory)
        # In each step the laws change the speeds of the ports by -speed_loss. The FMU gets the
        # constant force that causes this change: -speed_gain^-1 speed_loss. The accelerations that
        # the ports would have without laws are those of the last step plus its speed loss.
        asset, first_outputs, loads_by_input = self.start_run(run)
        outputs = [first_outputs]
        forces = np.column_stack([*loads_by_input.values()])  # (steps, inputs)
        port_columns = [list(loads_by_input).index(name) for name in inputs]
        # speeds before the start, extrapolated from the first step without laws
        previous_speeds = 2.0 * first_step[0] - first_step[1]
        speed_loss = np.zeros(len(ports))
        for step_forces in forces:
            positions = outputs[-1][position_columns]
            speeds = outputs[-1][speed_columns]
            accelerations = (speeds - previous_speeds + speed_loss) / run.step
            speed_loss = coupling.speed_loss(positions, speeds, accelerations)
            previous_speeds = speeds
            step_forces[port_columns] -= np.linalg.solve(speed_gain, speed_loss)  # a row of forces
            if not np.isfinite(step_forces).all():
                return np.full((len(forces) + 1, len(first_outputs)), np.nan)
            load = dict(zip(loads_by_input, step_forces.tolist(), strict=True))
            with self.refusal_context():
                outputs.append(asset.step(load=load).values)
        return np.array(outputs)

    def _probe_port_speeds(
        self, run: FmuRun, inputs: Sequence[str], speed_columns: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the speeds of the P ports in the first step of a run, and how forces change them.

        The step is made once without probing forces, and then once for each port with a probing
        force at that port.

        Parameters
        ----------
        run : FmuRun
            The run without laws.
        inputs : sequence of str
            Force input of each port (P,).
        speed_columns : list of int
            Index of the output that is each port's speed (P,).

        Returns
        -------
        speeds : (2, P) array
            The speeds of the ports without probing forces, at the start and the end of the step.
        gains : (P, P) array
            The changes of the speeds (rows) at the end of the step by unit forces at the ports
            (columns).
        """
        first_loads = {name: values[:1] for name, values in run.offsets.items()}
        one_step = run._replace(steps=1, offsets=first_loads)
        speeds = self.outputs_of_run(one_step)[:, speed_columns]
        _, speeds_at_end = speeds
        amplitudes = np.array([self.probing_amplitude(name) for name in inputs])
        speed_changes = []
        for name, amplitude in zip(inputs, amplitudes, strict=True):
            probing_load = first_loads.get(name, 0.0) + np.array([amplitude])  # (1,): one step
            probed_run = one_step._replace(offsets={**first_loads, name: probing_load})
            _, probed_speeds_at_end = self.outputs_of_run(probed_run)[:, speed_columns]
            speed_changes.append(probed_speeds_at_end - speeds_at_end)
        return speeds, np.stack(speed_changes, axis=1) / amplitudes

    def _find_converged_parts(
        self,
        laws: PortLaws,
        motion_key: Hashable,
        step: float,
        outputs_by: Callable[[int], FloatArray],
    ) -> int:
        """Return the number of parts of a step at which a motion with laws has converged.

        Steps are halved until no output changes by more than `CONVERGENCE_TOLERANCE` of its largest
        motion (rms). The number is kept, and returned at once for laws of the same kinds and
        exponents at the same ports that are at most twice as strong.

        Parameters
        ----------
        laws : PortLaws
            Internal forces.
        motion_key : hashable
            Everything else that the number depends on.
        step : float
            The whole step [s].
        outputs_by : callable
            Returns the outputs (K, C) at the ends of whole steps, given the number of parts.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        strength = float(np.max(np.abs(laws.parameters[:, 0])))
        # the exponents of a law say how rough it is, and rough laws need short steps
        exponents = np.round(np.clip(laws.parameters[:, 1:3], -9.0, 9.0), 1)
        key = (motion_key, laws.ports, laws.law_numbers.tobytes(), exponents.tobytes())
        refinement = self._refinements.get(key, Refinement(1, 0.0))
        parts = refinement.parts
        if strength <= 2.0 * refinement.strength:
            return parts
        fine_outputs = outputs_by(parts)
        while parts <= MOST_REFINEMENT:
            # the finer motion of the last pass is the coarser one of this pass
            coarse_outputs = fine_outputs
            fine_outputs = outputs_by(2 * parts)
            change = _relative_change(coarse_outputs, fine_outputs)
            if change <= CONVERGENCE_TOLERANCE:
                self._refinements[key] = Refinement(parts, strength)
                return parts
            parts *= 2
        ports = ", ".join(dict.fromkeys(laws.ports))
        raise ModelError(
            f"The internal force at {ports} does not converge in the co-simulation with the FMU "
            f"model {self.description.name!r}: halving steps of {2.0 * step / parts:.2g} s still "
            f"changes the motion by {change:.1g} of its size; the force is too stiff for the port."
        )


class Refinement(NamedTuple):
    """Number of parts of a step, and the strength of the laws for which they were enough."""

    parts: int
    strength: float


class StartState(NamedTuple):
    """State (n,) of a linear system at the start, and the memory of the laws.

    The memory is None if the laws were not loaded before.
    """

    state: FloatArray
    memory: FloatArray | None


class SteppedOutputs(NamedTuple):
    """Values (K, C) of outputs on an even time grid from zero, and the step of the grid [s]."""

    values: FloatArray
    step: float


class SettledRun(NamedTuple):
    """A run that begins at rest with laws, and their memory; None if they were never loaded."""

    run: FmuRun
    memory: FloatArray | None


def _relative_change(coarse: FloatArray, fine: FloatArray) -> float:
    """Return the largest rms difference of two motions (K, C), relative to the largest motion.

    The motion of an output is its departure from its mean; an output that does not move counts as
    equal. NaN in a motion makes the result NaN.
    """
    rows = min(len(fine), len(coarse))
    with np.errstate(all="ignore"):
        largest = np.max(np.abs(fine - fine.mean(axis=0)), axis=0)
        difference = np.sqrt(np.mean((coarse[:rows] - fine[:rows]) ** 2, axis=0))
        return float(np.max(difference / np.where(largest == 0.0, np.inf, largest)))
