"""The record of a calibration: samples of named quantities, with their data, origin and findings.

It holds the calibration of a wing from the folder of its laboratory, or of any model from a
campaign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import xarray as xr

from calibration.errors import CalibrationRecordError
from calibration.result.sensors import SensorFit
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import Seed, child_seed, stratified
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign
from reporting.arrays import Float
from reporting.json_file import JsonRecord
from reporting.pages.notebook import html_table, new_panels
from reporting.words import brief, comma_list, plus_minus

if TYPE_CHECKING:  # it takes long to import
    from matplotlib.axes import Axes

Procedure = Literal["quadrature", "Gaussian", "several optima", "joint"]
"""How the samples were drawn: by quadrature of one parameter and the others given it, from the
Gaussian at the optimum where the posterior is one, or from Gaussians at several optima; for a wing
by importance sampling."""

FROM_LABORATORY = "from the laboratory of a wing (`uav-twin calibrate`)"
FROM_CAMPAIGN = "from a campaign (`uav-twin calibrate campaign`)"

LONGEST_NAME = 80
"""Largest length of an asset's name, in characters."""

STATE = ("young_modulus_factor", "servo_mass", "pitot_mass", "damping_alpha", "damping_beta")
"""The parameters of a calibrated wing that belong to its digital state."""


@dataclass(frozen=True)
class CalibratedQuantity:
    """Name, unit (SI) and title of a calibrated parameter or quantity."""

    name: str
    unit: str
    title: str

    @property
    def printed_unit(self) -> str:
        """The printed unit: nothing for a plain number."""
        return "" if self.unit == "1" else self.unit

    @property
    def axis_title(self) -> str:
        """Name and unit as the title of an axis."""
        title = self.name.replace("_", " ")
        if self.printed_unit:
            return f"{title} ({self.printed_unit})"
        return title

    def printed(self, mean: float, deviation: float) -> str:
        """Format a mean ± standard deviation with the unit."""
        return f"{plus_minus(mean, deviation)} {self.printed_unit}".rstrip()


@dataclass(frozen=True)
class ParameterPrior:
    """The prior of a parameter: a Gaussian, truncated to the range of the model.

    Attributes
    ----------
    mean, deviation : float
        The mean and the standard deviation before the truncation [unit].
    low, high : float
        The range in which the model holds [unit].
    stated_by : str
        The file that states the prior: of the model or of the campaign; empty for the model's.
    title : str
        The title of the parameter; its name if the title is empty.
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
    def quantity(self) -> CalibratedQuantity:
        """The parameter as a calibrated quantity."""
        return CalibratedQuantity(self.name, self.unit, self.title or self.name.replace("_", " "))


@dataclass(frozen=True)
class ChannelFit:
    """The residuals of a channel before and after the calibration.

    Attributes
    ----------
    name, trials : str
        The channel, and its trials: "fitted" or "held out".
    readings : int
        The number of readings.
    before, after : float
        The rms residual at the prior means and at the optimum, in standard deviations of the noise
        [1]; NaN if the noise is not known. Gains, zeros and initial states are fitted in both.
    """

    name: str
    trials: Literal["fitted", "held out"]
    readings: int
    before: float
    after: float


@dataclass(frozen=True)
class QuantityReading:
    """A measured value of a quantity.

    Attributes
    ----------
    value, deviation : float
        The measured value and its standard deviation [unit of the quantity].
    """

    name: str
    experiment: str
    value: float
    deviation: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """The posterior of a model's parameters, given a campaign or a laboratory's experiments.

    Attributes
    ----------
    model, model_hash : str
        The name of the model, and the SHA-256 of all its files.
    procedure : Procedure
        How the samples were drawn.
    priors : tuple of ParameterPrior
        The priors of the P calibrated parameters.
    samples, prior_samples : (N, P + Q), (M, P + Q) array
        The equally weighted samples of posterior and prior, parameters first [units of
        `all_quantities`].
    explained : bool or None
        Whether noise and priors explain the residuals of the calibrated model; None if the data
        cannot decide.
    findings : tuple of str
        Sentences on what the data do not determine, and on what disagrees.
    channels : tuple of ChannelFit
        The residuals before and after the calibration.
    source : str
        The name of the campaign, or the origin of the measurements.
    provenance : mapping
        The versions and hashes.
    design_hash : str
        The SHA-256 of the design or structure of the model; empty if it is not known.
    quantities : tuple of CalibratedQuantity
        The Q quantities of the model that follow from the parameters.
    readings : tuple of QuantityReading
        The measured values of parameters and quantities.
    measured : Dataset
        Measurements that are arrays, by name, with units.
    design : WingDesign or None
        The design with the measured planform, for a wing.
    sensors : tuple of SensorFit
        The gains and zeros that were fitted together with the parameters; empty for a wing.

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
    provenance: JsonRecord
    design_hash: str = ""
    quantities: tuple[CalibratedQuantity, ...] = ()
    readings: tuple[QuantityReading, ...] = ()
    measured: xr.Dataset = field(default_factory=xr.Dataset)
    design: WingDesign | None = None
    sensors: tuple[SensorFit, ...] = ()

    def __repr__(self) -> str:
        return brief(
            self,
            asset=self.asset,
            model=self.model,
            parameters=[prior.name for prior in self.priors],
            samples=len(self.samples),
        )

    def _repr_html_(self) -> str:
        """Return prior and posterior of each parameter as HTML, for a notebook."""
        rows = []
        for prior in self.priors:
            name = prior.name
            posterior = plus_minus(self.mean(name), self.standard_deviation(name))
            prior_text = plus_minus(*self.prior_moments(name))
            rows.append([prior.quantity.title, prior_text, posterior, prior.quantity.printed_unit])
        title = f"Calibration of {self.asset}: parameters of {self.model}"
        return html_table(title, ("parameter", "prior", "posterior", "unit"), rows, self.findings)

    def plot(self, axes: "Axes | Sequence[Axes] | None" = None) -> "list[Axes]":
        """Draw prior and posterior of each parameter as histograms of their samples.

        Parameters
        ----------
        axes : Axes or sequence of Axes, optional
            A panel for each parameter; by default new ones of pyplot.

        Returns
        -------
        list of Axes
            The panels.
        """
        from reporting.pages import figures as style

        panels = new_panels(len(self.priors), axes)
        for panel, prior in zip(panels, self.priors, strict=True):
            for is_prior, color in ((True, style.REFERENCE), (False, style.PAST)):
                samples = self.draws_of(prior.name, prior=is_prior)
                label = "prior" if is_prior else "posterior"
                panel.hist(samples, bins="auto", density=True, color=color, alpha=0.6, label=label)
            panel.set_xlabel(prior.quantity.axis_title)
            panel.set_ylabel("density")
        panels[0].legend(frameon=False)
        return panels

    def __post_init__(self) -> None:
        check_name(self.asset)
        for samples in (self.samples, self.prior_samples):
            is_complete = len(samples) > 0 and samples.shape[1:] == (len(self.all_quantities),)
            if not is_complete or not np.isfinite(samples).all():
                raise CalibrationRecordError(
                    f"the calibration of {self.asset} must have finite samples of posterior and "
                    "prior for each of its quantities."
                )

    @property
    def all_quantities(self) -> tuple[CalibratedQuantity, ...]:
        """Parameters and quantities, in the order of the samples."""
        return (*(prior.quantity for prior in self.priors), *self.quantities)

    def draws_of(self, name: str, *, prior: bool = False) -> Float:
        """Return all samples (N,) of a parameter or quantity, in its unit.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no quantity of this name.
        """
        names = [quantity.name for quantity in self.all_quantities]
        if name not in names:
            raise CalibrationRecordError(
                f"the calibration of {self.asset} has no samples of `{name}`; "
                f"it has {comma_list(names)}."
            )
        samples = self.prior_samples if prior else self.samples
        return samples[:, names.index(name)]

    def mean(self, name: str) -> float:
        """Return the posterior mean of a parameter or quantity, in its unit."""
        return float(np.mean(self.draws_of(name)))

    def standard_deviation(self, name: str) -> float:
        """Return the posterior standard deviation of a parameter or quantity, in its unit."""
        return moments(self.draws_of(name))[1]

    def prior_moments(self, name: str) -> tuple[float, float]:
        """Return the prior mean and standard deviation, from the prior samples."""
        return moments(self.draws_of(name, prior=True))

    def posterior_over_prior(self, name: str) -> float:
        """Return the ratio of the posterior to the prior standard deviation [1]."""
        return self.standard_deviation(name) / self.prior_moments(name)[1]

    def interval(self, name: str, probability: float = 0.9) -> tuple[float, float]:
        """Return the central posterior interval with a probability, in the quantity's unit."""
        probabilities = [0.5 - 0.5 * probability, 0.5 + 0.5 * probability]
        low, high = np.quantile(self.draws_of(name), probabilities)
        return float(low), float(high)

    @property
    def correlation(self) -> Float:
        """Correlation matrix (P, P) of the parameters."""
        return correlation(self.samples[:, : len(self.priors)])

    @property
    def information(self) -> float | None:
        """Information gained [nat]: the Kullback-Leibler divergence of posterior from prior.

        Both are approximated by Gaussians with the moments of the samples. The value is None if a
        parameter follows from the others, as the paper's masses follow from e.
        """
        # Parameters in units of their prior standard deviations
        parameters = slice(len(self.priors))
        prior_deviation = self.prior_samples[:, parameters].std(axis=0)
        prior = self.prior_samples[:, parameters] / prior_deviation
        posterior = self.samples[:, parameters] / prior_deviation
        prior_covariance = np.atleast_2d(np.cov(prior, rowvar=False))
        posterior_covariance = np.atleast_2d(np.cov(posterior, rowvar=False))
        deviations = np.sqrt(np.diag(posterior_covariance))
        if not np.all(deviations > 0.0):
            return None
        posterior_correlation = posterior_covariance / np.outer(deviations, deviations)
        if np.linalg.cond(posterior_correlation) > _SINGULAR:
            return None
        # KL = (tr(C0^-1 C1) + d' C0^-1 d - P + ln(det C0 / det C1)) / 2 for Gaussians 0 (prior)
        # and 1 (posterior) of P unknowns with means d apart
        shift = posterior.mean(axis=0) - prior.mean(axis=0)
        prior_precision = np.linalg.inv(prior_covariance)
        log_prior_volume = np.linalg.slogdet(prior_covariance)[1]
        log_volume_ratio = log_prior_volume - np.linalg.slogdet(posterior_covariance)[1]
        trace = np.trace(prior_precision @ posterior_covariance)
        return 0.5 * float(trace + shift @ prior_precision @ shift - len(shift) + log_volume_ratio)

    def score(self, reading: QuantityReading) -> float:
        """Return model minus reading, in standard deviations of both together [1]."""
        deviation = np.hypot(reading.deviation, self.standard_deviation(reading.name))
        return (self.mean(reading.name) - reading.value) / float(deviation)

    def error(self, experiment: str, *, prior: bool = False) -> float:
        """Return minus the mean absolute difference between readings and model [1].

        Each difference is divided by the half-width of the 95 % interval of the reading, as in the
        error reward of Kapteyn et al. 2021. With `prior`, the model has the prior means instead of
        the posterior means.
        """
        errors = []
        for reading in self.readings:
            if reading.experiment == experiment:
                mean = np.mean(self.draws_of(reading.name, prior=prior))
                errors.append(abs(reading.value - mean) / (HALF_WIDTH_95 * reading.deviation))
        return -float(np.mean(errors))

    def stratified_draws(self, name: str, count: int, seed: Seed) -> Float:
        """Draw one value from each of `count` strata of equal probability; return them shuffled.

        Means over these draws have a far smaller variance than means over independent draws.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no quantity of this name.
        """
        values = np.sort(self.draws_of(name))
        generator = np.random.default_rng(child_seed(seed, 0))
        ranks = (stratified(generator, count) * len(values)).astype(np.int64)
        return values[np.minimum(ranks, len(values) - 1)]

    def conditional_means(self, name: str, values: Float) -> dict[str, Float]:
        """Return the conditional means of all other parameters, given values of one quantity.

        They follow by linear regression on the samples, which is exact for a Gaussian posterior,
        and are limited to the range of the samples.

        Parameters
        ----------
        name : str
            The parameter or quantity whose values are given.
        values : (n,) array
            Its values, in its unit.

        Returns
        -------
        dict of str to (n,) array
            The means of the other parameters by name, in their units.
        """
        draws = self.draws_of(name)
        variance = float(np.var(draws))
        means: dict[str, Float] = {}
        for prior in self.priors:
            if prior.name == name:
                continue
            other_draws = self.draws_of(prior.name)
            covariance = float(np.mean((draws - draws.mean()) * (other_draws - other_draws.mean())))
            slope = covariance / variance if variance else 0.0
            conditional_mean = other_draws.mean() + slope * (values - draws.mean())
            means[prior.name] = np.clip(conditional_mean, other_draws.min(), other_draws.max())
        return means

    @property
    def wing_design(self) -> WingDesign:
        """The design of a wing with the measured planform.

        Raises
        ------
        CalibrationRecordError
            If this is the calibration of a model from a campaign, which has no such design.
        """
        if self.design is None:
            raise CalibrationRecordError(
                f"the calibration of {self.asset} is {FROM_CAMPAIGN}, "
                f"and one {FROM_LABORATORY} is needed."
            )
        return self.design

    def mean_state(self) -> DigitalState:
        """Return the digital state of a healthy wing at the posterior mean."""
        return self._state(np.array([self.mean(quantity.name) for quantity in self.all_quantities]))

    def states(self) -> tuple[DigitalState, ...]:
        """Return the digital state of a healthy wing for each sample."""
        return tuple(self._state(row) for row in self.samples)

    def _state(self, row: Float) -> DigitalState:
        """Return the digital state of a wing from the values (P + Q,) of its quantities."""
        names = [quantity.name for quantity in self.all_quantities]
        values = dict(zip(names, row.tolist(), strict=True))
        return DigitalState(self.wing_design.geometry, **{name: values[name] for name in STATE})


_SINGULAR = 1e10  # condition of a correlation matrix in which one parameter follows from the others


def prior_samples(priors: tuple[ParameterPrior, ...], count: int, seed: int) -> Float:
    """Return stratified samples (count, P) of truncated Gaussian priors."""
    from scipy.special import ndtr, ndtri  # slow to import, and a file is read without it

    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    columns = []
    for prior in priors:
        standardised_limits = (np.array((prior.low, prior.high)) - prior.mean) / prior.deviation
        low, high = ndtr(standardised_limits)
        # Inverse transform: uniform probabilities between those of the limits
        standardised = ndtri(low + (high - low) * stratified(generator, count))
        values = prior.mean + prior.deviation * standardised
        columns.append(np.clip(values, prior.low, prior.high))
    return np.column_stack(columns)


def moments(values: Float) -> tuple[float, float]:
    """Return the mean and the standard deviation of samples (N,); the latter is 0 for N = 1."""
    standard_deviation = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return float(values.mean()), standard_deviation


def correlation(values: Float) -> Float:
    """Return the correlation matrix (F, F) of samples (N, F).

    A constant column has zero correlation with all others.
    """
    centred = values - values.mean(axis=0)
    norm = np.linalg.norm(centred, axis=0)
    unit_columns = centred / np.where(norm > 0.0, norm, 1.0)
    matrix = np.clip(unit_columns.T @ unit_columns, -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return np.asarray(matrix)


def check_name(asset: str) -> str:
    """Return the name of an asset if it can be printed.

    Raises
    ------
    CalibrationRecordError
        If it is empty, too long or contains control characters.
    """
    has_good_length = 0 < len(asset) <= LONGEST_NAME
    if not (has_good_length and asset.isprintable() and asset.strip()):
        raise CalibrationRecordError(
            f"the name of the asset must be 1 to {LONGEST_NAME} printable characters, but "
            f"{asset!r} was given."
        )
    return asset
