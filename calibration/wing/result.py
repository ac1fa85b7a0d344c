"""The calibration of one wing: what its twin is tailored with, in one record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.geometry import GeometryCalibration
from calibration.joint import ModalMeasurement, WeighedMass
from calibration.samples.record import (
    CalibratedFigure,
    SampledCalibration,
    SampleTable,
    check_name,
    frozen_samples,
)
from calibration.static.experiments import LoadDisplacementData
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign

from .steps import CalibrationStep

Float = NDArray[np.float64]
Procedure = Literal["joint", "paper"]
"""Which posterior the samples of a calibration are drawn from."""

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


def measured_quantities(modal: ModalMeasurement) -> dict[str, tuple[float, float]]:
    """Return name of a quantity of interest -> measured value and its standard deviation, SI."""
    return {
        f"{kind}_{mode + 1}": (getattr(modal, kind)[mode], getattr(modal, f"{kind}_standard_deviation")[mode])
        for kind in ("frequency", "damping_ratio")
        for mode in (0, 1)
    }


@dataclass(frozen=True, eq=False)
class CalibrationResult(SampledCalibration):
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
                values = frozen_samples(which, getattr(self, which), len(columns))
                object.__setattr__(self, which, values)
            if len(getattr(self, name)) != len(getattr(self, partner)):
                raise CalibrationRecordError(f"{partner} must be as many as {name}.")

    @property
    def design_hash(self) -> str:
        """SHA-256 of the tailored design."""
        return self.design.hash

    @property
    def calibrated(self) -> SampleTable:
        """Samples of `STATE`."""
        return SampleTable(STATE, self.samples, self.prior_samples)

    @property
    def derived(self) -> SampleTable:
        """Samples of `QUANTITIES`."""
        return SampleTable(QUANTITIES, self.quantity_samples, self.prior_quantity_samples)

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
