"""Laws at the ports of an FMU that is stepped: within a step a port is treated as a free mass.

The force of the laws is held constant over each step of the FMU. To find it, the step is first
integrated for a mass at each port, with the laws and with the acceleration that the port has by all
other forces. The mass is measured beforehand: it is the step times a unit force, divided by the
change of speed that the force makes. The coupling is of second order in the step.
"""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import compiled_kernel
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.motion_arrays import ModalState as ModalState
from fe.runtime.port_laws import PortLaws
from fe.runtime.time_steps import Boundaries, loaded_steps


class PortCoupling:
    """J laws that act on P ports of an FMU, integrated within each step of the FMU.

    Within a step the FMU is replaced by one mass for each port, with the responses `speed_gain`.
    The object keeps the memory of the laws from step to step.

    Parameters
    ----------
    laws : PortLaws
        The J laws.
    ports : sequence of str
        Names of their P ports.
    speed_gain : (P, P) ndarray
        Change of speed in a step of each port (row) under a unit force at each port (column).
    step : float
        Step of the FMU [s].
    memory : ndarray, optional
        Memory of the laws; by default they are loaded from zero at once.
    """

    def __init__(
        self,
        laws: PortLaws,
        ports: Sequence[str],
        speed_gain: FloatArray,
        step: float,
        memory: FloatArray | None,
    ) -> None:
        count = len(ports)
        # One coordinate for each port, without stiffness and damping. A unit force at a port gives
        # all coordinates the accelerations speed_gain / step.
        masses = ModalSystem(
            np.zeros(count),
            np.zeros((count, count)),
            dict(zip(ports, np.eye(count), strict=True)),
            actions=dict(zip(ports, speed_gain.T / step, strict=True)),
        )
        # arrays of a single step, into which each call of `speed_loss` writes its forces
        self._step = step
        boundaries = Boundaries(np.array([0.0, step]), np.arange(2), np.array([step]))
        no_force = np.zeros((1, count))
        no_displacement = np.zeros((2, len(laws)))
        self._steps = loaded_steps(masses, boundaries, no_force, no_force, no_displacement)
        self._law_arrays = tuple(
            laws.port_arrays(
                motion_rows=laws.port_rows(masses.ports, count),
                force_rows=laws.port_rows(masses.actions, count),
                flexibility=np.zeros(len(laws)),
                relaxation=0.0,
                transition=self._steps.transition,
            )
        )
        # arrays of state and results, which each step overwrites: rows for its start and its end
        self._has_memory = memory is not None
        memory = laws.unloaded_memory() if memory is None else memory
        self._state = ModalState(np.zeros(count), np.zeros(count), memory)
        self._results = ModalMotion(
            q=np.zeros((2, count)),
            v=np.zeros((2, count)),
            port_forces=np.zeros((2, len(laws))),
            lagged_forces=np.zeros((2, len(laws))),
            memory=memory,
        )

    def speed_loss(
        self, positions: FloatArray, speeds: FloatArray, accelerations: FloatArray
    ) -> FloatArray:
        """Return the speed (P,) that the laws take from the ports during the next step.

        This is the speed that the ports would have at its end without the laws, minus that with
        them, by which a step of the FMU is corrected. The memory of the laws is advanced by the
        step, so that each step needs exactly one call.

        Parameters
        ----------
        positions, speeds : (P,) arrays
            The motion of the ports at the start of the step.
        accelerations : (P,) array
            The accelerations of the ports without the laws, constant during the step.
        """
        h = self._step
        self._state.q[:] = positions
        self._state.v[:] = speeds
        # changes (2 P,) of position and speed of the ports under a constant acceleration
        self._steps.increment[:] = np.concatenate((0.5 * h * h * accelerations, h * accelerations))
        # each coordinate has a unit mass, so that forces are accelerations
        self._steps.begin_force[:] = accelerations
        self._steps.end_force[:] = accelerations
        # compiled code takes no keywords
        compiled_kernel().integrate(
            tuple(self._steps),
            0,  # first boundary
            1,  # last boundary
            0,  # first sample to record
            True,  # steps couple the coordinates
            self._has_memory,
            self._law_arrays,
            tuple(self._state),
            tuple(self._results),
        )
        self._has_memory = True
        speeds_without_laws = speeds + h * accelerations
        return speeds_without_laws - self._state.v
