"""The clock of a publisher: from the time of a message to its step."""

import math

from twin_master.scenario.tables import WatchSection
from twin_master.watch.message import Refused
from twin_master.watch.stream import TIME_UNITS, StreamNotices

LARGEST_UNCONFIRMED_GAP = 800
"""Number of steps between the only two times of a stream from which on they are not a gap.

Either a clock was set between them, or the times have another unit: where a step takes a second,
times in milliseconds lie 1,000 steps apart, give or take their jitter. Once two times agree,
`longest_gap` holds.
"""
_JITTER = 0.2
"""Relative deviation of a time from the expected one that still counts as that of another unit."""
_SECONDS_SINCE_1970 = 1e8, 1e11
"""Range [s] of clocks that count from 1970, in the years 1973 to 5138."""


class Clock:
    """The clock of a publisher, which may be set later, and may count in another unit.

    Parameters
    ----------
    section : WatchSection
        The length of a step, the unit of times, and how far ahead a message may be.

    Attributes
    ----------
    origin : float or None
        The time [s] of step 0; None before the first time has come.
    only_step : int or None
        The only step whose time is known so far; None once another time agrees with it.
    """

    def __init__(self, section: WatchSection) -> None:
        self._section = section
        self.origin: float | None = None
        self.only_step: int | None = None

    def step_of(self, time: float, next_step: int, stream: StreamNotices) -> int:
        """Return the step of a message from its time, and keep the origin of the clock up to date.

        The first time of a stream is that of the next step. If only one time has come so far, and
        this one lies too far from it, the clock was probably set: this message, too, is taken as
        the next step, and times are counted from it on.

        Parameters
        ----------
        time : float
            The time of the message [s].
        next_step : int
            The step that is expected next.
        stream : StreamNotices
            Takes the notice if two times do not agree.

        Raises
        ------
        Refused
            If the step lies before the first one or is not a number, or if the scenario gives no
            length of a step.
        """
        seconds_per_step = self._section.seconds_per_step
        if seconds_per_step is None:
            raise Refused(
                "it has a time and no step, and the scenario has no `watch.seconds_per_step`"
            )
        step = math.nan
        if self.origin is not None:
            step = (time - self.origin) / seconds_per_step
        is_unconfirmed = self.origin is None or self.only_step is not None
        if is_unconfirmed and self._is_too_far(step, next_step):
            if self.only_step is not None:
                distance = step - self.only_step
                unit = self.likely_unit(time, next_step, distance)
                stream.note_clock_jump(next_step, distance, unit)
            self.origin = time - seconds_per_step * next_step
            self.only_step = next_step
            return next_step
        if self.only_step is not None and round(step) != self.only_step:
            self.only_step = None
            stream.note_clock_agreement()
        if not math.isfinite(step):
            raise Refused("its time lies too far from the first")
        if step < -0.5:
            raise Refused(f"its time lies {-round(step)} steps before the first")
        return round(step)

    def _is_too_far(self, step: float, next_step: int) -> bool:
        """Return whether a step lies too far from the next one to be a time of the same clock.

        A step that is NaN, because the clock has no origin yet, counts as too far.
        """
        gap = self._section.longest_gap
        is_near = -gap <= step <= next_step + gap
        if not is_near:
            return True
        return self.only_step is not None and step - self.only_step >= LARGEST_UNCONFIRMED_GAP

    def likely_unit(self, time: float, next_step: int, distance: float = 0.0) -> str:
        """Return the unit in which a time seems to be given; empty if the stated unit fits.

        Only units smaller than the stated one are tried. A unit is likely if, read in it, the time
        lies one step after the only one before it, is close to the expected time, or counts from
        1970.

        Parameters
        ----------
        time : float
            The time of a message [s], read in the stated unit.
        next_step : int
            The step that is expected next.
        distance : float
            The number of steps by which the time lies after the only one before it. It is 0 once
            two times have agreed: then a distance of a thousand steps is a gap, and no sign of
            another unit.
        """
        low, high = _SECONDS_SINCE_1970
        expected_time = math.nan
        if self.origin is not None and self._section.seconds_per_step is not None:
            expected_time = self.origin + self._section.seconds_per_step * next_step
        units = list(TIME_UNITS)
        smaller_units = units[units.index(self._section.time_unit) + 1 :]
        # Each unit is a thousandth of the one before it
        for power, unit in enumerate(smaller_units, start=1):
            factor = 1000.0**power
            is_next_step = abs(distance / factor - 1.0) <= _JITTER
            is_expected = (
                expected_time > 0.0 and abs(time / (factor * expected_time) - 1.0) <= _JITTER
            )
            is_since_1970 = low <= time / factor < high
            if is_next_step or is_expected or is_since_1970:
                return unit
        return ""
