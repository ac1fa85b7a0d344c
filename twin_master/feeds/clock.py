"""The clock of a publisher: from a message's time, or its number, to its step."""

import math
from dataclasses import asdict, dataclass

from reporting.json_file import JsonObject, JsonRecord
from twin_master.feeds.message import Refused
from twin_master.feeds.stream import TIME_UNITS, StreamNotices
from twin_master.scenario.tables import Between, WatchSection

LARGEST_UNCONFIRMED_GAP = 800
"""Number of steps after the only message of a stretch from which on they are not a gap.

Either a clock was set meanwhile, or the times have another unit: where a step takes a second,
times in milliseconds lie 1,000 steps apart, give or take their jitter. Once a second message
agrees, `longest_gap` holds.
"""
LONGEST_LOSS = 3
"""Largest number of missing steps that count as lost messages of an asset that rests in pauses.

These steps are predicted through, so that late messages about them still find their place.
"""
ORDER_TOLERANCE = 0.8
"""Deviation of a time from the expected one, in steps, up to which its message is the next one.

It allows a jitter of 0.4 steps: the first time, from which all are counted, has it, too.
"""
RATE_MESSAGES = 8
"""Number of messages whose times show how often the logger sends."""
_FAST, _SLOW = 0.75, 1.5
"""Mean number of steps between messages up to, and from, which the logger sends at another rate.

Jitter of 0.4 steps changes the mean of `RATE_MESSAGES` times by 0.12 at most.
"""
_EVEN = 1.5
"""Largest ratio of the longest to the shortest interval of a slow logger that loses no message."""
_JITTER = 0.2
"""Relative deviation of a time from the expected one that still counts as that of another unit."""
_KEPT_STRETCHES = 3
"""Number of last stretches whose late messages still find their step."""
_SECONDS_SINCE_1970 = 1e8, 1e11
"""Range [s] of clocks that count from 1970, in the years 1973 to 5138."""


@dataclass(frozen=True)
class Stretch:
    """Steps without a pause between them, whose times are counted from one origin.

    Attributes
    ----------
    first_step : int
        The first step of the stretch.
    first_time : int or float
        The time of the first step's message [s], or its number by the publisher's counter.
    after_jump : bool
        Whether it follows a jump of the clock by more than the longest gap.
    """

    first_step: int
    first_time: float
    after_jump: bool = False


@dataclass
class _RateWindow:
    """The times of the last messages, which show the rate of the logger.

    Attributes
    ----------
    first, last : float
        The first and the last time [s].
    shortest, longest : float
        The shortest and the longest interval between two messages [s]; 0 with one message.
    count : int
        The number of messages.
    """

    first: float
    last: float
    shortest: float = 0.0
    longest: float = 0.0
    count: int = 1

    def add(self, time: float) -> None:
        """Add the time of a message, unless it is late."""
        interval = time - self.last
        if interval <= 0.0:
            return
        self.last = time
        self.shortest = interval if self.count == 1 else min(self.shortest, interval)
        self.longest = max(self.longest, interval)
        self.count += 1


class Clock:
    """The clock of a publisher, which may be set, may pause, and may count in another unit.

    Counting begins at the first message. After a pause, or a jump of the clock, a new stretch
    begins with the next step. The counter of a publisher is such a clock, too: it counts steps
    instead of seconds.

    Parameters
    ----------
    section : WatchSection
        The unit of times, and how far ahead a message may be.
    step_length : float or None
        The length of a step [s], or the counts in a step; None if it is unknown.
    between : {"steps", "rest"}
        Whether steps go on between messages, or the asset rests.
    counts_steps : bool
        Whether the clock is a counter of steps.
    """

    def __init__(
        self,
        section: WatchSection,
        step_length: float | None,
        between: Between,
        *,
        counts_steps: bool = False,
    ) -> None:
        self._section = section
        self._step_length = step_length
        self._between = between
        self._counts_steps = counts_steps
        self._stretches: list[Stretch] = []
        self._latest: float | None = None  # the latest time of which a step was assimilated
        self._rate: _RateWindow | None = None
        self._rate_is_reported = False

    def state(self) -> JsonObject | None:
        """Return the state for the journal; None before the first message."""
        if not self._stretches:
            return None
        stretches = []
        for stretch in self._stretches:
            stretches.append([stretch.first_step, stretch.first_time, stretch.after_jump])
        return {
            "stretches": stretches,
            "latest": self._latest,
            "rate": None if self._rate is None else asdict(self._rate),
            "rate_is_reported": self._rate_is_reported,
        }

    def restore(self, state: JsonRecord | None) -> None:
        """Restore a state that `state` returned."""
        if state is None:
            return
        self._stretches = [Stretch(*stretch) for stretch in state["stretches"]]
        self._latest = state["latest"]
        self._rate = None if state["rate"] is None else _RateWindow(**state["rate"])
        self._rate_is_reported = state["rate_is_reported"]

    def steps_at(self, time: float, next_step: int, stream: StreamNotices) -> list[int]:
        """Return the step of a message from its time; begin a new stretch if necessary.

        A message that is later than all before it is the next step if its time deviates from the
        expected one by at most `ORDER_TOLERANCE`. If it lies further ahead, steps are missing, or
        the asset has rested. If it lies more than `longest_gap` steps ahead, or too far from the
        only message before it, the clock was probably set: then it is the next step, too.

        Parameters
        ----------
        time : float
            The time of the message [s], or its number.
        stream : StreamNotices
            Receives the notice of a pause or a jump.

        Returns
        -------
        list of int
            The step; for a late message the possible steps, the nearest one first.

        Raises
        ------
        Refused
            If the step lies before the first one, in a pause, or is not a number, or if the
            scenario gives no length of a step.
        """
        if self._step_length is None:
            raise Refused(
                "it has a time and no step, but the scenario has no `watch.seconds_per_step`"
            )
        if not self._stretches:
            if self._counts_steps and time != next_step:
                stream.note_begin(next_step, int(time))
            self._begin_stretch(Stretch(next_step, time))
            return [next_step]
        stretch = self._stretches[-1]
        position = self._position(time, stretch)
        is_only_message = self._latest == stretch.first_time
        if not (math.isfinite(position) or is_only_message):
            raise Refused("its time lies too far from the first")
        if self._latest is None or time > self._latest:
            return [self._later_step(time, position, next_step, stream)]
        if self._has_returned(time, next_step):
            del self._stretches[-1]
            self._latest = None
            return self.steps_at(time, next_step, stream)
        is_far_before = position < stretch.first_step - self._section.longest_gap
        if is_only_message and is_far_before:
            self._note_jump(time, position, next_step, stream, widening=0)
            self._begin_stretch(Stretch(next_step, time, after_jump=True))
            self._latest = None  # times before the jump are later
            return [next_step]
        return self._late_steps(time, next_step)

    def _position(self, time: float, stretch: Stretch) -> float:
        """Return the fractional step at a time, counted from the origin of a stretch."""
        assert self._step_length is not None, "times have no steps without the length of a step"
        return stretch.first_step + (time - stretch.first_time) / self._step_length

    def _begin_stretch(self, stretch: Stretch) -> None:
        """Begin a stretch, and drop the oldest one if there are too many."""
        self._stretches = [*self._stretches, stretch][-_KEPT_STRETCHES:]
        if stretch.after_jump:
            self._rate = None

    def _later_step(
        self, time: float, position: float, next_step: int, stream: StreamNotices
    ) -> int:
        """Return the step of a message that is later than all before it.

        `position` is the step that its time suggests, as a number with a fraction. A jump ahead by
        more than the longest gap begins a new stretch: from there, steps are counted from the
        message. With `between = "rest"`, a pause begins a new stretch, too, and its steps do not
        count.
        """
        is_only_message = self._latest == self._stretches[-1].first_time
        limit = self._section.longest_gap
        if is_only_message:
            limit = min(limit, LARGEST_UNCONFIRMED_GAP)
        ahead = position - next_step
        if ahead < -ORDER_TOLERANCE:  # a logger that sends more than a message in each step
            return round(position)
        if ahead - ORDER_TOLERANCE > limit:
            # After the only message nothing tells how much time has passed
            goes_on = self._between == "steps" and not is_only_message
            widening = self._section.longest_gap if goes_on else 0
            self._note_jump(time, position, next_step, stream, widening=widening)
            self._begin_stretch(Stretch(next_step + widening, time, after_jump=True))
            return next_step + widening
        # The count stays the same for each of the missing steps that are assimilated one by one
        missing_steps = max(0, math.ceil(ahead - ORDER_TOLERANCE))
        if self._between == "rest" and missing_steps > LONGEST_LOSS:
            stream.note_pause(next_step, missing_steps, self._unit_of_jump(time, position))
            self._begin_stretch(Stretch(next_step, time))
            return next_step
        if time > self._stretches[-1].first_time:
            stream.note_clock_agreement()
        return next_step + missing_steps

    def _has_returned(self, time: float, next_step: int) -> bool:
        """Return whether a clock that had jumped continues with its count before the jump."""
        if len(self._stretches) < 2 or not self._stretches[-1].after_jump:
            return False
        ahead = self._position(time, self._stretches[-2]) - next_step
        return -ORDER_TOLERANCE <= ahead <= self._section.longest_gap

    def _late_steps(self, time: float, next_step: int) -> list[int]:
        """Return the possible steps of a late message, the nearest one first."""
        end = next_step
        for stretch in reversed(self._stretches):
            position = self._position(time, stretch)
            if position >= stretch.first_step - ORDER_TOLERANCE:
                nearest_steps = sorted(
                    {math.floor(position), math.ceil(position)},
                    key=lambda step: abs(step - position),
                )
                steps = [step for step in nearest_steps if stretch.first_step <= step < end]
                if steps:
                    return steps
                raise Refused(
                    f"it belongs to the pause before step {end}, in which no steps are counted; "
                    'where steps go on between messages, give `watch.between = "steps"`'
                )
            end = stretch.first_step
        noun = "number" if self._counts_steps else "time"
        raise Refused(f"its {noun} lies {end - position:.0f} steps before the first")

    def note_time(self, time: float, *, is_assimilated: bool, stream: StreamNotices) -> None:
        """Record the time of a message, and notify the operator if the logger has another rate.

        Parameters
        ----------
        time : float
            The time of the message [s], or its number.
        is_assimilated : bool
            Whether it is the message of a step, and was not refused.
        stream : StreamNotices
            Receives the notice.
        """
        if is_assimilated and (self._latest is None or time > self._latest):
            self._latest = time
        if self._counts_steps or self._step_length is None:
            return
        if self._rate is None:
            self._rate = _RateWindow(first=time, last=time)
            return
        self._rate.add(time)
        if self._rate.count < RATE_MESSAGES or not is_assimilated:
            return
        window = self._rate
        self._rate = _RateWindow(first=time, last=time)
        mean_interval = (window.last - window.first) / (window.count - 1)
        steps = mean_interval / self._step_length
        is_even = window.longest <= _EVEN * window.shortest
        is_slow = _SLOW <= steps < LARGEST_UNCONFIRMED_GAP and is_even
        has_another_rate = steps <= _FAST or is_slow
        if has_another_rate and not self._rate_is_reported:
            stream.note_rate(mean_interval, self._step_length)
        self._rate_is_reported = has_another_rate

    def _note_jump(
        self,
        time: float,
        position: float,
        next_step: int,
        stream: StreamNotices,
        *,
        widening: int,
    ) -> None:
        """Notify the operator that a message lies too far from the one before it."""
        stream.note_clock_jump(
            next_step,
            position - (next_step - 1),
            self._unit_of_jump(time, position),
            noun="number" if self._counts_steps else "time",
            widening=widening,
            rests=self._between == "rest",
        )

    def _unit_of_jump(self, time: float, position: float) -> str:
        """Return the likely unit of a time far ahead, see `likely_unit`."""
        if self._counts_steps:
            return ""
        stretch = self._stretches[-1]
        is_only_message = self._latest == stretch.first_time
        distance = position - stretch.first_step if is_only_message else 0.0
        return self.likely_unit(time, stretch.first_step, distance)

    def likely_unit(self, time: float, next_step: int, distance: float = 0.0) -> str:
        """Return the unit in which a time seems to be given; empty if the stated unit fits.

        Only units smaller than the stated one are tried. A unit is likely if, read in it, the time
        lies one step after the only one before it, is close to the expected time, or counts from
        1970.

        Parameters
        ----------
        time : float
            The time of a message [s], read in the stated unit.
        distance : float
            The number of steps by which the time lies after the only one before it. It is 0 once
            two times have agreed: then a distance of a thousand steps is a gap, and does not
            suggest another unit.
        """
        low, high = _SECONDS_SINCE_1970
        expected_time = math.nan
        if self._stretches and self._step_length is not None:
            stretch = self._stretches[-1]
            expected_time = (
                stretch.first_time + (next_step - stretch.first_step) * self._step_length
            )
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
