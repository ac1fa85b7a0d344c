"""What tests cost in processor time, and which of them are not quick.

A busy machine changes processor time less than it changes the time on the clock. What several tests share, a
fixture or the value of a function with `once`, is paid by whichever test comes first. So its cost is spread
evenly over all tests that use it.
"""

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, wraps
from typing import ParamSpec, TypeVar

QUICK_SECONDS = 0.15
"""A test function is quick if its tests take no more processor time than this on average [s]."""

_Parameters = ParamSpec("_Parameters")
_Value = TypeVar("_Value")


@dataclass
class RunningTest:
    """What a test of this process has cost so far.

    Attributes
    ----------
    start : float
        The processor time at which it began [s].
    seconds_of_shared : float
        The processor time that went into what other tests share with it [s].
    shared_used : set of str
        Names of what it shares.
    """

    start: float = 0.0
    seconds_of_shared: float = 0.0
    shared_used: set[str] = field(default_factory=set)

    @property
    def own_seconds(self) -> float:
        """The processor time of the test itself until now [s]."""
        return processor_seconds() - self.start - self.seconds_of_shared


@dataclass(frozen=True)
class TestCost:
    """What a test has cost, as a worker reports it: its own seconds, and by name those of what it shares."""

    __test__ = False

    own_seconds: float
    shared: Mapping[str, float]


seconds_of_shared: dict[str, float] = {}
"""By name, the processor time of what was made in this process for several tests [s]."""

running = RunningTest()
_nesting = 0


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for [s]."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def begin_test() -> None:
    """Count from here on for a new test."""
    running.start = processor_seconds()
    running.seconds_of_shared = 0.0
    running.shared_used = set()


@contextmanager
def shared_by_tests(name: str) -> Iterator[None]:
    """Count the processor time of a block for what several tests share, and not for the running one."""
    global _nesting
    start = processor_seconds()
    _nesting += 1
    try:
        yield
    finally:
        _nesting -= 1
        seconds = processor_seconds() - start
        seconds_of_shared[name] = seconds
        if not _nesting:  # else what it is made for counts it
            running.seconds_of_shared += seconds


def once(function: Callable[_Parameters, _Value]) -> Callable[_Parameters, _Value]:
    """Have a function compute each value once in a process, for all tests that ask for it."""

    @cache
    def compute(*arguments: _Parameters.args, **options: _Parameters.kwargs) -> _Value:
        with shared_by_tests(name(arguments, options)):
            return function(*arguments, **options)

    def name(arguments: tuple[object, ...], options: Mapping[str, object]) -> str:
        return f"{function.__module__}.{function.__qualname__}{hash((arguments, *options.items()))}"

    @wraps(function)
    def value(*arguments: _Parameters.args, **options: _Parameters.kwargs) -> _Value:
        running.shared_used.add(name(arguments, options))
        return compute(*arguments, **options)  # type: ignore[arg-type]

    return value


def slow_functions(costs: Mapping[str, list[TestCost]]) -> set[str]:
    """Return the names of test functions that are not quick, given the costs of their tests.

    Without the tests that are found slow, fewer share what is expensive, so that the others cost more: the
    search is repeated until it finds no more.
    """
    slow: set[str] = set()
    while True:
        quick_costs = {name: tests for name, tests in costs.items() if name not in slow}
        user_counts = Counter(
            shared for tests in quick_costs.values() for test in tests for shared in test.shared
        )
        seconds: dict[str, float] = defaultdict(float)
        for name, tests in quick_costs.items():
            for test in tests:
                seconds[name] += test.own_seconds
                seconds[name] += sum(cost / user_counts[shared] for shared, cost in test.shared.items())
        found = {name for name, tests in quick_costs.items() if seconds[name] / len(tests) > QUICK_SECONDS}
        if not found:
            return slow
        slow |= found
