"""The calibration of one wing: what its twin is tailored with, in one record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.geometry import GeometryCalibration
from calibration.joint import ModalMeasurement, WeighedMass
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import Seed, check_count, child_seed
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign

from .steps import CalibrationStep, deviation

Float = NDArray[np.float64]
Procedure = Literal["joint", "paper"]
"""Which posterior the samples of a calibration are drawn from."""

LONGEST_NAME = 80


@dataclass(frozen=True)
class CalibratedFigure:
    """Name, unit (SI) and meaning of a calibrated figure."""

    name: str
    unit: str
    title: str


STATE = (
    CalibratedFigure("young_modulus_factor", "1", "factor on Young's modulus of the skin, e"),
    CalibratedFigure("servo_mass", "kg", "mass of each servo"),
    CalibratedFigure("pitot_mass", "kg", "mass of the pitot tube"),
    CalibratedFigure("damping_alpha", "1/s", "mass-proportional Rayleigh damping, alpha"),
    CalibratedFigure("damping_beta", "s", "stiffness-proportional Rayleigh damping, beta"),
)
"""The calibrated part of the digital state, in the order of `CalibrationResult.samples`."""

QUANTITIES = (
    CalibratedFigure("tip_stiffness", "N/m", "tip stiffness"),
    CalibratedFigure("frequency_1", "Hz", "natural frequency of the first flapwise bending mode"),
    CalibratedFigure("frequency_2", "Hz", "natural frequency of the second flapwise bending mode"),
    CalibratedFigure("damping_ratio_1", "1", "damping ratio of the first flapwise bending mode"),
    CalibratedFigure("damping_ratio_2", "1", "damping ratio of the second flapwise bending mode"),
)
"""Quantities of interest, in the order of `CalibrationResult.quantity_samples`."""


def check_name(asset: str) -> str:
    """Return the name of an asset if it can be printed.

    Raises
    ------
    CalibrationRecordError
        If it is empty, too long or holds control characters.
    """
    if not (0 < len(asset) <= LONGEST_NAME and asset.isprintable() and asset.strip()):
        raise CalibrationRecordError(
            f"the name of the asset must be 1 to {LONGEST_NAME} printable characters, and {asset!r} came."
        )
    return asset


def measured_quantities(modal: ModalMeasurement) -> dict[str, tuple[float, float]]:
    """Return name of a quantity of interest -> measured value and its standard deviation, SI."""
    return {
        f"{kind}_{mode + 1}": (getattr(modal, kind)[mode], getattr(modal, f"{kind}_standard_deviation")[mode])
        for kind in ("frequency", "damping_ratio")
        for mode in (0, 1)
    }


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Everything that a twin of one wing is tailored with.

    Attributes
    ----------
    asset : str
        Name of the wing.
    design : WingDesign
        The design with the measured planform.
    geometry : GeometryCalibration
        Prior, measurement and posterior of the planform.
    procedure : {"joint", "paper"}
        The posterior that was sampled: of all five figures together, or step after step as in the paper.
    samples : (N, 5) array
        Equally weighted samples of `STATE`, SI.
    prior_samples : (M, 5) array
        Samples of the prior.
    quantity_samples : (N, 5) array
        `QUANTITIES` of the tailored model at each sample, SI.
    prior_quantity_samples : (M, 5) array
        The same at the prior's samples.
    pairs : LoadDisplacementData
        What the load test measured.
    total_mass : WeighedMass
        Weighed mass of two servos and the pitot tube.
    modal : ModalMeasurement
        What the ring-down test measured.
    steps : tuple of CalibrationStep
        What each step found.
    seed : int
        Seed of all samples.
    provenance : mapping
        Versions and hashes.

    Raises
    ------
    CalibrationRecordError
        If arrays do not fit each other or hold values that are not finite, or the name cannot be printed.
    """

    asset: str
    design: WingDesign
    geometry: GeometryCalibration
    procedure: Procedure
    samples: Float
    prior_samples: Float
    quantity_samples: Float
    prior_quantity_samples: Float
    pairs: LoadDisplacementData
    total_mass: WeighedMass
    modal: ModalMeasurement
    steps: tuple[CalibrationStep, ...]
    seed: int
    provenance: Mapping[str, Any]

    def __post_init__(self) -> None:
        check_name(self.asset)
        if self.procedure not in ("joint", "paper"):
            raise CalibrationRecordError(
                f"the procedure of a calibration is joint or paper, and {self.procedure!r} came."
            )
        for name, partner in (("samples", "quantity_samples"), ("prior_samples", "prior_quantity_samples")):
            for which, columns in ((name, STATE), (partner, QUANTITIES)):
                values = np.array(getattr(self, which), dtype=np.float64, order="C")
                values.setflags(write=False)
                object.__setattr__(self, which, values)
                if values.ndim != 2 or not len(values) or values.shape[1] != len(columns):
                    raise CalibrationRecordError(
                        f"{which} must have the shape (N, {len(columns)}), and {values.shape} came."
                    )
                if not np.all(np.isfinite(values)):
                    raise CalibrationRecordError(f"{which} hold a value that is not finite.")
            if len(getattr(self, name)) != len(getattr(self, partner)):
                raise CalibrationRecordError(f"{partner} must be as many as {name}.")

    @property
    def design_hash(self) -> str:
        """SHA-256 of the tailored design."""
        return self.design.hash

    def mean(self, name: str) -> float:
        """Return the posterior mean of a figure of `STATE` or `QUANTITIES`, SI."""
        return float(np.mean(self.draws_of(name)))

    def standard_deviation(self, name: str) -> float:
        """Return the posterior standard deviation of a figure of `STATE` or `QUANTITIES`, SI."""
        return deviation(self.draws_of(name))

    def draws_of(self, name: str, *, prior: bool = False) -> Float:
        """Return all samples of one figure; (N,), SI.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name.
        """
        for columns, values in (
            (STATE, self.prior_samples if prior else self.samples),
            (QUANTITIES, self.prior_quantity_samples if prior else self.quantity_samples),
        ):
            for index, quantity in enumerate(columns):
                if quantity.name == name:
                    return values[:, index]
        known = ", ".join(quantity.name for quantity in (*STATE, *QUANTITIES))
        raise CalibrationRecordError(
            f"the calibration of {self.asset} has no samples of `{name}`; it has {known}."
        )

    def stratified_draws(self, name: str, count: int, seed: Seed) -> Float:
        """Return `count` draws of one figure from its samples; (count,), SI.

        One from each of `count` strata of equal probability, in shuffled order: means of functions of this
        figure scatter far less than with independent draws.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name, or `count` is not 1 to `MOST_SAMPLES`.
        """
        values = np.sort(self.draws_of(name))
        check_count(count, CalibrationRecordError)
        generator = np.random.default_rng(child_seed(seed, 0))
        probability = (np.arange(count) + generator.random(count)) / count
        drawn = values[np.minimum((probability * len(values)).astype(np.int64), len(values) - 1)]
        return generator.permutation(drawn)

    def mean_state(self) -> DigitalState:
        """Return the digital state at the posterior mean, healthy."""
        return self._state([self.mean(entry.name) for entry in STATE])

    def states(self) -> tuple[DigitalState, ...]:
        """Return one digital state for each sample, healthy and of the tailored planform."""
        return tuple(self._state(row) for row in self.samples.tolist())

    def _state(self, row: Sequence[float]) -> DigitalState:
        factor, servo, pitot, alpha, beta = row
        return DigitalState(self.design.geometry, factor, servo, pitot, alpha, beta)

    def step(self, number: int) -> CalibrationStep:
        """Return the record of step 1, 2 or 3; of step 3 that of the samples' procedure."""
        return next(step for step in self.steps if step.number == number)
