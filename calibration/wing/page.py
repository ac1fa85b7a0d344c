"""The page and the folder of a wing's calibration."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from calibration.dynamics.figures import ring_down_figure
from calibration.paper.figures import calibration_figure
from calibration.paper.load_test import push_forward
from calibration.paper.table_1 import HEADINGS, write_table_1
from calibration.result.figures import corner_figure
from calibration.result.folder import drawing_names, write_calibration_folder
from calibration.result.page import drawn_parameters
from calibration.result.text import with_deviation
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.reduction.model_cache import wing_fields
from reporting.page import Column, Page, Table
from reporting.progress import Progress

from .calibrate import WingCalibration
from .figures import modes_figure

SOURCE = (
    "M. G. Kapteyn, J. V. R. Pretorius, K. E. Willcox: A probabilistic graphical model foundation for "
    "enabling predictive digital twins at scale. Nature Computational Science 1 (2021) 337-347. "
    "doi:10.1038/s43588-021-00069-0"
)
FIGURE_NAMES = ("load_test", "procedure", "modes", "ring_down")
"""All that a wing's page has beyond that of any calibration, the last where there are records."""

_EARLIER_FIGURES = ("masses", "quantities", "residuals")
"""What earlier versions drew; it would show another calibration than the file beside it."""

LOAD_FACTOR = 3.0
"""Of the turn in which `wing.vtu` shows the wing."""

TABLE_NAME, WING_FIELDS, MODE_FIELDS = "table_1.csv", "wing.vtu", "modes.vtu"


def write_wing_folder(
    calibration: WingCalibration, folder: Path, progress: Progress, *, report: bool = True
) -> Path:
    """Write page, figures, table, the wing for ParaView, and last `calibration.nc`; return its path.

    Without a report, table and `calibration.nc` alone.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    fields = wing_fields(calibration.result.design, progress=progress) if report else None

    def write_others(fresh: Path) -> None:
        write_table_1(calibration.table_1, fresh / TABLE_NAME)
        if fields is not None:
            state = calibration.result.mean_state()
            vector = fields.model.vector(state.values, state.stiffness_loss, load_factor=LOAD_FACTOR)
            write_wing_vtu(fresh / WING_FIELDS, fields, vector)
            write_modes_vtu(fresh / MODE_FIELDS, fields, vector)

    return write_calibration_folder(
        calibration.result,
        folder,
        progress,
        report=report,
        figures=lambda: {} if fields is None else _figures(calibration, fields),
        extra=lambda page, drawings: _add_sections(page, calibration, drawings),
        companions=[WING_FIELDS, MODE_FIELDS, *drawing_names((*FIGURE_NAMES, *_EARLIER_FIGURES))],
        write_others=write_others,
    )


def _figures(calibration: WingCalibration, fields: WingFields) -> Mapping[str, Figure]:
    state = calibration.result.mean_state()
    modes = calibration.model.modes(state.values, state.stiffness_loss)
    flapwise = dict(zip(modes.followed, ("first flapwise", "second flapwise"), strict=True))
    titles = [
        f"mode {index + 1}, {frequency:.2f} Hz" + (f", {flapwise[index]}" if index in flapwise else "")
        for index, frequency in enumerate(modes.frequency[:6])
    ]
    places, names = drawn_parameters(calibration.joint)
    sets = [
        ("joint posterior", calibration.joint.samples[:, places]),
        ("the paper's procedure", calibration.paper.samples[:, places]),
    ]
    if calibration.lab.authors is not None:
        sets.append(("authors' model", calibration.lab.authors.samples))
    drawn = [
        calibration_figure(calibration.static),
        corner_figure(names, sets),
        modes_figure(fields, modes, titles),
    ]
    if calibration.lab.trials is not None:
        drawn.append(ring_down_figure(calibration.lab.trials))
    return dict(zip(FIGURE_NAMES, drawn, strict=False))


def _add_sections(page: Page, calibration: WingCalibration, drawings: Mapping[str, bytes]) -> None:
    for origin in calibration.lab.origins:
        text = f"Step {origin.step}: {origin.text}."
        if any(other.read for other in calibration.lab.origins) and not origin.read:
            page.add_notice(text)
        else:
            page.add_paragraph(text)
    page.add_section("Beside the paper")
    _add_table_1(page, calibration)
    _add_load_test(page, calibration, drawings)
    page.add_figure(
        drawings["procedure"],
        "Samples of the joint posterior and of the paper's procedure (its histograms have scales of their "
        "own): the masses that meet the measured frequencies best under the weighed total, eqs. (19) and "
        "(20), and the Rayleigh coefficients of eq. (25), for each sample of e"
        + ("; grey are the authors' published samples." if calibration.lab.authors else "."),
        title="Masses and damping by the paper's procedure",
    )
    page.add_section("Ring-down")
    if "ring_down" in drawings:
        page.add_figure(
            drawings["ring_down"],
            "(a) The first trial with the fitted sum of two damped cosines and its envelopes. (b) Spectra "
            "of all trials. (c), (d) Frequency and damping of the first mode in windows of 0.8 s over its "
            "amplitude; a linear wing would show one value.",
            title="Ring-down records, fits and spectra",
        )
    else:
        page.add_paragraph(
            "No ring-down record was read: step 3 aims at the published frequencies and damping ratios."
        )
    page.add_section("The calibrated wing")
    page.add_figure(
        drawings["modes"],
        "Mode shapes of the upper skin at the posterior mean, healthy; the colour is the length of the "
        "displacement, from none (dark) to the largest (light); grey is the wing at rest. The leading "
        "edge is at the back. modes.vtu has them for ParaView, wing.vtu the wing in a 3g turn. The design is "
        "tailored to the measured planform, rounded to 0.1 mm, and meshed anew.",
        title="Mode shapes",
    )


def _add_table_1(page: Page, calibration: WingCalibration) -> None:
    page.add_table(
        Table(
            tuple(Column(name, numeric=at > 0) for at, name in enumerate(HEADINGS)),
            [row.cells for row in calibration.table_1],
        ),
        "Mean ± standard deviation. The paper's procedure: e by its particle filter on its stiffness line, "
        "then masses by eqs. (19), (20) and damping by eq. (25) on the tailored model for each sample of e; "
        "its standard deviations hold the uncertainty of e alone. In the paper: planform and e are printed "
        "in its Table 1; masses are the means of the authors' published samples of step 3, alpha and beta "
        "follow from their frequencies by eq. (25). Difference: this wing less the paper's, which is of its "
        f"own wing. table_1.csv has all figures in SI. {SOURCE}",
        title="This calibration beside Table 1 of the paper",
    )


def _add_load_test(page: Page, calibration: WingCalibration, drawings: Mapping[str, bytes]) -> None:
    page.add_figure(
        drawings["load_test"],
        "(a) Measured pairs with 95 % intervals; 95 % bands of f = k(e) x before (grey) and after (blue) "
        "the calibration. (b) Prior, the kernel likelihood of each pair, and the posterior by quadrature "
        "and by the particle filter. (c) The tip stiffness, before and after. After Fig. 5 of the paper.",
        title="Load test, posterior of e and of the tip stiffness",
    )
    rows = []
    for title, found in (
        ("tailored model", calibration.static),
        ("line of the paper, eq. (14)", calibration.static_published),
    ):
        pairs = [("exact", found.exact, found.tip_stiffness_exact)]
        pairs += [
            (f"exact, {name}", e, push_forward(e, found.curve)) for name, e in found.alternatives.items()
        ]
        pairs.append(("particle filter", found.particle.posterior, found.tip_stiffness_particle))
        for way, e, k in pairs:
            told = (with_deviation(item.mean, item.standard_deviation) for item in (e, k))
            rows.append((title, way, *told))
    page.add_table(
        Table(
            (
                Column("stiffness k(e)"),
                Column("posterior"),
                Column("e", numeric=True),
                Column("k", "N/m", numeric=True),
            ),
            rows,
        ),
        "e is the factor on the Young's modulus of the model that gives k(e): two models need two factors to "
        "have the measured stiffness. The prior is flat in the true displacement of a pair; beside it: flat "
        "in the true load, the density of the ratio of load and displacement (to which the particle filter "
        "tends), and a zero offset of the displacement, as uncertain as a reading, that each run shares.",
        title="e on the tailored model and on the published line, by the load test alone",
    )
