"""The calibration of a wing: from its laboratory's measurements to what tailors its twin, and its page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from calibration.dynamics.figures import ring_down_figure
from calibration.dynamics.trials import PUBLISHED_DAMPING_RATIOS, amplitude_dependence, average
from calibration.errors import CalibrationRecordError, said
from calibration.geometry import Lengths, tailored_design
from calibration.joint.posterior import joint_posterior
from calibration.joint.wing_table import QUANTITIES, tabulate_wing, wing_priors
from calibration.paper.figures import WORDS as TABLE_1
from calibration.paper.figures import TableRow, calibration_figure, table_1, write_table_1
from calibration.paper.load_test import StaticCalibration, calibrate_static, push_forward
from calibration.paper.procedure import fit_masses
from calibration.result.figures import corner_figure, drawn_parameters
from calibration.result.file import FILE_NAME, save_calibration
from calibration.result.folder import (
    MODE_FIELDS,
    WING_FIELDS,
    add_figure,
    begun_page,
    calibration_folder,
    end_page,
)
from calibration.result.record import Calibration, ChannelFit, Procedure, Reading, check_name, prior_samples
from calibration.static.errors_in_variables import FitQuality, assess_fit
from calibration.static.experiments import LoadDisplacementData, published_measurements
from calibration.static.posterior import PUBLISHED_LINE, child_seed
from calibration.wing.lab_data import LabData, published_data, read_lab_folder
from fe.reduction.model_cache import WingFields, reduced_model, wing_fields, write_modes_vtu, write_wing_vtu
from fe.runtime.reduced import Modes, ReducedModel
from fe.wing.design import WingDesign, load_design
from reporting import figures as style
from reporting.arrays import Float
from reporting.choices import require_one_of
from reporting.page import Page, Words
from reporting.progress import Progress, reporter, stage
from reporting.provenance import collect_provenance
from reporting.words import brief, capital, plus_minus

KeptProcedure = Literal["joint", "paper"]
"""Procedure whose samples a calibration keeps."""

NOTICEABLE = 2.0
"""Standard deviations from which a difference is pointed out."""

NOTICEABLE_FREQUENCY = 0.02
"""Relative difference from which that of a frequency is pointed out, whatever its standard deviation."""

AUTHORS_SECOND_FREQUENCY = 28.613
"""Mean of the authors' model's second flapwise frequency after their calibration [Hz] (step 3)."""


def disagreements(result: Calibration, lab: LabData, quality: FitQuality) -> list[str]:
    """Return sentences on what disagrees with the data; empty where nothing does."""
    found = []
    the_papers = lab.pairs.sha256 == published_measurements().sha256
    figures = {figure.name: figure for figure in result.figures}
    for reading in result.readings:
        name, figure = reading.name, figures[reading.name]
        relative = result.mean(name) / reading.value - 1.0
        far = name.startswith("frequency") and abs(relative) > NOTICEABLE_FREQUENCY
        if not far and abs(result.score(reading)) <= NOTICEABLE:
            continue
        measured = figure.shown(reading.value, reading.deviation)
        model = figure.shown(result.mean(name), result.standard_deviation(name))
        off = _percent(relative), abs(result.score(reading))
        told = {"title": capital(figure.title), "measured": measured, "model": model, "off": off}
        found.append(said("disagreements.figure", **told))
        if name == "frequency_2" and the_papers:
            found[-1] += said("disagreements.authors", frequency=AUTHORS_SECOND_FREQUENCY)
    return found + list(quality.remarks) + _of_the_ring_down(lab, the_papers=the_papers)


def _of_the_ring_down(lab: LabData, *, the_papers: bool) -> list[str]:
    trials = lab.trials
    if trials is None:
        return []
    found = []
    second = average(trials, "damping_ratio", 1).mean
    published = PUBLISHED_DAMPING_RATIOS[1]
    if the_papers and abs(second / published - 1.0) > 0.1:
        off = _percent(second / published - 1.0)
        found.append(said("disagreements.damping", second=100 * second, published=100 * published, off=off))
    points = sorted(
        (point for fit in trials for point in amplitude_dependence(fit)),
        key=lambda point: point.amplitude,
    )
    if len(points) >= 6:
        figures = np.array([(p.frequency, 100 * p.damping_ratio, 1e3 * p.amplitude) for p in points])
        third = len(points) // 3
        large, small = figures[-third:].mean(axis=0).tolist(), figures[:third].mean(axis=0).tolist()
        if abs(small[0] / large[0] - 1.0) > 0.003:
            found.append(said("disagreements.not_linear", large=large, small=small))
    return found


def _percent(value: float) -> str:
    return f"{100.0 * value:+.1f} %".replace("-", "−")


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

    def __repr__(self) -> str:
        return brief(self, procedure=self.procedure, result=self.result)

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


def _check_request(procedure: KeptProcedure, seed: int) -> None:
    """Refuse an unknown procedure, and a seed that is no whole number of 63 bits."""
    require_one_of(procedure, get_args(KeptProcedure), "procedure")
    if seed not in range(2**63):
        raise CalibrationRecordError(f"`seed` must be a whole number from 0 to 2^63 - 1, and {seed!r} came.")


def calibrate(
    lab: LabData | str | Path | None = None,
    design: WingDesign | None = None,
    *,
    asset: str | None = None,
    procedure: KeptProcedure = "joint",
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
    InvalidChoiceError
        If `procedure` is another word.
    """
    _check_request(procedure, seed)
    progress = reporter(progress)
    if not isinstance(lab, LabData):
        lab = published_data() if lab is None else read_lab_folder(Path(lab))
    drawn = design or load_design()
    name = check_name(drawn.name if asset is None else asset)
    tailored = tailored_design(drawn, lab.lengths)
    model = reduced_model(tailored, progress=progress)
    with progress.stage("Step 2: Young's modulus factor"):
        table = tabulate_wing(model)
        static = calibrate_static(table.stiffness, lab.pairs, seed)
        published = calibrate_static(PUBLISHED_LINE, lab.pairs, seed)
    with progress.stage("Step 3: masses and damping, the paper's procedure"):
        factors = static.exact.samples(child_seed(seed, _PAPER_PURPOSE), PAPER_SAMPLE_COUNT)
        paper = fit_masses(table.frequency, factors, table.validity, lab.readings)
    with progress.stage("Step 3: masses and damping, joint posterior"):
        joint = joint_posterior(table, lab.pairs, lab.readings, seed=seed, count=SAMPLE_COUNT)
    priors = (*wing_priors(model.validity), *(length.prior for length in lab.lengths))
    prior = prior_samples(priors, SAMPLE_COUNT, seed)
    prior = np.column_stack([prior, table.outputs(prior)])

    provenance = collect_provenance(
        seed,
        input_hashes={**lab.input_hashes, "design": drawn.hash},
        packages=("calibration", "fe"),
        distributions=("uav-twin", "numpy", "scipy", "scikit-fem"),
    ).as_dict()

    def record(way: Procedure, state: Float) -> Calibration:
        found = Calibration(
            asset=name,
            model=tailored.name,
            model_hash=tailored.hash,
            procedure=way,
            priors=priors,
            samples=np.column_stack([state, _lengths(lab.lengths, len(state), seed), table.outputs(state)]),
            prior_samples=prior,
            explained=None,
            findings=(),
            channels=_fits(static, float(state[:, 0].mean())),
            source="; ".join(origin.text for origin in lab.origins),
            seed=seed,
            provenance=provenance,
            design_hash=tailored.hash,
            quantities=QUANTITIES,
            readings=_readings(lab),
            measured=_measured(lab.pairs),
            design=tailored,
        )
        return replace(found, findings=tuple(disagreements(found, lab, static.quality)))

    ways = record("joint", joint), record("paper", paper.samples)
    return WingCalibration(*ways, procedure, lab, model, static, published)


def _fits(static: StaticCalibration, factor: float) -> tuple[ChannelFit, ...]:
    """Return how far each loading run is from the model at the prior mean of e and at a calibrated one."""
    data = static.data
    before, after = (
        assess_fit(data, stiffness).standardised_residual ** 2
        for stiffness in static.curve.stiffness([static.prior.mean, factor]).tolist()
    )
    return tuple(
        ChannelFit(
            f"load test, run {run + 1}", "fitted", int(of_run.sum()),
            float(np.sqrt(before[of_run].mean())), float(np.sqrt(after[of_run].mean())),
        )
        for run in data.run_indices
        for of_run in [data.run == run]
    )  # fmt: skip


def _lengths(lengths: Lengths, count: int, seed: int) -> Float:
    """Return samples (count, 3) of the posterior of the lengths [m]."""
    generator = np.random.default_rng(child_seed(seed, _LENGTHS_PURPOSE))
    strata = (np.arange(count) + generator.random(count)) / count
    return np.column_stack([length.posterior.quantile(generator.permutation(strata)) for length in lengths])


def _readings(lab: LabData) -> tuple[Reading, ...]:
    """Return every single number that was measured."""
    pairs = lab.pairs
    # The stiffness that the pairs show by themselves: least squares through the origin.
    square = float(pairs.displacement @ pairs.displacement)
    stiffness = float(pairs.load @ pairs.displacement) / square
    scatter = np.hypot(pairs.load_standard_deviation, stiffness * pairs.displacement_standard_deviation)
    load_test = Reading("tip_stiffness", "load test", stiffness, float(scatter / np.sqrt(square)))
    return *(length.reading for length in lab.lengths), load_test, *lab.readings


def _measured(pairs: LoadDisplacementData) -> xr.Dataset:
    """Return the load test as arrays with units."""
    found = xr.Dataset()
    for name, values, unit, deviation in (
        ("load", pairs.load, "N", pairs.load_standard_deviation),
        ("displacement", pairs.displacement, "m", pairs.displacement_standard_deviation),
        ("run", pairs.run, "1", 0.0),
    ):
        attributes = {"units": unit, "long_name": f"{name} of the test", "deviation": deviation}
        found[name] = "pair", values, attributes
    return found


WORDS = Words("calibration.wing")

LOAD_FACTOR = 3.0
"""Of the turn in which `wing.vtu` shows the wing."""

TABLE_NAME = "table_1.csv"


def write_wing_folder(calibration: WingCalibration, folder: Path, *, report: bool = True) -> Path:
    """Write page, figures, table, the wing for ParaView, and last `calibration.nc`; return its path.

    Without a report, table and `calibration.nc` alone.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    result = calibration.result
    fields = wing_fields(result.design) if report else None
    with calibration_folder(result, folder) as fresh:
        write_table_1(calibration.table_1, fresh / TABLE_NAME)
        if fields is not None:
            state = result.mean_state()
            vector = fields.model.vector(state.values, state.stiffness_loss, load_factor=LOAD_FACTOR)
            write_wing_vtu(fresh / WING_FIELDS, fields, vector)
            write_modes_vtu(fresh / MODE_FIELDS, fields, vector)
            with stage("Drawing the report"):
                page = begun_page(result, fresh)
                _add_sections(page, calibration, fields, fresh)
                end_page(page, result, fresh)
    return folder / FILE_NAME


def _add_sections(page: Page, calibration: WingCalibration, fields: WingFields, folder: Path) -> None:
    def show(name: str, figure: Figure, **values: object) -> None:
        add_figure(page, WORDS.figure(name, figure, **values), folder)

    lab, joint = calibration.lab, calibration.joint
    measured = any(origin.read for origin in lab.origins)
    for origin in lab.origins:
        add = page.add_notice if measured and not origin.read else page.add_paragraph
        add(WORDS.say("origin", origin=origin))
    page.add_section("Beside the paper")
    TABLE_1.add_table(page, "table_1", calibration.table_1)
    show("load_test", calibration_figure(calibration.static))
    rows = []
    for title, found in (
        ("tailored model", calibration.static),
        ("line of the paper, eq. (14)", calibration.static_published),
    ):
        ways = [("exact", found.exact), *((f"exact, {name}", e) for name, e in found.alternatives.items())]
        pairs = [(way, e, push_forward(e, found.curve)) for way, e in ways]
        pairs.append(("particle filter", found.particle, found.particle.stiffness))
        for way, e, k in pairs:
            told = (plus_minus(item.mean, item.standard_deviation) for item in (e, k))
            rows.append((title, way, *told))
    WORDS.add_table(page, "two_models", rows)
    places, names = drawn_parameters(joint)
    sets = [
        ("joint posterior", joint.samples[:, places]),
        ("the paper's procedure", calibration.paper.samples[:, places]),
    ]
    if lab.authors is not None:
        sets.append(("authors' model", lab.authors.samples))
    show("procedure", corner_figure(names, sets), authors=lab.authors is not None)
    page.add_section("Ring-down")
    if lab.trials is None:
        page.add_paragraph(WORDS.say("no_record"))
    else:
        show("ring_down", ring_down_figure(lab.trials))
    page.add_section("The calibrated wing")
    state = calibration.result.mean_state()
    modes = calibration.model.modes(state.values, state.stiffness_loss)
    flapwise = dict(zip(modes.followed, ("first flapwise", "second flapwise"), strict=True))
    titles = [
        f"mode {index + 1}, {frequency:.2f} Hz" + (f", {flapwise[index]}" if index in flapwise else "")
        for index, frequency in enumerate(modes.frequency[:6])
    ]
    show("modes", modes_figure(fields, modes, titles))


@style.publication_style()
def modes_figure(fields: WingFields, modes: Modes, titles: Sequence[str]) -> Figure:
    """Draw the mode shapes of the upper skin in oblique view, coloured by their displacement.

    Parameters
    ----------
    fields : WingFields
        Bases on the mesh.
    modes : Modes
        Of the calibrated wing.
    titles : sequence of str
        One for each mode.
    """
    # the skin and the damage regions in it, see `fe.reduction.model_cache.WingFields`
    skin = fields.cells[fields.region <= len(fields.regions)][:, :8]
    upper = np.unique(skin[fields.points[skin][:, :, 2].mean(axis=1) > 0.0])
    points = fields.points[upper]
    # neighbours seen from above; those at the trailing edge, which is in front, are drawn last
    triangles = Triangulation(points[:, 1], points[:, 0]).triangles
    triangles = triangles[np.argsort(points[triangles, 0].mean(axis=1))]
    span = float(np.ptp(points[:, 1]))
    shapes = (fields.modal_displacement @ modes.shape)[upper]
    rows = (len(titles) + 1) // 2
    figure, grid = style.panels(
        rows, 2, 1.5 * rows, 0.015 * rows, 0.0, wspace=0.06, hspace=0.04, left=0.01, right=0.99
    )
    places = style.keep_first_panels(grid, len(titles))
    for axes, shape, title in zip(places, np.moveaxis(shapes, -1, 0), titles, strict=False):
        length = np.linalg.norm(shape, axis=1)
        largest = float(length.max())
        moved = points + shape * (0.14 * span / largest)
        for (x, y, z), value, colours in (
            (points.T, 0.1 * largest, "Greys"),
            (moved.T, length, style.LEVELS),
        ):
            # oblique: span to the right, chord into the page
            seen = Triangulation(y - 0.45 * x, z - 0.40 * x, triangles)
            shade = np.broadcast_to(value, length.shape)
            axes.tripcolor(seen, shade, cmap=colours, clim=(0.0, largest), shading="gouraud", rasterized=True)
        axes.set(xlim=(-0.09 * span, 1.10 * span), ylim=(-0.24 * span, 0.27 * span), aspect="equal")
        axes.set_axis_off()
        axes.text(0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold")
    return figure
