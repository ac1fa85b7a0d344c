"""The clock of a publisher: from the times of messages to turns."""

import math

from twin_master.scenario.tables import WatchSection
from twin_master.watch.message import Refused
from twin_master.watch.stream import TIME_UNITS, StreamNotices

LARGEST_UNCONFIRMED_GAP = 800
"""Turns between the only two times of a stream from which on they are no gap.

A clock was set between them, or the times have another unit: milliseconds lie 1,000 turns apart where a turn
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
        How long a turn takes, in what unit times are, and how far ahead a message may be.

    Attributes
    ----------
    origin : float or None
        Time [s] of turn 0; None before the first time.
    only_turn : int or None
        The only turn of which a time has come so far; None once another one agrees with it.
    """

    def __init__(self, section: WatchSection) -> None:
        self._section = section
        self.origin: float | None = None
        self.only_turn: int | None = None

    def turn_of(self, time: float, next_turn: int, stream: StreamNotices) -> int:
        """Return the turn of a time.

        The first time belongs to the next turn. So does one that lies too far from the only one before it:
        the turns seen so far stay, and time is counted from this message on.

        Parameters
        ----------
        time : float
            Of a message [s].
        next_turn : int
            The turn that is expected next.
        stream : StreamNotices
            Told where times do not go together.

        Raises
        ------
        Refused
            The turn lies before the first one, or no number gives it; or turns have no length.
        """
        step, gap = self._section.seconds_per_turn, self._section.longest_gap
        if step is None:
            raise Refused("it has a time and no turn, and the scenario has no `watch.seconds_per_turn`")
        turn = math.nan if self.origin is None else (time - self.origin) / step
        is_too_far = not -gap <= turn <= next_turn + gap
        if self.only_turn is not None:
            is_too_far |= turn - self.only_turn >= LARGEST_UNCONFIRMED_GAP
        is_unconfirmed = self.origin is None or self.only_turn is not None
        if is_unconfirmed and is_too_far:
            if self.only_turn is not None:
                apart = turn - self.only_turn
                stream.clock(next_turn, apart, self.slipped_unit(time, next_turn, apart))
            self.origin = time - step * next_turn
            self.only_turn = next_turn
            return next_turn
        if self.only_turn is not None and round(turn) != self.only_turn:
            self.only_turn = None
            stream.clock_agrees()
        if not math.isfinite(turn):
            raise Refused("its time lies too far from the first")
        if turn < -0.5:
            raise Refused(f"its time lies {-round(turn)} turns before the first")
        return round(turn)

    def slipped_unit(self, time: float, next_turn: int, apart: float = 0.0) -> str:
        """Return the smaller unit that a time seems to have; empty where the stated one fits.

        Parameters
        ----------
        time : float
            Of a message [s], read in the stated unit.
        next_turn : int
            The turn that is expected next.
        apart : float
            Turns by which the time lies behind the only one before it. Once two times have agreed, a distance
            of a thousand turns is a gap, and no sign of another unit.
        """
        low, high = _SECONDS_SINCE_1970
        expected = math.nan
        if self.origin is not None and self._section.seconds_per_turn is not None:
            expected = self.origin + self._section.seconds_per_turn * next_turn
        units = [*TIME_UNITS]
        smaller_units = units[units.index(self._section.time_unit) + 1 :]
        for thousands, unit in enumerate(smaller_units, start=1):
            factor = 1000.0**thousands
            is_next_turn = abs(apart / factor - 1.0) <= _JITTER
            is_scaled = expected > 0.0 and abs(time / (factor * expected) - 1.0) <= _JITTER
            is_since_1970 = low <= time / factor < high
            if is_next_turn or is_scaled or is_since_1970:
                return unit
        return ""
