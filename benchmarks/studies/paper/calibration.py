"""The calibration of a wing as in the paper, step after step."""

from dataclasses import dataclass

import numpy as np

from benchmarks.studies.paper.masses import PaperSamples, fit_masses
from benchmarks.studies.paper.particle_filter import Moments, ParticlePosterior, particle_filter
from calibration.joint.wing_table import tabulate_wing
from calibration.result.record import STATE
from calibration.static.load_test import StaticCalibration, calibrate_static
from calibration.static.posterior import PUBLISHED_LINE, child_seed
from calibration.wing.calibrate import WingCalibration

SAMPLE_COUNT = 100
"""Number of samples of e for which masses are fitted, as in the paper."""

_PURPOSE = 31  # of the seed: the samples of e


@dataclass(frozen=True, eq=False)
class PaperCalibration:
    """The result of the paper's procedure for a wing.

    Attributes
    ----------
    static : StaticCalibration
        The load test with the published line k(e), by quadrature.
    particle : ParticlePosterior
        The posterior of e for the same line, by the paper's particle filter.
    masses : PaperSamples
        Masses and damping for samples of e, with the model of the wing.
    moments : dict of str to Moments
        Mean and standard deviation of each length, of e, of the masses and of the damping [SI].
    """

    static: StaticCalibration
    particle: ParticlePosterior
    masses: PaperSamples
    moments: dict[str, Moments]


def calibrate_as_in_the_paper(wing: WingCalibration, seed: int = 0) -> PaperCalibration:
    """Calibrate a wing by the procedure of Kapteyn et al. 2021 on the same measurements.

    Raises
    ------
    ExperimentDataError
        If no masses within the range of the model meet the readings, see `fit_masses`.
    PosteriorError
        If too few particles remain, see `particle_filter`.
    """
    pairs = wing.lab.pairs
    static = calibrate_static(PUBLISHED_LINE, pairs)
    particle = particle_filter(pairs, seed=seed)
    table = tabulate_wing(wing.model)
    factors = wing.static.exact.samples(child_seed(seed, _PURPOSE), SAMPLE_COUNT)
    masses = fit_masses(table.frequency, factors, table.validity, wing.lab.readings)

    moments = {
        length.name: Moments(length.posterior.mean, length.posterior.standard_deviation)
        for length in wing.lab.lengths
    }
    means = masses.samples.mean(axis=0).tolist()
    deviations = np.std(masses.samples, axis=0, ddof=1).tolist()
    for name, mean, deviation in zip(STATE, means, deviations, strict=True):
        moments[name] = Moments(mean, deviation)
    moments["young_modulus_factor"] = Moments(particle.mean, particle.standard_deviation)
    return PaperCalibration(static, particle, masses, moments)
