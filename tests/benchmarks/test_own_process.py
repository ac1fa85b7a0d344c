"""Figures of benchmarks that are measured in processes of their own."""

import os
from collections.abc import Callable, Iterator

import pytest

from benchmarks.measurement import Measurement, NotAvailableError
from benchmarks.own_process import figures_of_own_process


def process_number() -> Iterator[Measurement]:
    """Measure which process this is."""
    yield Measurement("process", os.getpid(), "")


def unavailable() -> Iterator[Measurement]:
    """Measure something, and find then that a peer is missing."""
    yield Measurement("first", 1.0, "s")
    raise NotAvailableError("no peer")


def killed() -> Iterator[Measurement]:
    """End the process in the middle."""
    yield Measurement("first", 1.0, "s")
    os._exit(3)


def load_process_number() -> Callable[[], Iterator[Measurement]]:
    return process_number


def load_unavailable() -> Callable[[], Iterator[Measurement]]:
    return unavailable


def load_killed() -> Callable[[], Iterator[Measurement]]:
    return killed


def test_each_benchmark_has_a_process_of_its_own() -> None:
    """So the peak memory of one does not count for the next."""
    (first,) = figures_of_own_process(load_process_number)
    (second,) = figures_of_own_process(load_process_number)
    assert len({first.value, second.value, os.getpid()}) == 3


def test_what_a_benchmark_raises_is_raised_after_its_figures() -> None:
    figures = figures_of_own_process(load_unavailable)
    assert next(figures).name == "first"
    with pytest.raises(NotAvailableError, match="no peer"):
        next(figures)


def test_a_benchmark_whose_process_ends_early_says_so() -> None:
    figures = figures_of_own_process(load_killed)
    next(figures)
    with pytest.raises(RuntimeError, match="exit code 3"):
        next(figures)
