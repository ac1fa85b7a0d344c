"""The record of calibration step 2, with its way to plain data and back."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError, CalibrationRecordError
from reporting.record_json import plain, record_of

from .experiments import LoadDisplacementData
from .particle_filter import ParticlePosterior
from .posterior import GaussianPrior, ScalarPosterior, Seed
from .quality import FitQuality
from .stiffness_curve import LinearStiffnessCurve, StiffnessCurve, TabulatedStiffnessCurve

SCHEMA = "uav-twin static calibration 1"


@dataclass(frozen=True)
class Alternative:
    """The same posterior under another assumption.

    Attributes
    ----------
    name : str
        The assumption.
    mean, standard_deviation : float
        Of e [1].
    """

    name: str
    mean: float
    standard_deviation: float


@dataclass(frozen=True)
class CalibrationReward:
    """What the experiment was worth: the evaluation factor p(R | D, Q, U, O) of Kapteyn et al. 2021, eq. (4).

    Attributes
    ----------
    prior_error, posterior_error : float
        -mean |x - f / k(e)| over the pairs in half-widths of their 95 % interval, sqrt(S) / k * 1.96, at the
        prior and at the posterior mean of e: the form of the paper's error reward, for displacements [1].
    uncertainty_reduction : float
        1 - posterior over prior standard deviation of e [1].
    information_gain : float
        Kullback-Leibler divergence of the exact posterior from the prior [nat].
    """

    prior_error: float
    posterior_error: float
    uncertainty_reduction: float
    information_gain: float


@dataclass(frozen=True, eq=False)
class StaticCalibration:
    """Everything that calibration step 2 found.

    Attributes
    ----------
    data : LoadDisplacementData
        The measured pairs.
    curve : StiffnessCurve
        k(e).
    prior : GaussianPrior
        p(e).
    particle : ParticlePosterior
        p(e | pairs) by the paper's particle filter.
    exact : ScalarPosterior
        p(e | pairs) with errors in both variables, by quadrature.
    tip_stiffness_prior, tip_stiffness_particle, tip_stiffness_exact : ScalarPosterior
        p(k) and p(k | pairs), the quantity of interest of Fig. 5 [N/m].
    pair_likelihood : (n_pairs, N) array
        Exact likelihood of each pair on `particle.likelihood_grid`, scaled to integrate to one there.
    alternatives : tuple of Alternative
        The exact posterior under other assumptions; those that leave the range of the curve are missing.
    quality : FitQuality
        Residuals at the exact posterior mean.
    reward : CalibrationReward
        What the experiment was worth.
    seed : int
        Seed of the particle filter.
    provenance : mapping
        Versions and hashes.
    """

    data: LoadDisplacementData
    curve: StiffnessCurve
    prior: GaussianPrior
    particle: ParticlePosterior
    exact: ScalarPosterior
    tip_stiffness_prior: ScalarPosterior
    tip_stiffness_particle: ScalarPosterior
    tip_stiffness_exact: ScalarPosterior
    pair_likelihood: NDArray[np.float64]
    alternatives: tuple[Alternative, ...]
    quality: FitQuality
    reward: CalibrationReward
    seed: int
    provenance: Mapping[str, Any]

    def samples(self, seed: Seed, count: int) -> NDArray[np.float64]:
        """Draw stratified samples of e from the exact posterior, for the mission; (count,) [1]."""
        return self.exact.samples(seed, count, stratified=True)

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings, ready for JSON (no NaN)."""
        return {
            "schema": SCHEMA,
            "seed": self.seed,
            "provenance": dict(self.provenance),
            "data": {
                "source": self.data.source,
                "sha256": self.data.sha256,
                "load_N": self.data.load.tolist(),
                "displacement_m": self.data.displacement.tolist(),
                "run": self.data.run.tolist(),
                "load_standard_deviation_N": self.data.load_standard_deviation,
                "displacement_standard_deviation_m": self.data.displacement_standard_deviation,
            },
            "stiffness_curve": _curve_to_dict(self.curve),
            "prior": plain(self.prior),
            "particle": {**plain(self.particle), "posterior": _posterior_to_dict(self.particle.posterior)},
            "exact": _posterior_to_dict(self.exact),
            "tip_stiffness_prior": _posterior_to_dict(self.tip_stiffness_prior),
            "tip_stiffness_particle": _posterior_to_dict(self.tip_stiffness_particle),
            "tip_stiffness_exact": _posterior_to_dict(self.tip_stiffness_exact),
            "pair_likelihood": self.pair_likelihood.tolist(),
            "alternatives": plain(self.alternatives),
            "quality": plain(self.quality),
            "reward": plain(self.reward),
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> "StaticCalibration":
        """Return the calibration that `to_dict` described.

        Raises
        ------
        CalibrationRecordError
            If the record is of another kind, lacks a part, or its data do not match their hash.
        """
        if record.get("schema") != SCHEMA:
            raise CalibrationRecordError(
                f"a record of schema {SCHEMA!r} is needed, but its schema is {record.get('schema')!r}."
            )
        try:
            calibration = cls._from_parts(record)
        except CalibrationError as error:
            raise CalibrationRecordError(f"the calibration record is damaged: {error}") from error
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise CalibrationRecordError(
                f"the calibration record is damaged ({type(error).__name__}: {error}); calibrate again."
            ) from error
        if calibration.data.sha256 != record["data"].get("sha256"):
            raise CalibrationRecordError(
                "the measurements in the calibration record do not match their hash."
            )
        return calibration

    @classmethod
    def _from_parts(cls, record: Mapping[str, Any]) -> "StaticCalibration":
        data = record["data"]
        return cls(
            data=LoadDisplacementData(
                load=data["load_N"],
                displacement=data["displacement_m"],
                run=data["run"],
                load_standard_deviation=data["load_standard_deviation_N"],
                displacement_standard_deviation=data["displacement_standard_deviation_m"],
                source=data["source"],
            ),
            curve=_curve_from_dict(record["stiffness_curve"]),
            prior=record_of(GaussianPrior, record["prior"]),
            particle=record_of(ParticlePosterior, record["particle"]),
            exact=record_of(ScalarPosterior, record["exact"]),
            tip_stiffness_prior=record_of(ScalarPosterior, record["tip_stiffness_prior"]),
            tip_stiffness_particle=record_of(ScalarPosterior, record["tip_stiffness_particle"]),
            tip_stiffness_exact=record_of(ScalarPosterior, record["tip_stiffness_exact"]),
            pair_likelihood=np.array(record["pair_likelihood"]),
            alternatives=tuple(record_of(Alternative, entry) for entry in record["alternatives"]),
            quality=record_of(FitQuality, record["quality"]),
            reward=record_of(CalibrationReward, record["reward"]),
            seed=int(record["seed"]),
            provenance=record["provenance"],
        )


def _number_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _posterior_to_dict(posterior: ScalarPosterior) -> dict[str, Any]:
    return {
        "unit": posterior.unit,
        "mean": posterior.mean,
        "standard_deviation": posterior.standard_deviation,
        "interval_95": list(posterior.interval(0.95)),
        "grid": posterior.grid.tolist(),
        "density": posterior.density.tolist(),
    }


def _curve_to_dict(curve: StiffnessCurve) -> dict[str, Any]:
    if isinstance(curve, LinearStiffnessCurve):
        return {
            "kind": "line",
            "name": curve.name,
            "gradient_N_per_m": curve.gradient,
            "intercept_N_per_m": curve.intercept,
            "lower": curve.lower,
            "upper": _number_or_none(curve.upper),
        }
    if isinstance(curve, TabulatedStiffnessCurve):
        factors, stiffnesses, error = curve.factors, curve.stiffnesses, _number_or_none(curve.table_error)
    else:  # any other curve is kept as a table over the range in which it may be trusted
        factors = np.linspace(curve.lower, min(curve.upper, curve.lower + 2.0), 401)
        stiffnesses, error = curve.stiffness(factors), None
    return {
        "kind": "table",
        "name": curve.name,
        "factors": factors.tolist(),
        "stiffnesses_N_per_m": stiffnesses.tolist(),
        "table_error": error,
    }


def _curve_from_dict(record: Mapping[str, Any]) -> StiffnessCurve:
    if record["kind"] == "line":
        return LinearStiffnessCurve(
            gradient=record["gradient_N_per_m"],
            intercept=record["intercept_N_per_m"],
            name=record["name"],
            lower=record["lower"],
            upper=math.inf if record["upper"] is None else record["upper"],
        )
    return TabulatedStiffnessCurve(
        factors=np.array(record["factors"]),
        stiffnesses=np.array(record["stiffnesses_N_per_m"]),
        name=record["name"],
        table_error=math.nan if record["table_error"] is None else record["table_error"],
    )
