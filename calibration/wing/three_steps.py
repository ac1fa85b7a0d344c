"""The three steps of the calibration in order: from the measurements of a wing to what tailors its twin."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.dynamics.masses_and_damping import DynamicCalibration, DynamicTargets, calibrate_dynamics
from calibration.errors import OutsideValidityError
from calibration.geometry import GeometryCalibration
from calibration.joint import (
    JointPosterior,
    ModalMeasurement,
    joint_posterior,
    modal_measurement,
    published_modal_measurement,
)
from calibration.samples.record import check_name
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import child_seed
from calibration.static.record import StaticCalibration
from calibration.static.stiffness import PUBLISHED_LINE, calibrate_static, stiffness_curve_of
from fe.reduction.model_cache import reduced_model
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign, load_design
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance

from .lab_data import LabData, published_data, read_lab_folder
from .result import (
    QUANTITIES,
    STATE,
    CalibrationResult,
    Procedure,
    measured_quantities,
)
from .result_file import save_calibration
from .steps import (
    CalibrationStep,
    StepReward,
    Update,
    error_reward,
    gaussian_reward,
    moment_reward,
    update_of_densities,
    update_of_samples,
)
from .tailoring import tailored_design

Float = NDArray[np.float64]

SAMPLE_COUNT = 1000
"""Samples of the joint posterior that a calibration keeps."""

PAPER_SAMPLE_COUNT = 100
"""Samples of e for which masses are sought, as in the paper."""

_PAPER_PURPOSE = 31  # of the seed: the samples of e of the paper's step 3


@dataclass(frozen=True, eq=False)
class WingCalibration:
    """The calibration of a wing with everything that its report shows.

    Attributes
    ----------
    result : CalibrationResult
        What the twin is tailored with.
    lab : LabData
        What was measured.
    model : ReducedModel
        The model of the tailored design.
    static, static_published : StaticCalibration
        Step 2 on the stiffness of this model, and on the published line.
    paper : DynamicCalibration
        Step 3 by the paper's procedure.
    joint : JointPosterior
        Step 3 together with step 2.
    """

    result: CalibrationResult
    lab: LabData
    model: ReducedModel
    static: StaticCalibration
    static_published: StaticCalibration
    paper: DynamicCalibration
    joint: JointPosterior

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
    model_of: Callable[[WingDesign], ReducedModel] | None = None,
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
    model_of : callable, optional
        Gives the reduced model of the tailored design; `fe.reduction.model_cache.reduced_model` by default.

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
    model = (model_of or (lambda wing: reduced_model(wing, progress=progress)))(tailored)
    with progress.stage("Step 2: Young's modulus factor"):
        curve = stiffness_curve_of(model, name="tip stiffness of the tailored model")
        static = calibrate_static(curve, lab.pairs, seed)
        published = calibrate_static(PUBLISHED_LINE, lab.pairs, seed)
    modal = published_modal_measurement() if lab.trials is None else modal_measurement(lab.trials)
    with progress.stage("Step 3: masses and damping, the paper's procedure"):
        paper = _paper_way(model, lab, static, modal, seed)
    with progress.stage("Step 3: masses and damping, joint posterior"):
        joint = joint_posterior(
            model, lab.pairs, modal, total_mass=lab.total_mass, seed=seed, count=SAMPLE_COUNT
        )
    paper_samples = np.column_stack([paper.young_modulus_factor, paper.samples])
    paper_quantities = quantities_of(model, paper_samples)
    prior_quantities = quantities_of(model, joint.prior_samples)
    joint_quantities = quantities_of(model, joint.samples)
    ways: dict[Procedure, tuple[Float, Float]] = {
        "joint": (joint.samples, joint_quantities),
        "paper": (paper_samples, paper_quantities),
    }
    samples, quantities = ways[procedure]
    thirds = {
        way: _modal_step(way, modal, joint.prior_samples, prior_quantities, *found)
        for way, found in ways.items()
    }
    other: Procedure = "paper" if procedure == "joint" else "joint"
    result = CalibrationResult(
        asset=name,
        design=tailored,
        geometry=lab.lengths,
        procedure=procedure,
        samples=samples,
        prior_samples=joint.prior_samples,
        quantity_samples=quantities,
        prior_quantity_samples=prior_quantities,
        pairs=lab.pairs,
        total_mass=lab.total_mass,
        modal=modal,
        steps=(_geometry_step(lab.lengths), _static_step(static), thirds[procedure], thirds[other]),
        seed=seed,
        provenance=_provenance(lab, drawn, seed),
    )
    return WingCalibration(result, lab, model, static, published, paper, joint)


def _paper_way(
    model: ReducedModel, lab: LabData, static: StaticCalibration, modal: ModalMeasurement, seed: int
) -> DynamicCalibration:
    """Return step 3 by the paper's procedure: masses and damping for each of some samples of e."""
    factors = static.exact.samples(child_seed(seed, _PAPER_PURPOSE), PAPER_SAMPLE_COUNT, stratified=True)
    targets = DynamicTargets(modal.frequency, modal.damping_ratio)
    return calibrate_dynamics(
        model, factors, targets, total_mass=lab.total_mass.mass, source="tailored model"
    )


def _provenance(lab: LabData, drawn: WingDesign, seed: int) -> dict[str, Any]:
    """Return of what the calibration was made."""
    return collect_provenance(
        seed,
        input_hashes={**lab.input_hashes, "design": drawn.hash},
        packages=("calibration", "fe"),
        distributions=("uav-twin", "numpy", "scipy", "scikit-fem", "pymor"),
    ).as_dict()


def quantities_of(model: ReducedModel, samples: Float) -> Float:
    """Return `QUANTITIES` of a healthy wing at samples of `STATE`: (N, 5) to (N, 5), SI.

    Raises
    ------
    OutsideValidityError
        If a sample lies where the model does not hold.
    """
    found = np.empty((len(samples), len(QUANTITIES)))
    for name, column in zip(STATE[:3], samples.T[:3], strict=True):
        low, high = model.validity[name.name]
        outside = column[~((column >= low) & (column <= high))]
        if outside.size:
            raise OutsideValidityError(
                f"a sample of the {name.title} is {outside[0]:.4g} {name.unit}, but the model holds for "
                f"{low:g} to {high:g}; check the measurements."
            )
    for row, (factor, servo, pitot, alpha, beta) in enumerate(samples.tolist()):
        modes = model.modes(young_modulus_factor=factor, servo_mass=servo, pitot_mass=pitot)
        frequency = modes.frequency[list(modes.followed)]
        found[row, 0] = model.tip_stiffness(factor)
        found[row, 1:3] = frequency
        found[row, 3:5] = rayleigh_damping_ratio(alpha, beta, frequency)
    return found


def _geometry_step(lengths: GeometryCalibration) -> CalibrationStep:
    """Return step 1: the lengths, and the planform area as what the mesh is made of."""
    updates = tuple(
        Update(
            length.name, length.name.replace("_", " "), "m",
            length.prior.mean, length.prior.standard_deviation,
            length.posterior.mean, length.posterior.standard_deviation,
            length.measured, length.reading_uncertainty / HALF_WIDTH_95,
        )
        for length in lengths.lengths
    )  # fmt: skip
    prior = _area([(update.prior_mean, update.prior_standard_deviation) for update in updates])
    posterior = _area([(update.posterior_mean, update.posterior_standard_deviation) for update in updates])
    measured = _area(
        [(length.measured, length.reading_uncertainty / HALF_WIDTH_95) for length in lengths.lengths]
    )
    area = Update("planform_area", "area of the half-wing's planform", "m2", *prior, *posterior, *measured)
    diagonal = (
        np.array([update.prior_mean for update in updates]),
        np.diag([update.prior_standard_deviation**2 for update in updates]),
    )
    after = (
        np.array([update.posterior_mean for update in updates]),
        np.diag([update.posterior_standard_deviation**2 for update in updates]),
    )
    return CalibrationStep(
        1, "Planform", "design tolerance and measured lengths, Gaussian", lengths.source,
        updates, (area,), moment_reward((area,), diagonal, after),
    )  # fmt: skip


def _area(lengths: list[tuple[float, float]]) -> tuple[float, float]:
    """Return area of the half-wing's planform and its standard deviation, to first order [m^2]."""
    (span, of_span), (root, of_root), (tip, of_tip) = lengths
    spread = np.hypot(0.5 * (root + tip) * of_span, 0.5 * span * np.hypot(of_root, of_tip))
    return 0.5 * span * (root + tip), float(spread)


def _static_step(static: StaticCalibration) -> CalibrationStep:
    """Return step 2: e, and the tip stiffness."""
    load, displacement = static.data.load, static.data.displacement
    # The stiffness that the pairs show by themselves: least squares through the origin.
    measured = float(load @ displacement / (displacement @ displacement))
    scatter = np.hypot(
        static.data.load_standard_deviation, measured * static.data.displacement_standard_deviation
    )
    stiffness = update_of_densities(
        "tip_stiffness", "tip stiffness", "N/m", static.tip_stiffness_prior, static.tip_stiffness_exact,
        (measured, float(scatter / np.sqrt(displacement @ displacement))),
    )  # fmt: skip
    factor = Update(
        STATE[0].name, STATE[0].title, STATE[0].unit,
        static.prior.mean, static.prior.standard_deviation,
        static.exact.mean, static.exact.standard_deviation,
    )  # fmt: skip
    reward = StepReward(
        error_reward((stiffness,), "prior"),
        error_reward((stiffness,), "posterior"),
        static.reward.uncertainty_reduction,
        static.reward.information_gain,
    )
    return CalibrationStep(
        2,
        "Load test",
        f"exact posterior, {static.curve.name}",
        static.data.source,
        (factor,),
        (stiffness,),
        reward,
    )


_WAYS: dict[Procedure, str] = {
    "joint": "joint posterior of stiffness, masses and damping",
    "paper": "the paper's: masses by eqs. (19), (20), damping by eq. (25), for each sample of e",
}


def _modal_step(
    procedure: Procedure,
    modal: ModalMeasurement,
    prior: Float,
    prior_quantities: Float,
    samples: Float,
    quantities: Float,
) -> CalibrationStep:
    """Return step 3: all five figures, and stiffness, frequencies and damping ratios."""
    state = tuple(
        update_of_samples(entry.name, entry.title, entry.unit, prior[:, index], samples[:, index])
        for index, entry in enumerate(STATE)
    )
    measured = measured_quantities(modal)
    follows = tuple(
        update_of_samples(
            entry.name, entry.title, entry.unit,
            prior_quantities[:, index], quantities[:, index], measured.get(entry.name),
        )
        for index, entry in enumerate(QUANTITIES)
    )  # fmt: skip
    return CalibrationStep(
        3,
        "Ring-down",
        _WAYS[procedure],
        modal.source,
        state,
        follows,
        gaussian_reward(follows, prior, samples),
    )
