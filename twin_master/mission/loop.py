"""The loop of missions, fleets and watches: act and observe, assimilate and decide.

A mission that was interrupted can be resumed.
"""

import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol, TypeVar

from numpy.typing import ArrayLike

from reporting.log import module_logger
from reporting.progress import Progress, SilentProgress
from twin_master.errors import (
    ImpossibleObservation,
    InvalidObservationError,
    TwinMasterError,
)
from twin_master.mission.journal import (
    JournalFile,
    damaged_line_error,
    decode_state,
    encode_state,
    large_parts,
    records_backwards,
    short_record,
    step_record,
    with_short_truth,
)
from twin_master.mission.plant import Plant
from twin_master.mission.preparation import Knowledge
from twin_master.mission.recent_parts import BLOCK_STEPS, is_whole_step
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.steps import History, MissionStep, OperatedStep, Reading, StepT
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin
from twin_master.scenario.schema import Scenario

_logger = module_logger(__name__)


class SteppedTwin(Protocol[StepT]):
    """A `Twin`, or `TwinsSideBySide`: it assimilates an observation and decides."""

    def step(self, observation: ArrayLike, control: int | None = None) -> StepT:
        """Return estimate and decision after an observation; a control left out is the proposed."""


AnyTwin = TypeVar("AnyTwin", contravariant=True)


class Source(Protocol[AnyTwin]):
    """Where observations come from: simulated assets, a file, a broker."""

    def read(self, twin: AnyTwin) -> Reading | None:
        """Act on the decision of the twin, and return its next observation; None at the end."""

    def replace_impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return the observation that replaces one that the twin refused with an error."""


StepSink = Callable[[MissionStep], None]
"""Stores a step, such as in a journal or in a history."""


def operate(
    twin: SteppedTwin[StepT],
    source: Source[Any],
    *sinks: Callable[[OperatedStep[StepT]], None],
) -> Iterator[OperatedStep[StepT]]:
    """Let a twin assimilate and decide until its source ends; yield each step once it is stored.

    Parameters
    ----------
    twin : Twin or TwinsSideBySide
        The twin or twins that assimilate and decide.
    source : Source
        The source of such a twin. It is asked for an observation after the previous step was
        stored.
    *sinks : callable
        Functions that store each step, called one after the other.
    """
    while True:
        begin = time.perf_counter()
        reading = source.read(twin)
        if reading is None:
            return
        time_received = time.perf_counter()
        try:
            twin_step = _assimilate(twin, reading)
        except (ImpossibleObservation, InvalidObservationError) as error:
            reading = source.replace_impossible(reading, error)
            twin_step = _assimilate(twin, reading)
        time_decided = time.perf_counter()
        step = OperatedStep(reading, twin_step)
        for sink in sinks:
            sink(step)
        time_stored = time.perf_counter()
        yield replace(
            step,
            seconds=(
                time_received - begin,
                time_decided - time_received,
                time_stored - time_decided,
            ),
        )


def _assimilate(twin: SteppedTwin[StepT], reading: Reading) -> StepT:
    """Let the twin take in a reading, as its next step or as the revision of an earlier one."""
    if reading.revises is not None and isinstance(twin, Twin):
        return twin.revise(reading.revises, reading.observed, reading.control)
    return twin.step(reading.observed, reading.control)


def log_notices(step: MissionStep) -> None:
    """Write the notices of a step to the log."""
    for notice in step.twin_step.notices:
        _logger.info("%s", notice.sentence)


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *sinks: StepSink,
    history: History | None = None,
    progress: Progress | None = None,
) -> History:
    """Fly a mission to its end, from the step that twin and plant have reached.

    An asset that ends its simulation early ends the mission; this is a notice to the operator.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the mission.
    twin : Twin
        The twin that assimilates and decides.
    plant : Plant
        The asset and its truth, at the same step as the twin.
    *sinks : callable
        The functions that store each step, see `operate`.
    history : History, optional
        The steps flown so far; the new ones are added to it, also if an error ends the flight.
    progress : Progress, optional
        The display of the progress in steps.

    Returns
    -------
    History
        All steps.

    Raises
    ------
    MissionInputError, ImpossibleObservation, FmuError, FiniteElementError
        If the mission cannot go on.
    """
    history = history or History(twin, scenario.observation.count)
    history.resumed_at = twin.steps
    progress = progress or SilentProgress()
    unit = f"{scenario.mission.step_name}s"
    with progress.stage("Flying", total=scenario.mission.steps, unit=unit) as stage:
        stage.advance(twin.steps)
        for step in operate(twin, plant, *sinks, log_notices):
            history.add(step)
            stage.advance(detail=scenario.control_names[step.twin_step.control_index])
    if plant.reason_of_end:
        sentence = early_end_sentence(scenario, twin.steps, plant.reason_of_end)
        history.sentence_of_early_end = sentence
        history.notices.append((twin.steps - 1, Notice("ended", sentence)))
        _logger.info("%s", sentence)
    return history


def early_end_sentence(scenario: Scenario, steps_flown: int, reason: str) -> str:
    """Return the sentence that the mission ended before its last step."""
    mission = scenario.mission
    steps = f"{steps_flown} of {mission.steps} {mission.step_name}s"
    return f"The asset ended the mission after {steps}: {reason}"


STATE_ALLOWANCE = 16_000_000
"""Size of a file up to which every state of the asset is kept in it, in bytes.

This holds for the files of recent parts, which have the state of every step, and for the journal,
which has those of every `BLOCK_STEPS`-th step.
"""
STATE_SHARE = 4_000
"""Largest size of a state beyond it, in bytes for each step since the last state that was kept.

An asset that is replayed keeps the inputs of all its steps in its state. If every step kept it, the
files would grow with the square of the number of steps. Steps after the last kept state are flown
again when a mission is resumed.
"""


def restore_flight(journal: JournalFile, knowledge: Knowledge, plant: Plant) -> History:
    """Return the steps of an earlier process, and set plant and journal to the end of these steps.

    Lines after the last saved state of the asset are removed from the journal; their steps must be
    flown again.

    Parameters
    ----------
    journal : JournalFile
        The journal of the run folder.
    knowledge : Knowledge
        The knowledge of the twin.
    plant : Plant
        The plant at its start.

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
    """Return a sink that appends steps to a journal, and the state of the asset after each.

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
    """Return whether a state is small enough for a file of a size, see `STATE_ALLOWANCE`."""
    is_within_allowance = file_size + len(state) <= STATE_ALLOWANCE
    return is_within_allowance or len(state) <= STATE_SHARE * steps_since_state
