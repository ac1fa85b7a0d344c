"""The calibration of a wing: from the measurements of its laboratory to what tailors its twin."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from calibration.errors import OutsideValidityError
from calibration.geometry import GeometryCalibration, tailored_design
from calibration.joint.inference import joint_posterior
from calibration.joint.measurement import (
    ModalMeasurement,
    modal_measurement,
    published_modal_measurement,
)
from calibration.joint.prior import wing_priors
from calibration.paper.load_test import StaticCalibration, calibrate_static
from calibration.paper.procedure import calibrate_dynamics
from calibration.paper.table_1 import TableRow, table_1
from calibration.result.file import save_calibration
from calibration.result.record import (
    STATE,
    CalibratedFigure,
    Calibration,
    ChannelFit,
    ParameterPrior,
    Procedure,
    Reading,
    check_name,
    prior_samples,
)
from calibration.static.experiments import HALF_WIDTH_95, LoadDisplacementData
from calibration.static.posterior import child_seed
from calibration.static.quality import assess_fit
from calibration.static.stiffness_curve import PUBLISHED_LINE, stiffness_curve_of
from fe.reduction.model_cache import reduced_model
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign, load_design
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance

from .disagreements import disagreements
from .lab_data import LabData, published_data, read_lab_folder

Float = NDArray[np.float64]

QUANTITIES = (
    CalibratedFigure("tip_stiffness", "N/m", "tip stiffness"),
    CalibratedFigure("frequency_1", "Hz", "natural frequency of the first flapwise bending mode"),
    CalibratedFigure("frequency_2", "Hz", "natural frequency of the second flapwise bending mode"),
    CalibratedFigure("damping_ratio_1", "1", "damping ratio of the first flapwise bending mode"),
    CalibratedFigure("damping_ratio_2", "1", "damping ratio of the second flapwise bending mode"),
    CalibratedFigure("weighed_mass", "kg", "mass of two servos and the pitot tube"),
)
"""Quantities of interest of a calibrated wing."""

SAMPLE_COUNT = 1000
"""Samples of the joint posterior that a calibration keeps."""

PAPER_SAMPLE_COUNT = 100
"""Samples of e for which masses are sought, as in the paper."""

_PAPER_PURPOSE, _LENGTHS_PURPOSE = 31, 35  # of the seed: the paper's samples of e, those of lengths


@dataclass(frozen=True, eq=False)
class WingCalibration:
    """The calibration of a wing with everything that its report shows.

    Attributes
    ----------
    joint, paper : Calibration
        By the joint posterior, and by the paper's procedure, step after step.
    procedure : {"joint", "paper"}
        Which of them is kept.
    lab : LabData
        What was measured.
    model : ReducedModel
        The model of the tailored design.
    static, static_published : StaticCalibration
        Step 2 alone, on the stiffness of this model and on the published line.
    """

    joint: Calibration
    paper: Calibration
    procedure: Procedure
    lab: LabData
    model: ReducedModel
    static: StaticCalibration
    static_published: StaticCalibration

    @property
    def result(self) -> Calibration:
        """What the twin is tailored with."""
        return self.paper if self.procedure == "paper" else self.joint

    @property
    def table_1(self) -> tuple[TableRow, ...]:
        """The rows of Table 1 of the paper."""
        return table_1(self.result, self.paper, self.static_published.particle)

    def save(self, path: Path | str) -> Path:
        """Write what the twin is tailored with, whole or not at all; `load_calibration` reads it."""
        return save_calibration(self.result, path)


def calibrate_wing(
    lab: LabData | str | Path | None = None,
    design: WingDesign | None = None,
    *,
    asset: str | None = None,
    procedure: Procedure = "joint",
    seed: int = 0,
    progress: Progress | None = None,
) -> WingCalibration:
    """Calibrate planform, stiffness, masses and damping of one wing: Kapteyn et al. 2021, Table 1.

    Parameters
    ----------
    lab : LabData or path, optional
        What was measured, or the lab folder that holds it; the published figures if left out.
    design : WingDesign, optional
        The wing as drawn; the shipped one by default. Its planform follows the measured lengths.
    asset : str, optional
        Name of the wing; that of the design by default.
    procedure : {"joint", "paper"}
        Whose samples are kept: of the joint posterior, or of the paper's steps one after another.
    seed : int
        Seed of all samples.
    progress : Progress, optional
        Where the steps are reported.

    Raises
    ------
    CalibrationError
        If a step cannot be done; one class for each cause.
    FiniteElementError
        If the tailored wing cannot be built.
    """
    progress = progress or SilentProgress()
    if not isinstance(lab, LabData):
        lab = published_data() if lab is None else read_lab_folder(Path(lab))
    drawn = design or load_design()
    name = check_name(drawn.name if asset is None else asset)
    tailored = tailored_design(drawn, lab.lengths)
    model = reduced_model(tailored, progress=progress)
    with progress.stage("Step 2: Young's modulus factor"):
        curve = stiffness_curve_of(model, "tip stiffness of the tailored model")
        static = calibrate_static(curve, lab.pairs, seed)
        published = calibrate_static(PUBLISHED_LINE, lab.pairs, seed)
    modal = published_modal_measurement() if lab.trials is None else modal_measurement(lab.trials)
    with progress.stage("Step 3: masses and damping, the paper's procedure"):
        factors = static.exact.samples(child_seed(seed, _PAPER_PURPOSE), PAPER_SAMPLE_COUNT, stratified=True)
        paper = calibrate_dynamics(model, factors, modal, total_mass=lab.total_mass.mass)
    with progress.stage("Step 3: masses and damping, joint posterior"):
        joint = joint_posterior(
            model, lab.pairs, modal, total_mass=lab.total_mass, seed=seed, count=SAMPLE_COUNT
        )
    priors = (*wing_priors(model.validity), *_length_priors(lab.lengths))
    prior = prior_samples(priors, SAMPLE_COUNT, seed)
    prior = np.column_stack([prior, quantities_of(model, prior)])

    def record(way: Procedure, state: Float) -> Calibration:
        lengths = _lengths(lab.lengths, len(state), seed)
        found = Calibration(
            asset=name,
            model=tailored.name,
            model_hash=tailored.hash,
            procedure=way,
            priors=priors,
            samples=np.column_stack([state, lengths, quantities_of(model, state)]),
            prior_samples=prior,
            explained=None,
            findings=(),
            channels=(_fit(static, float(state[:, 0].mean())),),
            source="; ".join(origin.text for origin in lab.origins),
            seed=seed,
            provenance=_provenance(lab, drawn, seed),
            design_hash=tailored.hash,
            quantities=QUANTITIES,
            readings=_readings(lab, modal),
            measured=_measured(lab.pairs),
            design=tailored,
        )
        return replace(found, findings=tuple(disagreements(found, lab, static.quality)))

    ways = record("joint", joint.samples), record("paper", paper.samples)
    return WingCalibration(*ways, procedure, lab, model, static, published)


def _provenance(lab: LabData, drawn: WingDesign, seed: int) -> Mapping[str, Any]:
    """Return of what the calibration was made."""
    return collect_provenance(
        seed,
        input_hashes={**lab.input_hashes, "design": drawn.hash},
        packages=("calibration", "fe"),
        distributions=("uav-twin", "numpy", "scipy", "scikit-fem"),
    ).as_dict()


def _fit(static: StaticCalibration, factor: float) -> ChannelFit:
    """Return how far the load test is from the model at the prior mean of e and at a calibrated one."""
    before, after = (
        float(np.sqrt(np.mean(assess_fit(static.data, stiffness).standardised_residual ** 2)))
        for stiffness in static.curve.stiffness([static.prior.mean, factor]).tolist()
    )
    return ChannelFit("load test", "fitted", static.data.count, before, after)


def quantities_of(model: ReducedModel, samples: Float) -> Float:
    """Return `QUANTITIES` of a healthy wing at samples (N, 5 or more) of `STATE`, SI.

    Raises
    ------
    OutsideValidityError
        If a sample lies where the model does not hold.
    """
    for prior, column in zip(wing_priors(model.validity)[:3], samples.T, strict=False):
        outside = column[~((column >= prior.low) & (column <= prior.high))]
        if outside.size:
            unit = "" if prior.unit == "1" else f" {prior.unit}"
            raise OutsideValidityError(
                f"a sample of the {prior.title} is {outside[0]:.4g}{unit}, but the model holds for "
                f"{prior.low:g} to {prior.high:g}{unit}; check the measurements."
            )
    found = np.empty((len(samples), len(QUANTITIES)))
    for row, (factor, servo, pitot, alpha, beta) in enumerate(samples[:, : len(STATE)].tolist()):
        modes = model.modes(young_modulus_factor=factor, servo_mass=servo, pitot_mass=pitot)
        frequency = modes.frequency[list(modes.followed)]
        ratio = rayleigh_damping_ratio(alpha, beta, frequency)
        found[row] = model.tip_stiffness(factor), *frequency, *ratio, 2.0 * servo + pitot
    return found


def _length_priors(lengths: GeometryCalibration) -> tuple[ParameterPrior, ...]:
    return tuple(
        ParameterPrior(
            length.name, "m", length.prior.mean, length.prior.standard_deviation,
            0.9 * length.designed, 1.1 * length.designed, "design tolerance",
        )
        for length in lengths.lengths
    )  # fmt: skip


def _lengths(lengths: GeometryCalibration, count: int, seed: int) -> Float:
    """Return samples (count, 3) of the posterior of the lengths [m]."""
    generator = np.random.default_rng(child_seed(seed, _LENGTHS_PURPOSE))
    strata = (np.arange(count) + generator.random(count)) / count
    return np.column_stack(
        [length.posterior.quantile(generator.permutation(strata)) for length in lengths.lengths]
    )


def _readings(lab: LabData, modal: ModalMeasurement) -> tuple[Reading, ...]:
    """Return every single number that was measured."""
    pairs = lab.pairs
    # The stiffness that the pairs show by themselves: least squares through the origin.
    square = float(pairs.displacement @ pairs.displacement)
    stiffness = float(pairs.load @ pairs.displacement) / square
    scatter = np.hypot(pairs.load_standard_deviation, stiffness * pairs.displacement_standard_deviation)
    return (
        *(
            Reading(length.name, "planform", length.measured, length.reading_uncertainty / HALF_WIDTH_95)
            for length in lab.lengths.lengths
        ),
        Reading("tip_stiffness", "load test", stiffness, float(scatter / np.sqrt(square))),
        Reading("weighed_mass", "weighing", *lab.total_mass),
        *(
            Reading(
                f"{kind}_{mode + 1}", "ring-down",
                getattr(modal, kind)[mode], getattr(modal, f"{kind}_standard_deviation")[mode],
            )
            for kind in ("frequency", "damping_ratio")
            for mode in (0, 1)
        ),
    )  # fmt: skip


def _measured(pairs: LoadDisplacementData) -> xr.Dataset:
    """Return the load test as arrays with units."""
    columns = {
        "load": (pairs.load, "N", pairs.load_standard_deviation),
        "displacement": (pairs.displacement, "m", pairs.displacement_standard_deviation),
        "run": (pairs.run, "1", 0.0),
    }
    return xr.Dataset(
        {
            name: (
                "pair",
                values,
                {"units": unit, "long_name": f"{name} of the test", "deviation": deviation},
            )
            for name, (values, unit, deviation) in columns.items()
        }
    )
