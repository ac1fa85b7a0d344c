"""What is wrong with a stream of messages as a whole: notices, each given once until it is over."""

from collections.abc import Mapping
from typing import Any

from reporting.words import counted, listing
from twin_master.network.estimator import Notice, NoticeWording

REFUSALS_IN_A_ROW = 3
"""Refused messages, with none between them that was taken, of which the operator is told."""
TIME_UNITS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
"""Units of times, each a thousandth of the one before it, and what they are called."""
_NAMES_TOLD = 24
"""Names of which the operator is told that they were passed over: a flood of them fills no journal."""


def unit_advice(unit: str) -> str:
    """Return what to do about times that seem to have a unit, behind another clause; or nothing."""
    if not unit:
        return ""
    return f'; its times look like {TIME_UNITS[unit]}: give `watch.time_unit = "{unit}"`'


class StreamNotices:
    """Notices about the messages of a stream: gaps, clocks, refusals, and names that are no sensor.

    Parameters
    ----------
    words : NoticeWording
        How sentences speak of steps and sensors.

    Attributes
    ----------
    is_blind : bool
        Whether the last message of a next step had no reading of any sensor.
    refused_in_a_row : int
        Messages that were refused since one was taken.
    last_reason : str
        Why the last of them was refused.
    """

    def __init__(self, words: NoticeWording) -> None:
        self._words = words
        self._coming: list[Notice] = []  # with the next reading
        self._gap_end = -1  # the step behind the last gap that was told
        self._clock_is_told = False
        self.is_blind = False
        self._names_told: list[str] = []
        self.refused_in_a_row = 0
        self.last_reason = ""
        self._refused_steps: list[int | None] = []
        self._refusals_are_told = False

    def state(self, *, waiting: bool) -> dict[str, Any]:
        """Return what is needed to tell nothing twice, as JSON.

        Parameters
        ----------
        waiting : bool
            Whether the message behind a gap is to be read again.
        """
        refused = {
            "count": self.refused_in_a_row,
            "steps": self._refused_steps,
            "reason": self.last_reason,
            "told": self._refusals_are_told,
        }
        state: dict[str, Any] = {
            "gap_end": self._gap_end if waiting else None,
            "clock": self._clock_is_told,
            "blind": self.is_blind,
            "names": list(self._names_told),
            "refused": refused if self.refused_in_a_row else None,
        }
        return {key: value for key, value in state.items() if value}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a state."""
        self._gap_end = state.get("gap_end", -1)
        self._clock_is_told = state.get("clock", False)
        self.is_blind = state.get("blind", False)
        self._names_told = list(state.get("names", ()))
        refused = state.get("refused", {})
        self.refused_in_a_row = refused.get("count", 0)
        self._refused_steps = list(refused.get("steps", ()))
        self.last_reason = refused.get("reason", "")
        self._refusals_are_told = refused.get("told", False)

    def gap(self, first: int, end: int, unit: str) -> None:
        """Take in that nothing came of the steps from `first` on to the one before `end`.

        Parameters
        ----------
        first, end : int
            The first step that is missing, and the one that has come.
        unit : str
            The unit that the times of the messages seem to have, see `Clock.slipped_unit`.
        """
        if end == self._gap_end:  # told before the watch was taken up again
            return
        self._gap_end = end
        step, count = self._words.step, end - first
        if count == 1:
            sentence = f"{step.capitalize()} {first}: no message came, and the belief is predicted through"
        else:
            sentence = (
                f"{step.capitalize()}s {first} to {end - 1}: no message came, and the belief is predicted "
                f"through {count} {step}s by what the transitions say alone"
            )
        self._coming.append(Notice("gap", f"{sentence}{unit_advice(unit)}.", value=float(count)))

    def clock(self, step: int, steps: float, unit: str) -> None:
        """Take in that a time lies too far from the only one before it; the message is the next step.

        Parameters
        ----------
        step : int
            The next step.
        steps : float
            Steps by which the time lies behind the other one.
        unit : str
            The unit that the times seem to have.
        """
        if self._clock_is_told:
            return
        self._clock_is_told = True
        word = self._words.step
        where = f"{abs(steps):.4g} {word}s {'behind' if steps > 0.0 else 'before'} that of the message before"
        cause = unit_advice(unit) or "; see whether the clock of the logger was set"
        sentence = (
            f"{word.capitalize()} {step}: the time of the message lies {where}{cause}. Until two times "
            f"agree, each message is taken as the next {word}, and no gap can be seen."
        )
        self._coming.append(Notice("clock", sentence))

    def clock_agrees(self) -> None:
        """Take in that two times agree."""
        self._clock_is_told = False

    def refuse(self, step: int | None, reason: str) -> None:
        """Take in that a message was refused, of which the step may be known."""
        self.refused_in_a_row += 1
        self.last_reason = reason
        if len(self._refused_steps) < REFUSALS_IN_A_ROW:
            self._refused_steps.append(step)

    @property
    def refusals_are_untold(self) -> bool:
        """Whether enough messages were refused in a row, and the operator was not told yet."""
        return self.refused_in_a_row >= REFUSALS_IN_A_ROW and not self._refusals_are_told

    def refusals(self, next_step: int) -> Notice:
        """Return the notice that no message is taken any more.

        Parameters
        ----------
        next_step : int
            The step that is expected next.
        """
        self._refusals_are_told = True
        word, count = self._words.step, self.refused_in_a_row
        since = f"Since {word} {next_step - 1}," if next_step else "From the beginning on,"
        sentence = (
            f"{since} {counted(count, 'message')} came, and all were refused (rejected.jsonl), the last one "
            f"because {self.last_reason}.{self._likely_cause(next_step)}"
        )
        return Notice("refused", sentence, value=float(count))

    def _likely_cause(self, next_step: int) -> str:
        """Return what the steps of the refused messages have in common, as a sentence; or nothing."""
        steps = [step for step in self._refused_steps if step is not None]
        if len(steps) < REFUSALS_IN_A_ROW or max(steps) >= next_step:
            return ""
        word = self._words.step
        if len({*steps}) == 1:
            return (
                f" All belong to {word} {steps[0]}: see whether its counter stands still, and whether "
                "`watch.seconds_per_step` and `watch.time_unit` are right."
            )
        if steps == sorted({*steps}):
            listed = listing(map(str, steps))
            return (
                f" They belong to the {word}s {listed}, which were watched before: where the counter or the "
                "clock of the logger has begun again, begin another watch in another folder (--out), or send "
                "messages without `step`, which go on with this one."
            )
        return ""

    def take(self, step: int, *, is_blind: bool, passed_over: Mapping[str, str]) -> list[Notice]:
        """Take in the message of the next step; return the notices that go with it.

        Parameters
        ----------
        step : int
        is_blind : bool
            Whether it has no reading of any sensor.
        passed_over : dict of str to str
            Names in it that are no sensor, with what each is beside that: "a JSON object", or the known name
            that it looks like, in words; empty where there is nothing to say.
        """
        when = f"{self._words.step.capitalize()} {step}"
        notices = self.coming()
        if self._refusals_are_told:
            sentence = f"{when}: messages are taken again, after {self.refused_in_a_row} were refused."
            notices.append(Notice("taken", sentence, value=float(self.refused_in_a_row)))
        self.refused_in_a_row = 0
        self._refused_steps = []
        self._refusals_are_told = False
        if is_blind and not self.is_blind:
            names = listing(f"`{name}`" for name in passed_over)
            ignored = f"; passed over: {names}" if names else ""
            sentence = f"{when}: the message has no reading of any {self._words.sensor}{ignored}."
            notices.append(Notice("blind", sentence))
        self.is_blind = is_blind
        notices += self._likely_slips(when, passed_over)
        return notices

    def _likely_slips(self, when: str, passed_over: Mapping[str, str]) -> list[Notice]:
        """Return a notice of the names that were passed over and look like known ones, each told once."""
        slips = [name for name in passed_over if passed_over[name] and name not in self._names_told]
        slips = slips[: _NAMES_TOLD - len(self._names_told)]
        if not slips:
            return []
        self._names_told += slips
        described = listing(f"`{name}` ({passed_over[name]})" for name in slips)
        return [Notice("passed_over", f"{when}: passed over as no {self._words.sensor}: {described}.")]

    def coming(self) -> list[Notice]:
        """Return the notices that wait for the next reading, once."""
        notices = self._coming
        self._coming = []
        return notices
