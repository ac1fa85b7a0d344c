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
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.reduction.model_cache import wing_fields
from reporting.page import Column, Page, Words
from reporting.progress import Progress
from reporting.words import plus_minus

from .calibrate import WingCalibration
from .figures import modes_figure

WORDS = Words("calibration.wing")
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
    def show(name: str, **values: object) -> None:
        page.add_figure(drawings[name], **WORDS.words("figures", name, **values))

    measured = any(origin.read for origin in calibration.lab.origins)
    for origin in calibration.lab.origins:
        add = page.add_notice if measured and not origin.read else page.add_paragraph
        add(WORDS.say("origin", origin=origin))
    page.add_section("Beside the paper")
    heads = [Column(name, numeric=at > 0) for at, name in enumerate(HEADINGS)]
    cells = [row.cells for row in calibration.table_1]
    WORDS.add_table(page, "table_1", cells, more=heads, source=WORDS.say("source"))
    show("load_test")
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
            told = (plus_minus(item.mean, item.standard_deviation) for item in (e, k))
            rows.append((title, way, *told))
    WORDS.add_table(page, "two_models", rows)
    show("procedure", authors=calibration.lab.authors is not None)
    page.add_section("Ring-down")
    if "ring_down" in drawings:
        show("ring_down")
    else:
        page.add_paragraph(WORDS.say("no_record"))
    page.add_section("The calibrated wing")
    show("modes")
