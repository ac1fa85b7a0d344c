"""The one loop: a source gives observations, the twin decides; and a mission, resumable at any step.

The journal of a run or a watch is read back: what was told, the twin as it was, steps to be stored.
"""

import math
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from reporting.arrays import Float
from reporting.progress import Progress, SilentProgress
from twin_master.errors import (
    ImpossibleObservation,
    InvalidObservationError,
    NotResumableError,
    TwinMasterError,
    said,
)
from twin_master.learning.expectation import Expectation, concatenate_expectations, expectation_of_draws
from twin_master.mission.journal import (
    JournalFile,
    array_of,
    damaged,
    reading_of,
    records_backwards,
    state_of,
    state_text,
    step_record,
)
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import History, MissionStep, Plant, Reading
from twin_master.network.estimator import Notice, is_state_believed
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import known_control
from twin_master.network.twin import Twin, TwinStep
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state

_SUSPECTED = ("none_of_these", "hypotheses", "decided_by")
"""What is told of a suspicion."""


def journalled_decision(line: Mapping[str, Any], scenario: Scenario, model: GraphicalModel) -> dict[str, Any]:
    """Return what the operator is told with a line of a journal: never a control without its certainty.

    Nothing where it tells no decision. Of a state that is not believed, because none explains the sensors, no
    moments are told.
    """
    for reason in ("quiet", "refused"):  # the last decision was told again
        if reason in line:
            return dict(line[reason])
    if "filtered" not in line:
        return {}
    filtered = array_of(line["filtered"])
    mean, deviation = model.states.mean(filtered), model.states.standard_deviation(filtered)
    controls, coming = scenario.control_names, line["next_control"]
    believed = is_state_believed(line.get("suspicion", {}).get("none_of_these", 0.0))
    record = {
        "step": line["step"],
        "control": controls[line.get("control_in_force", line["control_index"])],
        "state_believed": believed,
        "health": {
            factor.name: {
                "mean": mean[index] if believed else None,
                "standard_deviation": deviation[index] if believed else None,
                "unit": factor.unit,
            }
            for index, factor in enumerate(scenario.state)
        },
        "next_control": controls[coming],
        "probability": min(float(line["decision_probability"][coming]), 1.0),
        "lost_sensors": line["observed"][: scenario.observation.count].count(None),
        "log_evidence": line["log_evidence"],
        "notices": line.get("notices", []),
    }
    if "suspicion" in line:
        record |= {name: line["suspicion"][name] for name in _SUSPECTED}
    if "control_in_force" in line:
        record["revised_by_step"] = line["observation_step"]
    if "learnt" in line:
        record["learnt"] = line["learnt"]
    return record


def health_in_words(decision: Mapping[str, Any]) -> dict[str, str]:
    """Return mean and standard deviation of each factor of the state, as a decision tells them.

    Of a state that is not believed it is said that it is not.
    """
    told = {}
    for name, known in decision["health"].items():
        if known["mean"] is None:
            told[name] = "not believed"
            continue
        scale, unit = printed_state(known["unit"])
        digits = ".0f" if unit == "%" else ".3g"
        mean, deviation = (f"{scale * known[moment]:{digits}}" for moment in ("mean", "standard_deviation"))
        told[name] = f"{mean} ± {deviation} {unit}"
    return told


def expected_in(
    history: History, knowledge: Knowledge, name: str, belief: Float
) -> tuple[Expectation, Float]:
    """Return what is expected in the steps of a history, and the probability of each control there.

    Parameters
    ----------
    history : History
    knowledge : Knowledge
        Of the twin in these steps.
    name : str
        `filtered`, `smoothed` or `predicted`.
    belief : (T, S), or (T, H, S) where it is predicted
        Of that name.
    """
    learns, rows, more = knowledge.expectation, None, tuple[Any, ...]()
    if name == "predicted":
        asked = knowledge.asked(history.unexplained)
        joint = belief[..., None] * asked[:, None]  # (T, H, S, U), eqs. (37)-(39)
        belief, more = history.filtered, (asked, belief.shape[1])
    else:
        rows, more = history.row, (history.observed,)
        joint = known_control(belief, history.control_index, len(knowledge.model.controls))
    if learns is None:
        expected = expectation_of_draws(knowledge.sensor_model, knowledge.rewards, joint, rows)
    else:
        carried = [step.concluded.carried for step in history.steps]
        expected = getattr(learns, name)(carried, belief, *more)
    return expected, joint.sum(axis=-2)


def spans_of(history: History, given: "Sequence[BelievedModel]") -> list[tuple[Knowledge, slice]]:
    """Return what a twin knew, and in which of the steps of a history, by the models that it believed."""
    models = successive_models(given)
    starts = [max(0, model.from_step - history.first_step) for model in models]
    parts = map(slice, starts, [*starts[1:], len(history.steps)])
    return [(model.knowledge, part) for model, part in zip(models, parts, strict=True)]


def gap_of(history: History, from_step: int, models: "Sequence[BelievedModel]") -> dict[str, Any]:
    """Return root mean square residual and log evidence of the steps from one on; None without any.

    The residuals are in standard deviations of the noise that is assumed, or learnt where the twin learns.
    """
    left = history.behind(from_step - history.first_step)
    if not left.steps or np.isnan(left.observed).all():
        return {"rms_residual": None, "log_evidence": None}
    parts = [(known, replace(left, steps=left.steps[part])) for known, part in spans_of(left, models)]
    expected = concatenate_expectations(
        expected_in(own, known, "filtered", own.filtered)[0] for known, own in parts if own.steps
    )
    residual = (left.observed - expected.mean) / expected.noise
    return {
        "rms_residual": float(np.sqrt(np.nanmean(residual**2))),
        "log_evidence": float(np.sum(left.log_evidence)),
    }


@dataclass(frozen=True)
class BelievedModel:
    """What the twin believes from a step on.

    Attributes
    ----------
    from_step : int
        The first step that is filtered with it.
    knowledge : Knowledge
        Its predicted observations.
    patch : Path or None
        Of the model, where it has one.
    """

    from_step: int
    knowledge: Knowledge
    patch: Path | None = None


def replay(
    path: Path, models: Sequence[BelievedModel], lag: int | None, *, first_step: int | None = None,
    end: int | None = None, question: BelievedModel | None = None,
) -> tuple[History, dict[str, Any]]:  # fmt: skip
    """Filter the steps of a journal again, what came late in its place.

    The journal is read from its end to the last state of the twin that lies before what is wanted.

    Parameters
    ----------
    path : Path
        The journal.
    models : sequence of BelievedModel
        The model of the beginning, and those that were adopted later.
    lag : int or None
        Of the twin.
    first_step : int, optional
        The first step whose belief is wanted; if left out the twin alone, from the last state.
    end : int, optional
        Bytes of the journal that are read; all of it if left out.
    question : BelievedModel, optional
        What would be believed with one model more, from its step on.

    Returns
    -------
    History
        The steps behind that state, with the twin behind the last one.
    dict
        The last line; empty where there is none.

    Raises
    ------
    NotResumableError
        The journal was changed or is damaged, or decided otherwise.
    """
    wanted = [] if first_step is None else [first_step]
    wanted += [] if question is None else [question.from_step]
    seen: dict[int, Reading] = {}
    decided, stands = dict[int, int](), math.inf  # decisions from some step on were revised by later lines
    settled, last = (-1, b""), dict[str, Any]()
    behind, place = -1, 0  # the step of the line behind, and where it begins
    for record, begin, _ in records_backwards(path, end):
        try:
            step = int(record["step"]) if begin else -1
            if last and behind - step not in (0, 1):
                raise damaged(path, place if step < behind else begin, f"step {behind} is out of place")
            if not begin or step <= settled[0]:
                break
            last, behind, place = last or record, step, begin
            if settled[0] < 0 and "settled" in record:
                kept, state = int(record["settled"]["step"]), record["settled"]["state"]
                # Only one before what is wanted, and before all models that are adopted behind it.
                if all(kept < other for other in wanted):
                    settled = kept, state_of(state)
            if step < stands:
                decided.setdefault(step, record["next_control"])
            if "model" in record:
                stands = min(stands, int(record["model"]["from_step"]))
                wanted.append(int(record["model"]["from_step"]))
            elif "observed" in record:
                observed = int(record.get("observation_step", step))
                stands = min(stands, observed)
                seen.setdefault(observed, reading_of(record))
        except (KeyError, TypeError, ValueError, AttributeError, zlib.error) as error:
            raise damaged(path, begin, f"it has another layout, {error}") from error
    found = filtered_again(seen, [*models, *([question] if question else [])], lag, settled)
    for again in found.steps if question is None else ():
        number, control = again.concluded.step, again.concluded.next_control
        if decided.get(number, control) != control:
            other = f"begin another watch, in another folder, with `--observations {path.parent}`"
            advice = other if "intake" in last else "fly the mission again with --replace"
            raise NotResumableError(said("mission.decided", step=number, advice=advice))
    return found, last


def successive_models(given: Sequence[BelievedModel]) -> list[BelievedModel]:
    """Return the models that are believed one after the other.

    One that was adopted from an earlier step on than one before it takes its place altogether.
    """
    return [
        model
        for index, model in enumerate(given)
        if all(later.from_step > model.from_step for later in given[index + 1 :])
    ]


def filtered_again(
    seen: Mapping[int, Reading], given: Sequence[BelievedModel], lag: int | None = None,
    settled: tuple[int, bytes] = (-1, b""),
) -> History:  # fmt: skip
    """Return the steps that a twin filters of what was seen in each, from a settled state on."""
    models = successive_models(given)
    at = max(
        index for index, model in enumerate(models) if not index or model.from_step <= max(settled[0], 0)
    )
    twin = models[at].knowledge.twin(lag=lag)
    if settled[1]:
        twin.restore_state(settled[1])
    found = History(twin, models[at].knowledge.scenario.observation.count)
    while twin.steps in seen:
        if at + 1 < len(models) and models[at + 1].from_step <= twin.steps:
            at += 1
            state, twin = twin.save_state(), models[at].knowledge.twin(lag=lag)
            twin.restore_state(state)
            found.twin = twin
        reading = seen[twin.steps]
        found.add(MissionStep(reading, twin.step(reading.observed, reading.control)))
    return found


class Source(Protocol):
    """Where observations come from: a simulated asset, a file, a broker."""

    def read(self, twin: Twin) -> Reading | None:
        """Return the next observation of what the twin watches; None where there are no more."""

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return what is assimilated in the place of one that no state allows, or that has no weight."""


def operate(twin: Twin, source: Source, *sinks: Callable[[MissionStep], None]) -> Iterator[MissionStep]:
    """Let a twin assimilate and decide until its source ends; each step is kept before it is given.

    Parameters
    ----------
    twin : Twin
    source : Source
        Asked for the next observation when the step before it was taken in.
    *sinks : callable
        Told each step, one after the other: a journal, a history.
    """
    while True:
        begin = time.perf_counter()
        reading = source.read(twin)
        if reading is None:
            return
        received = time.perf_counter()
        try:
            concluded = _assimilated(twin, reading)
        except (ImpossibleObservation, InvalidObservationError) as error:
            reading = source.impossible(reading, error)
            concluded = _assimilated(twin, reading)
        decided = time.perf_counter()
        step = MissionStep(reading, concluded)
        for sink in sinks:
            sink(step)
        kept = time.perf_counter()
        yield replace(step, seconds=(received - begin, decided - received, kept - decided))


def _assimilated(twin: Twin, reading: Reading) -> TwinStep:
    if reading.revises is not None:
        return twin.revise(reading.revises, reading.observed, reading.control)
    return twin.step(reading.observed, reading.control)


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *sinks: Callable[[MissionStep], None],
    history: History | None = None,
    progress: Progress | None = None,
) -> History:
    """Fly a mission, or the rest of one; an asset that ends its simulation ends the mission, and is a notice.

    Parameters
    ----------
    scenario : Scenario
    twin : Twin
    plant : Plant
        The asset and its truth, where the twin is.
    *sinks : callable
        As of `operate`.
    history : History, optional
        Takes in the steps; what it has is there also where an error ends the flight.
    progress : Progress, optional

    Raises
    ------
    MissionInputError, ImpossibleObservation, FmuError, FiniteElementError
        The mission cannot be flown on.
    """
    history = history or History(twin, scenario.observation.count)
    history.resumed_at = twin.steps
    unit = f"{scenario.mission.step_name}s"
    with (progress or SilentProgress()).stage("Flying", total=scenario.mission.steps, unit=unit) as stage:
        stage.advance(twin.steps)
        for step in operate(twin, plant, *sinks):
            history.add(step)
            stage.advance(detail=scenario.control_names[step.concluded.control_index])
    if plant.ended:
        history.ended = ended_sentence(scenario, twin.steps, plant.ended)
        history.notices.append((twin.steps - 1, Notice("ended", history.ended)))
    return history


def ended_sentence(scenario: Scenario, steps_flown: int, how: str) -> str:
    """Return that an asset has ended its simulation after some steps of a mission."""
    steps, unit = scenario.mission.steps, scenario.mission.step_name
    return f"The asset ended the mission after {steps_flown} of {steps} {unit}s: {how}"


STATE_ALLOWANCE = 64_000_000
STATE_SHARE = 4_000
"""Bytes of asset states that a checkpoint may hold, and how many more for each step.

States that need more are kept less often, so that the file grows with the steps and not with their square
(an asset that is replayed keeps the inputs of all its steps); the steps after the last one are flown again.
"""


def taken_up(journal: JournalFile, knowledge: Knowledge, plant: Plant) -> History:
    """Return what an earlier process flew, with plant and journal where it stopped.

    Steps behind the last saved state of the asset are flown again.

    Raises
    ------
    NotResumableError
        The journal is damaged, or the twin decides otherwise than an earlier process did.
    """
    for record, begin, end in records_backwards(journal.path):
        if not begin or record.get("asset_state") is not None:
            journal.truncate(end)
            state = record.get("asset_state", "")
            break
    history, _ = replay(journal.path, [BelievedModel(0, knowledge)], None)
    if history.steps:
        try:
            plant.restore(history, state_of(state))
        except (TypeError, ValueError, zlib.error) as error:
            raise damaged(journal.path, begin, f"it has another layout, {error}") from error
    return history


def kept_in(journal: JournalFile, plant: Plant) -> Callable[[MissionStep], None]:
    """Return a sink that writes steps into a journal, with the state of the asset as often as it may.

    What a kill cuts off, or has no state of the asset behind it, is flown again to the same bits.
    """
    since = 0

    def keep(step: MissionStep) -> None:
        nonlocal since
        since += 1
        state: str | None = state_text(plant.save_state())
        if journal.size + len(state or "") > STATE_ALLOWANCE and len(state or "") > STATE_SHARE * since:
            state = None
        journal.append(step_record(step) | {"asset_state": state})
        since *= state is None

    return keep
