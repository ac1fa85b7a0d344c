"""Filtering the steps of a journal again, when a run or watch is resumed, taught or stored.

A mission writes states of its asset into the journal, from which it is resumed.
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from reporting.json_file import JsonObject
from twin_master.errors import NotResumableError
from twin_master.mission.journal import (
    JournalFile,
    JournalLine,
    NoiseFree,
    damaged_line_error,
    decode_state,
    encode_state,
    large_parts,
    reading_from_line,
    records_backwards,
    short_record,
    step_record,
    with_short_truth,
)
from twin_master.mission.plant import Plant
from twin_master.mission.preparation import Knowledge
from twin_master.mission.recent_parts import BLOCK_STEPS, RecentParts, is_whole_step
from twin_master.mission.steps import History, MissionStep, Reading, Source, StepSink, operate
from twin_master.network.twin import Twin


@dataclass(frozen=True)
class BelievedModel:
    """A model, and the first step that the twin filters with it.

    Attributes
    ----------
    patch : Path or None
        The file of its patch, if the model is patched.
    """

    from_step: int
    knowledge: Knowledge
    patch: Path | None = None


class SettledState(NamedTuple):
    """The state of a twin after a step that no late observation can revise any more.

    Attributes
    ----------
    step : int
        The number of the last step that cannot be revised any more.
    twin_state : bytes
        The state, as `Twin.save_state` returns it.
    """

    step: int
    twin_state: bytes


def replay(
    path: Path,
    models: Sequence[BelievedModel],
    lag: int | None,
    *,
    first_step: int | None = None,
    end: int | None = None,
    question: BelievedModel | None = None,
    noise_free: NoiseFree | None = None,
) -> tuple[History, JsonObject]:
    """Filter the steps of a journal again, with late observations at the steps they belong to.

    The journal is read backwards to the last settled state of the twin before all steps that are
    needed. The steps after that state are filtered again.

    Parameters
    ----------
    models : sequence of BelievedModel
        The model at the beginning, and those that were adopted later.
    lag : int or None
        The lag of the twin, in steps.
    first_step : int, optional
        The first step whose belief is needed. If left out, only the twin after the last step is
        needed.
    end : int, optional
        The end of the last line to read, in bytes; the end of the journal if left out.
    question : BelievedModel, optional
        A further model, to find what the twin would believe with it. If it is given, the decisions
        are not compared with those of the journal.
    noise_free : callable, optional
        Removes noise and drift from readings; needed for the steps of a simulated asset.

    Returns
    -------
    History
        The steps after the settled state; its twin stands after the last one.
    dict
        The record of the last line; empty if the journal has none.

    Raises
    ------
    NotResumableError
        If the journal was changed or is damaged, or if the twin now decides otherwise than the
        journal.
    """
    required_steps = []
    if first_step is not None:
        required_steps.append(first_step)
    if question is not None:
        required_steps.append(question.from_step)
    scan = _BackwardScan(path, required_steps, noise_free)
    for line in records_backwards(path, end, RecentParts(path.parent)):
        try:
            needs_earlier_lines = scan.read_line(line)
        except (KeyError, TypeError, ValueError, AttributeError, zlib.error) as error:
            reason = f"it has another layout, {error}"
            raise damaged_line_error(path, line.begin, reason) from error
        if not needs_earlier_lines:
            break
    all_models = [*models] if question is None else [*models, question]
    history = refilter(scan.readings, all_models, lag, scan.settled)
    if question is None:
        scan.check_decisions(history)
    return history, scan.last_record


class _BackwardScan:
    """The readings, decisions and settled state in a journal that is read backwards.

    Attributes
    ----------
    readings : dict of int to Reading
        The last reading of each step.
    settled : SettledState or None
        The last settled state before all required steps, once a line with one was taken in.
    last_record : dict
        The record of the last line.
    """

    def __init__(self, path: Path, required_steps: list[int], noise_free: NoiseFree | None) -> None:
        self._noise_free = noise_free
        self.readings: dict[int, Reading] = {}
        self.settled: SettledState | None = None
        self.last_record: JsonObject = {}
        self._path = path
        self._required_steps = required_steps
        self._next_controls: dict[int, int] = {}
        # Later lines of the journal revised the decisions from this step on.
        self._first_revised_step = math.inf
        self._later_step: int | None = None
        self._later_begin = 0

    def read_line(self, line: JournalLine) -> bool:
        """Evaluate one line of the journal, and return whether earlier lines are needed, too.

        The lines are read backwards, from the last one to the header, which is the first one.
        """
        is_header = line.begin == 0
        step = -1 if is_header else int(line.record["step"])
        # The step of a line is that of the following line or the one before it.
        later_step = self._later_step
        if later_step is not None and later_step - step not in (0, 1):
            begin = self._later_begin if step < later_step else line.begin
            raise damaged_line_error(self._path, begin, f"step {later_step} is out of place")
        settled_step = -1 if self.settled is None else self.settled.step
        if is_header or step <= settled_step:
            return False
        record = line.record
        if self._later_step is None:
            self.last_record = record
        self._later_step = step
        self._later_begin = line.begin

        # The last settled state before all required steps. These include the first step of each
        # model that was adopted later.
        if self.settled is None and "settled" in record:
            settled_step = int(record["settled"]["step"])
            if all(settled_step < required_step for required_step in self._required_steps):
                self.settled = SettledState(settled_step, decode_state(record["settled"]["state"]))

        # An adopted model and a late observation revise all decisions from their step on.
        if step < self._first_revised_step:
            self._next_controls.setdefault(step, record["next_control"])
        if "model" in record:
            from_step = int(record["model"]["from_step"])
            self._first_revised_step = min(self._first_revised_step, from_step)
            self._required_steps.append(from_step)
        elif "observed" in record:
            observed_step = int(record.get("observation_step", step))
            self._first_revised_step = min(self._first_revised_step, observed_step)
            self.readings.setdefault(observed_step, reading_from_line(record, self._noise_free))
        return True

    def check_decisions(self, history: History) -> None:
        """Refuse a history if a decision differs from that in the journal."""
        for step in history.steps:
            number = step.twin_step.step
            control = step.twin_step.next_control
            if self._next_controls.get(number, control) == control:
                continue
            advice = "fly the mission again with --replace"
            is_watch = "intake" in self.last_record
            if is_watch:
                observations = f"`--observations {self._path.parent}`"
                advice = f"begin another watch, in another folder, with {observations}"
            raise NotResumableError(
                f"the journal has another decision after step {number} than this version makes: "
                f"{advice}."
            )


def models_in_force(models: Sequence[BelievedModel]) -> list[BelievedModel]:
    """Return the models with which the steps are filtered, in the order of the steps.

    `models` are in the order of their adoption. A model is dropped if a later one holds from the
    same or an earlier step on.
    """
    in_force = []
    for index, model in enumerate(models):
        later_models = models[index + 1 :]
        if all(later_model.from_step > model.from_step for later_model in later_models):
            in_force.append(model)
    return in_force


class _StoredReadings(Source[Twin]):
    """The readings of consecutive steps, up to the first step of the next model."""

    def __init__(self, readings: Mapping[int, Reading], end: float) -> None:
        self._readings = readings
        self._end = end

    def read(self, twin: Twin) -> Reading | None:
        """Return the reading of the next step; None if there is none."""
        return self._readings.get(twin.steps) if twin.steps < self._end else None


def refilter(
    readings: Mapping[int, Reading],
    models: Sequence[BelievedModel],
    lag: int | None = None,
    settled: SettledState | None = None,
) -> History:
    """Return the steps of a mission after its readings are filtered again.

    Each reading is filtered with the model that was in force in its step. The steps are
    consecutive; filtering ends at the first step without a reading.

    Parameters
    ----------
    readings : mapping of int to Reading
        The reading of each step.
    models : sequence of BelievedModel
        The models in the order of their adoption.
    lag : int or None
        The lag of the twin, in steps.
    settled : SettledState, optional
        The state to begin with; the one before the first step if left out.
    """
    # begin with the model that is in force at the first step
    models = models_in_force(models)
    first_step = 0 if settled is None else max(settled.step, 0)
    while len(models) > 1 and models[1].from_step <= first_step:
        models = models[1:]
    twin = models[0].knowledge.twin(lag=lag)
    if settled is not None:
        twin.restore_state(settled.twin_state)
    history = History(twin, models[0].knowledge.scenario.observation.count)
    for next_model in [*models[1:], None]:
        end = math.inf if next_model is None else next_model.from_step
        for _ in operate(history.twin, _StoredReadings(readings, end), history.add):
            pass
        if next_model is None or history.twin.steps not in readings:
            break
        # The twin goes on with the next model, from the belief that it has reached.
        twin = next_model.knowledge.twin(lag=lag)
        twin.restore_state(history.twin.save_state())
        history.twin = twin
    return history


def spans_of_models(
    history: History, models: Sequence[BelievedModel]
) -> list[tuple[Knowledge, slice]]:
    """Return each model in force with the slice of steps that were filtered with it.

    Parameters
    ----------
    models : sequence of BelievedModel
        The models in the order of their adoption.
    """
    models = models_in_force(models)
    begins = [max(0, model.from_step - history.first_step) for model in models]
    ends = [*begins[1:], len(history.steps)]
    spans = []
    for model, begin, end in zip(models, begins, ends, strict=True):
        spans.append((model.knowledge, slice(begin, end)))
    return spans


STATE_ALLOWANCE = 16_000_000
"""Size of a file up to which it keeps every state of the asset, in bytes.

This holds for the files of recent parts, to which the state of every step belongs, and for the
journal, to which that of every `BLOCK_STEPS`-th step belongs.
"""
STATE_BYTES_PER_STEP = 4_000
"""Beyond that size: largest size of a state for each step since the last kept state, in bytes.

An asset that is replayed keeps the inputs of all its steps in its state. If every step kept it, the
files would grow with the square of the number of steps. Steps after the last kept state are flown
again when a mission is resumed.
"""


def restore_flight(journal: JournalFile, knowledge: Knowledge, plant: Plant) -> History:
    """Return the steps of an earlier process, and set plant and journal to their end.

    The journal is cut after the last saved state of the asset; later steps must be flown again.

    Raises
    ------
    NotResumableError
        If the journal is damaged, or if the twin now decides otherwise than the earlier process.
    """
    for line in records_backwards(journal.path, recent=journal.recent):
        is_header = line.begin == 0
        if is_header or line.record.get("asset_state") is not None:
            journal.truncate(line.end)
            break
    models = [BelievedModel(0, knowledge)]
    history, _ = replay(journal.path, models, None, noise_free=plant.noise_free)
    if history.steps:
        try:
            plant.restore(history, decode_state(line.record.get("asset_state", "")))
        except (TypeError, ValueError, zlib.error) as error:
            reason = f"it has another layout, {error}"
            raise damaged_line_error(journal.path, line.begin, reason) from error
    return history


def journal_sink(journal: JournalFile, plant: Plant) -> StepSink:
    """Return a sink that appends each step to a journal, with the state of the asset after it.

    If the process is killed, the steps after the last state are flown again, with the same results
    to the last bit. A state is left out if it would make the files too large.
    """
    steps_since_state = 0

    def append_step(step: MissionStep) -> None:
        nonlocal steps_since_state
        steps_since_state += 1
        number = step.twin_step.step
        record = with_short_truth(step_record(step), plant.noise_free)
        parts = large_parts(record)
        state = encode_state(plant.save_state())
        if _may_keep(state, journal.recent.size_before(number), steps_since_state):
            parts["asset_state"] = state
            steps_since_state = 0
        record = short_record(record, is_whole=is_whole_step(number))
        if number % BLOCK_STEPS == 0 and _may_keep(state, journal.size, BLOCK_STEPS):
            record["asset_state"] = state
        journal.append(record, parts)

    return append_step


def _may_keep(state: str, file_size: int, steps_since_state: int) -> bool:
    """Return whether a state is small enough for a file of this size, see `STATE_ALLOWANCE`."""
    is_within_allowance = file_size + len(state) <= STATE_ALLOWANCE
    return is_within_allowance or len(state) <= STATE_BYTES_PER_STEP * steps_since_state
