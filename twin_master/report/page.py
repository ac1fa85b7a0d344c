"""The report of a run: one self-contained page and its figures, made from the run folder alone."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.pages.figures import save_figure
from reporting.pages.page import (
    Block,
    Fold,
    Notice,
    Page,
    PageFigure,
    ReportFigure,
    Section,
    render_page,
)
from twin_master.assets.asset_source import calibration_sentence
from twin_master.assets.reduced_model import FIELD_NAME
from twin_master.errors import RunFolderError
from twin_master.report import captions, tables
from twin_master.report.belief import belief_figure, policy_figure
from twin_master.report.calibration import calibrated_moments, calibration_figure, true_value
from twin_master.report.captions import MISSION_NOW, MISSION_WHOLE, NETWORK, WORDS
from twin_master.report.check import PredictiveCheck, check_figure, predictive_check
from twin_master.report.learnt import learnt_figure
from twin_master.report.mission import default_present_row, mission_figure
from twin_master.report.opening_sentences import opening_sentences
from twin_master.report.reading import Run, read_run
from twin_master.report.structure import design_of, mesh_figure, planform_figure, planform_of
from twin_master.run_folder import REPORT_NAME
from twin_master.store.summary import truth_mismatch

FIGURE_FOLDER = "figures"
"""The folder of the figures in a run folder."""


def write_report(run_folder: Path | str, *, now: int | None = None) -> Path:
    """Write the report of a run: ``report.html`` and the folder ``figures``.

    Equal runs give equal bytes, because the report contains no wall-clock times; these are in
    ``timing.json``.

    Parameters
    ----------
    run_folder : Path or str
        The folder of the run. It holds ``run.nc`` and ``config.json`` and, if they exist,
        ``summary.json`` and ``calibration.json``.
    now : int, optional
        The number of the present step of the first figure; by default shortly before the control
        first changes.

    Returns
    -------
    Path
        The path of the page.

    Raises
    ------
    RunFolderError
        If there is no run, if it is damaged or of another layout, or if `now` is not a step of it.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    folder = Path(run_folder)
    run = read_run(folder)
    figures = {}
    # Only the drawing of each figure is kept, because figures of a long mission need much memory.
    for figure in _figures(run, now, folder):
        has_png = figure.name == MISSION_NOW
        figures[figure.name] = save_figure(figure, folder / FIGURE_FOLDER, png=has_png)
    figures[NETWORK] = captions.network_figure(run)
    atomic_write_bytes(folder / FIGURE_FOLDER / f"{NETWORK}.svg", figures[NETWORK].svg)
    return atomic_write_text(folder / REPORT_NAME, render_page(run_page(run, figures)))


def report_figures(run_folder: Path | str, now: int | None = None) -> Iterator[ReportFigure]:
    """Yield the figures of a run's report, drawn one after the other.

    Parameters
    ----------
    run_folder : Path or str
        The folder of the run.
    now : int, optional
        The number of the present step of the first figure; by default shortly before the control
        first changes.

    Yields
    ------
    ReportFigure
        A figure with its title and caption.

    Raises
    ------
    RunFolderError
        If there is no run, if it is damaged or of another layout, or if `now` is not a step of it.
    """
    yield from _figures(read_run(Path(run_folder)), now, Path(run_folder))


def _figures(run: Run, now: int | None, folder: Path) -> Iterator[ReportFigure]:
    """Draw the figures of a run in the order of the page, and yield them."""
    present_row = _present_row(run, now)
    last_row = run.step_count - 1
    figure = mission_figure(run, present_row)
    yield captions.caption_mission(run, figure, present_row, MISSION_NOW)
    if present_row != last_row:
        figure = mission_figure(run, last_row)
        yield captions.caption_mission(run, figure, last_row, MISSION_WHOLE)
    yield captions.caption_belief(run, belief_figure(run))
    if run.learnt_quantities:
        yield captions.caption_learnt(run, learnt_figure(run))
    if len(run.factors) == 2:
        yield captions.caption_policy(run, policy_figure(run))
    check = predictive_check(run)
    yield captions.caption_check(run, check, check_figure(run, check))
    yield captions.caption_calibration(run, calibration_figure(run))
    yield from _structure_figure(run, folder, check)


def _present_row(run: Run, now: int | None) -> int:
    """Return the row of the step with the number `now`; by default, `default_present_row` decides.

    Raises
    ------
    RunFolderError
        If the number is not that of a step of the run.
    """
    if now is None:
        return default_present_row(run)
    first_step = run.first_step
    last_step = first_step + run.step_count - 1
    if not first_step <= now <= last_step:
        raise RunFolderError(
            f"The present step of the report must lie in {first_step}..{last_step}, but {now} was "
            "given."
        )
    return now - first_step


def _structure_figure(run: Run, folder: Path, check: PredictiveCheck) -> Iterator[ReportFigure]:
    """Yield the picture of the structure after the last step, if the run has a mesh or a wing.

    The iterator has one figure or none.
    """
    last_residual = check.residual[-1]
    planform = planform_of(design_of(folder), run.scenario)
    if (folder / FIELD_NAME).is_file():
        yield captions.caption_mesh(run, mesh_figure(folder, last_residual))
    elif planform is not None:
        figure = planform_figure(run, planform, last_residual)
        yield captions.caption_planform(run, figure)


def run_page(run: Run, figures: Mapping[str, PageFigure]) -> Page:
    """Return the page of a run with these figures by name; those that are missing are left out."""
    mission = run.scenario.mission
    seed = run.config.get("seed", run.tree.attrs.get("seed", "unknown"))
    picture = "structure" if "structure" in figures else MISSION_NOW
    sentence, *further_sentences = opening_sentences(run)
    pictures_of_mission = [name for name in (MISSION_NOW, MISSION_WHOLE) if name != picture]
    return Page(
        mission.title or mission.name,
        WORDS.say(
            "subtitle",
            scenario=mission.name,
            step_count=run.step_count,
            step=run.step_word,
            seed=seed,
        ),
        sentence=sentence,
        picture=figures.get(picture),
        outcome=[*_notices(run), " ".join(further_sentences), _sentence_on_silence(run)],
        sections=[
            Section("Results", [tables.summary_table(run)]),
            Section("The mission", [figures.get(name) for name in pictures_of_mission]),
            Section("What the twin believes", [figures.get("belief")]),
            Section(
                "What the twin learnt",
                [
                    figures.get("learnt"),
                    tables.learnt_asset_table(run),
                    tables.learnt_sensors_table(run),
                ],
            ),
            Section("What the twin decides", [figures.get("policy")]),
            Section("Whether the data agree", [figures.get("check")]),
            Section(
                "The model",
                [
                    figures.get("calibration"),
                    tables.calibrated_table(run),
                    *_calibration_sentences(run),
                    figures.get(NETWORK),
                ],
            ),
            Section(
                "The run",
                [
                    tables.run_table(run, seed),
                    Fold(
                        "Versions of the software and hashes of the inputs",
                        [
                            "Wall-clock times are only in timing.json, so that equal runs give "
                            "equal reports.",
                            tables.provenance_table(run),
                        ],
                    ),
                ],
            ),
        ],
        footer=(WORDS.say("sources"), WORDS.say("colours")),
    )


def _notices(run: Run) -> list[Block]:
    """Return the notices of a report: what its reader must not overlook.

    They are a difference of asset and model, the notices of the twin, a true parameter that
    contradicts the calibration, and lost observations.
    """
    notices: list[Block] = []
    if run.summary.get("asset_and_model_differ"):
        sentence = (
            f"The asset and the twin's model differ: the asset was the {run.summary['asset']}, and "
            f"the twin believes the {run.summary['twin_model']}. Its intervals hold as far as that "
            "model holds."
        )
        notices.append(Notice(sentence))
    sentences = [notice["sentence"] for notice in run.summary.get("notices", [])]
    notices += [Notice(sentence) for sentence in sentences]
    if any(" DIR" in sentence for sentence in sentences):
        notices.append("DIR is the folder of this page.")
    notices.append(Notice(_true_parameter_sentence(run)))
    is_lost = np.isnan(run.observations)
    if is_lost.any():
        percentage = 100.0 * is_lost.mean()
        notices.append(Notice(f"Observations lost ({percentage:.1f} %): {lost_ranges(run)}."))
    steps_without_observation = run.first_step + np.flatnonzero(is_lost.all(axis=1))
    if len(steps_without_observation):
        steps = step_ranges(steps_without_observation, run.step_word)
        sentence = (
            f"No {run.sensors.word} reported at {steps}: there the belief followed the dynamics "
            "alone."
        )
        notices.append(Notice(sentence))
    return notices


def _sentence_on_silence(run: Run) -> str:
    """Return what it means that a run with watched sensors gave no notice; empty if it gave one."""
    if run.summary.get("notices") or run.get("notice/none_of_these") is None:
        return ""
    return (
        f"No notice was given. That does not prove the {run.sensors.word}s right: a fault that "
        "moves all of them towards what another state would show is taken for that state."
    )


def _true_parameter_sentence(run: Run) -> str:
    """Return the notice that the asset's true parameter differs from the calibrated one.

    It is empty if they agree, if the true one is not known, or if the twin learns the parameter
    during the mission.
    """
    parameter = run.scenario.calibration.parameter
    truth = true_value(run)
    is_learnt = any(quantity.name == parameter for quantity in run.learnt_quantities)
    if truth is None or is_learnt:
        return ""
    mean, deviation = calibrated_moments(run)
    return truth_mismatch(parameter, truth, mean, deviation) or ""


def _calibration_sentences(run: Run) -> list[str]:
    """Return the findings of the calibration, and the sentence on which model was calibrated."""
    sentences: list[str] = []
    if tables.calibrated_values(run.calibration):
        sentences += run.calibration.get("findings", [])
    asset = run.summary.get("asset")
    twin_model = run.summary.get("twin_model")
    if asset and twin_model:
        inputs = run.config.get("inputs", {})
        sentences.append(calibration_sentence(run.calibration, asset, twin_model, inputs) or "")
    return sentences


def step_ranges(steps: ArrayLike, step_word: str = "step") -> str:
    """Return the ranges of successive numbers in increasing steps, as in ``steps 3–4, 12–18``.

    Parameters
    ----------
    steps : (N,) array of int
        The numbers of the steps.
    step_word : str
        The noun for a step.
    """
    values = np.asarray(steps, dtype=int)
    ranges = []
    for part in np.split(values, np.flatnonzero(np.diff(values) > 1) + 1):
        ranges.append(f"{part[0]}" if len(part) == 1 else f"{part[0]}–{part[-1]}")
    noun = step_word if len(values) == 1 else f"{step_word}s"
    return f"{noun} {', '.join(ranges)}"


def lost_ranges(run: Run) -> str:
    """Return in words which sensors have no reading in which steps.

    Sensors without a reading in the same steps are listed together. Steps without any reading are
    listed at the end.
    """
    is_lost = np.isnan(run.observations)
    are_all_lost = is_lost.all(axis=1)
    sensors_of_steps: dict[tuple[int, ...], list[str]] = {}
    for sensor in range(is_lost.shape[1]):
        rows = np.flatnonzero(is_lost[:, sensor] & ~are_all_lost)
        if len(rows):
            steps = tuple((run.first_step + rows).tolist())
            sensors_of_steps.setdefault(steps, []).append(str(sensor + 1))
    word = run.sensors.word
    phrases = []
    for steps, sensors in sensors_of_steps.items():
        noun = f"{word}s" if len(sensors) > 1 else word
        phrases.append(f"{noun} {', '.join(sensors)} at {step_ranges(steps, run.step_word)}")
    if are_all_lost.any():
        steps_of_all = run.first_step + np.flatnonzero(are_all_lost)
        phrases.append(f"all {word}s at {step_ranges(steps_of_all, run.step_word)}")
    return "; ".join(phrases)
