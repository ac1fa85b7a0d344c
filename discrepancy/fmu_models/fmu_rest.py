"""Rest of an FMU under loads, with laws at its ports."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.fmu_excitation import FmuExcitation
from discrepancy.fmu_models.identified_fmu import LINEAR, RECORD, IdentifiedFmu
from fe.compilation import compiled_kernel
from fe.runtime.motion import StaticSolution, static_solution
from fe.runtime.port_laws import PortLaws
from fmu_asset.client.runs import OperatingPoint

STATIC_ITERATIONS = 30
"""Iterations after which a law and an FMU at rest are given up."""
STATIC_TOLERANCE = 1e-9
"""Change of the ports in an iteration, as a share of their displacement, that ends it."""


class RestWithLaws(NamedTuple):
    """Outputs (L, C) at rest with laws, and what the laws do then."""

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
        self._rest_is_linear: dict[tuple[str, ...], bool] = {}

    def rest(self, states: Sequence[OperatingPoint], loads: Mapping[str, FloatArray]) -> FloatArray:
        """Return the outputs (L, C) at rest in states that differ in inputs.

        Where the FMU has to come to rest and is linear, what loads add is that of its system.

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
        amounts = np.array([loads[name] for name in names]).reshape(-1, len(states)).T
        # the largest load says whether the FMU is linear
        largest_first = np.argsort(-np.abs(amounts).sum(axis=1), kind="stable")
        outputs = {}
        for row in largest_first.tolist():
            outputs[row] = self._settled_outputs(states[row], amounts[row], names)
        return np.array([outputs[row] for row in range(len(states))])

    def _settled_outputs(
        self, state: OperatingPoint, amounts: FloatArray, names: tuple[str, ...]
    ) -> FloatArray:
        """Return the outputs (C,) of the settled FMU under amounts (E,) on some inputs.

        Parameters
        ----------
        state : OperatingPoint
            Parameters and constant inputs.
        amounts : (E,) array
            What is added to the inputs.
        names : tuple of str
            These inputs.
        """
        excitation = FmuExcitation(
            state, self.description.static.step, RECORD, inputs=names, settles=True
        )
        if self._rest_is_linear.get(names) is False:
            return self._stepped_rest(state, amounts, names)
        system = self.system(excitation)
        if system is None:
            return self._stepped_rest(state, amounts, names)
        unloaded = self._stepped_rest(state, 0.0 * amounts, names)
        added = system.gain @ amounts
        if names not in self._rest_is_linear:
            answers = [self._answer_to_force(excitation, name) for name in names]
            largest = [np.max(np.abs(answer), axis=0) for answer in answers]
            tolerance = LINEAR * (np.abs(added) + np.abs(amounts) @ largest)
            loaded = self._stepped_rest(state, amounts, names)
            is_linear = bool(np.all(np.abs(loaded - unloaded - added) <= tolerance))
            self._rest_is_linear[names] = is_linear
        if self._rest_is_linear[names]:
            return np.asarray(unloaded + added)
        return self._stepped_rest(state, amounts, names)

    def _stepped_rest(
        self, state: OperatingPoint, amounts: FloatArray, names: tuple[str, ...]
    ) -> FloatArray:
        """Return the outputs (C,) of the FMU itself when it has come to rest."""
        loads = dict(zip(names, amounts[:, None], strict=True))
        key = (state, names, amounts.tobytes())
        step = self.description.static.step
        return self.cached(key, lambda: self.outputs_at_rest([state], loads, step, settle=True)[0])

    def flexibility(self, state: OperatingPoint) -> FloatArray:
        """Return the displacements (P, P) of the ports at rest under a unit force at each."""
        if not self.ports:
            # loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        pushes = np.diag([self.probing_amplitude(name) for name in self.port_inputs])
        # the first row is without a force
        loads = dict.fromkeys(self.port_inputs, np.zeros(len(pushes) + 1))
        for name, push in zip(self.port_inputs, pushes, strict=True):
            loads[name] = loads[name] + np.append(0.0, push)
        outputs = self.rest([state] * (len(pushes) + 1), loads)
        displacements = outputs[:, self.displacement_columns]
        return np.asarray((displacements[1:] - displacements[0]).T / np.diag(pushes))

    def at_rest(
        self,
        states: Sequence[OperatingPoint],
        loads: Mapping[str, FloatArray],
        laws: PortLaws,
        trial: str,
    ) -> FloatArray:
        """Return the outputs (L, C) where laws follow the load path; the FMU confirms the result.

        Parameters
        ----------
        states : sequence of OperatingPoint
            Parameters and constant inputs of each of the L rows.
        loads : mapping of str to (L,) array
            What is added to inputs in each row.
        laws : Laws
            Internal forces.
        trial : str
            Name of the trial, for sentences.

        Raises
        ------
        ModelError
            If the FMU refuses a row, a law has no solution, or the FMU does not confirm it.
        """
        try:
            outputs = self.rest(states, loads)
        except ModelError:
            self._refuse_first_row(states, loads, trial)
            raise
        if not len(laws):
            return outputs

        def outputs_under(forces: FloatArray) -> FloatArray:
            return self.rest(states, self.loads_less_laws(loads, laws, forces))

        return self.rest_with_laws(laws, outputs_under, outputs, states[0], trial).outputs

    def _refuse_first_row(
        self, states: Sequence[OperatingPoint], loads: Mapping[str, FloatArray], trial: str
    ) -> None:
        """Raise `ModelError` for the first row of a trial that the FMU refuses by itself."""
        for row, state in enumerate(states):
            row_loads = {name: values[row : row + 1] for name, values in loads.items()}
            where = f"The trial {trial!r}, row {row + 1} of its table: "
            with ModelError.instead_of(ModelError, before=where):
                self.rest([state], row_loads)

    def loads_less_laws(
        self, loads: Mapping[str, FloatArray], laws: PortLaws, forces: FloatArray
    ) -> dict[str, FloatArray]:
        """Return loads (L,) by input, less the forces (L, J) of laws.

        Parameters
        ----------
        loads : mapping of str to (L,) array
            Loads by input.
        laws : Laws
            J internal forces.
        forces : (L, J) array
            What they take.
        """
        remaining = dict(loads)
        for port, force in zip(laws.ports, forces.T, strict=True):
            name = self.port_inputs[self.ports.index(port)]
            remaining[name] = remaining.get(name, 0.0) - force
        return remaining

    def rest_with_laws(
        self,
        laws: PortLaws,
        outputs_under: Callable[[FloatArray], FloatArray],
        outputs: FloatArray,
        state: OperatingPoint,
        trial: str,
    ) -> RestWithLaws:
        """Return the rest with laws, by iterations of laws and FMU.

        Parameters
        ----------
        laws : Laws
            J internal forces.
        outputs_under : callable
            Forces (L, J) of the laws to outputs (L, C) at rest.
        outputs : (L, C) array
            Outputs without laws.
        state : OperatingPoint
            State whose flexibility leads to where laws and FMU agree.
        trial : str
            Name of the trial, for sentences.

        Raises
        ------
        ModelError
            If laws and FMU do not agree.
        """
        ports = [self.ports.index(name) for name in laws.ports]
        columns = [self.displacement_columns[port] for port in ports]
        compliance = self.flexibility(state)[np.ix_(ports, ports)]
        without_laws = outputs[:, columns]
        for _ in range(STATIC_ITERATIONS):
            solution = static_solution(laws, without_laws, compliance, kernel=compiled_kernel())
            outputs = outputs_under(solution.forces)
            # where the FMU is not linear, the law is solved again about the points that were
            # reached
            updated = outputs[:, columns] + solution.forces @ compliance.T
            change = np.abs(updated - without_laws).max(axis=1)
            without_laws = updated
            size = np.maximum(np.abs(updated).max(axis=1), 1e-300)
            if np.all(change <= STATIC_TOLERANCE * size):
                return RestWithLaws(outputs, solution)
        names = ", ".join(dict.fromkeys(laws.ports))
        level = int(np.argmax(change)) + 1
        raise ModelError(
            f"The law at {names} and the FMU model {self.description.name!r} did not agree at load "
            f"level {level} of {trial!r} within {STATIC_ITERATIONS} iterations; the force is too "
            "strong for the FMU."
        )
