"""The loop of a mission or watch: a twin assimilates observations step by step, and decides."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import AnyArray, Float
from reporting.system.log import module_logger
from twin_master.errors import ImpossibleObservation, InvalidObservationError, TwinMasterError
from twin_master.network.estimator import Notice, Suspicion
from twin_master.network.twin import Twin, TwinStep

_logger = module_logger(__name__)

StepT = TypeVar("StepT", covariant=True)
"""The estimates and decisions of a step: those of one twin, or of several side by side."""


class GroundTruth(NamedTuple):
    """The true state and values of a step, for store and journal; the twin never sees them.

    Attributes
    ----------
    state : (F,) or (B, F) array
        The true value of each state factor, SI; of B missions if they fly side by side.
    observation : (G,) or (B, G) array
        The observation without noise, SI.
    monitors : dict of str to float
        Quantities that the asset of a single mission reports of itself, such as an error bound.
    """

    state: Float
    observation: Float
    monitors: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """An observation for the twin to assimilate.

    Attributes
    ----------
    observed : (G + I,) or (B, G + I) array
        The values of G sensors and I inspections, SI; NaN where nothing was received. B missions
        that fly side by side have a row each.
    control : int or None
        The index of the control in force; None for the one that the twin proposed.
    revises : int or None
        The earlier step that the observation belongs to; None for the next step.
    unreadable : dict of int to str
        The content that a sensor sent in the place of a number, by the index of the sensor.
    ground_truth : GroundTruth or None
        The true state and values in the step; None for a real asset.
    """

    observed: Float
    control: int | None = None
    revises: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)
    ground_truth: GroundTruth | None = None


AnyTwin = TypeVar("AnyTwin", contravariant=True)


class Source(Protocol[AnyTwin]):
    """A source of observations: simulated assets, a file, a broker, a journal."""

    def read(self, twin: AnyTwin) -> Reading | None:
        """Act on the decision of the twin, and return its next observation; None at the end."""

    def replace_impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return an observation in place of one that the twin refused, or raise the error."""
        raise error


@dataclass(frozen=True)
class OperatedStep(Generic[StepT]):
    """A step of a mission or a watch.

    Attributes
    ----------
    reading : Reading
        The observation of the step.
    twin_step : TwinStep or StepOfTwins
        The estimate and the decision of the twin, or of all twins that fly side by side.
    seconds : tuple of float
        The wall-clock time of the source, of the twin, and of storing the step.
    """

    reading: Reading
    twin_step: StepT
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)


MissionStep = OperatedStep[TwinStep]
"""A step of a single twin."""


class _StackedAttribute:
    """An attribute of all steps of a `History`, stacked along the first axis of an array."""

    def __init__(self, path: str) -> None:
        self._attribute_of = attrgetter(path)

    def __get__(self, history: "History", _owner: type) -> AnyArray:
        return np.array([self._attribute_of(step) for step in history.steps])


@dataclass
class History:
    """The steps of one twin in order.

    T is the number of steps, G that of sensors, I that of values after them in a row.

    Attributes
    ----------
    twin : Twin
        The twin; it must keep all steps if they are to be smoothed.
    sensors : int
        The number of sensors G; after their values, a row holds the I readings of inspections, or
        the covariance of identified modes.
    steps : list of MissionStep
        The steps.
    notices : list of (int, Notice)
        The notices to the operator, each with the number of its step.
    resumed_at : int
        The number of steps that an earlier process flew.
    sentence_of_early_end : str
        How the asset ended the mission before its last step; empty if it did not.
    observation_rows : (T, G + I) array
        All observed values, NaN where nothing was received; `observed` and `readings` are its
        parts.
    control_index, log_evidence, filtered, predicted, decision_probability, unexplained : (T, ...)
    array
        The attributes of `TwinStep`.
    state, observation : (T, ...) array
        The attributes of `GroundTruth`; only for a simulated asset.
    seconds : (T, 3) array
        The times of `MissionStep`.
    """

    twin: Twin
    sensors: int
    steps: list[MissionStep] = field(default_factory=list)
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    resumed_at: int = 0
    sentence_of_early_end: str = ""

    observation_rows = _StackedAttribute("reading.observed")
    control_index = _StackedAttribute("twin_step.control_index")
    filtered = _StackedAttribute("twin_step.filtered")
    log_evidence = _StackedAttribute("twin_step.log_evidence")
    predicted = _StackedAttribute("twin_step.prediction.predicted")
    decision_probability = _StackedAttribute("twin_step.decision_probability")
    unexplained = _StackedAttribute("twin_step.unexplained")
    state = _StackedAttribute("reading.ground_truth.state")
    observation = _StackedAttribute("reading.ground_truth.observation")
    seconds = _StackedAttribute("seconds")

    def add(self, step: MissionStep) -> None:
        """Append a step and its notices.

        The joint prediction of states and controls is dropped: it is large, and it follows from the
        rest of the step.
        """
        prediction = replace(step.twin_step.prediction, joint=np.empty(0))
        twin_step = replace(step.twin_step, prediction=prediction)
        self.steps.append(replace(step, twin_step=twin_step))
        for notice in twin_step.notices:
            self.notices.append((twin_step.step, notice))

    def without_first(self, count: int) -> "History":
        """Return a copy without the first `count` steps; it has the notices of all steps."""
        return replace(self, steps=self.steps[count:])

    @property
    def first_step(self) -> int:
        """The number of the first step."""
        return self.steps[0].twin_step.step if self.steps else 0

    @property
    def observed(self) -> Float:
        """The values of the sensors (T, G), NaN where nothing was received."""
        return self.observation_rows[:, : self.sensors]

    @property
    def readings(self) -> Float:
        """The row's values after the sensors (T, I): readings of inspections, or a covariance."""
        return self.observation_rows[:, self.sensors :]

    @property
    def simulated(self) -> bool:
        """Whether the ground truth of the steps is known, as for a simulated asset."""
        return bool(self.steps) and self.steps[0].reading.ground_truth is not None

    @property
    def monitors(self) -> dict[str, Float]:
        """Quantities that the asset reports of itself, each as an array (T,)."""
        records = []
        for step in self.steps:
            if step.reading.ground_truth is not None:
                records.append(step.reading.ground_truth.monitors)
        if not records:
            return {}
        return {name: np.array([record[name] for record in records]) for name in records[-1]}

    @cached_property
    def smoothed(self) -> Float:
        """The belief p(D_k | all observations) in each step (T, S)."""
        return self.twin.smoothed()[-len(self.steps) :]

    @property
    def suspicion(self) -> tuple[Suspicion, ...]:
        """How well the model explained the sensors in each step; empty if that is not watched."""
        suspicions = (step.twin_step.suspicion for step in self.steps)
        return tuple(suspicion for suspicion in suspicions if suspicion is not None)

    @property
    def learnt_names(self) -> tuple[str, ...]:
        """The names of the quantities that the twin learns."""
        return tuple(self.steps[-1].twin_step.learnt) if self.steps else ()

    @property
    def learnt(self) -> Float:
        """Posterior of N learnt quantities in each step, `Learnt.moments_and_bounds`: (T, N, 4)."""
        posteriors = []
        for step in self.steps:
            posteriors.append(
                [posterior.moments_and_bounds for posterior in step.twin_step.learnt.values()]
            )
        return np.array(posteriors).reshape(len(self.steps), len(self.learnt_names), 4)


class SteppedTwin(Protocol[StepT]):
    """A `Twin`, or `TwinsSideBySide`: it assimilates an observation and decides."""

    def step(self, observation: ArrayLike, control: int | None = None) -> StepT:
        """Return the twin's step after an observation; by default under the proposed control."""


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
    """Let the twin assimilate a reading, as its next step or as the revision of an earlier one."""
    if reading.revises is not None and isinstance(twin, Twin):
        return twin.revise(reading.revises, reading.observed, reading.control)
    return twin.step(reading.observed, reading.control)


def log_notices(step: MissionStep) -> None:
    """Write the notices of a step to the log."""
    for notice in step.twin_step.notices:
        _logger.info("%s", notice.sentence)
