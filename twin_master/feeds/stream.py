"""Notices about a stream of messages as a whole, each given once until its cause is over."""

from collections.abc import Mapping

from reporting.json_file import JsonObject, JsonRecord
from reporting.words import counted, listing
from twin_master.network.estimator import Notice, NoticeWording

REFUSALS_IN_A_ROW = 3
"""Number of messages refused in a row after which the operator gets a notice."""
TIME_UNITS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
"""Units of times, each a thousandth of the one before it, and their names."""
_MOST_MISSPELLINGS = 24
"""Largest number of ignored names that a watch reports, so that they do not fill the journal."""


def unit_advice(unit: str) -> str:
    """Return a clause with the option that fits the unit which times seem to have.

    Parameters
    ----------
    unit : str
        The unit that the times of the messages seem to have; empty if the stated one fits, in
        which case the clause is empty.
    """
    if not unit:
        return ""
    return f'; its times look like {TIME_UNITS[unit]}: give `watch.time_unit = "{unit}"`'


class StreamNotices:
    """Notices about the messages of a stream: gaps, pauses, clocks, refusals, unknown names.

    Attributes
    ----------
    is_blind : bool
        Whether the last message of a next step had no reading of any sensor.
    refused_in_a_row : int
        The number of messages that were refused since one was accepted.
    last_reason : str
        Why the last of them was refused.
    """

    def __init__(self, words: NoticeWording) -> None:
        self._words = words
        self._pending: list[Notice] = []  # given with the next reading
        self._gap_end = -1  # the step after the last gap that was reported
        self._clock_is_reported = False
        self.is_blind = False
        self._reported_misspellings: list[str] = []
        self.refused_in_a_row = 0
        self.last_reason = ""
        self._refused_steps: list[int | None] = []
        self._refusals_are_reported = False

    def state(self, *, waiting: bool) -> JsonObject:
        """Return what the journal keeps of the reported notices, so that none is given twice.

        A watch that is resumed continues from this state.

        Parameters
        ----------
        waiting : bool
            Whether the message after a gap will be read again.
        """
        refusal_record = {
            "count": self.refused_in_a_row,
            "steps": self._refused_steps,
            "reason": self.last_reason,
            "told": self._refusals_are_reported,
        }
        state = {
            "gap_end": self._gap_end if waiting else None,
            "clock": self._clock_is_reported,
            "blind": self.is_blind,
            "names": list(self._reported_misspellings),
            "refused": refusal_record if self.refused_in_a_row else None,
        }
        # A journal leaves out what is zero, false or empty
        return {key: value for key, value in state.items() if value}

    def restore(self, state: JsonRecord) -> None:
        """Restore a state that `state` returned; what it leaves out gets its initial value."""
        self._gap_end = state.get("gap_end", -1)
        self._clock_is_reported = state.get("clock", False)
        self.is_blind = state.get("blind", False)
        self._reported_misspellings = list(state.get("names", ()))
        refusal_record = state.get("refused", {})
        self.refused_in_a_row = refusal_record.get("count", 0)
        self._refused_steps = list(refusal_record.get("steps", ()))
        self.last_reason = refusal_record.get("reason", "")
        self._refusals_are_reported = refusal_record.get("told", False)

    def note_gap(self, first_missing: int, next_step: int, unit: str) -> None:
        """Add a notice about a gap: steps without a message, before a step that has one.

        Parameters
        ----------
        first_missing : int
            The first step without a message.
        next_step : int
            The first step after it with a message.
        unit : str
            The unit in which the times seem to be given, see `Clock.likely_unit`.
        """
        if next_step == self._gap_end:  # reported before the watch was taken up again
            return
        self._gap_end = next_step
        step_name = self._words.step
        count = next_step - first_missing
        if count == 1:
            sentence = (
                f"{self._words.name_step(first_missing)}: no message was received, and the "
                "belief is predicted over it"
            )
        else:
            sentence = (
                f"{step_name.capitalize()}s {first_missing} to {next_step - 1}: no message was "
                f"received, and the belief is predicted over {count} {step_name}s by the "
                "transitions"
            )
        notice = Notice("gap", f"{sentence}{unit_advice(unit)}.", value=float(count))
        self._pending.append(notice)

    def note_begin(self, step: int, number: int) -> None:
        """Add a notice that the publisher counts its messages from another number.

        Parameters
        ----------
        step : int
            The step of the first message with a number.
        number : int
            This number.
        """
        step_name = self._words.step
        sentence = (
            f"{self._words.name_step(step)}: counting begins with this message, which calls "
            f"itself {step_name} {number}."
        )
        self._pending.append(Notice("begin", sentence, value=float(number)))

    def note_pause(self, next_step: int, steps: int, unit: str) -> None:
        """Add a notice that the asset is taken to have rested while no message came.

        A further pause is not reported until two messages follow each other without one.

        Parameters
        ----------
        next_step : int
            The next step, which is that of the message after the pause.
        steps : int
            The length of the pause in steps.
        unit : str
            The unit that the times seem to have; empty if the stated unit fits.
        """
        if self._clock_is_reported:
            return
        self._clock_is_reported = True
        step_name = self._words.step
        sentence = (
            f"{self._words.name_step(next_step)}: the message came after a pause of {steps} "
            f"{step_name}s, in which the asset is taken to have rested, so that nothing has worn; "
            f'where {step_name}s go on without messages, give `watch.between = "steps"`'
            f"{unit_advice(unit)}."
        )
        self._pending.append(Notice("pause", sentence, value=float(steps)))

    def note_rate(self, interval: float, step_length: float) -> None:
        """Add a notice that the logger sends at another rate than that of the steps.

        Parameters
        ----------
        interval : float
            The mean interval between two messages [s].
        step_length : float
            The length of a step [s].
        """
        step_name = self._words.step
        if interval < step_length:
            count = round(step_length / interval)
            consequence = f"so that of {count} messages one is taken and the others are refused"
            remedy = (
                f"give `watch.every = {count}` to take one in {count}, let the logger send means "
                f"over a {step_name}, or correct `watch.seconds_per_step`"
            )
        else:
            consequence = f"so that most {step_name}s have no message"
            remedy = (
                f"give `watch.seconds_per_step = {interval:.4g}`, with the transitions of such a "
                f"{step_name}, or let the logger send more often"
            )
        sentence = (
            f"A message comes every {interval:.4g} s, and a {step_name} takes {step_length:.4g} s, "
            f"{consequence}: {remedy}."
        )
        self._pending.append(Notice("rate", sentence, value=interval))

    def note_clock_jump(
        self,
        next_step: int,
        distance: float,
        unit: str,
        *,
        noun: str,
        widening: int,
        rests: bool,
    ) -> None:
        """Add a notice that a message lies too far from the one before it.

        The caller takes such a message as a new beginning. A further jump is not reported until two
        messages agree.

        Parameters
        ----------
        distance : float
            The number of steps by which the message lies after the one before it; negative if it
            lies earlier.
        unit : str
            The unit in which the times seem to be given.
        noun : str
            "time" or "number": how the message is counted.
        widening : int
            The number of steps through which the belief is predicted before the message.
        rests : bool
            Whether the asset rests between messages.
        """
        if self._clock_is_reported:
            return
        self._clock_is_reported = True
        step_name = self._words.step
        side = "behind" if distance > 0.0 else "before"
        cause = unit_advice(unit) or f"; see whether the {noun} of the logger was set"
        belief = "with the belief as it was"
        remedy = ""
        if widening:
            belief = f"and the belief is predicted over {widening} {step_name}s by the transitions"
            remedy = ' If the asset has rested, give `watch.between = "rest"`.'
        elif rests and not unit:
            remedy = (
                " If the asset was in service meanwhile, give `watch.longest_gap` and "
                '`watch.between = "steps"`.'
            )
        sentence = (
            f"{self._words.name_step(next_step)}: the {noun} of the message lies "
            f"{abs(distance):.4g} {step_name}s {side} that of the message before{cause}. Counting "
            f"begins anew with this message, {belief}. Until two messages agree, each is taken as "
            f"the next {step_name}, and no gap can be seen.{remedy}"
        )
        self._pending.append(Notice("clock", sentence))

    def note_clock_agreement(self) -> None:
        """Record that two messages agree, so that a later pause or jump is reported again."""
        self._clock_is_reported = False

    def note_refusal(self, step: int | None, reason: str) -> None:
        """Record a refused message, with its step if that is known, and the reason."""
        self.refused_in_a_row += 1
        self.last_reason = reason
        if len(self._refused_steps) < REFUSALS_IN_A_ROW:
            self._refused_steps.append(step)

    @property
    def has_refusals_to_report(self) -> bool:
        """Whether enough messages were refused in a row without a notice to the operator."""
        return self.refused_in_a_row >= REFUSALS_IN_A_ROW and not self._refusals_are_reported

    def report_refusals(self, next_step: int) -> Notice:
        """Return the notice that all messages since the last step were refused.

        This marks the refusals as reported, so that the notice is not repeated until a message has
        been accepted again.

        Parameters
        ----------
        next_step : int
            The step that is expected next; 0 if no message was accepted yet.
        """
        self._refusals_are_reported = True
        count = self.refused_in_a_row
        since = "From the beginning on,"
        if next_step:
            since = f"Since {self._words.step} {next_step - 1},"
        sentence = (
            f"{since} {counted(count, 'message')} were received, and all were refused "
            "(rejected.jsonl), the last one because "
            f"{self.last_reason}.{self._likely_cause(next_step)}"
        )
        return Notice("refused", sentence, value=float(count))

    def _likely_cause(self, next_step: int) -> str:
        """Return a sentence with the likely cause if refused messages belong to past steps.

        Two patterns are known: all messages name the same step (a counter that stands still), or
        rising steps that were watched before (a counter that has restarted). Otherwise the text is
        empty.
        """
        steps = [step for step in self._refused_steps if step is not None]
        if len(steps) < REFUSALS_IN_A_ROW or max(steps) >= next_step:
            return ""
        step_name = self._words.step
        if len(set(steps)) == 1:
            return (
                f" All belong to {step_name} {steps[0]}: check whether its counter has stopped, "
                "and whether `watch.seconds_per_step` and `watch.time_unit` are right."
            )
        if steps == sorted(set(steps)):
            listed = listing(map(str, steps))
            return (
                f" They belong to the {step_name}s {listed}, which were watched before: where the "
                "counter or the clock of the logger has begun again, begin another watch in "
                "another folder (--out), or send messages without `step`, which go on with this "
                "one."
            )
        return ""

    def accept(self, step: int, *, is_blind: bool, ignored: Mapping[str, str]) -> list[Notice]:
        """Record that a message is accepted; return the notices for its step.

        Parameters
        ----------
        is_blind : bool
            Whether the message has no reading of any sensor.
        ignored : dict of str to str
            The names in the message that are not sensors, each with the known name that was
            probably meant, in words, or an empty text.
        """
        when = self._words.name_step(step)
        notices = self.pop_pending()
        if self._refusals_are_reported:
            count = self.refused_in_a_row
            sentence = f"{when}: messages are taken again, after {count} were refused."
            notices.append(Notice("taken", sentence, value=float(count)))
        self.refused_in_a_row = 0
        self._refused_steps = []
        self._refusals_are_reported = False
        if is_blind and not self.is_blind:
            names = listing(f"`{name}`" for name in ignored)
            passed_over = f"; passed over: {names}" if names else ""
            sentence = (
                f"{when}: the message has no reading of any {self._words.sensor}{passed_over}."
            )
            notices.append(Notice("blind", sentence))
        self.is_blind = is_blind
        notices += self._report_misspellings(when, ignored)
        return notices

    def _report_misspellings(self, when: str, ignored: Mapping[str, str]) -> list[Notice]:
        """Return a notice about ignored names that look like misspelt sensors or keys, if any.

        Each name is reported once in a watch, and at most `_MOST_MISSPELLINGS` names altogether.
        """
        new_misspellings = []
        for name, meaning in ignored.items():
            if meaning and name not in self._reported_misspellings:
                new_misspellings.append(name)
        new_misspellings = new_misspellings[: _MOST_MISSPELLINGS - len(self._reported_misspellings)]
        if not new_misspellings:
            return []
        self._reported_misspellings += new_misspellings
        described = listing(f"`{name}` ({ignored[name]})" for name in new_misspellings)
        sentence = f"{when}: passed over as no {self._words.sensor}: {described}."
        return [Notice("passed_over", sentence)]

    def pop_pending(self) -> list[Notice]:
        """Return the notices that wait for the next reading, and clear them."""
        notices = self._pending
        self._pending = []
        return notices
