"""The linear system of a trial at rest, with its loads and outputs."""

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.system.excitation import LoadLevels
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.response import Outputs, PortsAtRest
from fe.runtime.errors import FiniteElementError


class LoadedSystem(NamedTuple):
    """The linear system in successive rows of a trial at rest, with its loads and outputs.

    Attributes
    ----------
    rows : slice
        The rows in which the structure is the same.
    system : LinearSystem
        The system of N unknowns.
    directions : (k, N) ndarray
        The load on all unknowns for a value of one of each of k loads.
    levels : (R, k) ndarray
        The value of each load in all R rows of the trial.
    output_rows : (C, N) ndarray
        The rows that give the C outputs from the unknowns.
    constants : (C,) ndarray
        What is added to each output.
    """

    rows: slice
    system: LinearSystem
    directions: FloatArray
    levels: FloatArray
    output_rows: FloatArray
    constants: FloatArray

    @classmethod
    def of_trial(
        cls,
        trial: Trial,
        rows: slice,
        system: LinearSystem,
        load_levels: LoadLevels,
        outputs: Outputs,
        equations: Sequence[OutputEquation],
    ) -> "LoadedSystem":
        """Return the system in some rows of a trial, with its loads and its outputs' equations."""
        return cls(
            rows=rows,
            system=system,
            directions=load_levels.directions,
            levels=load_levels.values,
            output_rows=_output_rows(trial, outputs, equations, system.displacement_count),
            constants=np.array([equation.constant for equation in equations]),
        )


def errors_at_rest(trial: Trial) -> AbstractContextManager[None]:
    """Return a context in which errors of a model at rest are told as those of a trial."""
    trial_text = f"The trial {trial.name!r} is at rest, but "
    return ModelError.instead_of(ModelError, FiniteElementError, before=trial_text)


def _output_rows(
    trial: Trial,
    outputs: Outputs,
    equations: Sequence[OutputEquation],
    displacement_count: int,
) -> FloatArray:
    """Return the matrix (C, N) that gives the C outputs of a structure at rest from its N unknowns.

    The first `displacement_count` unknowns are displacements. The others are integrals of states of
    first order, so that the rate of such an unknown is the value of its state. At rest an output
    depends on displacements (row 0 of its equation) and on values of states (row 1). Raises
    `ModelError` if an output is a velocity, an acceleration or the rate of a state.
    """
    output_rows = []
    for (_, quantity), equation in zip(outputs, equations, strict=True):
        shows_state_rate = np.any(equation.rows[2:, displacement_count:])
        shows_speed = quantity.order > 0 and np.any(equation.rows[1:, :displacement_count])
        if shows_state_rate or shows_speed:
            raise ModelError(
                f"The trial {trial.name!r} is at rest, but a channel measures velocity or "
                "acceleration."
            )
        displacement_row = equation.rows[0, :displacement_count]
        state_row = equation.rows[1, displacement_count:]
        output_rows.append(np.append(displacement_row, state_row))
    return np.array(output_rows)


def ports_of_blocks(trial: Trial, blocks: Iterable[LoadedSystem]) -> PortsAtRest:
    """Return the ports in a trial at rest, without laws; a port of a state does not move.

    `blocks` are the linear systems of all rows of the trial.
    """
    ports: tuple[str, ...] = ()
    positions: list[FloatArray] = []
    compliance: list[FloatArray] = []
    outputs_by_force: list[FloatArray] = []
    for block in blocks:
        system = block.system
        ports = tuple(system.ports)
        # rows of the ports on the unknowns (P, N), without states
        port_rows = np.array([system.ports[name] for name in ports])
        port_rows[:, system.displacement_count :] = 0.0
        with errors_at_rest(trial):
            # the displacements under unit loads, and under unit forces at the ports
            displacements = system.equilibrium_under(block.directions)
            flexibility = system.equilibrium_under(port_rows)
        positions.append(block.levels[block.rows] @ displacements @ port_rows.T)
        row_count = len(positions[-1])
        compliance += [port_rows @ flexibility.T] * row_count
        outputs_by_force += [flexibility @ block.output_rows.T] * row_count
    return PortsAtRest(
        ports, np.concatenate(positions), np.array(compliance), np.array(outputs_by_force)
    )
