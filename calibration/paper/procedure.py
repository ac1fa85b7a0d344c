"""The paper's step 3: point masses and Rayleigh damping for each sample of e.

Kapteyn et al. 2021, eqs. (19) and (20): the masses that bring the first two flapwise frequencies nearest to
the measured ones, under the weighed total; eq. (25): the Rayleigh coefficients that give the two modes their
measured damping ratios through eq. (18).
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.dynamics.records import STEP_FOLDER
from calibration.errors import ExperimentDataError, said
from calibration.joint.measured_modes import MODAL
from calibration.joint.posterior import servo_range
from calibration.lab_folder import lab_table
from calibration.result.record import Reading
from fe.runtime.modal_system import rayleigh_coefficients
from reporting.arrays import Float

RESULTS_FILE = "massoptimizationresults.csv"
"""The authors' masses and frequencies for each of their samples of e."""

_RESULT_COLUMNS = (
    "e_sample", "mass_servo_1", "mass_pitot", "freq_1", "freq_2", "zeta_1", "zeta_2",
    "target_freq_1", "target_freq_2",
)  # fmt: skip


FrequencyModel = Callable[[Float], Float]
"""Rows of e, servo and pitot mass [kg] (N, 3) to the frequencies of the two flapwise modes (N, 2) [Hz]."""


class PaperSamples(NamedTuple):
    """Samples of e, servo and pitot mass, alpha and beta (N, 5), and the model's frequencies (N, 2)."""

    samples: Float
    frequency: Float


def fit_masses(
    frequencies: FrequencyModel,
    young_modulus_factor: Float,
    validity: Mapping[str, tuple[float, float]],
    readings: Sequence[Reading],
) -> PaperSamples:
    """Find masses under the weighed total, then damping, for each sample of e.

    One mass is free: the pitot tube has what two servos leave of the total. The search, of Brent, ends at
    1 microgram; the authors', of Nelder and Mead, ends at 1 g.

    Parameters
    ----------
    frequencies : callable
        Of a model, such as `WingTable.frequency`.
    young_modulus_factor : (N,) array
        Samples of e [1].
    validity : mapping of str to (float, float)
        Range of the masses for which the model may be asked [kg].
    readings : sequence of Reading
        The weighed mass and both modes.

    Raises
    ------
    ExperimentDataError
        If no masses within the range keep the total, the best lie at the limit of the range, or the damping
        ratios need a negative Rayleigh coefficient.
    OutsideValidityError
        If a sample of e lies outside the range of the model.
    """
    measured = {item.name: item.value for item in readings}
    total_mass, wanted = measured["weighed_mass"], np.array([measured[name] for name in MODAL[:2]])
    lower, upper = servo_range(validity, total_mass)
    samples, pairs = [], []
    for factor in young_modulus_factor.tolist():

        def error(mass: float, factor: float = factor) -> float:
            found = frequencies(np.array([[factor, mass, total_mass - 2.0 * mass]]))[0]
            return 0.5 * float(np.abs(found / wanted - 1.0).sum())

        servo = float(
            minimize_scalar(error, bounds=(lower, upper), method="bounded", options={"xatol": 1e-9}).x
        )
        if min(servo - lower, upper - servo) < 1e-6:
            found = servo, total_mass
            raise ExperimentDataError(said("paper.masses", factor=factor, wanted=wanted, masses=found))
        masses = factor, servo, total_mass - 2.0 * servo
        pairs.append(frequencies(np.array([masses]))[0])
        ratios = measured[MODAL[2]], measured[MODAL[3]]
        samples.append((*masses, *damping_coefficients(tuple(pairs[-1].tolist()), ratios)))
    return PaperSamples(np.array(samples), np.array(pairs))


def damping_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return alpha [1/s] and beta [s] by eq. (25).

    Raises
    ------
    ExperimentDataError
        If a coefficient would be negative, so that some mode would gain energy.
    """
    alpha, beta = rayleigh_coefficients(frequency, damping_ratio)
    if alpha < 0.0 or beta < 0.0:
        modes = *damping_ratio, *frequency
        raise ExperimentDataError(said("paper.negative", modes=modes, alpha=alpha, beta=beta))
    return alpha, beta


def read_published_results(path: Path) -> PaperSamples:
    """Read the authors' masses and frequencies, and add alpha and beta by eq. (25).

    Parameters
    ----------
    path : Path
        The authors' calibration folder, or `massoptimizationresults.csv` itself.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column, or has a cell that is no number.
    ExperimentDataError
        If a value is not positive and finite.
    """
    table = lab_table(path, STEP_FOLDER / RESULTS_FILE)
    columns = np.array(
        [table.numbers(name, "the authors' step 3", positive=True) for name in _RESULT_COLUMNS]
    )
    first, second = columns[5:7, 0].tolist()
    pairs = columns[3:5].T
    damping = [damping_coefficients((f1, f2), (first, second)) for f1, f2 in pairs.tolist()]
    return PaperSamples(np.column_stack([columns[:3].T, damping]), pairs)
