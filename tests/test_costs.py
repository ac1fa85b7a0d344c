"""What tests cost, and the list of those that are not quick."""

import ast
import time
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tests import costs
from tests.conftest import NOT_QUICK
from tests.costs import QUICK_SECONDS, TestCost, once, shared_by_tests, slow_functions
from tests.kept import ROOT

ROWS = NOT_QUICK.read_text(encoding="utf-8").split()


@cache
def functions_of(file: Path) -> frozenset[str]:
    """Return the names of the functions of a file, those of classes with the name of the class."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            functions |= {
                f"{node.name}::{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)
            }
    return frozenset(functions)


def test_the_tests_that_are_not_quick_exist():
    """Else a test that was renamed would be run among the quick ones."""
    missing = []
    for row in ROWS:
        file, _, function = row.partition("::")
        if not (ROOT / file).is_file() or function not in functions_of(ROOT / file):
            missing.append(row)
    assert missing == []


def test_each_test_that_is_not_quick_is_listed_once():
    assert [row for row, count in Counter(ROWS).items() if count > 1] == []


SLOW, QUICK = 2.0 * QUICK_SECONDS, 0.5 * QUICK_SECONDS


def test_a_function_is_slow_if_its_tests_are_slow_on_average():
    tests = {
        "slow": [TestCost(SLOW, {}), TestCost(QUICK, {})],
        "quick": [TestCost(QUICK, {})] * 10,
    }
    assert slow_functions(tests) == {"slow"}


def test_the_cost_of_what_is_shared_is_spread_over_the_tests_that_use_it():
    shared = {"a fixture": 10.0 * QUICK_SECONDS}
    of_one_user = {"test": [TestCost(0.0, shared)]}
    of_twenty_users = {"test": [TestCost(0.0, shared)] * 20}
    assert slow_functions(of_one_user) == {"test"}
    assert slow_functions(of_twenty_users) == set()


def test_a_function_is_slow_if_only_slow_ones_share_what_it_uses():
    """Beside the ten slow tests each would have to pay a small part of the fixture alone."""
    shared = {"a fixture": 5.0 * QUICK_SECONDS}
    tests = {"slow": [TestCost(SLOW, shared)] * 10, "user": [TestCost(0.0, shared)] * 2}
    assert slow_functions(tests) == {"slow", "user"}


@pytest.fixture
def running(monkeypatch):
    """The count of a test that begins here, in place of this one's."""
    count = costs.RunningTest(start=costs.processor_seconds())
    monkeypatch.setattr(costs, "running", count)
    return count


def work(seconds: float) -> None:
    """Keep the processor busy."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_what_is_shared_is_no_cost_of_the_test_that_makes_it(running):
    with shared_by_tests("what is shared"):
        work(0.05)
    assert costs.seconds_of_shared.pop("what is shared") >= 0.05
    assert running.own_seconds < running.seconds_of_shared


def test_what_is_shared_within_what_is_shared_is_counted_once(running):
    with shared_by_tests("outer"), shared_by_tests("inner"):
        work(0.05)
    outer = costs.seconds_of_shared.pop("outer")
    inner = costs.seconds_of_shared.pop("inner")
    assert running.seconds_of_shared == outer >= inner


def test_a_value_is_computed_once_and_used_by_all_that_ask_for_it(running):
    calls = []

    @once
    def square(number):
        calls.append(number)
        return number**2

    assert [square(3), square(3), square(4)] == [9, 9, 16]
    assert calls == [3, 4]
    assert len(running.shared_used) == 2
