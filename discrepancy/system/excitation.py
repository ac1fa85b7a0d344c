"""What acts on a system in a trial, between the samples too and under a patch, and what its outputs show."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite, pi, sqrt
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import FloatArray, Hold, Start, Trial
from discrepancy.errors import ModelError
from discrepancy.system.response import Place
from fe.runtime.expression import Expression
from fe.runtime.patch import LoadGain, LoadPlace, Primitive

DEFAULT_PLACE = "tip_load"
"""What a campaign says when it does not say where the force acts; a model with one input takes that one."""

SMOOTH_PARTS = 8
"""Steps of an interval under an input that is a spline; straight lines on them err by 1e-6 of it."""


@dataclass(frozen=True, eq=False)
class Course:
    """A load or a prescribed motion over time.

    Attributes
    ----------
    time, values : (N,) ndarray
        Its samples [s], [SI].
    hold : Hold, optional
        Between them, linear unless it is said. A load keeps its values before the first and after the last.
    motion : int, optional
        What was recorded of a motion, which is `SMOOTH`: 0 displacement, 1 velocity, 2 acceleration; the
        latter two begin at zero displacement, and the last at zero velocity. None: it is a load.
    """

    time: FloatArray
    values: FloatArray
    hold: Hold | None = None
    motion: int | None = None

    @property
    def edges(self) -> tuple[float, ...]:
        """Moments at which it jumps, or is no curve [s]."""
        return () if self.hold is Hold.SMOOTH else tuple(self.time.tolist())

    @cached_property
    def _spline(self) -> PPoly:
        """The spline of the load, or of the displacement."""
        base: PPoly = CubicSpline(self.time, self.values)
        return base.antiderivative(self.motion) if self.motion else base

    def at(self, time: FloatArray, order: int = 0) -> FloatArray:
        """Return the values (N,) at times, or a derivative; where it jumps, that of just before."""
        if self.hold is Hold.SMOOTH:
            inside = np.clip(time, self.time[0], self.time[-1]) if self.motion is None else time
            return np.asarray(self._spline(inside, order))
        if self.hold is not Hold.ZERO_ORDER and order == 0:
            return np.asarray(np.interp(time, self.time, self.values))
        held = self.values
        if order:  # slopes of straight lines
            held = np.diff(self.values, append=self.values[-1]) / np.diff(self.time, append=np.inf)
        row = np.searchsorted(self.time, time - 1e-9 * (self.time[-1] - self.time[0]) / len(self.time))
        return np.asarray(held[np.maximum(row - 1, 0)])


@dataclass(frozen=True, eq=False)
class FormulaCourse:
    """A load by a formula in time, zero outside of its spans.

    Attributes
    ----------
    formula : Expression
        In `time` [s].
    spans : tuple of (float, float)
        Begin and end [s] of each; empty: always.
    """

    formula: Expression
    spans: tuple[tuple[float, float], ...] = ()

    hold: ClassVar[Hold] = Hold.SMOOTH

    @property
    def edges(self) -> tuple[float, ...]:
        """Moments at which it begins or ends [s]."""
        return tuple(moment for span in self.spans for moment in span if isfinite(moment))

    def at(self, time: FloatArray, order: int = 0) -> FloatArray:
        """Return the values (N,) at times."""
        spans = self.spans or ((-inf, inf),)
        inside = np.any([(time >= begin) & (time < end) for begin, end in spans], axis=0)
        return np.where(inside, self.formula.course(time, {"pi": pi}), 0.0)


class Load(NamedTuple):
    """The row (N,) along which a load acts, and its course, which is derived `order` times."""

    row: FloatArray
    course: Course | FormulaCourse
    order: int = 0


def straight(at: Callable[[FloatArray], FloatArray], time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values (K, ...) at the begin and at the end of the steps between times (K + 1,).

    They are those of straight lines that have the mean effect of what is asked, to fourth order in the step:
    through its values at the points of Gauss and Legendre.
    """
    middle, half = 0.5 * (time[1:] + time[:-1]), 0.5 * np.diff(time)
    low, high = (at(middle + side * half / sqrt(3.0)) for side in (-1.0, 1.0))
    mean, rise = 0.5 * (low + high), 0.5 * sqrt(3.0) * (high - low)
    return mean - rise, mean + rise


@dataclass(frozen=True)
class Acting:
    """What acts in a trial.

    Attributes
    ----------
    time : (N,) ndarray
        Stamps of the inputs [s].
    sampled : (N,) ndarray
        Times at which the samples show the motion [s].
    loads : sequence of Load
        What pushes.
    drives : mapping of str to Course
        Prescribed motions by their inputs, in the order of `LinearSystem.drives`.
    begins : Start
        How it began, where it was not released.
    initial : (L,) or (R, 2) ndarray
        State at the first stamp, where it is unknown: displacements and speeds of the modes, then the states.
        Of a release as in `Conditions`; rows beyond the modes are passed over.
    release : tuple of ((n,) ndarray, Release), optional
        How a structure was let go, and the row of the release point: row . u is its displacement, and the
        holding force acts along it.
    """

    time: FloatArray
    sampled: FloatArray
    loads: Sequence[Load] = ()
    drives: Mapping[str, Course] = field(default_factory=dict)
    begins: Start = Start.SETTLED
    initial: FloatArray = field(default_factory=lambda: np.zeros(0))
    release: tuple[FloatArray, Release] | None = None

    @property
    def edges(self) -> list[float]:
        """Moments at which a load jumps, begins or ends [s]."""
        return [moment for load in self.loads for moment in load.course.edges]

    @property
    def levels(self) -> tuple[FloatArray, FloatArray]:
        """Loads (k, n + m), and how much of each (L, k) acts in the rows of a trial at rest."""
        pushes = [(load.row, load.course.values) for load in self.loads if isinstance(load.course, Course)]
        units, amounts = zip(*pushes, strict=True)
        return np.array(units), np.column_stack(amounts)

    def load_at(self, time: FloatArray, base: FloatArray) -> FloatArray:
        """Return the loads (T, B) in a base (n + m, B) at times, held ones as they were just before."""
        rows = np.array([load.row for load in self.loads]).reshape(len(self.loads), len(base))
        amounts = np.array([load.course.at(time, load.order) for load in self.loads])
        return amounts.reshape(len(rows), len(time)).T @ (rows @ base)


class Shown(NamedTuple):
    """What an output shows of the unknowns and their derivatives.

    Attributes
    ----------
    rows : (4, N) ndarray
        Of z = (u, s) and its first three derivatives; a state is x = s'.
    constant : float
        In it.
    courses : sequence of (float, Load), optional
        Courses of loads in it, each with its factor; None but for the force of a drive or of a controller.
    felt : (N,) ndarray, optional
        Row along which forces of laws are in it, of a drive.
    """

    rows: FloatArray
    constant: float = 0.0
    courses: Sequence[tuple[float, Load]] | None = None
    felt: FloatArray | None = None

    @classmethod
    def of(cls, row: FloatArray, order: int = 0, further: int = 0, states: int = 0) -> "Shown":
        """Return what shows row . (u, x), u derived `order` times and the `states` x `further` times."""
        rows, n = np.zeros((4, len(row))), len(row) - states
        rows[order, :n], rows[further + 1, n:] = row[:n], row[n:]
        return cls(rows)


def by_order(shown: Sequence[Shown], shapes: FloatArray) -> FloatArray:
    """Return what outputs show of modal coordinates and their derivatives (4, C, M), in shapes (N, M)."""
    return np.moveaxis(np.array([item.rows for item in shown]) @ shapes, 1, 0)


def place_among(places: Sequence[str], place: Place, what: str, where: str = "a trial") -> str:
    """Return the load place of a model, `what`, that a trial means: the only one where it says none.

    Raises
    ------
    ModelError
        If there is no such place, or none is named of several.
    """
    if place == DEFAULT_PLACE and place not in places and len(places) == 1:
        return places[0]
    if not isinstance(place, str) or place not in places:
        said = "no load_place is said" if place == DEFAULT_PLACE else f"the load place is {place!r}"
        known = f"forces at {', '.join(places)}: name one of these" if places else "no force"
        raise ModelError(f"In {where} {said}, and {what} takes {known}.")
    return place


def release_of(trial: Trial) -> Release:
    """Return how a ring-down began; raises `ModelError` where it does not say it."""
    if trial.release is None:
        raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
    return trial.release


class LoadChange(NamedTuple):
    """What of recorded loads changes.

    Attributes
    ----------
    gain, tare : float
        The acting force is (1 + gain) times the recorded one, plus the tare [N] where it is not zero.
    along_span, along_chord : float
        How far the acting force is moved [m].
    """

    gain: float = 0.0
    tare: float = 0.0
    along_span: float = 0.0
    along_chord: float = 0.0

    @classmethod
    def of(cls, patch: Iterable[Primitive]) -> "LoadChange":
        """Return the change by gains and places, one upon the other."""
        gain, tare, span, chord = cls()
        for item in patch:
            if isinstance(item, LoadGain):
                gain, tare = (1.0 + gain) * (1.0 + item.gain) - 1.0, tare * (1.0 + item.gain) + item.tare
            elif isinstance(item, LoadPlace):
                span, chord = span + item.along_span, chord + item.along_chord
        return cls(gain, tare, span, chord)

    def changed(self, values: FloatArray, recorded: FloatArray) -> FloatArray:
        """Return what acts (N,) of recorded values [N, or N m], the values themselves or with a constant."""
        return np.asarray((1.0 + self.gain) * values + self.tare * (recorded != 0.0))


def divided(time: FloatArray, parts: int) -> FloatArray:
    """Return stamps whose intervals are divided into so many parts."""
    return np.interp(np.arange((len(time) - 1) * parts + 1) / parts, np.arange(len(time)), time)
