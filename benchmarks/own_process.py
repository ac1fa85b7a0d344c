"""A benchmark in a process of its own, so that none changes the memory or the time of the next."""

import importlib
import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection

from benchmarks.measurement import Measurement

Benchmark = Callable[[], Iterable[Measurement]]
"""Measures figures, and yields each as soon as it is known."""


def figures_of_own_process(load: Callable[[], Benchmark]) -> Iterator[Measurement]:
    """Yield the figures of a benchmark, which a new process measures, as soon as each is known.

    The peak memory of a process never falls, and that of its children begins with its own. In one
    process, each benchmark would therefore have at least the memory of those before it.

    Parameters
    ----------
    load : callable
        Imports the benchmark and returns it; it can be pickled.

    Raises
    ------
    RuntimeError
        If the process ends before it has told of all figures.
    Exception
        What the benchmark raises, with its traceback as a note.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_figures, args=(load, sender))
    process.start()
    sender.close()  # the end of the other process is the end of the pipe
    try:
        while (message := receiver.recv()) is not None:
            if isinstance(message, Exception):
                raise message
            yield message
    except EOFError:
        process.join()
        raise RuntimeError(f"its process ended early, with exit code {process.exitcode}") from None
    finally:
        receiver.close()
        process.join()


def imported_benchmark(module: str) -> Benchmark:
    """Import a module of a benchmark and return the function that measures it.

    The new process finds this function in its own module; it does not find those of the module that
    was started as a program.
    """
    benchmark: Benchmark = importlib.import_module(module).run
    return benchmark


def _send_figures(load: Callable[[], Benchmark], sender: Connection) -> None:
    """Send the figures of a benchmark, and at last None or what it has raised."""
    try:
        for measurement in load()():
            sender.send(measurement)
    except Exception as error:  # noqa: BLE001 - the process that asked for the figures raises it
        error.add_note(traceback.format_exc())
        sender.send(error)
    else:
        sender.send(None)
