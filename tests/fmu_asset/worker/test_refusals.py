"""What the sandbox refuses an FMU is counted, by kind, and the first of each is named."""

import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from fmu_asset.checks.fmu_check import FmuCheck, check_fmu
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuError
from fmu_asset.worker.refusal_tracer import RefusalTracer
from fmu_asset.worker.refusals import RefusalReport, watch_for_refusals
from fmu_asset.worker.sandbox import landlock_version
from tests.fmu_asset.client.kinds import HOSTILE, SPRING_BINDING
from tests.fmu_asset.making import changed, limit_call_without_answer
from tests.fmu_asset.worker.test_hostile import ASKED, await_nothing, twin

pytestmark = pytest.mark.skipif(
    landlock_version() < 6, reason="the kernel is older than Linux 6.12"
)

Told = Callable[..., str]


def fly(asset: FmiAsset, steps: int = 4) -> None:
    """Fly until an error or the last step."""
    with asset, suppress(FmuError):
        for _ in range(steps):
            asset.step()


@pytest.fixture
def told(foreign_fmu: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Told:
    """Return what is said of an FMU that makes an attempt upon a file or another target."""

    def attempt(what: str, target: object = "", **limits: Any) -> str:
        monkeypatch.setenv("HOSTILE_TARGET", str(target or tmp_path / "key"))
        (tmp_path / "key").write_text("the private key")
        with watch_for_refusals() as report:
            fly(
                FmiAsset(
                    foreign_fmu("hostile2", f"ATTEMPT={what}"), changed(HOSTILE, limits=limits)
                )
            )
            return report.sentence()

    return attempt


@pytest.mark.parametrize(
    ("what", "call"),
    [
        ("look_into(TARGET)", "openat"),
        ("BY_CHILD(unlink(TARGET))", "unlink"),
        ('rename(TARGET,"mine")', "rename"),
        ('link(TARGET,"mine")', "link"),
        ("overwrite(TARGET)", "openat"),
    ],
)
def test_a_file_that_is_refused_is_named_also_in_a_child(told, tmp_path, what, call) -> None:
    expected = f"The sandbox refused 1 file or folder ({tmp_path / 'key'} by {call})."
    assert told(what) == expected or os.uname().machine != "x86_64"
    assert str(tmp_path / "key") in told(what)


def test_refusals_are_counted_and_the_first_is_named(told, tmp_path) -> None:
    twice = "(create(TARGET),mkdir(TARGET,0700))"
    said = told(twice, tmp_path / "made")
    assert said == f"The sandbox refused 2 files or folders (first {tmp_path / 'made'} by openat)."


def test_a_relative_path_is_said_from_the_folder_in_which_it_is_looked_for(told, tmp_path) -> None:
    expected = f"({tmp_path / 'made'} by openat)"
    assert expected in told('(chdir(TARGET),create("made"))', tmp_path)
    assert expected in told('openat(open(TARGET,O_PATH),"made",O_WRONLY|O_CREAT,0600)', tmp_path)


def test_a_socket_is_named_by_its_family(told) -> None:
    assert told("call(SOCK_STREAM,0,TARGET)", 9) == (
        "The sandbox refused 1 socket or connection (IPv4 by socket)."
    )


def test_a_connection_beside_the_granted_port_is_named_by_its_address(told) -> None:
    said = told("call(SOCK_STREAM,0,TARGET)", 9, ports=[10])
    assert said == "The sandbox refused 1 socket or connection (127.0.0.1:9 by connect)."


def test_a_program_and_a_signal_to_another_process_are_named(told, tmp_path) -> None:
    program = told("start_program(TARGET)", tmp_path / "made")
    assert program == "The sandbox refused 1 program or other process (/usr/bin/touch by execve)."
    assert f"(process {os.getpid()} by kill)" in told("kill(atoi(TARGET),0)", os.getpid())


def test_kinds_are_counted_apart(told) -> None:
    said = told("(look_into(TARGET),call_service(TARGET),shmget(IPC_PRIVATE,4096,0600))")
    assert "1 file or folder (" in said
    assert "1 socket or connection (Unix by socket)" in said
    assert "1 other system call (system call " in said


def test_nothing_is_refused_to_an_fmu_that_starts_a_child_in_its_own_folder(told) -> None:
    assert told('BY_CHILD(create("notes.txt"))') == "The sandbox refused nothing."


def test_what_was_granted_is_not_counted(told, tmp_path) -> None:
    assert told("look_into(TARGET)", read=[str(tmp_path)]) == "The sandbox refused nothing."


def test_the_flight_of_a_watched_fmu_in_python_is_the_same_and_no_file_is_refused(
    spring_mass,
) -> None:
    def outputs() -> list[float]:
        with FmiAsset(spring_mass, SPRING_BINDING) as asset:
            return [float(asset.step().values[0]) for _ in range(3)]

    plain = outputs()
    with watch_for_refusals() as report:
        assert outputs() == plain
        assert set(report.counts) <= {"sockets"}  # which Python or its libraries try on their own


@pytest.mark.parametrize(
    "case",
    [
        ["SEGFAULT"],
        ["HANG"],
        ["KILL"],
        ["EXIT"],
        ["HOP"],
        ["START_PROCESS_ELSEWHERE", "GROUP=setsid()"],
    ],
    ids=lambda case: case[0],
)
def test_a_watched_worker_ends_with_all_that_it_has_started(
    foreign_fmu, scratch, monkeypatch, case
) -> None:
    if case == ["HANG"]:
        limit_call_without_answer(monkeypatch, "step", 3)
    with watch_for_refusals() as report:
        fly(FmiAsset(foreign_fmu("hostile2", *case), HOSTILE))
        await_nothing(scratch)
        assert report.sentence() == "The sandbox refused nothing."


def test_a_watched_worker_that_makes_calls_without_end_ends_with_its_twin(
    foreign_fmu, scratch
) -> None:
    endless = foreign_fmu("hostile2", "ATTEMPT=({for(;;)getppid();0;})")
    lines = (
        "from fmu_asset.worker.refusals import watch_for_refusals",
        "watch = watch_for_refusals()",
    )
    watched = *lines, "watch.__enter__()", *ASKED, "asset.step()"
    with twin(endless, HOSTILE, *watched) as process:
        assert int(process.stdout.readline())
    await_nothing(scratch, 30.0)


def sandbox_finding(check: FmuCheck) -> tuple[str, str]:
    (finding,) = (finding for finding in check.findings if finding.check == "sandbox")
    return finding.verdict, finding.text


def test_the_check_of_an_fmu_says_what_was_refused_and_does_not_call_it_a_problem(
    foreign_fmu, monkeypatch, tmp_path
) -> None:
    """An FMU that does without what it was refused."""
    monkeypatch.setenv("HOSTILE_TARGET", str(tmp_path / "made"))
    check = check_fmu(foreign_fmu("hostile2", "ATTEMPT=(create(TARGET),0)"))
    assert check.passed, check.problems
    assert sandbox_finding(check) == (
        "warning",
        f"The sandbox refused 1 file or folder ({tmp_path / 'made'} by openat).",
    )


def test_without_a_sandbox_the_check_counts_nothing(foreign_fmu) -> None:
    check = check_fmu(foreign_fmu("hostile2"), changed(HOSTILE, limits={"sandbox": False}))
    assert sandbox_finding(check) == (
        "skipped",
        "There is no sandbox: the binding turns it off, or the kernel has none.",
    )


def test_where_the_system_forbids_tracing_the_report_says_so() -> None:
    """As it forbids a process to trace itself."""
    with tempfile.TemporaryFile() as file:
        RefusalTracer(file.fileno()).begin(os.getpid())
        report = RefusalReport(file)
        assert report.verdict() == "skipped"
        assert report.sentence() == (
            "What the sandbox refuses could not be counted on this machine "
            "(Operation not permitted)."
        )
