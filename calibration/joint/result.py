"""The joint posterior as a record of equally weighted samples."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import PosteriorError
from fe.runtime.state import DigitalState, Geometry

from .measurement import ModalMeasurement
from .prior import NAMES, JointPrior, ModelError, WeighedMass

__all__ = ["NAMES", "JointDiagnostics", "JointPosterior"]


@dataclass(frozen=True, eq=False)
class JointDiagnostics:
    """How the samples came about.

    Attributes
    ----------
    proposal_count : int
        Weighted draws from which the samples were taken.
    effective_sample_size : float
        (sum w)^2 / sum w^2 of their weights.
    distinct_samples : int
        How many of the equally weighted samples differ from each other.
    laplace_mode : (5,) array
        Mode of the posterior of e and the masses, and the mean of the Rayleigh coefficients there, before
        they are cut off at zero [SI].
    laplace_covariance : (5, 5) array
        Gaussian approximation there, from second derivatives [SI].
    weighted_mean, weighted_standard_deviation : (5,) array
        Of all weighted draws, closer to the posterior's than those of the samples [SI].
    log_evidence : float
        Log of the probability density of all measurements under prior and model error.
    frequency_table_error : float
        Largest relative error found of the tabulated frequencies [1].
    """

    proposal_count: int
    effective_sample_size: float
    distinct_samples: int
    laplace_mode: NDArray[np.float64]
    laplace_covariance: NDArray[np.float64]
    weighted_mean: NDArray[np.float64]
    weighted_standard_deviation: NDArray[np.float64]
    log_evidence: float
    frequency_table_error: float


@dataclass(frozen=True, eq=False)
class JointPosterior:
    """p(e, masses, Rayleigh coefficients | load test, weighed total, ring-down) as samples.

    Attributes
    ----------
    samples : (N, 5) array
        Equally weighted samples of `names` in SI units, in no order.
    prior_samples : (N, 5) array
        Samples of the prior, without the weighed total.
    frequency : (N, 2) array
        The model's flapwise frequencies at `samples` [Hz].
    prior : JointPrior
        What was assumed of the quantities.
    total_mass : WeighedMass
        What the scale said.
    model_error : ModelError
        What was assumed of the model's frequencies.
    modal : ModalMeasurement
        What the ring-down said.
    static_source, static_sha256 : str
        Where the load test comes from, and the hash of its figures.
    diagnostics : JointDiagnostics
        How the samples came about.
    seed : int
        Seed; equal input and seed give equal samples.
    """

    samples: NDArray[np.float64]
    prior_samples: NDArray[np.float64]
    frequency: NDArray[np.float64]
    prior: JointPrior
    total_mass: WeighedMass
    model_error: ModelError
    modal: ModalMeasurement
    static_source: str
    static_sha256: str
    diagnostics: JointDiagnostics
    seed: int
    names: tuple[str, ...] = NAMES

    @property
    def mean(self) -> NDArray[np.float64]:
        """(5,) mean of the samples [SI]."""
        return np.asarray(self.samples.mean(axis=0))

    @property
    def standard_deviation(self) -> NDArray[np.float64]:
        """(5,) standard deviation of the samples [SI]."""
        return np.asarray(self.samples.std(axis=0, ddof=1))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """(5, 5) correlation matrix of the samples [1]."""
        return np.asarray(np.corrcoef(self.samples, rowvar=False))

    def interval(self, probability: float = 0.9) -> NDArray[np.float64]:
        """Return the (5, 2) ends of the central intervals that hold `probability` of the samples [SI].

        Raises
        ------
        PosteriorError
            If the probability does not lie between 0 and 1.
        """
        if not 0.0 < probability < 1.0:
            raise PosteriorError(
                f"an interval needs a probability between 0 and 1, but {probability!r} came."
            )
        tail = 0.5 * (1.0 - probability)
        return np.asarray(np.quantile(self.samples, [tail, 1.0 - tail], axis=0).T)

    def states(self, geometry: Geometry | None = None) -> tuple[DigitalState, ...]:
        """Return one digital state for each sample, healthy and of this planform."""
        return tuple(DigitalState(geometry or Geometry(), *row) for row in self.samples.tolist())

    @property
    def settings(self) -> Mapping[str, float]:
        """All assumptions and measurements as plain figures in SI units, by name."""
        figures: dict[str, float] = {}
        for name, prior in zip(self.names, self.prior.marginals, strict=True):
            figures[f"prior_{name}_mean"] = prior.mean
            figures[f"prior_{name}_standard_deviation"] = prior.standard_deviation
        figures["total_mass"] = self.total_mass.mass
        figures["total_mass_standard_deviation"] = self.total_mass.standard_deviation
        for mode in (0, 1):
            number = mode + 1
            figures[f"model_error_frequency_{number}"] = self.model_error.frequency[mode]
            for name in (
                "frequency",
                "frequency_standard_deviation",
                "damping_ratio",
                "damping_ratio_standard_deviation",
            ):
                figures[f"{name}_{number}"] = getattr(self.modal, name)[mode]
        return figures
