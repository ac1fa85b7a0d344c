"""The search for the cause of an alarm that `uav_twin` hands to a watch."""

import inspect
import os
import sys
from pathlib import Path

import pytest

import uav_twin
from tests.twin_master.watch.conftest import wait_until
from twin_master.errors import MissionInputError
from twin_master.watch import workflow
from twin_master.watch.cause_search import SearchRequest
from uav_twin import cli
from uav_twin.cause_search import COMMAND, NICENESS, DiscrepancySearch, with_discrepancy_search

# It writes its arguments, its session and its niceness into the log, and then waits to be ended.
SCRIPT = """
import os, sys, time
print(*sys.argv[1:], os.getsid(0) == os.getpid(), os.nice(0), flush=True)
time.sleep(600)
"""


def request_in(folder: Path, *, low_priority: bool) -> SearchRequest:
    return SearchRequest(
        run_folder=folder / "watch",
        first_step=3,
        last_step=13,
        verdict_folder=folder / "verdict",
        log=folder / "search.log",
        seed=7,
        low_priority=low_priority,
    )


def test_a_search_is_a_process_of_its_own_that_is_ended_with_the_watch(tmp_path):
    script = tmp_path / "search.py"
    script.write_text(SCRIPT)
    request = request_in(tmp_path, low_priority=False)
    search = DiscrepancySearch(command=(sys.executable, str(script))).start(request)
    try:
        wait_until(lambda: request.log.read_text().endswith("\n"))
        assert not search.has_ended()
    finally:
        search.stop()
    assert search.has_ended()
    search.stop()  # of one that has ended does nothing
    options = (
        f"--from-run {tmp_path / 'watch'} --from-step 3 --to-step 13 --out {tmp_path / 'verdict'} --seed 7"
    )
    assert request.log.read_text().split("\n")[0] == f"{options} True {os.nice(0)}"


def test_a_search_beside_a_live_watch_gives_way_to_it(tmp_path):
    script = tmp_path / "search.py"
    script.write_text("import time; time.sleep(600)")
    search = DiscrepancySearch(command=(sys.executable, str(script))).start(
        request_in(tmp_path, low_priority=True)
    )
    try:
        assert os.getpriority(os.PRIO_PROCESS, search._process.pid) == NICENESS
    finally:
        search.stop()


def test_the_search_that_a_watch_gets_is_the_command_that_an_alarm_names():
    assert (sys.executable, "-m", "uav_twin", "discrepancy", "run") == COMMAND


def test_a_watch_gets_the_search_unless_another_one_is_given():
    watch_with_search = with_discrepancy_search(lambda cause_search=None: cause_search)
    assert isinstance(watch_with_search(), DiscrepancySearch)
    assert watch_with_search(cause_search="another") == "another"


def test_the_search_is_given_from_python_and_is_no_option_of_the_command():
    assert "cause_search" in inspect.signature(uav_twin.watch).parameters
    assert "cause_search" not in inspect.signature(cli.watch_with_search()).parameters


def test_to_teach_without_a_search_is_refused_before_a_folder_is_made(tmp_path):
    with pytest.raises(
        MissionInputError, match=r"`teach` needs a `cause_search`, as `uav_twin.watch` has it"
    ):
        workflow.watch("watched_wing", folder=tmp_path / "watch", teach=True)
    assert not (tmp_path / "watch").exists()
