"""The clock of a publisher: from the times of messages to steps."""

import math

from twin_master.scenario.tables import WatchSection
from twin_master.watch.message import Refused
from twin_master.watch.stream import TIME_UNITS, StreamNotices

LARGEST_UNCONFIRMED_GAP = 800
"""Steps between the only two times of a stream from which on they are no gap.

A clock was set between them, or the times have another unit: milliseconds lie 1,000 steps apart where a step
takes a second, give or take their jitter. Once two times agree, `longest_gap` holds.
"""
_JITTER = 0.2
"""Share by which a time that has another unit may differ from what that unit makes of it."""
_SECONDS_SINCE_1970 = 1e8, 1e11
"""Clocks that count from 1970 show seconds between these from 1973 until the year 5138."""


class Clock:
    """The clock of a publisher, which may be set after its first message, and may count in another unit.

    Parameters
    ----------
    section : WatchSection
        How long a step takes, in what unit times are, and how far ahead a message may be.

    Attributes
    ----------
    origin : float or None
        Time [s] of step 0; None before the first time.
    only_step : int or None
        The only step of which a time has come so far; None once another one agrees with it.
    """

    def __init__(self, section: WatchSection) -> None:
        self._section = section
        self.origin: float | None = None
        self.only_step: int | None = None

    def step_of(self, time: float, next_step: int, stream: StreamNotices) -> int:
        """Return the step of a time.

        The first time belongs to the next step. So does one that lies too far from the only one before it:
        the steps seen so far stay, and time is counted from this message on.

        Parameters
        ----------
        time : float
            Of a message [s].
        next_step : int
            The step that is expected next.
        stream : StreamNotices
            Told where times do not go together.

        Raises
        ------
        Refused
            The step lies before the first one, or no number gives it; or steps have no length.
        """
        seconds_per_step, gap = self._section.seconds_per_step, self._section.longest_gap
        if seconds_per_step is None:
            raise Refused("it has a time and no step, and the scenario has no `watch.seconds_per_step`")
        step = math.nan if self.origin is None else (time - self.origin) / seconds_per_step
        is_too_far = not -gap <= step <= next_step + gap
        if self.only_step is not None:
            is_too_far |= step - self.only_step >= LARGEST_UNCONFIRMED_GAP
        is_unconfirmed = self.origin is None or self.only_step is not None
        if is_unconfirmed and is_too_far:
            if self.only_step is not None:
                apart = step - self.only_step
                stream.clock(next_step, apart, self.slipped_unit(time, next_step, apart))
            self.origin = time - seconds_per_step * next_step
            self.only_step = next_step
            return next_step
        if self.only_step is not None and round(step) != self.only_step:
            self.only_step = None
            stream.clock_agrees()
        if not math.isfinite(step):
            raise Refused("its time lies too far from the first")
        if step < -0.5:
            raise Refused(f"its time lies {-round(step)} steps before the first")
        return round(step)

    def slipped_unit(self, time: float, next_step: int, apart: float = 0.0) -> str:
        """Return the smaller unit that a time seems to have; empty where the stated one fits.

        Parameters
        ----------
        time : float
            Of a message [s], read in the stated unit.
        next_step : int
            The step that is expected next.
        apart : float
            Steps by which the time lies behind the only one before it. Once two times have agreed, a distance
            of a thousand steps is a gap, and no sign of another unit.
        """
        low, high = _SECONDS_SINCE_1970
        expected = math.nan
        if self.origin is not None and self._section.seconds_per_step is not None:
            expected = self.origin + self._section.seconds_per_step * next_step
        units = [*TIME_UNITS]
        smaller_units = units[units.index(self._section.time_unit) + 1 :]
        for thousands, unit in enumerate(smaller_units, start=1):
            factor = 1000.0**thousands
            is_next_step = abs(apart / factor - 1.0) <= _JITTER
            is_scaled = expected > 0.0 and abs(time / (factor * expected) - 1.0) <= _JITTER
            is_since_1970 = low <= time / factor < high
            if is_next_step or is_scaled or is_since_1970:
                return unit
        return ""
