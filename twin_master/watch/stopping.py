"""The end of a watch that is asked for: between two turns, never within one."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from twin_master.errors import TwinMasterError
from twin_master.mission.turns import Reading
from twin_master.network.twin import Twin
from twin_master.watch.intake import Intake

POLL_SECONDS = 0.05
"""Between two looks at a feed that may go on."""


class Stopping:
    """A source that ends when SIGINT or SIGTERM ask for it: between two turns, never within one.

    Parameters
    ----------
    intake : Intake
        Of the readings.
    turns : int or None
        In all, after which it ends.
    look : callable
        Called now and then while nothing comes, and behind messages from which no reading comes.
    """

    def __init__(self, intake: Intake, turns: int | None, look: Callable[[], None]) -> None:
        self._intake, self._turns, self._look = intake, turns, look
        intake.look = self._looked
        self.asked = self._waiting = False

    def read(self, twin: Twin) -> Reading | None:
        """Return the next reading; None once the watch is to end."""
        if self.asked or (self._turns is not None and twin.turns >= self._turns):
            return None
        try:
            while not self.asked:
                self._waiting, begin = True, time.monotonic()
                if (reading := self._intake.read(twin)) is not None or self._intake.ended:
                    return reading
                time.sleep(max(0.0, begin + POLL_SECONDS - time.monotonic()))
                self._looked()
        except _Asked:
            pass
        finally:
            self._waiting = False
        return None

    def _looked(self) -> None:
        self._waiting = False
        self._look()
        self._waiting = True
        if self.asked:
            raise _Asked

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return what is assimilated in the place of an observation that no state allows."""
        return self._intake.impossible(reading, error)

    def _ask(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self._waiting:
            raise _Asked

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen to the signals."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class _Asked(BaseException):
    """Somebody asked the watch to end while it waited."""
