"""Motion of the linear system of an FMU under forces, with internal forces at its ports."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.excitation import Excitation
from discrepancy.system.time_history import SMOOTH_PARTS, equivalent_ramps
from fe.compilation import compiled_kernel
from fe.runtime.arrays import IntArray
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import InitialMotion, integrate_motion
from fe.runtime.port_laws import NO_LAWS, PortLaws
from fe.runtime.time_steps import loaded_steps, step_boundaries
from fmu_asset.client.state_space import FmuStateSpace

MOST_SYSTEMS = 64
"""Number of systems that are kept."""
COMPLIANCE_ROUNDING = 1e-9
"""An instantaneous displacement below this fraction of the static one is a rounding error."""
NO_INDICES: IntArray = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LawPorts:
    """The outputs and forces of a system that belong to the ports of J laws.

    Attributes
    ----------
    columns : (J,) ndarray of int
        Index of the system's output that is the displacement of each law's port.
    force_indices : (J,) ndarray of int
        Index of the system's force at each law's port.
    rest_positions : (J,) ndarray
        Position of each law's port at a state of zero and without forces.
    """

    columns: IntArray
    force_indices: IntArray
    rest_positions: FloatArray


WITHOUT_PORTS = LawPorts(NO_INDICES, NO_INDICES, np.zeros(0))


class SystemMotion(NamedTuple):
    """States (N, n) of a system at the samples, and all forces (N, E) on it: loads minus laws."""

    states: FloatArray
    forces: FloatArray


def system_motion(
    system: FmuStateSpace,
    excitation: Excitation,
    start: FloatArray,
    laws: PortLaws = NO_LAWS,
    ports: LawPorts = WITHOUT_PORTS,
    refinement: int = 1,
    memory: FloatArray | None = None,
) -> SystemMotion:
    """Return the motion of a system at the samples of an excitation, with laws at ports.

    The position and speed of each law's port are added to the state as further coordinates,
    although they follow from it: laws can then act on this system as on any modal system.

    Parameters
    ----------
    system : FmuStateSpace
        The system that moves.
    excitation : Excitation
        Forces, whose directions (E,) are over the inputs of the system.
    start : (n,) array
        State at the first time.
    laws : PortLaws
        J internal forces.
    ports : LawPorts
        The J outputs and inputs at which the laws act.
    refinement : int
        Steps with laws are this many times smaller.
    memory : array, optional
        Memory of the laws at the first time; by default they were loaded from zero at once.
    """
    with_ports = _system_with_ports(
        system, laws.ports, tuple(ports.columns.tolist()), tuple(ports.force_indices.tolist())
    )
    modal = with_ports.modal
    # steps under the forces, which act on P port coordinates and n states
    boundaries = step_boundaries(
        modal,
        laws,
        excitation.sample_times,
        refinement,
        SMOOTH_PARTS if excitation.is_smooth else 1,
        excitation.jump_times,
    )
    begin_force, end_force = equivalent_ramps(
        lambda times: excitation.loads_at(times, with_ports.directions.T), boundaries.time
    )
    # (boundaries, J): displacement of each law's port that appears at once with the loads
    direct_displacement = excitation.loads_at(boundaries.time, system.feedthrough[ports.columns].T)
    steps = loaded_steps(modal, boundaries, begin_force, end_force, direct_displacement)
    # position and speed (P,) of the ports at the start, from the state
    port_rows = system.output_matrix[ports.columns[with_ports.first_laws]]
    rest_positions = ports.rest_positions[with_ports.first_laws]
    positions = port_rows @ start + rest_positions
    speeds = port_rows @ system.state_matrix @ start
    # the state is a speed; the coordinate of this speed acts on nothing and begins at zero
    initial_motion = InitialMotion(
        q=np.concatenate((positions, np.zeros_like(start))),
        v=np.concatenate((speeds, start)),
        memory=memory,
    )
    motion = integrate_motion(modal, laws, steps, initial_motion, compiled_kernel())
    # all forces (N, E) on the system: the excitation minus those of the laws
    forces = excitation.loads_at(excitation.sample_times, np.eye(system.input_matrix.shape[1]))
    np.subtract.at(forces.T, ports.force_indices, motion.port_forces.T)
    return SystemMotion(motion.v[:, len(positions) :], forces)


class SystemWithPorts(NamedTuple):
    """A system whose ports are coordinates in addition to its state.

    Attributes
    ----------
    directions : (P + n, E) ndarray
        Rates of the ports' speeds and of the state under unit forces.
    modal : ModalSystem
        The equation of motion of P ports and n states; a state is the speed of a coordinate.
    first_laws : (P,) ndarray of int
        Index of the first law at each port; ports are in alphabetical order.
    """

    directions: FloatArray
    modal: ModalSystem
    first_laws: IntArray


@lru_cache(maxsize=MOST_SYSTEMS)
def _system_with_ports(
    system: FmuStateSpace,
    names: tuple[str, ...],
    columns: tuple[int, ...],
    force_numbers: tuple[int, ...],
) -> SystemWithPorts:
    """Return a system with the P ports of J laws as coordinates before its n states.

    Parameters
    ----------
    system : FmuStateSpace
        The system, of order n.
    names : tuple of str
        Port of each law (J,).
    columns, force_numbers : tuple of int
        Indices (J,) of the displacement output and of the force of each law's port.
    """
    port_names, first_laws = np.unique(names, return_index=True)
    port_count = len(first_laws)
    state_count = len(system.state_matrix)
    port_columns = np.array(columns, dtype=np.int64)[first_laws]
    port_forces = np.array(force_numbers, dtype=np.int64)[first_laws]
    # The state s is the speed of a coordinate: s' = A s + B f is an equation of motion without
    # stiffness, with the damping -A. A port has the position C s, so that its speed is C A s up to
    # the forces, and the rate of that speed is C A A s + C A B f.
    port_rates = system.output_matrix[port_columns] @ system.state_matrix
    directions = np.vstack((port_rates @ system.input_matrix, system.input_matrix))
    damping = np.zeros((port_count + state_count, port_count + state_count))
    damping[:, port_count:] = -np.vstack((port_rates @ system.state_matrix, system.state_matrix))
    # A displacement that appears at once with the force (feedthrough) is a flexibility of the port
    # in addition to that of the states; one as small as a rounding error is set to zero.
    direct_compliance = system.feedthrough[port_columns, port_forces]
    static_compliance = system.gain[port_columns, port_forces]
    modal = ModalSystem(
        np.zeros(port_count + state_count),
        damping,
        dict(zip(port_names, np.eye(port_count, port_count + state_count), strict=True)),
        np.where(
            direct_compliance > COMPLIANCE_ROUNDING * static_compliance, direct_compliance, 0.0
        ),
        actions=dict(zip(port_names, directions.T[port_forces], strict=True)),
    )
    return SystemWithPorts(directions, modal, first_laws)
