"""The loop of missions, fleets, watches and replays: act and observe, assimilate and decide."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from numpy.typing import ArrayLike

from reporting.log import module_logger
from reporting.progress import Progress, SilentProgress
from twin_master.errors import ImpossibleObservation, InvalidObservationError
from twin_master.mission.plant import Plant
from twin_master.mission.steps import History, MissionStep, OperatedStep, Reading, Source, StepT
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin
from twin_master.scenario.schema import Scenario

_logger = module_logger(__name__)


class SteppedTwin(Protocol[StepT]):
    """A `Twin`, or `TwinsSideBySide`: it assimilates an observation and decides."""

    def step(self, observation: ArrayLike, control: int | None = None) -> StepT:
        """Return estimate and decision after an observation; a control left out is the proposed."""


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
    for sentence in plant.endings.values():
        history.sentence_of_early_end = sentence
        history.notices.append((twin.steps - 1, Notice("ended", sentence)))
        _logger.info("%s", sentence)
    return history
