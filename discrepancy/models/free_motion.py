"""Free motion of modes that damping does not couple, in closed form at any times."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.sampling import is_even
from fe.runtime.modal_system import ModalSystem


def free_motion(
    modal: ModalSystem, q: FloatArray, v: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return free motion (N, M), displacement and velocity, of uncoupled modes.

    Parameters
    ----------
    modal : ModalSystem
        The modes; only the diagonal of their damping acts.
    q, v : (M,) ndarray
        Displacement and velocity at time zero, mass-normalised.
    times : (N,) ndarray
        [s]; evenly spaced ones take a tenth of the time.
    """
    half = 0.5 * np.diag(modal.damping)
    w = modal.angular_frequency
    root = np.sqrt((half**2 - w**2).astype(complex))
    root = np.where(np.abs(root) < 1e-6 * w, 1e-6 * w, root)  # critical: beside it, by 1e-12 of w^2
    fast, slow = -half - root, -half + root
    first = (v - fast * q) / (2.0 * root)  # q = first e^(slow t) + second e^(fast t)
    if np.all(root.imag != 0.0):  # the two are conjugate
        wave = 2.0 * first * _exponentials(slow, times)
        return np.ascontiguousarray(wave.real), np.ascontiguousarray((slow * wave).real)
    one, two = first * _exponentials(slow, times), (q - first) * _exponentials(fast, times)
    return np.ascontiguousarray((one + two).real), np.ascontiguousarray((slow * one + fast * two).real)


def _exponentials(rates: NDArray[Any], times: FloatArray) -> NDArray[np.complex128]:
    """Return e^(rate t) (N, M); at evenly spaced times as products of few exponentials."""
    count, block = len(times), 32
    if count <= 2 * block or not is_even(times):
        return np.asarray(np.exp(np.outer(times, rates)))
    interval = (times[-1] - times[0]) / (count - 1)
    blocks = -(-count // block)
    coarse = np.exp(np.outer(times[0] + interval * block * np.arange(blocks), rates))
    fine = np.exp(np.outer(interval * np.arange(block), rates))
    return np.asarray((coarse[:, None, :] * fine).reshape(blocks * block, -1)[:count])
