"""Measured figures with their targets and references, and timers of function calls."""

import resource
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
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

    def beside(
        self, name: str, value: float, *, peer: str = "", agreement: Agreement | None = None
    ) -> "Measurement":
        """Return the figure with what ran beside it; the parameters are the attributes above."""
        return replace(
            self, reference_name=name, reference_value=value, peer=peer, agreement=agreement
        )


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
    return agreement_within(quantity, float(difference / np.abs(reference).max()), tolerance)


def agreement_within(quantity: str, difference: float, tolerance: float) -> Agreement:
    """Return an agreement whose relative difference is known; raises as `compared`."""
    if not difference <= tolerance:
        raise DisagreementError(
            f"{quantity} differ by {difference:.2g} of the largest value between ours and the "
            f"peer's; expected at most {tolerance:g}."
        )
    return Agreement(quantity, difference, tolerance)


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


def least_seconds_of(function: Callable[[], object], *, repeats: int = 15, inner: int = 1) -> float:
    """Return the least wall-clock seconds of one call, over `repeats` batches of `inner` calls.

    One call before the first batch warms the function. On a busy machine the least of many short
    batches is one that nothing has interrupted.
    """
    return least_seconds({"": function}, repeats=repeats, inner=inner)[""]


def least_seconds(
    functions: Mapping[str, Callable[[], object]], *, repeats: int, inner: int
) -> dict[str, float]:
    """Return the least seconds of one call of each function, over alternating batches of calls."""
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


@dataclass(frozen=True)
class FinishedCommand:
    """A command that has ended.

    Attributes
    ----------
    processor_seconds : float
        The processor time of the command and of all processes that it started [s].
    output : str
        All that it printed.
    """

    processor_seconds: float
    output: str


def run_command(command: Sequence[str], environment: Mapping[str, str]) -> FinishedCommand:
    """Run a command in a process of its own.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments.
    environment : mapping of str to str
        All environment variables of the command.

    Raises
    ------
    RuntimeError
        If the command ends with another exit code than 0; with the last line that it printed.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    finished = subprocess.run(
        command,
        check=False,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=dict(environment),
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if finished.returncode:
        last_line = (finished.stdout.strip().splitlines() or ["nothing was printed"])[-1]
        raise RuntimeError(
            f"{' '.join(command[:3])!r} ended with exit code {finished.returncode}: {last_line}"
        )
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return FinishedCommand(seconds, finished.stdout)
