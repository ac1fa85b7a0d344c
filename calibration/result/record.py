"""The calibration of an asset as a record: samples of named figures, what they rest on, what has to be said.

A wing's from the folder of its laboratory and any model's from a campaign are of this one class.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import xarray as xr
from scipy.special import ndtr, ndtri

from calibration.errors import CalibrationRecordError, said
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import Seed, child_seed, stratified
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign
from reporting.arrays import Float
from reporting.words import brief, plus_minus

Procedure = Literal["quadrature", "Gaussian", "several optima", "joint", "paper"]
"""How the samples were made: by quadrature of one parameter and the others given it, from
the Gaussian at the optimum where the posterior is one, from Gaussians at several optima; of a wing by
importance sampling, or by the paper's procedure."""

FROM_LABORATORY = "from the laboratory of a wing (`uav-twin calibrate`)"
FROM_CAMPAIGN = "from a campaign (`uav-twin calibrate campaign`)"

LONGEST_NAME = 80

STATE = ("young_modulus_factor", "servo_mass", "pitot_mass", "damping_alpha", "damping_beta")
"""The parameters of a calibrated wing that are a part of its digital state."""


@dataclass(frozen=True)
class CalibratedFigure:
    """Name, unit (SI) and meaning of a calibrated figure."""

    name: str
    unit: str
    title: str

    @property
    def shown_unit(self) -> str:
        """The unit as it is printed: nothing for a plain number."""
        return "" if self.unit == "1" else self.unit

    @property
    def axis_title(self) -> str:
        """Name and unit as they stand at an axis."""
        return self.name.replace("_", " ") + (f" ({self.shown_unit})" if self.shown_unit else "")

    def shown(self, mean: float, deviation: float) -> str:
        """Return a mean ± standard deviation with the unit."""
        return f"{plus_minus(mean, deviation)} {self.shown_unit}".rstrip()


@dataclass(frozen=True)
class ParameterPrior:
    """What was stated of a parameter: a normal distribution, cut off at the ends of the model's range.

    Attributes
    ----------
    name, unit : str
        Name of the parameter and its unit.
    mean, deviation : float
        Mean and standard deviation before the cut [unit].
    low, high : float
        Range in which the model holds [unit].
    stated_by : str
        Where it stands: the model's file or the campaign; empty: the model's.
    title : str
        What it is; its name where nothing is said.
    """

    name: str
    unit: str
    mean: float
    deviation: float
    low: float
    high: float
    stated_by: str = ""
    title: str = ""

    @property
    def figure(self) -> CalibratedFigure:
        """The parameter as a calibrated figure."""
        return CalibratedFigure(self.name, self.unit, self.title or self.name.replace("_", " "))


@dataclass(frozen=True)
class ChannelFit:
    """How far model and readings of a channel are apart.

    Attributes
    ----------
    name, trials : str
        Channel, and which trials: "fitted" or "held out".
    readings : int
        Number of readings.
    before, after : float
        Rms residual at the prior means and at the optimum, gains, zeros and the like fitted in both, in
        standard deviations of the noise [1]; NaN where the noise is not known.
    """

    name: str
    trials: Literal["fitted", "held out"]
    readings: int
    before: float
    after: float


@dataclass(frozen=True)
class Reading:
    """A number that an experiment measured of a figure.

    Attributes
    ----------
    name : str
        The figure.
    experiment : str
        What was done.
    value, deviation : float
        Measured, and its standard deviation [unit of the figure].
    """

    name: str
    experiment: str
    value: float
    deviation: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """The posterior of the parameters of a model, under a campaign or the experiments of a laboratory.

    Attributes
    ----------
    asset : str
        Name of what was measured.
    model, model_hash : str
        Name of the model, and SHA-256 of all that it was read from.
    procedure : Procedure
        How the samples were made.
    priors : tuple of ParameterPrior
        The calibrated parameters, P of them.
    samples, prior_samples : (N, P + Q), (M, P + Q) array
        Equally weighted samples of posterior and prior, parameters first [units of `figures`].
    explained : bool or None
        Whether noise and priors allow what the calibrated model leaves; None where the data cannot tell.
    findings : tuple of str
        What has to be said, a sentence each: what the data do not tell, what disagrees.
    channels : tuple of ChannelFit
        Residuals before and after.
    source : str
        Name of the campaign, or where the measurements come from.
    seed : int
        Of all samples.
    provenance : mapping
        Versions and hashes.
    design_hash : str
        SHA-256 of the design or structure that the model was made of; empty where that is not known.
    quantities : tuple of CalibratedFigure
        Q figures of the model that follow from the parameters.
    readings : tuple of Reading
        Numbers measured of parameters and quantities.
    measured : Dataset
        Readings that are more than one number, by name, with units.
    design : WingDesign or None
        Of a wing, the design with the measured planform.

    Raises
    ------
    CalibrationRecordError
        If the name cannot be printed, or samples are missing or not finite.
    """

    asset: str
    model: str
    model_hash: str
    procedure: Procedure
    priors: tuple[ParameterPrior, ...]
    samples: Float
    prior_samples: Float
    explained: bool | None
    findings: tuple[str, ...]
    channels: tuple[ChannelFit, ...]
    source: str
    seed: int
    provenance: Mapping[str, Any]
    design_hash: str = ""
    quantities: tuple[CalibratedFigure, ...] = ()
    readings: tuple[Reading, ...] = ()
    measured: xr.Dataset = field(default_factory=xr.Dataset)
    design: WingDesign | None = None

    def __repr__(self) -> str:
        facts = {"parameters": [prior.name for prior in self.priors], "samples": len(self.samples)}
        return brief(self, asset=self.asset, model=self.model, **facts)

    def __post_init__(self) -> None:
        check_name(self.asset)
        for samples in (self.samples, self.prior_samples):
            whole = len(samples) and samples.shape[1:] == (len(self.figures),)
            if not (whole and np.isfinite(samples).all()):
                raise CalibrationRecordError(said("posterior.samples", self=self))

    # ------------------------------------------------------------ figures

    @property
    def figures(self) -> tuple[CalibratedFigure, ...]:
        """Parameters and quantities, in the order of the samples."""
        return (*(prior.figure for prior in self.priors), *self.quantities)

    def draws_of(self, name: str, *, prior: bool = False) -> Float:
        """Return all samples of one figure; (N,), SI.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name.
        """
        names = [figure.name for figure in self.figures]
        if name not in names:
            raise CalibrationRecordError(said("posterior.no_samples", self=self, name=name, known=names))
        return (self.prior_samples if prior else self.samples)[:, names.index(name)]

    def mean(self, name: str) -> float:
        """Return the posterior mean of a figure, SI."""
        return float(np.mean(self.draws_of(name)))

    def standard_deviation(self, name: str) -> float:
        """Return the posterior standard deviation of a figure, SI; zero where it does not vary."""
        return moments(self.draws_of(name))[1]

    def prior_moments(self, name: str) -> tuple[float, float]:
        """Return mean and standard deviation of a figure before, parameters cut off at their range [unit]."""
        return moments(self.draws_of(name, prior=True))

    def kept_share(self, name: str) -> float:
        """Return the standard deviation of a figure over that of its prior [1]."""
        return self.standard_deviation(name) / self.prior_moments(name)[1]

    def interval(self, name: str, probability: float = 0.9) -> tuple[float, float]:
        """Return the central interval of a figure [unit]."""
        ends = np.quantile(self.draws_of(name), [0.5 - 0.5 * probability, 0.5 + 0.5 * probability])
        return float(ends[0]), float(ends[1])

    @property
    def correlation(self) -> Float:
        """Correlation matrix (P, P) of the parameters."""
        return correlation(self.samples[:, : len(self.priors)])

    @property
    def information(self) -> float | None:
        """Information gained [nat]: Kullback-Leibler divergence of Gaussians of these moments.

        None where a parameter follows from the others, as the paper's masses from e.
        """
        prior, posterior = (
            values[:, : len(self.priors)] / self.prior_samples[:, : len(self.priors)].std(axis=0)
            for values in (self.prior_samples, self.samples)
        )
        before, after = (np.atleast_2d(np.cov(values, rowvar=False)) for values in (prior, posterior))
        scale = np.sqrt(np.diag(after))
        if not np.all(scale > 0.0) or np.linalg.cond(after / np.outer(scale, scale)) > _SINGULAR:
            return None
        shift = posterior.mean(axis=0) - prior.mean(axis=0)
        inverse = np.linalg.inv(before)
        logs = np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]
        return 0.5 * float(np.trace(inverse @ after) + shift @ inverse @ shift - len(shift) + logs)

    # ------------------------------------------------------------ readings

    def score(self, reading: Reading) -> float:
        """Return how far the model's figure lies from a reading, in standard deviations of both [1]."""
        spread = np.hypot(reading.deviation, self.standard_deviation(reading.name))
        return (self.mean(reading.name) - reading.value) / float(spread)

    def error(self, experiment: str, *, prior: bool = False) -> float:
        """Return minus the mean of |measured - mean| of an experiment's readings [1].

        In half-widths of their 95 % intervals: the form of the error reward of Kapteyn et al. 2021.
        """
        return -float(
            np.mean(
                [
                    abs(reading.value - np.mean(self.draws_of(reading.name, prior=prior)))
                    / (HALF_WIDTH_95 * reading.deviation)
                    for reading in self.readings
                    if reading.experiment == experiment
                ]
            )
        )

    # ------------------------------------------------------------ for a twin

    def stratified_draws(self, name: str, count: int, seed: Seed) -> Float:
        """Return `count` draws of one figure, one from each of as many strata; (count,) [unit].

        Strata are of equal probability and in shuffled order: means of functions of this figure scatter far
        less than with independent draws.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name.
        """
        values = np.sort(self.draws_of(name))
        generator = np.random.default_rng(child_seed(seed, 0))
        place = (stratified(generator, count) * len(values)).astype(np.int64)
        return values[np.minimum(place, len(values) - 1)]

    def given(self, name: str, values: Float) -> dict[str, Float]:
        """Return what the other parameters are expected to be where one has these values (n,), [units].

        By linear regression on the samples, and within what these hold: exact for a Gaussian.
        """
        own = self.draws_of(name)
        variance = float(np.var(own))
        found: dict[str, Float] = {}
        for prior in self.priors:
            if prior.name != name:
                other = self.draws_of(prior.name)
                shared = float(np.mean((own - own.mean()) * (other - other.mean())))
                expected = other.mean() + (shared / variance if variance else 0.0) * (values - own.mean())
                found[prior.name] = np.clip(expected, other.min(), other.max())
        return found

    @property
    def wing_design(self) -> WingDesign:
        """The design of a wing with the measured planform.

        Raises
        ------
        CalibrationRecordError
            If this is the calibration of a model's parameters from a campaign, which has none.
        """
        if self.design is None:
            kinds = FROM_CAMPAIGN, FROM_LABORATORY
            raise CalibrationRecordError(said("posterior.laboratory", self=self, kinds=kinds))
        return self.design

    def mean_state(self) -> DigitalState:
        """Return the digital state of a wing at the posterior mean, healthy."""
        return self._state(np.array([self.mean(figure.name) for figure in self.figures]))

    def states(self) -> tuple[DigitalState, ...]:
        """Return one digital state of a wing for each sample, healthy and of the tailored planform."""
        return tuple(self._state(row) for row in self.samples)

    def _state(self, row: Float) -> DigitalState:
        values = dict(zip((figure.name for figure in self.figures), row.tolist(), strict=True))
        return DigitalState(self.wing_design.geometry, **{name: values[name] for name in STATE})


_SINGULAR = 1e10  # condition of a correlation matrix beyond which some figure has no freedom of its own


def prior_samples(priors: tuple[ParameterPrior, ...], count: int, seed: int) -> Float:
    """Return samples (count, P) of priors, cut off at their ranges, one from each of as many strata."""
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    columns = []
    for prior in priors:
        low, high = ndtr((np.array((prior.low, prior.high)) - prior.mean) / prior.deviation)
        u = ndtri(low + (high - low) * stratified(generator, count))
        columns.append(np.clip(prior.mean + prior.deviation * u, prior.low, prior.high))
    return np.column_stack(columns)


def moments(values: Float) -> tuple[float, float]:
    """Return mean and standard deviation of samples (N,); the latter is 0 of a single one."""
    return float(values.mean()), float(values.std(ddof=1)) if values.size > 1 else 0.0


def correlation(values: Float) -> Float:
    """Return the correlation matrix of samples (N, F); one that does not vary has 1 with itself alone."""
    centred = values - values.mean(axis=0)
    norm = np.linalg.norm(centred, axis=0)
    scaled = centred / np.where(norm > 0.0, norm, 1.0)
    matrix = np.clip(scaled.T @ scaled, -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return np.asarray(matrix)


def check_name(asset: str) -> str:
    """Return the name of an asset if it can be printed.

    Raises
    ------
    CalibrationRecordError
        If it is empty, too long or holds control characters.
    """
    if not (0 < len(asset) <= LONGEST_NAME and asset.isprintable() and asset.strip()):
        raise CalibrationRecordError(said("posterior.name", most=LONGEST_NAME, asset=asset))
    return asset
