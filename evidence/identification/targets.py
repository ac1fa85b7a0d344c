"""Outputs of the published model from which the wing is identified, with their weights.

The fit uses the healthy strains, the strain ratios at 40 and 80 % of z1 alone and of z2 alone, the
slopes in e, the tip stiffness and its slope, and every second of the 100 rows of step 3. Everything
else in the published folders is held out: the report compares it, and the fit does not use it.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError, ExperimentFileError
from evidence.identification.published_results import RESULTS_FILE, read_published_results
from twin_master.assets.strain_library_source import FILE_NAME, StrainLibrary, load_strain_library

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LIBRARY_FACTOR = 1.0073
"""The factor e that the library's entry "mean" belongs to; it is not the average of the draws."""
LOAD_FACTOR = 3.0
"""Load factor of the strains that are fitted; the library's 2g is exactly two thirds of them."""
CONTROL = "3g"
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8)
FITTED_LEVELS = (0.4, 0.8)
"""Fitted stiffness losses of one region alone; the others and all combined ones are held out."""
NO_LOSS = LEVELS.index(0.0)
"""Index of a region without stiffness loss."""
HEALTHY = (NO_LOSS, NO_LOSS)
"""Index of the healthy state in arrays over both regions."""
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
    """Standard deviations by which the residuals are divided.

    They are judgements of how well the idealised wing can match the outputs. The errors of the
    published data are far smaller.

    Attributes
    ----------
    strain : float
        Healthy strain, relative.
    limiting_strain : float
        Healthy strain of the limiting gauge, relative.
    ratio : float
        Strain over healthy strain.
    limiting_ratio : float
        Strain over healthy strain of the limiting gauge under a loss z1.
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
    strain : (5, 5, 24) array
        Strains [1] of the gauges at 3g and e = 1.0073, for z1 and z2 at `LEVELS`.
    strain_slope : (24,) array
        d ln strain / d ln e of the healthy wing at e = 1.0073, from the draws.
    young_modulus_factor, servo_mass, pitot_mass : (R,) arrays
        Rows of step 3 [1, kg, kg].
    frequency : (R, 2) array
        First and second flapwise bending frequency [Hz] of the published model in each row.
    fitted_row : (R,) array of bool
        Whether a row is fitted; every second row is.
    frequency_at_one, frequency_slope, mass_slope : (2,) arrays
        Regression of the fitted rows: frequencies [Hz] at e = 1 and `REFERENCE_PITOT`, and the
        slopes of their logarithms in ln e [1] and in the pitot's mass [1/kg], where the servos
        keep the total mass.
    all_frequency_at_one, all_frequency_slope, all_mass_slope : (2,) arrays
        Regression of all rows, with which the result is compared.
    sources : dict of str to str
        SHA-256 of each file read.
    tip_stiffness, tip_stiffness_slope : float
        Tip stiffness [N/m] at e = 1, and d ln k / d ln e.
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
        return np.asarray(self.strain / self.healthy_strain)

    @property
    def healthy_strain(self) -> FloatArray:
        """Strains (24,) of the healthy wing."""
        return np.asarray(self.strain[HEALTHY])


def fitted_states() -> BoolArray:
    """Return whether the strain ratios of each state are fitted, as an array (5, 5)."""
    fitted = np.zeros((len(LEVELS), len(LEVELS)), dtype=bool)
    for level in FITTED_LEVELS:
        number = LEVELS.index(level)
        fitted[number, NO_LOSS] = True
        fitted[NO_LOSS, number] = True
    return fitted


def read_targets(data: Path | str) -> Targets:
    """Read the two published folders below `data`.

    Parameters
    ----------
    data : Path or str
        Folder that holds the authors' two repositories, `UAV-Digital-Twin` with `UAVconfig.json`
        and `UAV-Experimental-Calibration` with step 3, under any names.

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
    strain_file = _find_library(data)
    results_file = _find_results(data)
    library = load_strain_library(strain_file)
    _check_library(library, strain_file)
    control = library.controls.index(CONTROL)
    strain = _strain_at_control(library, control, strain_file)
    healthy_draws = library.strain_per_draw[:, NO_LOSS, control]

    published = read_published_results(results_file)
    factor, servo, pitot = published.states.T
    fitted_row = np.arange(len(servo)) % 2 == 0
    if fitted_row.sum() < MODAL_TERMS + 1:
        raise ExperimentDataError(
            f"{results_file} holds {len(fitted_row)} rows; at least {2 * MODAL_TERMS + 2} are "
            "needed "
            "for slopes."
        )
    regression = frequency_slopes(
        factor[fitted_row], pitot[fitted_row], published.frequency[fitted_row]
    )
    regression_of_all = frequency_slopes(factor, pitot, published.frequency)
    return Targets(
        strain=strain,
        strain_slope=strain_slopes(library.young_modulus_factor, healthy_draws),
        young_modulus_factor=factor,
        servo_mass=servo,
        pitot_mass=pitot,
        frequency=published.frequency,
        fitted_row=fitted_row,
        frequency_at_one=regression.frequency_at_one,
        frequency_slope=regression.factor_slope,
        mass_slope=regression.mass_slope,
        all_frequency_at_one=regression_of_all.frequency_at_one,
        all_frequency_slope=regression_of_all.factor_slope,
        all_mass_slope=regression_of_all.mass_slope,
        sources={
            file.name: hashlib.sha256(file.read_bytes()).hexdigest()
            for file in (strain_file, results_file)
        },
    )


def _check_library(library: StrainLibrary, file: Path) -> None:
    """Raise `ExperimentDataError` if the library lacks the control or has other states."""
    if CONTROL not in library.controls:
        raise ExperimentDataError(
            f"{file} has no control {CONTROL}, only {', '.join(library.controls)}."
        )
    for region in library.states.factors:
        same_count = len(region.levels) == len(LEVELS)
        if not same_count or not np.allclose(region.levels, LEVELS, atol=1e-9):
            raise ExperimentDataError(
                f"{file}: the levels of {region.name} are {region.levels}, but {LEVELS} are "
                "expected."
            )


def _strain_at_control(library: StrainLibrary, control: int, file: Path) -> FloatArray:
    """Return the strains (5, 5, gauges) of the library at a control, given its number.

    Raises
    ------
    ExperimentDataError
        If a strain cannot be one of the wing, or the limiting gauge is missing.
    """
    _, *controls_and_gauges = library.strain.shape
    every_control = library.strain.reshape((*library.states.shape, *controls_and_gauges))
    strain = every_control[:, :, control]
    if strain.min() <= 0.0 or strain.max() > 0.1:
        raise ExperimentDataError(
            f"{file}: strains at {CONTROL} must be positive and below 100,000 microstrain, but "
            "reach "
            f"from {1e6 * strain.min():g} to {1e6 * strain.max():g}."
        )
    if not 0 <= LIMITING_GAUGE < strain.shape[2]:
        raise ExperimentDataError(
            f"{file} holds {strain.shape[2]} gauges; at least 17 are expected."
        )
    return strain


def strain_slopes(young_modulus_factor: FloatArray, strain: FloatArray) -> FloatArray:
    """Return d ln strain / d ln e (G,) at e = `LIBRARY_FACTOR` of a parabola through draws.

    Parameters
    ----------
    young_modulus_factor : (E,) array
        Factor e of each draw.
    strain : (E, G) array
        Strains of the gauges in each draw.
    """
    x = np.log(young_modulus_factor / LIBRARY_FACTOR)
    basis = np.column_stack([np.ones_like(x), x, x**2])
    coefficients, *_ = np.linalg.lstsq(basis, np.log(strain), rcond=None)
    _, slope, _ = coefficients
    return np.asarray(slope)


class FrequencyRegression(NamedTuple):
    """Both bending frequencies of the published model, as functions of e and the pitot's mass.

    Attributes
    ----------
    frequency_at_one : (2,) array
        Frequencies [Hz] at e = 1 and `REFERENCE_PITOT`.
    factor_slope : (2,) array
        Slopes of the logarithms of the frequencies in ln e [1].
    mass_slope : (2,) array
        Slopes of the logarithms of the frequencies in the pitot's mass [1/kg].
    """

    frequency_at_one: FloatArray
    factor_slope: FloatArray
    mass_slope: FloatArray


MODAL_TERMS = 4
"""Terms of the regression of ln f: constant, ln e, pitot mass, square of ln e."""


def frequency_slopes(
    young_modulus_factor: FloatArray, pitot_mass: FloatArray, frequency: FloatArray
) -> FrequencyRegression:
    """Regress the logarithms of the frequencies on ln e, the pitot's mass and the square of ln e.

    The rows lie near one line in e and mass. They determine one term of curvature and no more.

    Parameters
    ----------
    young_modulus_factor, pitot_mass : (R,) arrays
        Factor e [1] and mass of the pitot [kg] of each row.
    frequency : (R, 2) array
        First and second flapwise bending frequency [Hz] of each row.
    """
    x = np.log(young_modulus_factor)
    basis = np.column_stack([np.ones_like(x), x, pitot_mass - REFERENCE_PITOT, x**2])
    coefficients, *_ = np.linalg.lstsq(basis, np.log(frequency), rcond=None)
    log_frequency, factor_slope, mass_slope, _ = coefficients
    return FrequencyRegression(
        np.exp(log_frequency), np.asarray(factor_slope), np.asarray(mass_slope)
    )


def _find_library(data: Path) -> Path:
    """Return the file of the strain library, in a folder or one folder below it."""
    if (data / FILE_NAME).is_file():
        return data / FILE_NAME
    files = sorted(data.glob(f"*/{FILE_NAME}")) + sorted(data.glob(f"*/src/{FILE_NAME}"))
    if len(files) != 1:
        raise ExperimentFileError(
            f"{data} holds {len(files)} files {FILE_NAME} instead of one, in it or one folder "
            "below; "
            "give the folder with the authors' repository UAV-Digital-Twin."
        )
    return files[0]


def _find_results(data: Path) -> Path:
    """Return the file of the results of step 3, anywhere below a folder."""
    files = sorted({*data.glob(f"**/step3/{RESULTS_FILE}"), *data.glob(RESULTS_FILE)})
    if len(files) != 1:
        raise ExperimentFileError(
            f"{data} holds {len(files)} files step3/{RESULTS_FILE} instead of one; give the folder "
            "with the "
            "authors' repository UAV-Experimental-Calibration."
        )
    return files[0]
