"""A linear structure in few modes, and its exact step under a force that is linear in time.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ModalSystem:
    """A linear structure in mass-normalised modal coordinates: q'' + D q' + W^2 q = forces.

    Attributes
    ----------
    angular_frequency : (M,) ndarray
        Undamped angular frequencies [rad/s]; zero is allowed.
    damping : (M, M) ndarray
        D [1/s]; diagonal 2 zeta w for modal damping.
    ports : mapping of str to (M,) ndarray
        Modal rows of the ports: the motion of a port is row . q, and what the flexibility adds.
    flexibility : (P,) ndarray, optional
        Position of each port, in their order, by a unit force there that these modes leave out; none if it is
        left out [m/N, rad/(N m) and so on].
    relaxation : float
        What is left out follows a force with this lag, the factor of damping in proportion to the stiffness
        [s].
    """

    angular_frequency: FloatArray
    damping: FloatArray
    ports: Mapping[str, FloatArray] = field(default_factory=dict)
    flexibility: FloatArray | None = None
    relaxation: float = 0.0

    @cached_property
    def stiffness(self) -> FloatArray:
        """Squared angular frequencies (M,) [1/s^2]."""
        return np.ascontiguousarray(self.angular_frequency**2)

    @cached_property
    def coupled(self) -> bool:
        """Whether damping couples the modes."""
        return bool(np.any(self.damping != np.diag(np.diag(self.damping))))


class LinearStep(NamedTuple):
    """Exact linear step: y(h) = `transition` y + `begin` f(0) + `end` f(h) + `constant`, y = (q, v)."""

    transition: FloatArray
    begin: FloatArray
    end: FloatArray
    constant: FloatArray


def linear_step(system: ModalSystem, shape: FloatArray, constant: FloatArray, h: float) -> LinearStep:
    """Return the exact step of the linear system under a force that is linear in time.

    The exponential of one matrix (Van Loan 1978) by scaling, a Taylor polynomial and squaring.

    Parameters
    ----------
    system : ModalSystem
        The structure.
    shape, constant : (M,) ndarray
        b of the force and the constant modal force.
    h : float
        Duration [s].

    Returns
    -------
    LinearStep
        Arrays over (q, v).
    """
    key = (
        system.angular_frequency.tobytes(),
        system.damping.tobytes(),
        shape.tobytes(),
        constant.tobytes(),
        h,
    )
    step = _STEPS.get(key)
    if step is None:
        step = _linear_step(system, shape, constant, h)
        if len(_STEPS) >= MOST_STEPS:
            _STEPS.pop(next(iter(_STEPS)))
        _STEPS[key] = step
    return step


_STEPS: dict[tuple[bytes, bytes, bytes, bytes, float], LinearStep] = {}
MOST_STEPS = 64
"""Linear steps that are kept, because the same structure is often moved again with other laws."""


def _linear_step(system: ModalSystem, shape: FloatArray, constant: FloatArray, h: float) -> LinearStep:
    count = len(system.angular_frequency)
    # Velocities are measured in units of the highest frequency, which balances the matrix.
    unit = max(
        float(np.max(system.angular_frequency)), float(np.max(np.abs(system.damping))), 1.0 / h if h else 1.0
    )
    matrix = np.zeros((2 * count + 3, 2 * count + 3))
    matrix[:count, count : 2 * count] = unit * np.eye(count)
    matrix[count : 2 * count, :count] = -np.diag(system.angular_frequency**2) / unit
    matrix[count : 2 * count, count : 2 * count] = -system.damping
    matrix[count : 2 * count, 2 * count] = shape / unit
    matrix[count : 2 * count, 2 * count + 2] = constant / unit
    matrix *= h
    matrix[2 * count, 2 * count + 1] = 1.0
    norm = float(np.max(np.sum(np.abs(matrix[: 2 * count, : 2 * count]), axis=1)))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / 0.5))))
    scaled = matrix / 2.0**squarings
    result = np.eye(len(matrix))
    for order in range(14, 0, -1):
        result = np.eye(len(matrix)) + scaled @ result / order
    for _ in range(squarings):
        result = result @ result
    scale = np.repeat((1.0, unit), count)
    state = slice(0, 2 * count)
    slope = result[state, 2 * count + 1] * scale
    return LinearStep(
        np.ascontiguousarray(result[state, state] * scale[:, None] / scale),
        result[state, 2 * count] * scale - slope,
        slope,
        result[state, 2 * count + 2] * scale,
    )
