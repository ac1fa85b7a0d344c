"""Measured figures with their targets and references, and timers of function calls."""

import resource
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from math import isfinite

import numpy as np
from numpy.typing import ArrayLike


class NotAvailableError(RuntimeError):
    """What a benchmark needs is not installed; the message says how to install it."""


class DisagreementError(RuntimeError):
    """Two programs that solve the same problem have different answers."""


@dataclass(frozen=True)
class Agreement:
    """How far the answers of two programs differ.

    Attributes
    ----------
    quantity : str
        What was compared: "smoothed beliefs".
    difference : float
        The largest difference, relative to the largest value of the reference.
    tolerance : float
        The largest difference that is accepted.
    """

    quantity: str
    difference: float
    tolerance: float


@dataclass(frozen=True)
class Measurement:
    """One measured figure.

    Attributes
    ----------
    name : str
        What was measured.
    value : float
        The figure, in `unit`.
    unit : str
        Unit of `value` and `target`.
    target : float or None
        The figure wanted; None where none was set.
    reference_name, reference_value
        What ran beside it in the same process, and its figure in the same unit, so that the ratio
        of the two does not depend on the machine.
    larger_is_better : bool
        True for speed-ups; False for times, sizes and errors.
    peer : str
        The program of others that is the reference, with its version: "pgmpy 1.1.2". Empty if the
        reference is ours.
    agreement : Agreement or None
        How far the answer of the reference differs from ours; None if it was not compared.
    remark : str
        A sentence for the reader, such as how to install a peer that is missing.
    """

    name: str
    value: float
    unit: str
    target: float | None = None
    reference_name: str = ""
    reference_value: float | None = None
    larger_is_better: bool = False
    peer: str = ""
    agreement: Agreement | None = None
    remark: str = ""

    def __post_init__(self) -> None:
        """Check that the figure is a number."""
        if not isfinite(self.value):
            raise ValueError(f"The figure {self.name!r} is {self.value}, not a finite number.")

    @property
    def reached(self) -> bool | None:
        """Whether the target is reached; None without a target."""
        if self.target is None:
            return None
        return self.value >= self.target if self.larger_is_better else self.value <= self.target

    @property
    def ratio(self) -> float | None:
        """The figure over that of the reference; None without a reference."""
        return self.value / self.reference_value if self.reference_value else None


def compared(quantity: str, ours: ArrayLike, theirs: ArrayLike, tolerance: float) -> Agreement:
    """Return how far our answer differs from that of another program.

    Parameters
    ----------
    quantity : str
        What is compared.
    ours, theirs : array_like
        The two answers, of the same shape and in the same unit.
    tolerance : float
        The largest accepted difference, relative to the largest value of `theirs`.

    Raises
    ------
    DisagreementError
        If the difference is larger than the tolerance, or is not a number.
    """
    reference = np.asarray(theirs, dtype=np.float64)
    difference = np.abs(np.asarray(ours, dtype=np.float64) - reference).max()
    relative_difference = float(difference / np.abs(reference).max())
    if not relative_difference <= tolerance:
        raise DisagreementError(
            f"{quantity} differ by {relative_difference:.2g} of the largest value between ours and "
            f"the peer's; expected at most {tolerance:g}."
        )
    return Agreement(quantity, relative_difference, tolerance)


def peer_version(distribution: str) -> str:
    """Return the name and the installed version of a distribution: "pgmpy 1.1.2".

    Raises
    ------
    NotAvailableError
        If the distribution is not installed.
    """
    try:
        return f"{distribution} {metadata.version(distribution)}"
    except metadata.PackageNotFoundError:
        raise NotAvailableError(
            f"{distribution} is not installed; `pip install {distribution}` installs it."
        ) from None


def median_seconds(function: Callable[[], object], *, repeats: int = 15, inner: int = 1) -> float:
    """Return the median wall-clock seconds of one call, over `repeats` batches of `inner` calls."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(inner):
            function()
        times.append((time.perf_counter() - begin) / inner)
    return float(np.median(times))


def least_seconds(
    functions: Mapping[str, Callable[[], object]], *, repeats: int, inner: int
) -> dict[str, float]:
    """Return the least seconds of one call of each function, over alternating batches of calls.

    On a busy machine the least of many short batches is one that nothing has interrupted.
    """
    least = dict.fromkeys(functions, float("inf"))
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            begin = time.perf_counter()
            for _ in range(inner):
                function()
            least[name] = min(least[name], (time.perf_counter() - begin) / inner)
    return least


def least_processor_seconds(function: Callable[[], object], *, repeats: int) -> float:
    """Return the least processor seconds of a call of a function, after one call to warm it."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return min(times)


def processor_seconds_of(command: Sequence[str], environment: Mapping[str, str]) -> float:
    """Return the processor seconds of a command and of all its processes.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments. Its output is discarded.
    environment : mapping of str to str
        All environment variables of the command.

    Raises
    ------
    subprocess.CalledProcessError
        If the command ends with another exit code than 0.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True, env=dict(environment))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
