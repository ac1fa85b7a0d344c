"""Integrate the motion of a linear system with laws at its ports, and solve it at rest.

Without laws the motion is exact at the stamps. The loops run as plain Python here; `fe.compilation`
has the same functions compiled, to be given as `kernel`. NumPy and relative imports only: this file
is copied into the FMU.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .arrays import POSITION, FloatArray
from .errors import SolutionError
from .modal_system import ModalSystem
from .motion_arrays import ModalMotion, ModalState, StepArrays
from .motion_kernel import integrate
from .port_laws import PortLaws, port_flexibility, port_in_patch
from .static_path import static_path


class Kernel(NamedTuple):
    """The loops `motion_kernel.integrate` and `static_path.static_path`, plain or compiled."""

    integrate: Callable[..., None]
    static_path: Callable[..., int]


PLAIN_KERNEL = Kernel(integrate, static_path)
"""The loops as plain Python."""

# ---------------------------------------------------------------- static solutions


class StaticSolution(NamedTuple):
    """Static states at L load levels.

    Attributes
    ----------
    positions : (L, J) array
        Positions of the laws' ports.
    forces : (L, J) array
        Forces of the laws.
    memory : (J, 5 + E) array
        Memory of the laws after the last level.
    """

    positions: FloatArray
    forces: FloatArray
    memory: FloatArray


def static_solution(
    laws: PortLaws,
    linear_positions: FloatArray,
    compliance: FloatArray,
    *,
    memory: FloatArray | None = None,
    start: FloatArray | None = None,
    kernel: Kernel | None = None,
) -> StaticSolution:
    """Compute the forces of laws in static equilibrium at successive load levels.

    The displacement of the structure is then that of the linear structure under the loads minus
    that under these forces.

    Parameters
    ----------
    laws : PortLaws
        Laws of speed have no force at rest.
    linear_positions : (L, J) array
        Position of each law's port at each level without internal forces.
    compliance : (J, J) array
        Position of the port of each law (row) under a unit force at that of another (column).
    memory : (J, 5 + E) array, optional
        Memory of the laws before the first level; by default they were never loaded.
    start : (J,) array, optional
        Linear positions from which the first level is reached; by default zero.
    kernel : Kernel, optional
        By default the loops in plain Python.

    Raises
    ------
    SolutionError
        If a level has no solution on the path: a softening law that the structure cannot hold.
    """
    linear_positions = np.ascontiguousarray(linear_positions, dtype=np.float64)
    memory = laws.unloaded_memory() if memory is None else memory.copy()
    positions = linear_positions.copy()
    forces = np.zeros_like(linear_positions)
    if not len(laws) or not len(linear_positions):
        return StaticSolution(positions, forces, memory)
    if start is None:
        start = np.zeros(len(laws))
    unsolved_level = (kernel or PLAIN_KERNEL).static_path(
        linear_positions,
        np.ascontiguousarray(compliance, dtype=np.float64),
        tuple(laws.port_arrays_at_rest()),
        memory,
        np.ascontiguousarray(start, dtype=np.float64),
        positions,
        forces,
    )
    if unsolved_level >= 0:
        port_names = ", ".join(dict.fromkeys(map(port_in_patch, laws.ports)))
        raise SolutionError(
            f"The static state at load level {unsolved_level + 1} was not found: an internal force "
            f"at {port_names} takes more stiffness than the structure has there."
        )
    return StaticSolution(positions, forces, memory)


# ---------------------------------------------------------------- motion


class InitialMotion(NamedTuple):
    """The state in which a motion begins.

    Attributes
    ----------
    q, v : (M,) array
        Modal coordinates and speeds.
    memory : (J, 5 + E) array or None
        Memory of the laws; None if they are loaded from zero at once.
    """

    q: FloatArray
    v: FloatArray
    memory: FloatArray | None = None


def integrate_motion(
    system: ModalSystem,
    laws: PortLaws,
    steps: StepArrays,
    begin: InitialMotion,
    kernel: Kernel = PLAIN_KERNEL,
) -> ModalMotion:
    """Integrate the motion of a system with laws over prepared time steps.

    Where a law begins or ends to act, a new section of the motion begins. The modes keep their
    state, and so do laws that continue to act. A law that begins to act is loaded from zero to the
    position of its port. A sample at the boundary of two sections belongs to the later one.

    Parameters
    ----------
    laws : PortLaws
        The laws at the ports of the system.
    steps : StepArrays
        The steps, from `loaded_steps`.

    Returns
    -------
    ModalMotion
        The motion at the samples of the steps.
    """
    mode_count = len(begin.q)
    memory_is_known = begin.memory is not None
    memory = laws.unloaded_memory() if begin.memory is None else begin.memory.copy()
    state = ModalState(begin.q.astype(float), begin.v.astype(float), memory)
    motion = _empty_motion(len(steps.sample_boundary), mode_count, memory)
    flexibility = port_flexibility(system, laws)
    drift_time = steps.time - laws.drift_start
    step_fields = tuple(map(np.ascontiguousarray, steps._replace(time=drift_time)))
    previously_active = np.ones(len(laws), dtype=bool)
    for first, last in pairwise(_section_boundaries(steps.time, laws)):
        # the laws of this section
        mid_time = 0.5 * float(steps.time[first] + steps.time[first + 1])
        motion_rows = laws.port_rows(system.ports, mode_count, mid_time)
        force_rows = laws.port_rows(system.actions or system.ports, mode_count, mid_time)
        active = laws.active_at(mid_time)
        for j in np.flatnonzero(active & ~previously_active):
            state.memory[j] = 0.0
            if laws.depends_on_speed[j]:
                state.memory[j, POSITION] = motion_rows[j] @ state.q
        ports = laws.port_arrays(
            motion_rows, force_rows, flexibility, float(system.relaxation), steps.transition
        )
        # its motion
        kernel.integrate(
            step_fields,
            first,
            last,
            int(np.searchsorted(steps.sample_boundary, first)),
            system.coupled,
            memory_is_known,
            tuple(ports),
            tuple(state),
            tuple(motion),
        )
        memory_is_known = True
        previously_active = active
    return motion


def _empty_motion(sample_count: int, mode_count: int, memory: FloatArray) -> ModalMotion:
    """Allocate arrays for a motion; `memory` (J, 5 + E) is the state's, which changes in place."""
    modal = np.empty((2, sample_count, mode_count))
    forces = np.empty((2, sample_count, len(memory)))
    return ModalMotion(
        q=modal[0], v=modal[1], port_forces=forces[0], lagged_forces=forces[1], memory=memory
    )


def _section_boundaries(time: FloatArray, laws: PortLaws) -> list[int]:
    """Return the boundaries at which a law begins or ends to act, with both ends."""
    begin = time[0]
    end = time[-1]
    inner_times = [
        switching_time for switching_time in laws.switching_times if begin < switching_time < end
    ]
    inner_boundaries = np.searchsorted(time, inner_times)
    ends = [0, len(time) - 1]
    boundaries = np.unique(np.concatenate((ends, inner_boundaries)))
    return [int(boundary) for boundary in boundaries]
