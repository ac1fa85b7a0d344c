"""Calibrate a wing from a laboratory's measurements."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from calibration.errors import CalibrationRecordError
from calibration.geometry import Lengths, tailored_design
from calibration.joint.posterior import joint_posterior
from calibration.joint.wing_table import QUANTITIES, tabulate_wing, wing_priors
from calibration.result.file import save_calibration
from calibration.result.record import (
    Calibration,
    ChannelFit,
    QuantityReading,
    check_name,
    prior_samples,
)
from calibration.static.errors_in_variables import assess_fit
from calibration.static.experiments import LoadDisplacementData
from calibration.static.load_test import StaticCalibration, calibrate_static
from calibration.static.posterior import child_seed
from calibration.wing.disagreements import disagreements
from calibration.wing.lab_data import LabData, published_data, read_lab_folder
from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign, load_design
from reporting.arrays import Float
from reporting.progress import Progress, reporter
from reporting.provenance import collect_provenance
from reporting.words import brief

SAMPLE_COUNT = 1000
"""Number of samples of the posterior that a calibration stores."""

_LENGTHS_PURPOSE = 35  # of the seed: the samples of the lengths


@dataclass(frozen=True, eq=False)
class WingCalibration:
    """The calibration of a wing with the contents of its report.

    Attributes
    ----------
    result : Calibration
        The calibration, which tailors the twin.
    model : ReducedModel
        The model of the tailored design.
    static : StaticCalibration
        The result of step 2 alone.
    """

    result: Calibration
    lab: LabData
    model: ReducedModel
    static: StaticCalibration

    def __repr__(self) -> str:
        return brief(self, result=self.result)

    def save(self, path: Path | str) -> Path:
        """Write the calibration atomically; `load_calibration` reads it."""
        return save_calibration(self.result, path)


def calibrate(
    lab: LabData | str | Path | None = None,
    design: WingDesign | None = None,
    *,
    asset: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> WingCalibration:
    """Calibrate planform, stiffness, masses and damping of one wing, as in Kapteyn et al. 2021.

    Parameters
    ----------
    lab : LabData or path, optional
        The measurements, or the lab folder that holds them; the published ones by default.
    design : WingDesign, optional
        The wing as drawn; the shipped one by default. It gets the measured planform.
    asset : str, optional
        The name of the wing; that of the design by default.

    Raises
    ------
    CalibrationError
        If a step cannot be done; one class for each cause.
    FiniteElementError
        If the tailored wing cannot be built.
    """
    if seed not in range(2**63):
        raise CalibrationRecordError(
            f"`seed` must be a whole number from 0 to 2^63 - 1, but {seed!r} was given."
        )
    progress = reporter(progress)
    if lab is None:
        lab = published_data()
    elif not isinstance(lab, LabData):
        lab = read_lab_folder(Path(lab))
    drawn = design or load_design()
    name = check_name(drawn.name if asset is None else asset)
    tailored = tailored_design(drawn, lab.lengths)
    model = reduced_model(tailored, progress=progress)
    with progress.stage("Step 2: Young's modulus factor"):
        table = tabulate_wing(model)
        static = calibrate_static(table.stiffness, lab.pairs)
    with progress.stage("Step 3: masses and damping"):
        states = joint_posterior(table, lab.pairs, lab.readings, seed=seed, count=SAMPLE_COUNT)

    # record of the samples, with lengths and outputs of the model
    priors = (*wing_priors(table.validity), *(length.prior for length in lab.lengths))
    prior_states = prior_samples(priors, SAMPLE_COUNT, seed)
    lengths = _length_samples(lab.lengths, len(states), seed)
    samples_of_e, *_ = states.T
    result = Calibration(
        asset=name,
        model=tailored.name,
        model_hash=tailored.hash,
        procedure="joint",
        priors=priors,
        samples=np.column_stack([states, lengths, table.outputs(states)]),
        prior_samples=np.column_stack([prior_states, table.outputs(prior_states)]),
        explained=None,
        findings=(),
        channels=_channel_fits(static, float(samples_of_e.mean())),
        source="; ".join(origin.text for origin in lab.origins),
        seed=seed,
        provenance=collect_provenance(
            seed,
            input_hashes={**lab.input_hashes, "design": drawn.hash},
            packages=("calibration", "fe"),
            distributions=("uav-twin", "numpy", "scipy", "scikit-fem"),
        ).as_dict(),
        design_hash=tailored.hash,
        quantities=QUANTITIES,
        readings=_all_readings(lab),
        measured=_load_test_dataset(lab.pairs),
        design=tailored,
    )
    findings = tuple(disagreements(result, lab, static.quality))
    return WingCalibration(replace(result, findings=findings), lab, model, static)


def _channel_fits(static: StaticCalibration, calibrated_factor: float) -> tuple[ChannelFit, ...]:
    """Return the rms residuals of each loading run before and after the calibration.

    Before the calibration, e has its prior mean; after it, `calibrated_factor`.
    """
    data = static.data
    factors = [static.prior.mean, calibrated_factor]
    prior_stiffness, calibrated_stiffness = static.curve.stiffness(factors).tolist()
    squares_before = assess_fit(data, prior_stiffness).standardised_residual ** 2
    squares_after = assess_fit(data, calibrated_stiffness).standardised_residual ** 2
    fits = []
    for run in data.run_indices:
        is_in_run = data.run == run
        fits.append(
            ChannelFit(
                name=f"load test, run {run + 1}",
                trials="fitted",
                readings=int(is_in_run.sum()),
                before=float(np.sqrt(squares_before[is_in_run].mean())),
                after=float(np.sqrt(squares_after[is_in_run].mean())),
            )
        )
    return tuple(fits)


def _length_samples(lengths: Lengths, count: int, seed: int) -> Float:
    """Return samples (count, 3) of the posterior of semi-span and chords [m]."""
    generator = np.random.default_rng(child_seed(seed, _LENGTHS_PURPOSE))
    strata = (np.arange(count) + generator.random(count)) / count
    samples_of_lengths = [
        length.posterior.quantile(generator.permutation(strata)) for length in lengths
    ]
    return np.column_stack(samples_of_lengths)


def _all_readings(lab: LabData) -> tuple[QuantityReading, ...]:
    """Return all readings of a laboratory: lengths, tip stiffness, mass and modes."""
    pairs = lab.pairs
    # The stiffness k by the pairs alone: least squares of f = k x, so k = f'x / x'x with the
    # variance S / x'x, where S is the variance of f - k x.
    displacement_square = float(pairs.displacement @ pairs.displacement)
    stiffness = float(pairs.load @ pairs.displacement) / displacement_square
    load_deviation = np.hypot(
        pairs.load_standard_deviation, stiffness * pairs.displacement_standard_deviation
    )
    deviation = float(load_deviation / np.sqrt(displacement_square))
    tip_stiffness = QuantityReading("tip_stiffness", "load test", stiffness, deviation)
    return (*(length.reading for length in lab.lengths), tip_stiffness, *lab.readings)


def _load_test_dataset(pairs: LoadDisplacementData) -> xr.Dataset:
    """Return the load test as a dataset, with units and reading errors as attributes."""
    dataset = xr.Dataset()
    for name, values, unit, deviation in (
        ("load", pairs.load, "N", pairs.load_standard_deviation),
        ("displacement", pairs.displacement, "m", pairs.displacement_standard_deviation),
        ("run", pairs.run, "1", 0.0),
    ):
        attributes = {"units": unit, "long_name": f"{name} of the test", "deviation": deviation}
        dataset[name] = "pair", values, attributes
    return dataset
