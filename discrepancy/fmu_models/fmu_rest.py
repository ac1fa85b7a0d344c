"""Static equilibrium of an FMU under loads, with internal forces (laws) at its ports."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.fmu_excitation import FmuExcitation
from discrepancy.fmu_models.identified_fmu import (
    LINEARITY_TOLERANCE,
    MOST_RECORDED_STEPS,
    IdentifiedFmu,
)
from fe.compilation import compiled_kernel
from fe.runtime.motion import StaticSolution, static_solution
from fe.runtime.port_laws import PortLaws
from fmu_asset.client.runs import OperatingPoint

STATIC_ITERATIONS = 30
"""Largest number of iterations between the laws and a static FMU."""
STATIC_TOLERANCE = 1e-9
"""The iteration ends if it changes the ports by less than this fraction of their displacement."""


class EquilibriumWithLaws(NamedTuple):
    """Outputs (L, C) of an FMU in equilibrium with laws, and the laws' forces and memory there."""

    outputs: FloatArray
    solution: StaticSolution


class FmuAtRest(IdentifiedFmu):
    """An FMU at rest, with laws at its ports.

    Parameters
    ----------
    description : FmuModelDescription
        Content of the model's file.
    folder : Path
        Its folder, where relative names begin.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        # whether the outputs at rest are linear in a set of inputs, once that was tested
        self._linear_at_rest: dict[tuple[str, ...], bool] = {}

    def solve_rest(
        self, states: Sequence[OperatingPoint], loads: Mapping[str, FloatArray]
    ) -> FloatArray:
        """Return the outputs (L, C) at rest in L rows, which differ in state and loads.

        A quasi-static FMU makes one step for each row. Any other (`static.settle`) is stepped until
        its motion has decayed; if it is linear, it is stepped without loads, and the changes of the
        outputs by the loads are computed from its static gain.

        Parameters
        ----------
        states : sequence of OperatingPoint
            Parameters and constant inputs of each of the L rows.
        loads : mapping of str to (L,) array
            What is added to inputs in each row.
        """
        static = self.description.static
        if not static.settle:
            return self.outputs_at_rest(states, loads, static.step, settle=False)
        names = tuple(sorted(name for name, values in loads.items() if np.any(values)))
        values_of_inputs = np.array([loads[name] for name in names])
        load_values = values_of_inputs.reshape(-1, len(states)).T  # (L, inputs), even without any
        # the first row is tested for linearity, and the largest load is the strictest test
        total_load = np.abs(load_values).sum(axis=1)
        largest_first = np.argsort(-total_load, kind="stable")
        outputs = {}
        for row in largest_first.tolist():
            outputs[row] = self._settled_outputs(states[row], load_values[row], names)
        return np.array([outputs[row] for row in range(len(states))])

    def _settled_outputs(
        self, state: OperatingPoint, load_values: FloatArray, names: tuple[str, ...]
    ) -> FloatArray:
        """Return the outputs (C,) of the FMU at rest under constant loads on E inputs.

        `load_values` (E,) are added to the inputs of these names. If the FMU is linear in them, it
        is stepped without loads, and their effect is computed from the static gain.
        """
        if self._is_linear_at_rest(state, load_values, names):
            gain = self._static_gain(state, names)
            if gain is not None:
                unloaded_outputs = self._step_to_rest(state, np.zeros_like(load_values), names)
                return np.asarray(unloaded_outputs + gain @ load_values)
        return self._step_to_rest(state, load_values, names)

    def _is_linear_at_rest(
        self, state: OperatingPoint, load_values: FloatArray, names: tuple[str, ...]
    ) -> bool:
        """Return whether the outputs at rest are linear in the loads on some inputs.

        The change of the outputs by the static gain is compared with the change of the FMU itself.
        Because the FMU is stepped over a long time, the two may differ by `LINEARITY_TOLERANCE`
        times the sum of the change and the largest transient. Each set of inputs is tested once,
        under the loads of the first call. The arguments are those of `_settled_outputs`.
        """
        if names in self._linear_at_rest:
            return self._linear_at_rest[names]
        gain = self._static_gain(state, names)
        if gain is None:
            return False  # not kept: there may be a gain at another operating point
        change_by_gain = gain @ load_values  # (C,)
        excitation = self._excitation_to_rest(state, names)
        responses = [self._response_to_force(excitation, name) for name in names]
        largest_responses = [np.max(np.abs(response), axis=0) for response in responses]  # (E, C)
        tolerance = LINEARITY_TOLERANCE * (
            np.abs(change_by_gain) + np.abs(load_values) @ largest_responses
        )
        unloaded_outputs = self._step_to_rest(state, np.zeros_like(load_values), names)
        change_of_fmu = self._step_to_rest(state, load_values, names) - unloaded_outputs
        is_linear = bool(np.all(np.abs(change_of_fmu - change_by_gain) <= tolerance))
        self._linear_at_rest[names] = is_linear
        return is_linear

    def _static_gain(self, state: OperatingPoint, names: tuple[str, ...]) -> FloatArray | None:
        """Return the change (C, E) of the outputs at rest by unit loads; None if it is not known.

        The change is that of the linear system which is identified from the responses of the FMU.
        """
        system = self.linear_system(self._excitation_to_rest(state, names))
        return None if system is None else system.gain

    def _excitation_to_rest(self, state: OperatingPoint, names: tuple[str, ...]) -> FmuExcitation:
        """Return the excitation by which the FMU is identified until its motion has decayed."""
        return FmuExcitation(
            state,
            self.description.static.step,
            MOST_RECORDED_STEPS,
            inputs=names,
            decays_to_rest=True,
        )

    def _step_to_rest(
        self, state: OperatingPoint, load_values: FloatArray, names: tuple[str, ...]
    ) -> FloatArray:
        """Step the FMU itself until it is at rest, and return its outputs (C,)."""
        loads = dict(zip(names, load_values[:, None], strict=True))
        key = (state, names, load_values.tobytes())
        step = self.description.static.step
        return self.cached(key, lambda: self.outputs_at_rest([state], loads, step, settle=True)[0])

    def largest_input(self, variable: str) -> float:
        """Return the largest value of an input of the FMU that a trial sets [SI]."""
        return self.asset.input_range("load", variable)[1]

    def port_flexibility(self, state: OperatingPoint) -> FloatArray:
        """Return the displacements of the ports (rows) at rest by unit forces at ports (columns).

        This is the flexibility (P, P) [m/N]. A force of the probing amplitude is applied at one
        port after the other.
        """
        if not self.ports:
            # there is nothing to compute, and the FMU may not accept loads of zero
            return np.zeros((0, 0))
        amplitudes = np.array([self.probing_amplitude(name) for name in self.port_inputs])
        # the first row is without a force; each further row has a force at one port
        row_count = 1 + len(amplitudes)
        loads = dict.fromkeys(self.port_inputs, np.zeros(row_count))
        for name, force in zip(self.port_inputs, np.diag(amplitudes), strict=True):
            loads[name] = loads[name] + np.append(0.0, force)
        outputs = self.solve_rest([state] * row_count, loads)
        displacements = outputs[:, self.displacement_columns]
        changes = displacements[1:] - displacements[0]
        return np.asarray(changes.T / amplitudes)

    def solve_rest_with_laws(
        self,
        states: Sequence[OperatingPoint],
        loads: Mapping[str, FloatArray],
        laws: PortLaws,
        trial: str,
    ) -> FloatArray:
        """Return the outputs (L, C) at rest along a load path, in equilibrium with laws.

        Parameters
        ----------
        states : sequence of OperatingPoint
            Parameters and constant inputs of each of the L rows.
        loads : mapping of str to (L,) array
            What is added to inputs in each row, by the FMU's names.
        laws : PortLaws
            Internal forces at the ports.
        trial : str
            Name of the trial, for messages.

        Raises
        ------
        ModelError
            If the FMU refuses a row, the equations of the laws have no solution, or the FMU does
            not agree with it.
        """
        try:
            outputs = self.solve_rest(states, loads)
        except ModelError:
            self._raise_for_refused_row(states, loads, trial)
            raise
        if not len(laws):
            return outputs

        def outputs_under(forces: FloatArray) -> FloatArray:
            """Return the outputs (L, C) of the FMU under the loads minus forces of the laws."""
            return self.solve_rest(states, self.subtract_law_forces(loads, laws, forces))

        return self.find_equilibrium_with_laws(
            laws, outputs_under, outputs, states[0], trial
        ).outputs

    def _raise_for_refused_row(
        self, states: Sequence[OperatingPoint], loads: Mapping[str, FloatArray], trial: str
    ) -> None:
        """Raise `ModelError` for the first row of a trial that the FMU refuses by itself.

        Each row is computed alone. If the FMU accepts every one, nothing is raised.
        """
        for row, state in enumerate(states):
            row_loads = {name: values[row : row + 1] for name, values in loads.items()}
            row_text = f"The trial {trial!r}, row {row + 1} of its table: "
            with ModelError.instead_of(ModelError, before=row_text):
                self.solve_rest([state], row_loads)

    def subtract_law_forces(
        self, loads: Mapping[str, FloatArray], laws: PortLaws, forces: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the loads (L,) on each input minus the forces of the laws at its port.

        Parameters
        ----------
        loads : mapping of str to (L,) array
            Loads by input.
        laws : PortLaws
            J internal forces.
        forces : (L, J) array
            The force of each law in each row.
        """
        remaining_loads = dict(loads)
        for port, force in zip(laws.ports, forces.T, strict=True):
            name = self.port_inputs[self.ports.index(port)]
            remaining_loads[name] = remaining_loads.get(name, 0.0) - force
        return remaining_loads

    def find_equilibrium_with_laws(
        self,
        laws: PortLaws,
        outputs_under: Callable[[FloatArray], FloatArray],
        outputs: FloatArray,
        state: OperatingPoint,
        trial: str,
    ) -> EquilibriumWithLaws:
        """Return the equilibrium of the FMU with laws, by a Newton iteration of fixed flexibility.

        In each iteration the equations of the laws are solved for a linear structure, whose
        flexibility is that of the FMU in one state. The FMU is then loaded by these forces of the
        laws, and the linear structure is shifted so that it passes through the positions that the
        FMU reaches. For a linear FMU the second iteration confirms the first.

        Parameters
        ----------
        laws : PortLaws
            J internal forces.
        outputs_under : callable
            Returns the outputs (L, C) at rest under forces (L, J) of the laws.
        outputs : (L, C) array
            Outputs without laws.
        state : OperatingPoint
            State whose flexibility is used in all iterations.
        trial : str
            Name of the trial, for messages.

        Raises
        ------
        ModelError
            If the positions still change after `STATIC_ITERATIONS`.
        """
        ports = [self.ports.index(name) for name in laws.ports]
        columns = [self.displacement_columns[port] for port in ports]
        compliance = self.port_flexibility(state)[np.ix_(ports, ports)]
        positions_without_laws = outputs[:, columns]  # (L, J)
        for _ in range(STATIC_ITERATIONS):
            solution = static_solution(
                laws, positions_without_laws, compliance, kernel=compiled_kernel()
            )
            outputs = outputs_under(solution.forces)
            # positions that the ports would have without laws, if the FMU were linear about the
            # positions that it reached
            updated_positions = outputs[:, columns] + solution.forces @ compliance.T
            largest_change = np.abs(updated_positions - positions_without_laws).max(axis=1)
            positions_without_laws = updated_positions
            largest_position = np.maximum(np.abs(updated_positions).max(axis=1), 1e-300)
            if np.all(largest_change <= STATIC_TOLERANCE * largest_position):
                return EquilibriumWithLaws(outputs, solution)
        names = ", ".join(dict.fromkeys(laws.ports))
        level = int(np.argmax(largest_change)) + 1
        raise ModelError(
            f"The law at {names} and the FMU model {self.description.name!r} did not agree at load "
            f"level {level} of {trial!r} within {STATIC_ITERATIONS} iterations; the force is too "
            "strong for the FMU."
        )
