"""FMUs that do what they must not: the twin lives on, says so, and leaves nothing behind."""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.client.binding import Binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.worker.client import WorkerInstance
from fmu_asset.worker.protocol import HEADER, Question
from tests.fmu_asset.client.kinds import HOSTILE, SPRING_BINDING, WING_BINDING
from tests.fmu_asset.making import (
    HANGS,
    NEVER_ANSWERED,
    ROOT,
    archive_of,
    changed,
    limit_call_without_answer,
    members,
    run_python,
    tables,
)

MISBEHAVIOURS = tables(__file__, "misbehaviours")
REPLAYED = changed(HOSTILE, header={"state": "replay"})
FREE = changed(HOSTILE, limits={"sandbox": False})
LIMITS_OF_TIME = {"step_timeout": HANGS, "load_timeout": HANGS}
HANGING_CALLS = {"HANG_AT_LOAD": "open", "HANG_IN_INITIALISATION": "initialise"}
"""The call of a start that an FMU never answers."""
Hostile = Callable[..., FmiAsset]


@pytest.fixture
def hostile(foreign_fmu: Any) -> Hostile:
    """Return what makes an asset of an FMU that misbehaves."""
    return lambda *what, binding=HOSTILE, **limits: FmiAsset(
        foreign_fmu("hostile2", *what), binding, **LIMITS_OF_TIME | limits
    )


def cases(table: str) -> pytest.MarkDecorator:
    """Return the parametrisation by a table: what is done, the error, and its sentence."""
    rows = [
        (row["what"], getattr(errors, row["error"]), row["sentence"])
        for row in MISBEHAVIOURS[table]
    ]
    return pytest.mark.parametrize(("what", "kind", "sentence"), rows, ids=[row[0] for row in rows])


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def processes(of: Path) -> list[str]:
    """Return the processes whose working directory or arguments lie in a folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            where = (process / "cwd").readlink()
            what = (process / "cmdline").read_bytes().decode("utf-8", "replace")
        except OSError:
            continue
        if of in where.parents or of == where or str(of) in what:
            found.append(process.name)
    return found


def wait_until(done: Callable[[], Any], limit: float = HANGS) -> None:
    """Wait: who is killed does not die in the same moment."""
    deadline = time.monotonic() + limit
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def await_nothing(scratch: Path, limit: float = HANGS) -> None:
    """Wait until nothing is left behind, neither processes nor files."""
    wait_until(lambda: not processes(scratch) and not list(scratch.iterdir()), limit)


def await_processes(scratch: Path, *counts: int) -> None:
    """A second look may find one that ends just now."""
    wait_until(lambda: len(processes(scratch)) in counts)


# ---------------------------------------------------------------------- start, step, end, state


@pytest.fixture
def leaves_nothing(scratch: Path) -> Iterator[None]:
    """What a test leaves behind: no process, no file, no open descriptor."""
    before = descriptors()
    yield
    await_nothing(scratch)
    assert descriptors() == before


@cases("step")
@pytest.mark.usefixtures("leaves_nothing")
def test_a_step_that_goes_wrong_is_one_sentence(hostile, monkeypatch, what, kind, sentence) -> None:
    """The same instance is never used again; another one goes on from the last state."""
    if kind is errors.FmuTimeoutError:
        limit_call_without_answer(monkeypatch, "step", 3)
    with hostile(what, memory_limit=400.0) as asset:
        assert [asset.step().values[0] for _ in range(2)] == [1.0, 2.0]
        saved = asset.save_state()
        with pytest.raises(kind, match=sentence) as caught:
            asset.step()
        assert str(asset.description.path) in str(caught.value)
        if what != "NOT_A_NUMBER":
            with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
                asset.step()
        asset.restore_state(saved)
        assert (asset.step_index, asset.observe().values[0]) == (2, 2.0)


def test_a_slow_leak_is_noticed_between_short_steps(hostile) -> None:
    asset = hostile("LEAK_SLOWLY", memory_limit=400.0)
    with asset, pytest.raises(errors.FmuMemoryError, match=r"more than the limit of 400 MiB"):
        wait_until(lambda: asset.step() is None)


@cases("start")
def test_a_start_that_goes_wrong_is_one_sentence(
    hostile, scratch, monkeypatch, what, kind, sentence
) -> None:
    if kind is errors.FmuTimeoutError:
        limit_call_without_answer(monkeypatch, HANGING_CALLS[what], since="open")
    asset = hostile(what)
    for _ in range(2):
        with pytest.raises(kind, match=sentence):
            asset.reset()
        await_nothing(scratch)


@pytest.mark.parametrize("what", MISBEHAVIOURS["end"], ids=lambda what: what[-1])
def test_what_goes_wrong_at_the_end_leaves_nothing(hostile, scratch, what) -> None:
    """Nor a process that leaves the group."""
    with hostile(*what) as asset:
        assert [asset.step().values[0] for _ in range(4)] == [1.0, 2.0, 3.0, 4.0]
        if "START_PROCESS_ELSEWHERE" in what:
            assert (
                len(processes(scratch)) == 3
            )  # the supervisor, the worker, and what the FMU has started
    await_nothing(scratch)


@cases("state")
def test_a_state_that_lies_is_found_and_can_be_replayed(hostile, what, kind, sentence) -> None:
    with hostile(what) as asset:
        asset.step(), asset.step()
        with pytest.raises(kind, match=sentence):  # noqa: PT012 - either of the two may tell
            saved = asset.save_state()
            asset.step()
            asset.restore_state(saved)
    with hostile(what, binding=REPLAYED) as asset:
        asset.step(), asset.step({"u": 3.0})
        saved = asset.save_state()
        asset.step()
        asset.restore_state(saved)
        assert asset.observe().values[0] == 4.0


def test_what_cannot_be_replayed_says_so(hostile) -> None:
    with hostile("NOT_DETERMINISTIC", binding=REPLAYED) as asset:
        asset.step()
        saved = asset.save_state()
        asset.close()
        with pytest.raises(
            errors.FmuStateError, match="does not give equal outputs for equal inputs"
        ):
            asset.restore_state(saved)


def test_two_processes_that_return_from_one_step(hostile, scratch) -> None:
    pushes = np.arange(1.0, 11.0)
    with hostile("FORK_AND_RETURN") as asset:
        assert asset.simulate({"u": pushes}).values[:, 0].tolist() == np.cumsum(pushes).tolist()
        asset.reset()
        seen = [asset.step({"u": push}).values[0] for push in pushes if not time.sleep(0.01)]
        assert seen == np.cumsum(pushes).tolist()
    await_nothing(scratch)


def test_an_answer_to_another_request_is_not_taken(hostile) -> None:
    """A reply that is whole but bears another number, as one that comes late."""
    with hostile() as asset:
        asset.step()
        instance = asset._running.host.instance
        assert isinstance(instance, WorkerInstance)
        question = instance._pickled("read")
        os.write(instance._outgoing, HEADER.pack(Question.CALL, 0, 77, len(question)) + question)
        with pytest.raises(errors.FmuWorkerError, match="wrote something else into it"):
            asset.step()


# ---------------------------------------------------------------------- who is killed


@contextmanager
def twin(fmu: Path, binding: Binding, *lines: str) -> Iterator[subprocess.Popen[bytes]]:
    """A twin in another process that runs these lines with its asset, and is killed in the end."""
    program = (
        "import json, sys\n"
        "from fmu_asset.client.binding import parse_binding\n"
        "from fmu_asset.client.session import FmiAsset\n"
        "asset = FmiAsset(sys.argv[1], parse_binding(json.loads(sys.argv[2])))\n"
    )
    told = json.dumps(binding.model_dump(exclude_none=True, mode="json"))
    command = [sys.executable, "-c", program + "\n".join(lines), fmu, told]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def state_and_supervisor(worker: int | None) -> tuple[str, int]:
    _, _, state, parent, *_ = Path(f"/proc/{worker}/stat").read_text(encoding="utf-8").split()
    return state, int(parent)


def kill_supervisor(worker: int | None) -> None:
    os.kill(state_and_supervisor(worker)[1], signal.SIGKILL)


@pytest.mark.parametrize("end", ["(void)0", "hang()", "kill(getppid(),SIGKILL)"])
def test_nothing_is_left_when_the_supervisor_is_killed(hostile, scratch, monkeypatch, end) -> None:
    """The worker has cleared its parent-death signal; what it has started has its own session."""
    if end == "hang()":
        limit_call_without_answer(monkeypatch, "step", 3)
    with hostile(f"ESCAPE={end}", binding=FREE) as asset:
        asset.step(), asset.step()
        if end == "hang()":
            threading.Timer(0.3, kill_supervisor, [asset.worker_process_id]).start()
            with pytest.raises(errors.FmuTimeoutError, match=r"longer than 2 s"):
                asset.step()
        else:
            asset.step()
            if end == "(void)0":
                kill_supervisor(asset.worker_process_id)
            assert asset.step().values[0] == 4.0
            await_processes(scratch, 1, 2)  # the worker, and mostly the process that has left it
    await_nothing(scratch)


ASKED = "asset.step(), asset.step()", "print(asset.worker_process_id, flush=True)"


def test_nothing_is_left_when_twin_and_worker_end_before_the_supervisor_looks(
    foreign_fmu, scratch
) -> None:
    with twin(foreign_fmu("hostile2"), HOSTILE, *ASKED, "sys.stdin.read()") as process:
        worker = int(process.stdout.readline())
        _, supervisor = state_and_supervisor(worker)
        os.kill(supervisor, signal.SIGSTOP)
    wait_until(lambda: state_and_supervisor(worker)[0] == "Z")
    os.kill(supervisor, signal.SIGCONT)
    await_nothing(scratch)


def test_what_a_dead_twin_without_a_supervisor_left_is_removed_by_the_next(
    foreign_fmu, scratch
) -> None:
    with twin(foreign_fmu("hostile2", "ESCAPE=hang()"), HOSTILE, *ASKED, "asset.step()") as process:
        worker = int(process.stdout.readline())
        await_processes(scratch, 3)
        os.kill(process.pid, signal.SIGSTOP)
        kill_supervisor(worker)
    await_processes(scratch, 2)
    (scratch / "somebody-else").mkdir()
    run_python(
        "from fmu_asset.folders import plain_folder, remove_folder; remove_folder(plain_folder())"
    )
    wait_until(lambda: not processes(scratch))
    assert [path.name for path in scratch.iterdir()] == ["somebody-else"]


@pytest.mark.parametrize("what", ["HANG", "START_PROCESS", "ATTEMPT=(hold_pipes(),hang(),0)"])
def test_nothing_is_left_when_the_twin_is_killed_during_a_step(foreign_fmu, scratch, what) -> None:
    lines = *ASKED, "asset.step()", "print('fourth', flush=True)", "sys.stdin.read()"
    with twin(foreign_fmu("hostile2", what), HOSTILE, *lines) as process:
        assert int(process.stdout.readline())
        if what == "START_PROCESS":
            assert process.stdout.readline() == b"fourth\n"
            assert len(processes(scratch)) == 3  # with the supervisor
    await_nothing(scratch)


# ---------------------------------------------------------------------- an FMU in Python


@pytest.mark.parametrize(("misbehaviour", "kind", "sentence"), MISBEHAVIOURS["spoilt"])
def test_an_fmu_in_python_that_spoils_what_we_share(
    spring_mass, misbehaviour, kind, sentence
) -> None:
    with FmiAsset(spring_mass, SPRING_BINDING) as asset:
        with pytest.raises(getattr(errors, kind), match=sentence) as caught:
            asset.step(load={"misbehaviour": misbehaviour})
        told = [str(caught.value), *(text for _, text in asset.log)]
        assert not [text for text in told if re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", text)]
        asset.reset()
        assert asset.step({"push": 1.0}).extra == {"steps": 1.0}


@pytest.mark.parametrize("misbehaviour", [8, 9], ids=["loop", "hold"])
def test_an_fmu_in_python_that_loops(spring_mass, scratch, misbehaviour) -> None:
    """It holds the interpreter of the worker, which neither the limit nor a dead twin needs."""
    load = {"misbehaviour": misbehaviour}
    limits = {"step_timeout": NEVER_ANSWERED, "load_timeout": HANGS}
    asset = FmiAsset(spring_mass, SPRING_BINDING, **limits)
    with asset, pytest.raises(errors.FmuTimeoutError, match=r"longer than 2 s for the step"):
        asset.step(load=load)
    lines = "asset.step()", "print('loops', flush=True)", f"asset.step(load={load})"
    with twin(spring_mass, SPRING_BINDING, *lines) as process:
        assert process.stdout.readline() == b"loops\n"
    await_nothing(scratch)


# ---------------------------------------------------------------------- a process of its own

PUSHED = {"push": 1.0}


def test_an_interruption_leaves_no_stale_answer(spring_mass, monkeypatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with FmiAsset(spring_mass, SPRING_BINDING) as asset:
        expected = asset.step(PUSHED).values
        with monkeypatch.context() as patch:
            patch.setattr("fmu_asset.worker.client.WorkerInstance._wait_for_answer", interrupt)
            with pytest.raises(KeyboardInterrupt):
                asset.step({"push": 2.0})
        with pytest.raises(errors.FmuWorkerError, match="interrupted; reset the asset"):
            asset.step()
        asset.reset()
        np.testing.assert_array_equal(asset.step(PUSHED).values, expected)


def test_what_an_fmu_does_to_its_process_stays_there(spring_mass, capfd) -> None:
    """Neither its chatter nor its working directory are the twin's."""
    here = Path.cwd()
    with FmiAsset(spring_mass, SPRING_BINDING) as asset:
        for behaviour in (7.0, 6.0, 0.0):  # it talks, goes elsewhere, is fine
            asset.step(load={"misbehaviour": behaviour})
        assert asset.log[0] == ("OK", "the spring creaks")
    assert capfd.readouterr().out == ""
    assert Path.cwd() == here


def test_a_temporary_folder_with_odd_characters(fmu, tmp_path, isolated, monkeypatch) -> None:
    odd = tmp_path / "Flügel é # % + 翼 'x' \"y\" $z"
    odd.mkdir()
    file = archive_of(odd / "wing é.fmu", members(fmu) | {"resources/Größe ß.txt": b"x"})
    monkeypatch.setattr(tempfile, "tempdir", str(odd))
    with FmiAsset(file, WING_BINDING, isolated=isolated) as asset:
        assert np.all(asset.step({"load_factor": 3.0}).values > 0.0)
