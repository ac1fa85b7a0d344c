"""Logs that grow while they are read, rotated by logrotate and by hand: no row is lost or read twice."""

import logging
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from itertools import takewhile
from logging.handlers import RotatingFileHandler
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from tests.twin_master.runs import belief_in_journal, journal
from tests.twin_master.watch.conftest import ran
from twin_master.errors import MissionInputError
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.message import Message, Refused
from twin_master.watch.folder import Watch

pytestmark = pytest.mark.xdist_group("watches")

HEADER = "step,strain_1,strain_2\n"
LOGROTATE = shutil.which("logrotate")
Rotation = Callable[[Path], None]


def row(step: int) -> str:
    return f"{step},{step + 1}e-5,1e-4\n"


def append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def logrotate(directive: str) -> Rotation:
    """Return what rotates a log by the real logrotate."""

    def rotate(path: Path) -> None:
        assert LOGROTATE is not None
        config, state = path.with_name("logrotate.conf"), path.with_name("logrotate.state")
        config.write_text(f"{path} {{\nrotate 9\nnomail\n{directive}\n}}\n")
        config.chmod(0o644)
        words = [LOGROTATE, "--force", "--state", str(state), str(config)]
        subprocess.run(words, check=True, capture_output=True)

    return rotate


def renamed(path: Path) -> None:
    """Rename a log and begin another one."""
    handler = RotatingFileHandler(path, backupCount=9)
    handler.doRollover()
    handler.close()


def dated(path: Path) -> None:
    """Rename a log by the date, as logrotate does with `dateext`; the next one comes later."""
    days = len(list(path.parent.glob("log.csv-*")))
    path.rename(path.with_name(f"log.csv-{20260501 + days}"))


def moved(path: Path) -> None:
    """Rename a log into another folder."""
    (path.parent / "old").mkdir(exist_ok=True)
    path.rename(path.parent / "old" / "log")


def copied(path: Path) -> None:
    """Copy a log and cut it, as logrotate does with `copytruncate`; its writer has it open."""
    older = sorted(path.parent.glob("log.csv.*"), key=lambda file: -int(file.suffix[1:]))
    for file in older:
        file.rename(path.with_name(f"log.csv.{int(file.suffix[1:]) + 1}"))
    shutil.copy(path, path.with_name("log.csv.1"))
    os.truncate(path, 0)


def stamped(path: Path) -> None:
    """Rename a log by date and seconds, as Telegraf does; the next one comes later."""
    seconds = 1777629600 + len(list(path.parent.glob("log.2*.csv")))
    path.rename(path.with_name(f"log.2026-05-01-{seconds}.csv"))


ROTATIONS: dict[str, Rotation] = {
    "telegraf": stamped,
    "create": logrotate("create"),
    "absent": logrotate("nocreate"),
    "copytruncate": logrotate("copytruncate"),
    "copied": copied,
    "dated": dated,
    "python": renamed,
    "moved": moved,
}
BY_LOGROTATE = "create", "absent", "copytruncate"
CUT = "copytruncate", "copied"


def rotations(*names: str) -> list[Any]:
    """Return ways to rotate a log as parameters of a test; those of logrotate are skipped without it."""
    without = pytest.mark.skipif(LOGROTATE is None, reason="logrotate is not installed")
    return [pytest.param(name, marks=without if name in BY_LOGROTATE else ()) for name in names]


Feeding = Iterator[tuple[Message | Refused | None, str]]
Begun = Callable[..., tuple[Path, Feeding]]


def new(messages: Feeding) -> list[int | str]:
    """Return the steps that have come, and in the place of what was refused its text."""
    came = takewhile(lambda fed: fed[0] is not None, messages)
    return [fed.step if isinstance(fed, Message) and fed.step is not None else text for fed, text in came]


def released_between_looks(feed: CsvFeed, messages: Feeding) -> Feeding:
    """Yield what comes, and close the file whenever nothing more has come."""
    for fed in messages:
        if fed[0] is None:
            feed.release_file()
        yield fed


@pytest.fixture(params=["open", "released"])
def begun_log(base: Watch, tmp_path: Path, request: pytest.FixtureRequest) -> Begun:
    """What begins a log with some steps, and reads them; the file stays open between looks or not."""

    def begin(*steps: int) -> tuple[Path, Feeding]:
        path = tmp_path / "log.csv"
        path.write_text(HEADER + "".join(map(row, steps)))
        feed = CsvFeed(path, base.scenario, follow=True)
        messages = feed.messages(None)
        if request.param == "released":
            if "moved" in request.node.name:
                pytest.skip("a released log is not looked for in other folders")
            messages = released_between_looks(feed, messages)
        assert new(messages) == [*steps]
        return path, messages

    return begin


@pytest.mark.parametrize("header", [HEADER, ""], ids=["header", "no header"])
@pytest.mark.parametrize("rotation", rotations(*ROTATIONS))
def test_no_row_is_lost_in_a_rotation(begun_log, rotation, header):
    rotate, cut = ROTATIONS[rotation], rotation in CUT
    path, messages = begun_log(0, 1)
    append(path, row(2) + row(3)[:4])  # not read before it is rotated
    if cut:
        rotate(path)
        append(path, row(3)[4:] + row(4))  # its writer has it open, and knows nothing of it
    else:
        with path.open("a") as writer:
            rotate(path)
            assert new(messages) == [2]
            writer.write(row(3)[4:])  # until its writer opens the new one
        append(path, header + row(4))
    assert new(messages) == ([2, 3, 4] if cut else [3, 4])
    for step in (5, 7):
        append(path, row(step))
        rotate(path)
        append(path, header + row(step + 1))
        assert new(messages) == [step, step + 1]


@pytest.mark.parametrize("way", ["logging", *rotations("copytruncate")])
def test_a_writer_that_does_not_wait_for_its_reader(begun_log, way):
    (path, messages), steps = begun_log(), 4000
    handler = RotatingFileHandler(path, maxBytes=2000 if way == "logging" else 0, backupCount=1000)

    def write() -> None:
        for step in range(steps):
            if way == "copytruncate" and step % 500 == 250:  # between copy and cut nobody may write
                ROTATIONS[way](path)
            handler.emit(logging.makeLogRecord({"msg": row(step).strip()}))
        handler.close()

    writer = Thread(target=write)
    writer.start()
    found: list[int | str] = []
    while writer.is_alive():
        found += new(messages)
    writer.join()
    assert found + new(messages) == list(range(steps))
    assert len(list(path.parent.glob("log.csv.*"))) >= (30 if way == "logging" else 8)


def test_half_rows_are_waited_for(begun_log):
    path, messages = begun_log()
    for character in row(0)[:-1]:
        append(path, character)
        assert new(messages) == []
    append(path, "\n")
    assert new(messages) == [0]


def test_a_copy_that_begins_with_the_same_rows_is_read_on(begun_log):
    """The copy is made as rsync makes it."""
    path, messages = begun_log()
    append(path, row(0))
    assert new(messages) == [0]
    copy = path.with_name("fresh")
    copy.write_text(path.read_text() + row(1))
    copy.rename(path)
    # A file that is not open is missed in a second look, too, before another one is read
    assert new(messages) + new(messages) == [1]


@pytest.mark.parametrize("begun_log", ["released"], indirect=True)
def test_a_log_that_is_removed_while_it_is_not_open_is_told(begun_log):
    path, messages = begun_log(0)
    size = path.stat().st_size
    moved(path)
    path.write_text(HEADER + row(7))
    assert new(messages) == []
    assert str(next(messages)[0]) == (
        f"the file that was log.csv before was removed when it was read to byte {size}: what "
        "followed and was not read yet is lost"
    )
    assert new(messages) == [7]


def test_columns_of_a_new_file_are_read_again_also_behind_several_rotations(begun_log):
    path, messages = begun_log()
    for step in (2, 3):
        append(path, row(step))
        renamed(path)
    append(path, "strain_2,step\n1e-4,4\n")
    *steps, message = (next(messages)[0] for _ in range(3))
    assert [step.step for step in steps if isinstance(step, Message)] == [2, 3]
    assert isinstance(message, Message)
    assert (message.step, message.observed[1], np.isnan(message.observed[0])) == (4, 1e-4, True)


def test_half_a_row_of_a_dead_writer_ends_with_its_file(begun_log):
    """The next file has no header: its first row must not be taken for the rest of the half row."""
    path, messages = begun_log()
    append(path, row(2))
    renamed(path)
    append(path, "strain_2,step\n1e-4,4\n")
    assert new(messages) == [2, 4]
    append(path, "1e-4,5e")
    assert new(messages) == []
    renamed(path)
    append(path, "2e-4,6\n1e-4,7\n")
    assert new(messages) == ["1e-4,5e", 6, 7]


@pytest.mark.parametrize(
    ("steps", "left"),
    [
        ([0, 1], [*range(2, 9)]),  # longer than before: it is known by its rows
        ([*range(6000)], [*range(5000)]),  # it begins as before: known by its size
    ],
)
def test_a_cut_without_a_copy_is_told(begun_log, steps, left):
    path, messages = begun_log(*steps)
    size = path.stat().st_size
    path.write_text(HEADER + "".join(map(row, left)))
    assert str(next(messages)[0]) == (
        f"log.csv was cut at byte {size}, and no copy is beside it: what followed and was not read "
        "yet is lost"
    )
    assert new(messages) == left


@pytest.mark.parametrize("has_header", [True, False], ids=["header", "no header"])
@pytest.mark.parametrize("rotation", rotations("create", "telegraf", *CUT))
def test_a_watch_that_was_down_takes_up_a_rotated_log(watch, mission, plain, tmp_path, rotation, has_header):
    """Where a log is cut, its writer has it open, and writes no header again."""
    header, *rows = plain.read_text().splitlines(keepends=True)
    path = tmp_path / "log.csv"
    path.write_text(header)
    for step, text in enumerate(rows):
        if step in (15, 30, 33):
            ROTATIONS[rotation](path)
            append(path, header if has_header else "")
        append(path, text)
        if step in (13, 17, 20, 29, 49):  # else it is down
            counts = ran(watch, CsvFeed(path, watch.scenario, follow=True), step + 1 - step % 4)
    assert (counts.received, counts.missing, counts.duplicates, counts.rejected) == (49, 0, 0, 0)
    assert [line["filtered"] for line in journal(watch.folder)] == belief_in_journal(mission.filtered[:49])


@pytest.mark.parametrize("allows_unknown", [False, True])
def test_a_row_in_the_place_of_the_header_is_no_header(base, tmp_path, allows_unknown):
    """Also where names that are not sensors are passed over."""
    scenario = base.scenario.with_changes("watch", allow_unknown=allows_unknown)
    path = tmp_path / "log.csv"
    path.write_text(row(2))
    with pytest.raises(MissionInputError, match=r"begins with `2,3e-5,1e-4`, .* found with --follow"):
        CsvFeed(path, scenario)
    with pytest.raises(MissionInputError, match="no rotated file beside it has that line"):
        CsvFeed(path, scenario, follow=True)
    path.with_name("log.csv.2").write_text(HEADER + row(0))
    path.with_name("log.csv.1").write_text(row(1))
    (message, *_) = new(CsvFeed(path, scenario, follow=True).messages(None))
    assert message == 2


def test_columns_of_which_none_is_known_are_refused_also_where_names_are_passed_over(base, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("strian_1,battery\n1e-4,3.3\n")
    with pytest.raises(MissionInputError, match="`strian_1` and `battery` are not sensors"):
        CsvFeed(path, base.scenario.with_changes("watch", allow_unknown=True))
