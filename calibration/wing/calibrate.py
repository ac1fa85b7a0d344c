"""Calibrate a wing from a laboratory's measurements."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import xarray as xr

from calibration.errors import CalibrationRecordError
from calibration.geometry import Lengths, tailored_design
from calibration.joint.posterior import joint_posterior
from calibration.joint.wing_table import QUANTITIES, WingTable, tabulate_wing, wing_priors
from calibration.paper.figures import TableRow, table_1
from calibration.paper.load_test import StaticCalibration, calibrate_static
from calibration.paper.procedure import fit_masses
from calibration.result.file import save_calibration
from calibration.result.record import (
    Calibration,
    ChannelFit,
    Procedure,
    QuantityReading,
    check_name,
    prior_samples,
)
from calibration.static.errors_in_variables import assess_fit
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import PUBLISHED_LINE, child_seed
from calibration.wing.disagreements import disagreements
from calibration.wing.lab_data import LabData, published_data, read_lab_folder
from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign, load_design
from reporting.arrays import Float
from reporting.choices import require_one_of
from reporting.progress import Progress, reporter
from reporting.provenance import collect_provenance
from reporting.words import brief

SavedProcedure = Literal["joint", "paper"]
"""The procedure whose samples a calibration stores."""

SAMPLE_COUNT = 1000
"""Number of samples of the joint posterior that a calibration stores."""

PAPER_SAMPLE_COUNT = 100
"""Number of samples of e for which masses are fitted, as in the paper."""

_PAPER_PURPOSE = 31  # of the seed: the paper's samples of e
_LENGTHS_PURPOSE = 35  # of the seed: the samples of the lengths


@dataclass(frozen=True, eq=False)
class WingCalibration:
    """The calibration of a wing with the contents of its report.

    Attributes
    ----------
    joint, paper : Calibration
        The calibration by the joint posterior, and by the paper's procedure, step after step.
    procedure : {"joint", "paper"}
        The procedure whose calibration tailors the twin.
    model : ReducedModel
        The model of the tailored design.
    static, static_published : StaticCalibration
        The results of step 2 alone, for the stiffness of this model and for the published line.
    """

    joint: Calibration
    paper: Calibration
    procedure: Procedure
    lab: LabData
    model: ReducedModel
    static: StaticCalibration
    static_published: StaticCalibration

    def __repr__(self) -> str:
        return brief(self, procedure=self.procedure, result=self.result)

    @property
    def result(self) -> Calibration:
        """The calibration that tailors the twin."""
        return self.paper if self.procedure == "paper" else self.joint

    @property
    def table_1(self) -> tuple[TableRow, ...]:
        """The rows of Table 1 of the paper."""
        return table_1(self.result, self.paper, self.static_published.particle)

    def save(self, path: Path | str) -> Path:
        """Write the calibration that tailors the twin atomically; `load_calibration` reads it."""
        return save_calibration(self.result, path)


def _check_request(procedure: SavedProcedure, seed: int) -> None:
    """Raise an error for an unknown procedure, or a seed that is not a 63-bit integer from 0 on."""
    require_one_of(procedure, get_args(SavedProcedure), "procedure")
    if seed not in range(2**63):
        raise CalibrationRecordError(
            f"`seed` must be a whole number from 0 to 2^63 - 1, but {seed!r} was given."
        )


def calibrate(
    lab: LabData | str | Path | None = None,
    design: WingDesign | None = None,
    *,
    asset: str | None = None,
    procedure: SavedProcedure = "joint",
    seed: int = 0,
    progress: Progress | None = None,
) -> WingCalibration:
    """Calibrate planform, stiffness, masses and damping of one wing: Kapteyn et al. 2021, Table 1.

    Parameters
    ----------
    lab : LabData or path, optional
        The measurements, or the lab folder that holds them; the published ones by default.
    design : WingDesign, optional
        The wing as drawn; the shipped one by default. It gets the measured planform.
    asset : str, optional
        The name of the wing; that of the design by default.
    procedure : {"joint", "paper"}
        Whether to store samples of the joint posterior, or of the paper's step-by-step procedure.

    Raises
    ------
    CalibrationError
        If a step cannot be done; one class for each cause.
    FiniteElementError
        If the tailored wing cannot be built.
    InvalidChoiceError
        If `procedure` is another word.
    """
    _check_request(procedure, seed)
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
        static = calibrate_static(table.stiffness, lab.pairs, seed)
        static_published = calibrate_static(PUBLISHED_LINE, lab.pairs, seed)
    with progress.stage("Step 3: masses and damping, the paper's procedure"):
        factors = static.exact.samples(child_seed(seed, _PAPER_PURPOSE), PAPER_SAMPLE_COUNT)
        paper = fit_masses(table.frequency, factors, table.validity, lab.readings)
    with progress.stage("Step 3: masses and damping, joint posterior"):
        joint = joint_posterior(table, lab.pairs, lab.readings, seed=seed, count=SAMPLE_COUNT)
    records = _RecordMaker(
        asset=name,
        drawn=drawn,
        tailored=tailored,
        lab=lab,
        table=table,
        static=static,
        seed=seed,
    )
    return WingCalibration(
        joint=records.record("joint", joint),
        paper=records.record("paper", paper.samples),
        procedure=procedure,
        lab=lab,
        model=model,
        static=static,
        static_published=static_published,
    )


class _RecordMaker:
    """Makes the records of both procedures for one wing."""

    def __init__(
        self,
        *,
        asset: str,
        drawn: WingDesign,
        tailored: WingDesign,
        lab: LabData,
        table: WingTable,
        static: StaticCalibration,
        seed: int,
    ) -> None:
        self._asset = asset
        self._tailored = tailored
        self._lab = lab
        self._table = table
        self._static = static
        self._seed = seed
        self._priors = (
            *wing_priors(table.validity),
            *(length.prior for length in lab.lengths),
        )
        prior_states = prior_samples(self._priors, SAMPLE_COUNT, seed)
        self._prior_samples = np.column_stack([prior_states, table.outputs(prior_states)])
        self._provenance = collect_provenance(
            seed,
            input_hashes={**lab.input_hashes, "design": drawn.hash},
            packages=("calibration", "fe"),
            distributions=("uav-twin", "numpy", "scipy", "scikit-fem"),
        ).as_dict()

    def record(self, procedure: Procedure, states: Float) -> Calibration:
        """Return the calibration by a procedure.

        `states` (N, 5) are its samples of e, masses and Rayleigh coefficients.
        """
        lab = self._lab
        lengths = _length_samples(lab.lengths, len(states), self._seed)
        samples_of_e, *_ = states.T
        calibration = Calibration(
            asset=self._asset,
            model=self._tailored.name,
            model_hash=self._tailored.hash,
            procedure=procedure,
            priors=self._priors,
            samples=np.column_stack([states, lengths, self._table.outputs(states)]),
            prior_samples=self._prior_samples,
            explained=None,
            findings=(),
            channels=_channel_fits(self._static, float(samples_of_e.mean())),
            source="; ".join(origin.text for origin in lab.origins),
            seed=self._seed,
            provenance=self._provenance,
            design_hash=self._tailored.hash,
            quantities=QUANTITIES,
            readings=_all_readings(lab),
            measured=_load_test_dataset(lab.pairs),
            design=self._tailored,
        )
        findings = disagreements(calibration, lab, self._static.quality)
        return replace(calibration, findings=tuple(findings))


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
