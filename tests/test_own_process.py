"""Processes of their own for tests are forked from an interpreter without threads."""

import os
from pathlib import Path

import psutil
import pytest

from tests.own_process import ended_by

ROOT = Path(__file__).parents[1]
FORKS = ("os." + "fork(", 'get_context("' + 'fork")')
ALLOWED = {
    ROOT
    / "reporting"
    / "formats"
    / "netcdf.py": "reads a file with h5py, which holds its own lock while it forks",
    ROOT / "fmu_asset" / "worker" / "supervisor.py": "forks before it loads any library",
}
"""Files of the product that fork, and why the fork meets no thread."""


def check_threads_of_parent() -> None:
    assert psutil.Process(os.getppid()).num_threads() == 1


def test_the_process_that_is_forked_has_no_other_thread():
    assert ended_by(check_threads_of_parent) == 0


def test_a_process_that_fails_is_told_by_its_exit_code():
    assert ended_by(lambda: pytest.fail("as it should")) == 1


PACKAGES = (
    "benchmarks",
    "calibration",
    "discrepancy",
    "fe",
    "fmu_asset",
    "reporting",
    "tests",
    "twin_master",
    "uav_twin",
)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_process_with_threads_is_forked(package):
    files = [file for file in (ROOT / package).rglob("*.py") if file not in ALLOWED]
    forking = [file.name for file in files if any(fork in file.read_text("utf-8") for fork in FORKS)]
    assert forking == []
