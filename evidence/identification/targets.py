"""What the wing is identified from: outputs of the published model, each with a weight, fitted or held out.

Fitted are the healthy strains and the ratios at 40 and 80 % of z1 alone and of z2 alone, the slopes in e,
the tip stiffness and its slope, and every second of the 100 rows of step 3. Everything else that the
published folders hold is held out and only reported.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.paper.procedure import RESULTS_FILE, read_published_results
from twin_master.assets.strain_library_source import FILE_NAME, load_strain_library

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LIBRARY_FACTOR = 1.0073
"""The factor e that the library's entry "mean" belongs to; it is not the average of the draws."""
LOAD_FACTOR = 3.0
"""Load factor of the strains that are fitted; the library's 2g is exactly two thirds of them."""
CONTROL = "3g"
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8)
FITTED_LEVELS = (0.4, 0.8)
"""Stiffness losses of one region alone that are fitted; the others, and all combined ones, are held out."""
LIMITING_GAUGE = 16
"""The gauge with the largest strain in every state; the choice of control hangs on it."""

TIP_STIFFNESS = 677.0
"""Tip stiffness at e = 1 [N/m]: Kapteyn et al. 2021, eq. (14), k = 0.5752 e + 0.1018 N/mm."""
TIP_STIFFNESS_SLOPE = 0.5752 / 0.6770
"""d ln k / d ln e at e = 1 of eq. (14)."""
MASS_TOTAL = 0.472
"""Two servos and the pitot [kg]: Kapteyn et al. 2021, eqs. (19) and (20)."""
REFERENCE_PITOT = 0.1345
"""Pitot mass [kg] at which frequencies and slopes are stated."""


@dataclass(frozen=True)
class Weights:
    """Standard deviations that weigh the residuals: what misfit of each kind is taken for one unit.

    They are judgements of what the idealisation can reach, not errors of the data, which are far smaller.

    Attributes
    ----------
    strain : float
        Healthy strain, relative.
    limiting_strain : float
        The same for the limiting gauge.
    ratio : float
        Strain over healthy strain.
    limiting_ratio : float
        The same for the limiting gauge and z1.
    slope : float
        d ln strain / d ln e.
    stiffness, stiffness_slope : float
        Tip stiffness, relative, and its slope.
    frequency : float
        Frequency of a row, relative.
    frequency_slope, mass_slope : float
        Slopes of the logarithms of the frequencies in ln e and [1/kg] in the mass of the pitot.
    """

    strain: float = 0.02
    limiting_strain: float = 0.002
    ratio: float = 0.01
    limiting_ratio: float = 0.0015
    slope: float = 0.02
    stiffness: float = 0.0003
    stiffness_slope: float = 0.0015
    frequency: float = 0.0015
    frequency_slope: float = 0.0015
    mass_slope: float = 0.004


@dataclass(frozen=True, eq=False)
class Targets:
    """Published outputs.

    Attributes
    ----------
    strain : (5, 5, 24) dimensionless
        At 3g and e = 1.0073, for z1 and z2 at `LEVELS`.
    strain_slope : (24,)
        d ln strain / d ln e of the healthy wing at that e, from the draws.
    young_modulus_factor, servo_mass, pitot_mass : (R,)
        The rows of step 3 [1, kg, kg].
    frequency : (R, 2) Hz
        First and second flapwise bending frequency of the published model in these rows.
    fitted_row : (R,) bool
        Every second row is fitted.
    frequency_at_one, frequency_slope, mass_slope : (2,)
        Regression of the fitted rows: frequencies [Hz] at e = 1 and `REFERENCE_PITOT`, and the slopes of
        their logarithms in ln e and in the pitot's mass [1/kg], with the servos keeping the total.
    all_frequency_at_one, all_frequency_slope, all_mass_slope : (2,)
        The same of all rows, to report against.
    sources : dict of str to str
        SHA-256 of each file read.
    tip_stiffness, tip_stiffness_slope : float
        At e = 1 [N/m], and d ln k / d ln e.
    """

    strain: FloatArray
    strain_slope: FloatArray
    young_modulus_factor: FloatArray
    servo_mass: FloatArray
    pitot_mass: FloatArray
    frequency: FloatArray
    fitted_row: BoolArray
    frequency_at_one: FloatArray
    frequency_slope: FloatArray
    mass_slope: FloatArray
    all_frequency_at_one: FloatArray
    all_frequency_slope: FloatArray
    all_mass_slope: FloatArray
    sources: dict[str, str]
    tip_stiffness: float = TIP_STIFFNESS
    tip_stiffness_slope: float = TIP_STIFFNESS_SLOPE

    @property
    def ratio(self) -> FloatArray:
        """Strain over healthy strain (5, 5, 24)."""
        return np.asarray(self.strain / self.strain[0, 0])


def fitted_states() -> BoolArray:
    """Whether the strain ratios of a state are fitted (5, 5)."""
    fitted = np.zeros((len(LEVELS), len(LEVELS)), dtype=bool)
    for level in FITTED_LEVELS:
        fitted[LEVELS.index(level), 0] = fitted[0, LEVELS.index(level)] = True
    return fitted


def read_targets(data: Path | str) -> Targets:
    """Read the two published folders below `data`.

    Parameters
    ----------
    data : Path or str
        Folder that holds the authors' two repositories, `UAV-Digital-Twin` with `UAVconfig.json` and
        `UAV-Experimental-Calibration` with step 3, under any names.

    Raises
    ------
    ExperimentFileError
        If a file is missing, cannot be read or lacks an entry or a column.
    ExperimentDataError
        If a value is not a finite number, or the library has other states or gauges than published.
    MissionInputError
        If the library is none.
    """
    data = Path(data)
    if not data.is_dir():
        raise ExperimentFileError(
            f"{data} is not a folder; give the one that holds the authors' two folders."
        )
    strain_file, results_file = _find_library(data), _find_results(data)
    library = load_strain_library(strain_file)
    if CONTROL not in library.controls:
        raise ExperimentDataError(
            f"{strain_file} has no control {CONTROL}, only {', '.join(library.controls)}."
        )
    for region in library.states.factors:
        if len(region.levels) != len(LEVELS) or not np.allclose(region.levels, LEVELS, atol=1e-9):
            raise ExperimentDataError(
                f"{strain_file}: the levels of {region.name} are {region.levels}, but {LEVELS} are expected."
            )
    control = library.controls.index(CONTROL)
    strain = library.strain.reshape(*library.states.shape, *library.strain.shape[1:])[:, :, control]
    if strain.min() <= 0.0 or strain.max() > 0.1:
        raise ExperimentDataError(
            f"{strain_file}: strains at {CONTROL} must be positive and below 100,000 microstrain, but reach "
            f"from {1e6 * strain.min():g} to {1e6 * strain.max():g}."
        )
    if not 0 <= LIMITING_GAUGE < strain.shape[2]:
        raise ExperimentDataError(f"{strain_file} holds {strain.shape[2]} gauges; at least 17 are expected.")
    slope = strain_slopes(library.young_modulus_factor, library.strain_per_draw[:, 0, control])
    published = read_published_results(results_file)
    factor, servo, pitot = published.samples.T[:3]
    fitted = np.arange(len(servo)) % 2 == 0
    if fitted.sum() < MODAL_TERMS + 1:
        raise ExperimentDataError(
            f"{results_file} holds {len(fitted)} rows; at least {2 * MODAL_TERMS + 2} are needed for slopes."
        )
    rows = factor, pitot, published.frequency
    level, frequency_slope, mass_slope = frequency_slopes(*(column[fitted] for column in rows))
    every = frequency_slopes(*rows)
    return Targets(
        strain=strain,
        strain_slope=slope,
        young_modulus_factor=factor,
        servo_mass=servo,
        pitot_mass=pitot,
        frequency=published.frequency,
        fitted_row=fitted,
        frequency_at_one=level,
        frequency_slope=frequency_slope,
        mass_slope=mass_slope,
        all_frequency_at_one=every[0],
        all_frequency_slope=every[1],
        all_mass_slope=every[2],
        sources={
            file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in (strain_file, results_file)
        },
    )


def strain_slopes(young_modulus_factor: FloatArray, strain: FloatArray) -> FloatArray:
    """D ln strain / d ln e (G,) at e = `LIBRARY_FACTOR` from draws e (E,) and strains (E, G): a parabola."""
    x = np.log(young_modulus_factor / LIBRARY_FACTOR)
    basis = np.column_stack([np.ones_like(x), x, x**2])
    coefficients, *_ = np.linalg.lstsq(basis, np.log(strain), rcond=None)
    return np.asarray(coefficients[1])


MODAL_TERMS = 4


def frequency_slopes(
    young_modulus_factor: FloatArray, pitot_mass: FloatArray, frequency: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frequencies (2,) [Hz] at e = 1, their slopes (2,) in ln e and (2,) in the pitot's mass [1/kg].

    Regression of ln f on ln e, the mass and the square of ln e; the rows lie near one line in (e, mass), so
    that one term of curvature is all that they tell.
    """
    x = np.log(young_modulus_factor)
    basis = np.column_stack([np.ones_like(x), x, pitot_mass - REFERENCE_PITOT, x**2])
    coefficients, *_ = np.linalg.lstsq(basis, np.log(frequency), rcond=None)
    return np.exp(coefficients[0]), np.asarray(coefficients[1]), np.asarray(coefficients[2])


def _find_library(data: Path) -> Path:
    if (data / FILE_NAME).is_file():
        return data / FILE_NAME
    found = sorted(data.glob(f"*/{FILE_NAME}")) + sorted(data.glob(f"*/src/{FILE_NAME}"))
    if len(found) != 1:
        raise ExperimentFileError(
            f"{data} holds {len(found)} files {FILE_NAME} instead of one, in it or one folder below; "
            "give the folder with the authors' repository UAV-Digital-Twin."
        )
    return found[0]


def _find_results(data: Path) -> Path:
    found = sorted({*data.glob(f"**/step3/{RESULTS_FILE}"), *data.glob(RESULTS_FILE)})
    if len(found) != 1:
        raise ExperimentFileError(
            f"{data} holds {len(found)} files step3/{RESULTS_FILE} instead of one; give the folder with the "
            "authors' repository UAV-Experimental-Calibration."
        )
    return found[0]
