"""The calibration of the parameters of a model from a campaign: what its twin is tailored with."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.samples.record import (
    CalibratedFigure,
    SampledCalibration,
    SampleTable,
    check_name,
    frozen_samples,
)

Float = NDArray[np.float64]
Procedure = Literal["quadrature", "Gaussian", "several optima"]
"""How the samples were made: from the Gaussian at the optimum where the posterior is one, by quadrature of
the parameter that is told least and the others given it, from Gaussians at several optima."""


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
        Where it stands: the model's file or the campaign.
    """

    name: str
    unit: str
    mean: float
    deviation: float
    low: float
    high: float
    stated_by: str

    @property
    def figure(self) -> CalibratedFigure:
        """The parameter as a calibrated figure."""
        return CalibratedFigure(self.name, self.unit, self.name.replace("_", " "))


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


@dataclass(frozen=True, eq=False)
class ParameterCalibration(SampledCalibration):
    """The posterior of a model's parameters under a campaign.

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
    samples, prior_samples : (N, P), (M, P) array
        Equally weighted samples of posterior and prior [units of `priors`].
    explained : bool or None
        Whether noise and priors allow what the calibrated model leaves; None where the campaign cannot tell.
    findings : tuple of str
        What has to be said, a sentence each: what the data do not tell, what disagrees.
    channels : tuple of ChannelFit
        Residuals before and after.
    source : str
        Name of the campaign.
    seed : int
        Of all samples.
    provenance : mapping
        Versions and hashes.
    design_hash : str
        SHA-256 of the design or structure that the model was made of; empty where that is not known.

    Raises
    ------
    CalibrationRecordError
        If arrays do not fit each other or hold values that are not finite, or a name cannot be printed.
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

    def __post_init__(self) -> None:
        check_name(self.asset)
        if self.procedure not in get_args(Procedure):
            raise CalibrationRecordError(
                f"the procedure of a calibration is one of {', '.join(get_args(Procedure))}, and "
                f"{self.procedure!r} came."
            )
        for which in ("samples", "prior_samples"):
            object.__setattr__(self, which, frozen_samples(which, getattr(self, which), len(self.priors)))

    @property
    def calibrated(self) -> SampleTable:
        """Samples of all parameters."""
        return SampleTable(tuple(item.figure for item in self.priors), self.samples, self.prior_samples)

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
                slope = (
                    float(np.mean((own - own.mean()) * (other - other.mean()))) / variance
                    if variance
                    else 0.0
                )
                expected = other.mean() + slope * (values - own.mean())
                found[prior.name] = np.clip(expected, other.min(), other.max())
        return found

    def kept_share(self, name: str) -> float:
        """Return the standard deviation of a parameter over that of its prior [1]."""
        return self.standard_deviation(name) / self.prior_moments(name)[1]

    def prior_moments(self, name: str) -> tuple[float, float]:
        """Return mean and standard deviation of a parameter's prior, cut off at its range [unit]."""
        draws = self.draws_of(name, prior=True)
        return float(np.mean(draws)), float(np.std(draws, ddof=1))

    def interval(self, name: str, probability: float = 0.9) -> tuple[float, float]:
        """Return the central interval of a parameter [unit]."""
        ends = np.quantile(self.draws_of(name), [0.5 - 0.5 * probability, 0.5 + 0.5 * probability])
        return float(ends[0]), float(ends[1])

    @property
    def information(self) -> float:
        """Information gained [nat]: Kullback-Leibler divergence of Gaussians of these moments."""
        prior, posterior = (
            np.atleast_2d(np.cov(values, rowvar=False)) for values in (self.prior_samples, self.samples)
        )
        shift = self.samples.mean(axis=0) - self.prior_samples.mean(axis=0)
        inverse = np.linalg.inv(prior)
        logs = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(posterior)[1]
        return 0.5 * float(np.trace(inverse @ posterior) + shift @ inverse @ shift - len(shift) + logs)
