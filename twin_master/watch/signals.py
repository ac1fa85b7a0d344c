"""Signals that ask for the end of a watch."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def call_on_end_signal(request_end: Callable[[], None]) -> Iterator[None]:
    """Call a function when SIGINT or SIGTERM comes, and restore the former handlers at the end.

    Only the main thread of a process may set handlers. In another thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former_handlers = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        former_handlers[number] = signal.signal(number, lambda *_: request_end())
    try:
        yield
    finally:
        for number, handler in former_handlers.items():
            signal.signal(number, handler)
