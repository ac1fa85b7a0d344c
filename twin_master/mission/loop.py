"""The loop of a twin: observe, assimilate, predict, decide, write down, whatever the observations come from.

A mission is the loop with a simulated asset as its source, and at its end the history is smoothed. A watch
(`twin_master.watch`) is the same loop with a real one.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fmu_asset.errors import FmuEndedError
from reporting.progress import Progress, SilentProgress
from twin_master.errors import (
    ImpossibleObservation,
    InvalidObservationError,
    MissionError,
    NotResumableError,
    TwinMasterError,
)
from twin_master.mission.checkpoint import Checkpoint, FlownTurn
from twin_master.mission.plant import Plant, PlantRecord
from twin_master.network.estimator import Carried, Notice, Suspicion
from twin_master.network.twin import Twin, TwinTurn
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class TurnTiming:
    """Wall-clock seconds of one turn."""

    asset: float
    twin: float
    checkpoint: float


@dataclass(frozen=True)
class Reading:
    """An observation that is to be assimilated.

    Attributes
    ----------
    observed : (G,)
        What the sensors say, SI; NaN where lost. Where modes are observed, a row with their covariance; see
        `network.identified`.
    control : int or None
        Index of the control in force; None for the one that the twin proposed.
    revises : int or None
        The turn that it belongs to, if it came late; None for the next one.
    unreadable : dict of int to str
        What came in the place of a reading, of each sensor that has none, from 0.
    """

    observed: Float
    control: int | None = None
    revises: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)


class Source(Protocol):
    """Where observations come from: a simulated asset, a file, a broker."""

    def read(self, twin: Twin) -> Reading | None:
        """Return the next observation of what the twin watches; None where there are no more."""

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return what is assimilated in the place of one that no state allows, or that has no weight."""


def operate(
    twin: Twin, source: Source, keep: Callable[[Reading, TwinTurn], None] | None = None
) -> Iterator[tuple[Reading, TwinTurn, TurnTiming]]:
    """Let a twin assimilate and decide until its source ends; each turn is kept before it is given.

    Parameters
    ----------
    twin : Twin
        Which need not be new.
    source : Source
        Of its observations.
    keep : callable, optional
        Writes down a turn.
    """
    while True:
        begin = time.perf_counter()
        reading = source.read(twin)
        if reading is None:
            return
        received = time.perf_counter()
        try:
            turn = _assimilated(twin, reading)
        except (ImpossibleObservation, InvalidObservationError) as error:
            reading = source.impossible(reading, error)
            turn = _assimilated(twin, reading)
        decided = time.perf_counter()
        if keep is not None:
            keep(reading, turn)
        yield reading, turn, TurnTiming(received - begin, decided - received, time.perf_counter() - decided)


def _assimilated(twin: Twin, reading: Reading) -> TwinTurn:
    if reading.revises is not None:
        return twin.revise(reading.revises, reading.observed, reading.control)
    return twin.turn(reading.observed, reading.control)


@dataclass(frozen=True)
class Flight:
    """A flown mission of T turns.

    Attributes
    ----------
    observed : (T, G)
        What the sensors said, SI; NaN where lost.
    readings : (T, I)
        What inspections read, SI; NaN where none was asked for.
    control_index : (T,)
        Control in force in each turn.
    filtered : (T, S)
        p(D_t | o_0..o_t).
    log_evidence : (T,)
        log p(o_t | o_0..o_{t-1}).
    smoothed : (T, S)
        p(D_t | o_0..o_{T-1}).
    predicted : (T, H, S)
        p(D_{t+h} | o_0..o_t), h = 1..H.
    decision_probability : (T, U)
        What the control of turn t + 1 was decided by: its mode is flown.
    truth : PlantRecord or None
        What really happened; None where nobody knows.
    timing : tuple of TurnTiming
        Of the turns flown by this process.
    resumed_at : int
        Turn at which this process took over; 0 for an uninterrupted mission.
    first_turn : int
        Number of the first of the T turns.
    suspicion : tuple of Suspicion
        How well the model explains the sensors in each turn; empty where that is not watched.
    notices : tuple of (int, Notice)
        Turns, and what the operator should know of them.
    learnt_names : tuple of str
        The N quantities that are learnt, as the estimator names them.
    learnt : (T, N, 4)
        Mean, standard deviation and bounds of the central 90 % interval of each after each turn.
    carried : tuple of Carried
        What the estimator that learns carried on from each turn; empty where nothing is learnt.
    """

    observed: Float
    readings: Float
    control_index: Index
    filtered: Float
    log_evidence: Float
    smoothed: Float
    predicted: Float
    decision_probability: Float
    truth: PlantRecord | None
    timing: tuple[TurnTiming, ...]
    resumed_at: int = 0
    first_turn: int = 0
    suspicion: tuple[Suspicion, ...] = ()
    notices: tuple[tuple[int, Notice], ...] = ()
    learnt_names: tuple[str, ...] = ()
    learnt: Float = field(default_factory=lambda: np.empty((0, 0, 4)))
    carried: tuple[Carried, ...] = ()

    def behind(self, skipped: int) -> "Flight":
        """Return the turns behind the first `skipped` of a watched asset; the notices stay those of all."""
        by_turn = (
            "observed", "readings", "control_index", "filtered", "log_evidence", "smoothed", "predicted",
            "decision_probability", "suspicion", "learnt", "carried",
        )  # fmt: skip
        cut = {name: getattr(self, name)[skipped:] for name in by_turn}
        return replace(self, **cut, first_turn=self.first_turn + skipped)

    @property
    def happened(self) -> PlantRecord:
        """What really happened.

        Raises
        ------
        MissionError
            Nobody knows: a real asset was watched.
        """
        if self.truth is None:
            raise MissionError("what really happened to a watched asset is not known.")
        return self.truth


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *,
    checkpoint: Checkpoint | None = None,
    keep: Callable[[FlownTurn], None] | None = None,
    progress: Progress | None = None,
) -> Flight:
    """Fly a mission, or the rest of one; an asset that ends its simulation ends the mission, and is a notice.

    Parameters
    ----------
    scenario : Scenario
        Number of turns and first control.
    twin : Twin
        A twin that has seen nothing yet.
    plant : Plant
        The asset with its truth, before its first turn.
    checkpoint : Checkpoint, optional
        Where an interrupted mission stopped.
    keep : callable, optional
        Called with what cannot be computed again after every turn.
    progress : Progress, optional
        Shows the turns.

    Raises
    ------
    ImpossibleObservation, AssetOutputError, FmuError
        The mission cannot go on; the last checkpoint is that of the turn before.
    NotResumableError
        The decisions of the checkpoint do not follow from its observations.
    """
    steps = scenario.mission.steps
    beliefs = Beliefs(scenario.observation.count)
    timing: list[TurnTiming] = []
    if checkpoint is not None:
        _replay(twin, checkpoint, beliefs)
        plant.restore(checkpoint.plant, checkpoint.asset_state)
    resumed_at = twin.turns

    def kept(reading: Reading, turn: TwinTurn) -> None:
        if keep is not None:
            state, noise_free, monitors = plant.latest()
            keep(
                FlownTurn(
                    control_index=turn.control_index,
                    next_control=turn.next_control,
                    observed=reading.observed,
                    state=state,
                    observation=noise_free,
                    monitors=monitors,
                    asset_state=plant.save_state(),
                    concluded=turn,
                )
            )

    unit = f"{scenario.mission.step_name}s"
    with (progress or SilentProgress()).stage("Flying", total=steps, unit=unit) as stage:
        stage.advance(resumed_at)
        source = _Flown(plant, scenario)
        for reading, turn, seconds in operate(twin, source, kept):
            beliefs.add(reading.observed, turn)
            timing.append(seconds)
            stage.advance(detail=scenario.control_names[turn.control_index])
    if source.ended is not None:
        sentence = ended_sentence(scenario, twin.turns, source.ended)
        beliefs.notices.append((twin.turns - 1, Notice("ended", sentence)))
    return beliefs.flight(twin, plant.record(), tuple(timing), resumed_at=resumed_at)


def ended_sentence(scenario: Scenario, turns: int, how: str) -> str:
    """Return that an asset has ended its simulation after some turns of a mission."""
    steps, unit = scenario.mission.steps, scenario.mission.step_name
    return f"The asset ended the mission after {turns} of {steps} {unit}s: {how}"


def decided_to_end(scenario: Scenario, control_index: int) -> str:
    """Return that an action has ended a mission, for `ended_sentence`."""
    return f"the twin decided on `{scenario.control_names[control_index]}`."


class _Flown:
    """A simulated asset as a source: it is flown under the control that the twin proposed.

    Attributes
    ----------
    ended : str or None
        How the asset has ended its simulation before the mission was over, in a sentence.
    """

    ended: str | None = None

    def __init__(self, plant: Plant, scenario: Scenario) -> None:
        self._plant, self._scenario = plant, scenario

    def read(self, twin: Twin) -> Reading | None:
        if twin.turns == self._scenario.mission.steps:
            return None
        control = twin.proposed_control
        before = twin.control_of(twin.turns - 1) if twin.turns else None
        if before is not None and self._scenario.ends(before):
            self.ended = decided_to_end(self._scenario, before)
            return None
        try:
            return Reading(self._plant.turn(control, before), control)
        except FmuEndedError as error:
            if not twin.turns:
                raise
            self.ended = error.sentence
            return None

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        raise error


@dataclass
class Beliefs:
    """What is kept of each turn of a twin, for the store; `sensors` values of each row that is observed."""

    sensors: int | None = None
    observed: list[Float] = field(default_factory=list)
    beside: list[Float] = field(default_factory=list)
    control_index: list[int] = field(default_factory=list)
    filtered: list[Float] = field(default_factory=list)
    log_evidence: list[float] = field(default_factory=list)
    predicted: list[Float] = field(default_factory=list)
    decision_probability: list[Float] = field(default_factory=list)
    suspicion: list[Suspicion] = field(default_factory=list)
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    learnt_names: tuple[str, ...] = ()
    learnt: list[Float] = field(default_factory=list)
    residual: list[Float] = field(default_factory=list)

    def add(self, observed: Float, turn: TwinTurn) -> None:
        """Keep a turn."""
        self.observed.append(observed[: self.sensors])
        self.beside.append(observed[len(self.observed[-1]) :])
        self.control_index.append(turn.control_index)
        self.filtered.append(turn.filtered)
        self.log_evidence.append(turn.log_evidence)
        self.predicted.append(turn.prediction.predicted)
        self.decision_probability.append(turn.decision_probability)
        if turn.suspicion is not None:
            self.suspicion.append(turn.suspicion)
        self.notices += [(turn.turn, notice) for notice in turn.notices]
        if turn.learnt:
            self.learnt_names = tuple(turn.learnt)
            self.learnt.append(np.array([learnt.figures for learnt in turn.learnt.values()]))
        if turn.expected is not None:
            mean, noise = turn.expected()
            self.residual.append((self.observed[-1] - mean) / noise)

    def flight(
        self,
        twin: Twin,
        truth: PlantRecord | None,
        timing: tuple[TurnTiming, ...] = (),
        *,
        resumed_at: int = 0,
        first_turn: int = 0,
    ) -> Flight:
        """Return the turns as arrays, see `Flight`; the twin has kept all of them."""
        count, width = len(self.observed), max(map(len, self.beside), default=0)
        none = np.full(width, np.nan)  # a row without readings has none of them
        return Flight(
            observed=np.array(self.observed),
            readings=np.array([[*row, *none[len(row) :]] for row in self.beside]).reshape(count, width),
            control_index=np.array(self.control_index, dtype=np.int64),
            filtered=np.array(self.filtered),
            log_evidence=np.array(self.log_evidence),
            smoothed=twin.smoothed()[-count:],
            predicted=np.array(self.predicted),
            decision_probability=np.array(self.decision_probability),
            truth=truth,
            timing=timing,
            resumed_at=resumed_at,
            first_turn=first_turn,
            suspicion=tuple(self.suspicion),
            notices=tuple(self.notices),
            learnt_names=self.learnt_names,
            learnt=np.array(self.learnt).reshape(len(self.learnt), len(self.learnt_names), 4),
            carried=twin.carried[-count:] if self.learnt_names else (),
        )


def _replay(twin: Twin, checkpoint: Checkpoint, beliefs: Beliefs) -> None:
    """Let the twin see again what was observed, and check that it decides as it did."""
    for step, observation in enumerate(checkpoint.observed):
        turn = twin.turn(observation, int(checkpoint.control_index[step]))
        if turn.next_control != checkpoint.control_index[step + 1]:
            raise NotResumableError(
                f"the journal decided otherwise after turn {step} than this version does: "
                "fly the mission again with --replace."
            )
        beliefs.add(observation, turn)
