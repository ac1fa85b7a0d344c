"""The report of a run: one self-contained page and its figures, from nothing but the run folder.

First the sentences with which it begins: what was decided, what is believed, whether the model holds.
"""

from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom

from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.page import Page, ReportFigure, Words
from reporting.words import counted, listing, parameter_title, small
from twin_master.assets.asset_source import calibrated_with
from twin_master.assets.reduced_model import FIELD_NAME
from twin_master.errors import RunFolderError
from twin_master.network.estimator import is_state_believed
from twin_master.report import mission as course
from twin_master.report import model as tailored
from twin_master.report.reading import Run, read_run
from twin_master.report.structure import design_of, mesh_figure, planform_figure, planform_of
from twin_master.store.summary import control_changes, find_fallback, truth_mismatch
from twin_master.store.writing import REPORT_NAME

WORDS = Words("twin_master.report")

_STATES_SAID = 4
_SPREAD_DIFFERS = 0.05
"""Relative departure of the spread of residuals from one below which nothing is said of it."""
_SURE = 1e-3
"""Probability of a false word about the spread, or about any sensor."""


def opening_sentences(run: Run) -> tuple[str, ...]:
    """Return at most three sentences on a run; what the run does not hold is not spoken of."""
    sentences = (_decision(run), _belief(run), _agreement(run, tailored.predictive_check(run)))
    return tuple(sentence for sentence in sentences if sentence)


def _decision(run: Run) -> str:
    """Return how the control went, and by how much it followed the damage that calls for another."""
    first, controls, index = int(run.control_index[0]), run.controls, run.control_index
    changes, policy = int(np.count_nonzero(np.diff(index))), run["policy/control_index"].astype(np.int64)
    known = run.model.states, policy, int(index[0]), index
    fallback = None if run.truth is None else find_fallback(*known, run.truth)
    fell = None if fallback is None or fallback.early_step is not None else fallback.fallback_step
    switch: dict[str, object] = {"what": "", "level": "", "everywhere": False}
    if fallback is not None and fallback.switch_state is not None and fallback.switch_level is not None:
        factor = run.factors[run.scenario.state_names.index(fallback.switch_state)]
        level = factor.scale * fallback.switch_level
        switch = {
            "what": _named(factor.title), "level": f"{level:.4g} {factor.unit}".rstrip(),
            "everywhere": level <= factor.levels[0],
        }  # fmt: skip
    missed = 0
    if run.watched:  # a real asset may be under another control than the one that its twin asked for
        asked = np.argmax(run["filtered/decision_probability"][:-1], axis=1)
        missed = int(np.count_nonzero(asked != index[1:]))
    return WORDS.say(
        "decision", run=run, first=controls[first], **switch, missed=missed and _count(missed, run.step),
        asset="asset" if run.watched else "twin", changes=changes,
        changed=control_changes(controls, index, run.step, run.first_step),
        called=None if fallback is None or fallback.called_for_step is None
        else run.first_step + fallback.called_for_step,
        fell=None if fell is None else run.first_step + fell,
        now=controls[int(index[fell or 0])],
        delay=fallback and fallback.delay and _count(fallback.delay, run.step),
    )  # fmt: skip


def _belief(run: Run) -> str:
    """Return the last estimate of the state, and of the parameter where it is learnt.

    Where no state explains the sensors none is told.
    """
    unexplained = run.get("notice/none_of_these")
    if unexplained is not None and not is_state_believed(unexplained[-1]):
        return (
            f"At the end no state is believed: no state of the model explains the {run.sensors.word}s "
            f"(probability {unexplained[-1]:.3g})."
        )
    parts = [_state(run, index) for index in range(min(len(run.factors), _STATES_SAID))]
    rest = len(run.factors) - len(parts)
    if rest:
        parts.append(f"{counted(rest, 'other state')} as the figures below show")
    figures = {figure["key"]: figure["value"] for figure in run.summary.get("figures", ())}
    learnt = next((one for one in run.learnt if one.name == run.scenario.calibration.parameter), None)
    told = None
    if learnt is not None:
        mean, deviation = learnt.posterior[-1, :2]
        told = {
            "name": _named(parameter_title(learnt.name)), "mean": mean, "low": mean - 2 * deviation,
            "high": mean + 2 * deviation, "truth": None if learnt.truth is None else float(learnt.truth),
        }  # fmt: skip
    decided = figures.get("decided_by") or "model"
    return WORDS.say("belief", states=listing(parts), decided=decided, learnt=told)


def _state(run: Run, index: int) -> str:
    factor = run.factors[index]
    mean, deviation = (
        factor.scale * run[f"filtered/{moment}"][-1, index] for moment in ("mean", "standard_deviation")
    )
    ends = np.clip(mean + np.array([-2.0, 2.0]) * deviation, factor.levels[0], factor.levels[-1])
    form, true = (".1f", ".0f") if factor.unit == "%" else (".3g", ".3g")
    low, high = (f"{end:{form}}" for end in ends)
    interval = f"{low} to {high}" if low != high else "no other level is believed"
    if run.truth is not None:
        interval += f", truth {factor.scale * run.truth[-1, index]:{true}}"
    return f"{_named(factor.title)} at {f'{mean:{form}} {factor.unit}'.rstrip()} ({interval})"


def _agreement(run: Run, check: tailored.PredictiveCheck) -> str:
    """Return whether the observations scatter about the model as the twin assumes."""
    count, spread = int(check.count.sum()), check.standard_deviation
    if count == 0:
        return ""
    # standard deviations of the spread that chance exceeds once in 1,000
    differs = max(_SPREAD_DIFFERS, 3.3 / np.sqrt(2.0 * count))
    hits = np.rint(np.nan_to_num(check.coverage, nan=1.0) * check.count)
    chance = np.where(check.count > 0, binom.cdf(hits, np.maximum(check.count, 1), 0.95), 1.0)
    worst = int(np.argmin(chance))
    return WORDS.say(
        "agreement", spread=spread, wide=spread > 1.0 + differs, narrow=spread < 1.0 - differs,
        inside=100.0 * check.overall_coverage, off=chance[worst] < _SURE / len(chance),
        worst=run.sensors.titles[worst], share=100.0 * check.coverage[worst],
    )  # fmt: skip


def _named(title: str) -> str:
    return f"the {title}" if " " in title and not title.startswith("the ") else title


def _count(count: int, word: str) -> str:
    return f"one {word}" if count == 1 else counted(count, word)


FIGURE_FOLDER = "figures"
MAIN_FIGURE, NETWORK = "mission_now", "network"
"""The figure that is also written as PNG, and the one that is the same for all runs."""


def write_report(run_folder: Path | str, *, now: int | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of a run; return the path of the page.

    Equal runs give equal bytes: wall-clock figures stay in ``timing.json``.

    Parameters
    ----------
    run_folder
        Holds ``run.nc`` and ``config.json`` and, where they exist, ``summary.json`` and ``calibration.json``.
    now
        The present step of the first figure; by default shortly before the control first changes.

    Raises
    ------
    RunFolderError
        There is no run, it is damaged or of another layout, or `now` is no step of it.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    folder = Path(run_folder)
    run = read_run(folder)
    drawings, figures = {}, {}
    for drawn in _figures(run, now, folder):  # one after the other: those of a long mission are large
        drawings[drawn.name] = to_svg(drawn.figure)
        if drawn.name == MAIN_FIGURE:
            atomic_write_bytes(folder / FIGURE_FOLDER / f"{MAIN_FIGURE}.png", to_png(drawn.figure))
        figures[drawn.name] = drawn._replace(figure=None)  # type: ignore[arg-type]
    figures[NETWORK] = WORDS.figure(NETWORK, None, run=run)
    drawings[NETWORK] = resources.files(__package__).joinpath("network.svg").read_bytes()
    for name, drawing in drawings.items():
        atomic_write_bytes(folder / FIGURE_FOLDER / f"{name}.svg", drawing)
    return atomic_write_text(folder / REPORT_NAME, render_page(run, drawings, figures))


def report_figures(run_folder: Path | str, now: int | None = None) -> Iterator[ReportFigure]:
    """Draw every figure of a run, one after the other: those of a long mission are large.

    Parameters
    ----------
    run_folder
        The folder of the run.
    now
        The present step of the first figure; by default shortly before the control first changes.

    Raises
    ------
    RunFolderError
        There is no run, it is damaged or of another layout, or `now` is no step of it.
    """
    yield from _figures(read_run(Path(run_folder)), now, Path(run_folder))


def _figures(run: Run, now: int | None, folder: Path) -> Iterator[ReportFigure]:
    first, last = run.first_step, run.steps - 1
    now = course.default_now(run) if now is None else now - first
    if now not in range(run.steps):
        ends = f"{first}..{first + last}"
        raise RunFolderError(f"The present step of the report must lie in {ends}, and {first + now} came.")
    units = ", ".join(
        dict.fromkeys("percent" if factor.unit == "%" else factor.unit for factor in run.factors)
    )
    for name, step in ((MAIN_FIGURE, now), *([("mission_whole", last)] if now != last else [])):
        asked = run["filtered/decision_probability"][step]
        chosen = int(np.argmax(asked))
        decided = WORDS.say(
            "decided", run=run, now=first + step, chosen=run.controls[chosen], probability=asked[chosen]
        )
        past = "in hindsight" if step == last else "as seen at the time"
        yield WORDS.figure(
            "mission", course.mission_figure(run, step), run=run, now=first + step, units=units,
            whole=name != MAIN_FIGURE, last=step == last, past=past, decided=decided,
        )._replace(name=name)  # fmt: skip
    yield WORDS.figure("belief", course.belief_figure(run), run=run, units=units)
    if run.learnt:
        yield WORDS.figure("learnt", tailored.learnt_figure(run), run=run)
    if len(run.factors) == 2:
        yield WORDS.figure("policy", course.policy_figure(run), run=run)
    check = tailored.predictive_check(run)
    yield WORDS.figure(
        "check", tailored.check_figure(run, check), run=run, check=check, **_check_words(run, check)
    )
    unit = str(run.tree["calibration/draw_value"].attrs.get("units", "1"))
    yield WORDS.figure(
        "calibration", tailored.calibration_figure(run), run=run,
        measured=tailored.measured(run), truth=tailored.true_value(run),
        name=parameter_title(run.scenario.calibration.parameter), draws=run["calibration/draw_value"],
        unit="dimensionless" if unit == "1" else unit,
    )  # fmt: skip
    planform = planform_of(design_of(folder), run.scenario)
    if (folder / FIELD_NAME).is_file():
        picture = mesh_figure(run, folder, check.residual[-1])
        yield WORDS.figure("structure", picture.figure, run=run, picture=picture)
    elif planform is not None:  # of a wing
        figure = planform_figure(run, planform, check.residual[-1])
        yield WORDS.figure("structure", figure, run=run, picture=None)


def _check_words(run: Run, check: tailored.PredictiveCheck) -> dict[str, str | bool]:
    """Return the assumed noise with its units, the error of the model, and the sensor of lowest coverage."""
    section, sensors = run.scenario.observation, run.sensors
    noise, error = np.asarray(section.standard_deviation), 100.0 * np.asarray(section.model_error)
    told = f"{sensors.scale * float(noise.flat[0]):.4g} {sensors.unit}"
    if noise.ndim or not sensors.unit:
        each = zip(np.broadcast_to(noise, section.count).tolist(), sensors.units, sensors.titles, strict=True)
        told = ", ".join(
            f"{sensors.scale * value:.4g} {unit} ({small(title)})" for value, unit, title in each
        )
    low, high = float(error.min()), float(error.max())
    share = f"{low:.3g} %" if low == high else f"{low:.3g} to {high:.3g} %"
    lowest = ""
    if len(check.transform):
        sensor = int(np.nanargmin(check.coverage))
        lowest = f"{small(sensors.titles[sensor])}, {100.0 * check.coverage[sensor]:.0f} %"
    learnt = run.scenario.learning is not None
    return {"noise": told, "error": share if high else "", "lowest": lowest, "learnt": learnt}


def render_page(run: Run, drawings: Mapping[str, bytes], figures: Mapping[str, ReportFigure]) -> str:
    """Return the page: outcome, mission, belief, decision, check, model and run.

    Parameters
    ----------
    run
        The run.
    drawings, figures
        Its figures as SVG by the names of their files, and title and caption of each.
    """
    mission = run.scenario.mission
    told: dict[str, Any] = {"run": run, "seed": run.config.get("seed", run.tree.attrs.get("seed", "unknown"))}
    footer = WORDS.say("sources"), WORDS.say("colours")
    page = Page(mission.title or mission.name, WORDS.say("subtitle", **told), footer=footer)
    lost = np.isnan(run.observed)
    blind = np.flatnonzero(lost.all(axis=1))
    whole, own = ([one for one in run.learnt if one.is_per_sensor == each] for each in (False, True))
    given = run.scenario.transition.probability
    truth, parameter, another = tailored.true_value(run), run.scenario.calibration.parameter, None
    if truth is not None and not any(learnt.name == parameter for learnt in run.learnt):
        another = truth_mismatch(parameter, truth, *tailored.believed(run))
    asset, model, kept = run.summary.get("asset"), run.summary.get("twin_model"), run.calibration
    told |= {
        "figures": figures, "opening": opening_sentences(run), "another": another,
        "referred": any(figure["reference"] is not None for figure in run.summary.get("figures", ())),
        "share": 100.0 * lost.mean(), "ranges": lost_ranges(run),
        "blind": step_ranges(run.first_step + blind, run.step) if len(blind) else "",
        "learnt_asset": whole, "truth": any(learnt.truth is not None for learnt in whole),
        "plain": listing(f"{p:g} in {name}" for name, p in given.items() if isinstance(p, int | float)),
        "learnt_sensors": tailored.sensor_rows(run), "labels": [learnt.label for learnt in own],
        # The prior of the sensors is one, unless the scenario gives one for each.
        "prior": [
            f"{one.title.lower()} {tailored.with_interval(np.nanmedian(one.prior, axis=0))}" for one in own
        ],
        "calibrated": _calibrated(kept), "monitors": _monitors(run),
        "of": asset and model and calibrated_with(kept, asset, model, run.config.get("inputs", {})),
    }  # fmt: skip
    WORDS.fill(page, drawings, **told)
    return page.render()


def _calibrated(kept: Mapping[str, Any]) -> list[Any]:
    """Return the figures that the calibration file has of the wing or the model; none without one."""
    names = kept.get("correlation", {}).get("names", ()), kept.get("names", {}).get("quantities", ())
    return [
        kept[group][name] for group, own in zip(("state", "quantities"), names, strict=True) for name in own
    ]


def _monitors(run: Run) -> list[Sequence[str]]:
    """Return the largest of each figure that the asset reported of itself."""
    rows: list[Sequence[str]] = []
    for name, variable in (run.tree["truth"].data_vars if run.truth is not None else {}).items():
        strain = name == "strain_error_bound"
        scale, unit = (1.0e6, "µε") if strain else (1.0, variable.attrs.get("units", "1"))
        if variable.dims == ("step",) and unit != "1" and np.isfinite(variable.values).any():
            largest = scale * float(np.nanmax(variable.values))
            rows.append((f"largest {str(name).replace('_', ' ')}", f"{largest:.3g} {unit}"))
    return rows


def step_ranges(steps: ArrayLike, step_word: str = "step") -> str:
    """Return increasing steps in words: ``steps 3–4, 12–18``."""
    values = np.asarray(steps, dtype=int)
    parts = np.split(values, np.flatnonzero(np.diff(values) > 1) + 1)
    words = [f"{part[0]}" if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts]
    return f"{step_word} {words[0]}" if len(values) == 1 else f"{step_word}s {', '.join(words)}"


def lost_ranges(run: Run) -> str:
    """Return which sensors were lost when, those lost together in one phrase."""
    lost = np.isnan(run.observed)
    blind = lost.all(axis=1)
    together: dict[tuple[int, ...], list[str]] = {}
    for sensor in range(lost.shape[1]):
        steps = tuple((run.first_step + np.flatnonzero(lost[:, sensor] & ~blind)).tolist())
        if steps:
            together.setdefault(steps, []).append(str(sensor + 1))
    word = run.sensors.word
    phrases = [
        f"{word}{'s' if len(labels) > 1 else ''} {', '.join(labels)} at {step_ranges(steps, run.step)}"
        for steps, labels in together.items()
    ]
    if blind.any():
        phrases.append(f"all {word}s at {step_ranges(run.first_step + np.flatnonzero(blind), run.step)}")
    return "; ".join(phrases)
