"""A turn, from its observation to its decision, and the turns of a mission as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from twin_master.network.estimator import Notice, Suspicion
from twin_master.network.twin import Twin, TwinTurn


class Happened(NamedTuple):
    """What really happened in a turn, for store and journal; never for the twin.

    Attributes
    ----------
    state : (F,)
        True state, SI.
    observation : (G,)
        Noise-free observation, SI.
    monitors : dict of str to float
        Figures that the asset reported of itself.
    """

    state: Float
    observation: Float
    monitors: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """An observation that is to be assimilated.

    Attributes
    ----------
    observed : (G + I,)
        What the sensors said and inspections read, SI; NaN where nothing was received.
    control : int or None
        Index of the control in force; None is the one that was proposed.
    revises : int or None
        The earlier turn that it belongs to; None is the next turn.
    unreadable : dict of int to str
        What came in the place of a reading, by the index of the sensor.
    happened : Happened or None
        Of a simulated asset.
    """

    observed: Float
    control: int | None = None
    revises: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)
    happened: Happened | None = None


@dataclass(frozen=True)
class Turn:
    """A turn.

    Attributes
    ----------
    reading : Reading
        What came.
    concluded : TwinTurn
        What the twin made of it.
    seconds : tuple of float
        On the clock: of the source, of the twin, and of those that kept it.
    """

    reading: Reading
    concluded: TwinTurn
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)


class _Column:
    """What the turns say under a name, as an array with a leading axis of the turns."""

    def __init__(self, name: str) -> None:
        self._of = attrgetter(name)

    def __get__(self, history: "History", _owner: type) -> NDArray[Any]:
        return np.array([self._of(turn) for turn in history.turns])


@dataclass
class History:
    """The turns of one twin, T of them, in their order.

    Attributes
    ----------
    twin : Twin
        It has kept all of them where they are to be smoothed.
    sensors : int
        Values of a row that are observed; behind them stand readings of inspections, or a covariance.
    turns : list of Turn
    notices : list of (int, Notice)
        What the operator was told, and in which turn.
    resumed_at : int
        Turns that an earlier process flew.
    ended : str
        How the asset ended the mission before its last turn; empty where it did not.
    row : (T, G + I)
        All that came; `observed` and `readings` are its two parts, NaN where nothing was received.
    control_index, log_evidence, filtered, predicted, decision_probability, unexplained : (T, ...)
        As in `TwinTurn`.
    state, observation : (T, ...)
        As in `Happened`; of a simulated asset only.
    seconds : (T, 3)
        As in `Turn`.
    """

    twin: Twin
    sensors: int
    turns: list[Turn] = field(default_factory=list)
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    resumed_at: int = 0
    ended: str = ""

    row = _Column("reading.observed")
    control_index = _Column("concluded.control_index")
    filtered = _Column("concluded.filtered")
    log_evidence = _Column("concluded.log_evidence")
    predicted = _Column("concluded.prediction.predicted")
    decision_probability = _Column("concluded.decision_probability")
    unexplained = _Column("concluded.unexplained")
    state = _Column("reading.happened.state")
    observation = _Column("reading.happened.observation")
    seconds = _Column("seconds")

    def add(self, turn: Turn) -> None:
        """Take in a turn, without what follows from the rest of it."""
        prediction = replace(turn.concluded.prediction, joint=np.empty(0))
        self.turns.append(replace(turn, concluded=replace(turn.concluded, prediction=prediction)))
        self.notices += [(turn.concluded.turn, notice) for notice in turn.concluded.notices]

    def behind(self, skipped: int) -> "History":
        """Return the turns behind the first `skipped`; the notices stay those of all."""
        return replace(self, turns=self.turns[skipped:])

    @property
    def first_turn(self) -> int:
        """Number of the first turn."""
        return self.turns[0].concluded.turn if self.turns else 0

    @property
    def observed(self) -> Float:
        """What the sensors said (T, G)."""
        return self.row[:, : self.sensors]

    @property
    def readings(self) -> Float:
        """What came behind it (T, I)."""
        return self.row[:, self.sensors :]

    @property
    def simulated(self) -> bool:
        """Whether it is known what really happened."""
        return bool(self.turns) and self.turns[0].reading.happened is not None

    @property
    def monitors(self) -> dict[str, Float]:
        """Figures that the asset reported of itself (T,)."""
        told = [turn.reading.happened.monitors for turn in self.turns if turn.reading.happened is not None]
        return {name: np.array([monitors[name] for monitors in told]) for name in (told[-1] if told else ())}

    @cached_property
    def smoothed(self) -> Float:
        """p(D_k | all observations) (T, S)."""
        return self.twin.smoothed()[-len(self.turns) :]

    @property
    def suspicion(self) -> tuple[Suspicion, ...]:
        """How well the model explained the sensors, where that is watched."""
        found = (turn.concluded.suspicion for turn in self.turns)
        return tuple(suspicion for suspicion in found if suspicion is not None)

    @property
    def learnt_names(self) -> tuple[str, ...]:
        """What is learnt."""
        return tuple(self.turns[-1].concluded.learnt) if self.turns else ()

    @property
    def learnt(self) -> Float:
        """The figures of each posterior (T, N, 4)."""
        figures = [[one.figures for one in turn.concluded.learnt.values()] for turn in self.turns]
        return np.array(figures).reshape(len(self.turns), len(self.learnt_names), 4)
