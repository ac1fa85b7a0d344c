"""The report of a run: one self-contained page and its figures, from nothing but the run folder."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.page import Column, Page, Table
from twin_master.assets.asset_source import calibrated_with
from twin_master.errors import RunFolderError
from twin_master.report.belief import belief_figure, policy_figure
from twin_master.report.calibration import (
    CalibrationView,
    calibration_caption,
    calibration_figure,
    calibration_view,
)
from twin_master.report.check import check_figure, predictive_check
from twin_master.report.data import RunRecord
from twin_master.report.learnt import learnt_caption, learnt_figure, learnt_tables
from twin_master.report.mission import mission_figure
from twin_master.report.network import network_figure
from twin_master.report.opening import opening_sentences
from twin_master.report.reading import read_run
from twin_master.report.structure import structure_figure
from twin_master.report.text import (
    belief_caption,
    check_caption,
    lost_ranges,
    mission_caption,
    network_caption,
    number,
    policy_caption,
    turn_ranges,
)
from twin_master.report.view import choose_sensors, default_now, sensor_title, sensor_word, state_scale
from twin_master.store.summary import another_truth
from twin_master.store.writing import REPORT_NAME

FIGURE_FOLDER = "figures"
MAIN_FIGURE = "mission_now"
"""The figure that is also written as PNG."""

_SOURCES = (
    "M. G. Kapteyn, J. V. R. Pretorius, K. E. Willcox: A probabilistic graphical model foundation for "
    "enabling predictive digital twins at scale. Nature Computational Science 1 (2021) 337-347, "
    "arXiv:2012.05841. Equation numbers in the captions are those of this paper.",
    "Colours: M. Okabe, K. Ito, Color Universal Design (2008).",
)


@dataclass(frozen=True)
class ReportFigure:
    """A figure ready for the page.

    Attributes
    ----------
    name
        Name of its file, without ending.
    figure
        The drawing.
    title, caption
        Below it.
    """

    name: str
    figure: Figure
    title: str
    caption: str


@dataclass(frozen=True)
class Drawing:
    """A figure as it stands in the page; the attributes are those of `ReportFigure`."""

    name: str
    svg: bytes
    title: str
    caption: str


def write_report(run_folder: Path | str, *, now: int | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of a run; return the path of the page.

    Equal runs give equal bytes: wall-clock figures stay in ``timing.json``.

    Parameters
    ----------
    run_folder
        Holds ``run.nc`` and, where they exist, ``config.json``, ``summary.json`` and ``calibration.json``.
    now
        The present turn of the first figure; by default shortly before the control first changes.

    Raises
    ------
    RunFolderError
        There is no run, it is damaged or of another layout, or `now` is no turn of it.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    record = read_run(Path(run_folder))
    folder = Path(run_folder) / FIGURE_FOLDER
    drawings = []
    for figure in chain(report_figures(record, now), _structure_picture(Path(run_folder), record.step_word)):
        drawing = to_svg(figure.figure)
        drawings.append(Drawing(figure.name, drawing, figure.title, figure.caption))
        atomic_write_bytes(folder / f"{figure.name}.svg", drawing)
        if figure.name == MAIN_FIGURE:
            atomic_write_bytes(folder / f"{MAIN_FIGURE}.png", to_png(figure.figure))
    return atomic_write_text(Path(run_folder) / REPORT_NAME, render_page(record, drawings))


def report_figures(run: RunRecord | Path | str, now: int | None = None) -> Iterator[ReportFigure]:
    """Draw every figure for which a run has data, one after the other: those of a long mission are large.

    Parameters
    ----------
    run : RunRecord or path
        The run, or its folder.
    now : int, optional
        The present turn of the first figure; by default shortly before the control first changes.

    Raises
    ------
    RunFolderError
        There is no run, it is damaged or of another layout, or `now` is no turn of it.
    """
    record = run if isinstance(run, RunRecord) else read_run(Path(run))
    now = default_now(record) if now is None else now
    sensors = choose_sensors(record)
    last = record.step_count - 1
    if not 0 <= now <= last:
        raise RunFolderError(f"The present turn of the report must lie in 0..{last}, and {now} came.")
    step = record.step_word
    drawing = mission_figure(record, now, sensors)
    title = f"The mission as the twin sees it at {step} {now}"
    yield ReportFigure(MAIN_FIGURE, drawing, title, mission_caption(record, now))
    if now != last:
        drawing = mission_figure(record, last, sensors)
        title = f"The whole mission, seen from its last {step}"
        yield ReportFigure("mission_whole", drawing, title, mission_caption(record, last))
    yield ReportFigure("belief", belief_figure(record), "The belief about the state", belief_caption(record))
    learnt = learnt_figure(record)
    if learnt is not None:
        yield ReportFigure("learnt", learnt, "What the twin learnt", learnt_caption(record))
    policy = policy_figure(record)
    if policy is not None:
        yield ReportFigure("policy", policy, "The policy", policy_caption(record))
    check = predictive_check(record)
    if check is not None:
        drawing = check_figure(record, check)
        yield ReportFigure("check", drawing, "Posterior predictive check", check_caption(record, check))
    view = calibration_view(record)
    if view is not None:
        drawing = calibration_figure(view)
        yield ReportFigure(
            "calibration",
            drawing,
            "What the model was tailored with" + (" before the flight" if record.learnt else ""),
            calibration_caption(view),
        )
    title = f"The dynamic decision network for a few {step}s"
    yield ReportFigure("network", network_figure(), title, network_caption(record))


def _structure_picture(run_folder: Path, step: str) -> Iterator[ReportFigure]:
    """Draw the structure that was flown, where the run left its field."""
    field = structure_figure(run_folder)
    if field is not None:
        caption = (
            "Surface of the mesh, coloured by the stiffness that each region has lost by the twin's last "
            f"estimate; the edges of regions are black. Displacements under the last control are shown "
            f"{field.scale:.3g} times as large; the largest is {1e3 * field.largest:.3g} mm."
        )
        yield ReportFigure("structure", field.figure, f"The structure after the last {step}", caption)


def render_page(record: RunRecord, drawings: Sequence[Drawing]) -> str:
    """Return the page: outcome, mission, belief, decision, check, model and run."""
    mission = record.scenario.get("mission")
    mission = mission if isinstance(mission, Mapping) else {}
    name = str(mission.get("name") or record.attributes.get("scenario") or "run")
    page = Page(
        title=str(mission.get("title") or name),
        subtitle=f"Scenario {name}, {record.step_count} {record.step_word}s, seed {_seed(record)}",
        footer=_SOURCES,
    )
    page.add_section("Outcome")
    _add_outcome(page, record)
    for title, names in (
        ("The mission", (MAIN_FIGURE, "mission_whole")),
        ("What the twin believes", ("belief",)),
        ("What the twin learnt", ("learnt",)),
        ("What the twin decides", ("policy",)),
        ("Whether the data agree", ("check",)),
        ("The model", ("structure", "calibration", "network")),
    ):
        present = [drawing for drawing in drawings if drawing.name in names]
        if present:
            page.add_section(title)
        for figure in present:
            page.add_figure(figure.svg, figure.caption, title=figure.title)
            if figure.name == "calibration":
                _add_calibrated_wing(page, calibration_view(record))
                _add_calibrated_model(page, record)
            if figure.name == "learnt":
                for table, caption, title in learnt_tables(record):
                    page.add_table(table, caption, title=title)
    page.add_section("The run")
    _add_run(page, record)
    return page.render()


def _seed(record: RunRecord) -> str:
    seed = record.config.get("seed", record.attributes.get("seed"))
    return "unknown" if seed is None else str(seed)


def _summary_figures(record: RunRecord) -> list[Mapping[str, Any]]:
    figures = record.summary.get("figures", [])
    return [figure for figure in figures if isinstance(figure, Mapping)] if isinstance(figures, list) else []


def _add_outcome(page: Page, record: RunRecord) -> None:
    page.add_paragraph(" ".join(opening_sentences(record)))
    for text in _notices(record):
        page.add_notice(text)
    figures = _summary_figures(record)
    referred = any(figure.get("reference") is not None for figure in figures)
    columns = [Column("figure"), Column("this run", numeric=True), Column("unit")]
    if referred:
        columns += [Column("reference", numeric=True), Column("source of the reference")]
    rows = []
    for figure in figures:
        row = [str(figure.get("title", figure.get("key", ""))), number(figure.get("value"))]
        row.append(str(figure.get("unit") or ""))
        if referred:
            reference = figure.get("reference")
            row += ["" if reference is None else number(reference), str(figure.get("reference_source") or "")]
        rows.append(tuple(row))
    if rows:
        page.add_table(
            Table(tuple(columns), rows),
            f"{_points(record)}A dash means that it did not happen.",
            title="Figures of the run" + (", beside their references" if referred else ""),
        )


def _points(record: RunRecord) -> str:
    titles = [title for k, title in enumerate(record.state_titles) if state_scale(record, k)[1] == "%"]
    return f"Points are percentage points of {' and '.join(titles)}. " if titles else ""


def _add_calibrated_wing(page: Page, view: CalibrationView | None) -> None:
    """Add what the calibration file says of the wing, where the run flew with one."""
    if view is None or not view.figures:
        return
    rows = [
        (
            figure.title,
            number(figure.mean),
            number(figure.standard_deviation),
            " to ".join(number(end) for end in figure.interval),
            "" if figure.unit == "1" else figure.unit,
        )
        for figure in view.figures
    ]
    columns = (
        Column("figure"),
        Column("mean", numeric=True),
        Column("standard deviation", numeric=True),
        Column("95 % interval", numeric=True),
        Column("unit"),
    )
    if not view.campaign:
        source, what = "of the healthy wing", "wing"
    else:
        source, what = f"from the campaign {view.campaign}", "parameters"
    page.add_table(
        Table(columns, rows),
        f"From the samples of the calibration file, {source}.",
        title=f"The calibrated {what}: {view.wing}",
    )
    for sentence in view.findings:
        page.add_paragraph(sentence)


def _add_calibrated_model(page: Page, record: RunRecord) -> None:
    """Say which model a campaign calibrated, and which was flown."""
    asset, believed = (record.summary.get(key) for key in ("asset", "twin_model"))
    if asset and believed:
        inputs = record.config.get("inputs")
        hashes = inputs if isinstance(inputs, Mapping) else {}
        told = calibrated_with(record.calibration, str(asset), str(believed), hashes)
        if told is not None:
            page.add_paragraph(told)


def _notices(record: RunRecord) -> list[str]:
    """Return what a reader must not miss: another model, alarms, lost observations."""
    said = record.summary.get("notices")
    notices = [
        str(notice.get("sentence", ""))
        for notice in (said if isinstance(said, list) else [])
        if isinstance(notice, Mapping)
    ]
    notices += _loss_notices(record)
    if record.summary.get("asset_and_model_differ") is True:
        asset, model = record.summary.get("asset"), record.summary.get("twin_model")
        notices.insert(
            0,
            f"The asset and the twin's model differ: flown was the {asset}, and the twin believes the "
            f"{model}. Its intervals hold as far as that model holds.",
        )
    return notices


def _loss_notices(record: RunRecord) -> list[str]:
    if record.observation is None:
        return ["The run holds no observations, so the figures show the twin's beliefs only."]
    view = calibration_view(record)
    notices = []
    fixed = view is not None and all(learnt.name != view.parameter for learnt in record.learnt)
    if view is not None and view.true_value is not None and fixed:
        believed = view.moments or (float(view.draws.mean()), float(view.draws.std()))
        sentence = another_truth(view.parameter, view.true_value, *believed)
        notices += [] if sentence is None else [sentence]
    lost = np.isnan(record.observation)
    if not lost.any():
        return notices
    word = sensor_word(record).lower()
    notices += [f"Observations lost ({100.0 * lost.mean():.1f} %): {lost_ranges(record)}."]
    blind = np.flatnonzero(lost.all(axis=1))
    if len(blind):
        notices.append(
            f"No {word} reported at {turn_ranges(blind, record.step_word)}: there the belief followed the "
            "dynamics alone."
        )
    return notices


def _add_run(page: Page, record: RunRecord) -> None:
    rows: list[tuple[str, str]] = [
        (f"{record.step_word}s flown", str(record.step_count)),
        (f"{record.step_word}s predicted", str(record.horizon)),
        ("states", f"{len(record.coordinates)} ({' × '.join(str(len(level)) for level in record.levels)})"),
        ("controls", ", ".join(record.controls)),
        (f"{sensor_word(record).lower()}s", _sensor_list(record)),
        ("seed", _seed(record)),
    ]
    for title, key in (("asset", "asset"), ("model that the twin believes", "twin_model")):
        if key in record.attributes:
            rows.append((title, str(record.attributes[key])))
    if record.log_evidence is not None:
        rows.append(("log evidence of all observations", f"{float(np.sum(record.log_evidence)):.2f}"))
    for name, (values, unit) in record.monitors.items():
        scale, printed = (1.0e6, "µε") if name == "strain_error_bound" else (1.0, unit)
        if printed != "1" and np.isfinite(values).any():
            rows.append(
                (f"largest {name.replace('_', ' ')}", f"{scale * float(np.nanmax(values)):.3g} {printed}")
            )
    page.add_table(
        Table((Column("item"), Column("value")), rows), "From run.nc and config.json.", title="Run"
    )
    page.add_paragraph("Wall-clock times stand in timing.json, so that equal runs give equal reports.")
    origin = _origin(record)
    if origin:
        page.add_table(
            Table((Column("item"), Column("value")), origin),
            "Versions of the software, and the first 12 digits of the SHA-256 of sources and inputs; "
            "config.json has them in full.",
            title="Provenance",
        )


def _sensor_list(record: RunRecord) -> str:
    count = str(len(record.sensors))
    if not record.sensor_titles:
        return count
    return f"{count}: {', '.join(sensor_title(record, k) for k in range(len(record.sensors)))}"


def _origin(record: RunRecord) -> list[tuple[str, str]]:
    """Return versions and hashes as the configuration keeps them."""
    origin, inputs = record.config.get("provenance", {}), record.config.get("inputs", {})
    origin = origin if isinstance(origin, Mapping) else {}
    rows: list[tuple[str, str]] = []
    versions = origin.get("versions")
    if isinstance(versions, Mapping) and versions:
        rows.append(
            ("software", ", ".join(f"{name} {version}" for name, version in sorted(versions.items())))
        )
    for title, hashes in (
        ("sources", origin.get("source_hashes")),
        ("inputs", origin.get("input_hashes")),
        ("inputs", inputs),
    ):
        if isinstance(hashes, Mapping) and hashes:
            rows.append(
                (title, ", ".join(f"{name} {str(value)[:12]}" for name, value in sorted(hashes.items())))
            )
    return rows
