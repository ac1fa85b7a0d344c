"""FMUs that do what they must not: the twin lives on, says what happened, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.draft import draft_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import (
    FmuCallError,
    FmuError,
    FmuFileError,
    FmuMemoryError,
    FmuOutputError,
    FmuStateError,
    FmuTimeoutError,
    FmuWorkerError,
)
from fmu_asset.worker.client import WorkerInstance
from fmu_asset.worker.protocol import CALL, HEADER

ROOT = Path(__file__).parents[2]
HOSTILE: dict[str, Any] = {
    "binding": {"name": "hostile", "step_size": 1.0},
    "control": {"u": {"variable": "u", "unit": "m/s"}},
    "observation": {"y": {"variables": "y", "unit": "m"}},
}
LIMITS = {"step_timeout": 30.0, "load_timeout": 30.0, "memory_limit": 400.0}


@pytest.fixture
def described() -> Binding:
    return parse_binding(HOSTILE)


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


def left_behind(scratch: Path, limit: float = 20.0) -> list[str]:
    """Return what is still there after a while: who is killed does not die in the same moment."""
    deadline = time.monotonic() + limit
    while True:
        left = [*processes(scratch), *(path.name for path in scratch.iterdir())]
        if not left or time.monotonic() >= deadline:
            return left
        time.sleep(0.02)


IN_THE_THIRD_STEP = [
    ("SEGFAULT", FmuWorkerError, r"signal 11 \(SIGSEGV\): the FMU's code touched memory that is not its own"),
    ("ABORT", FmuWorkerError, r"signal 6 \(SIGABRT\): the FMU's code gave up with abort\(\)"),
    ("DIVIDE", FmuWorkerError, r"signal 8 \(SIGFPE\): the FMU's code divided an integer by zero"),
    ("KILL", FmuWorkerError, r"signal 9 \(SIGKILL\): somebody killed it, or the system ran out of memory"),
    ("EXIT", FmuWorkerError, r"exit status 3: the FMU's code ended its own process"),
    ("HANG", FmuTimeoutError, r"longer than 0\.5 s for the step.*more `step_time` in .*otherwise it hangs"),
    ("IGNORE_SIGNALS", FmuTimeoutError, r"longer than 0\.5 s for the step"),
    ("HALF_AN_ANSWER", FmuTimeoutError, r"longer than 0\.5 s for the step"),
    ("LEAK_IN_STEP", FmuMemoryError, r"MiB of memory during the step, more than the limit of 400 MiB.*leaks"),
    ("FILL_DISK", FmuWorkerError, r"SIGXFSZ\): the FMU wrote more than 2 GiB to one file"),
    ("NOT_A_NUMBER", FmuOutputError, r"values that are not finite at t = 3 s: y\."),
    ("FAIL", FmuCallError, r"(?s)returned Error.*no longer to be trusted.*does not converge"),
    ("FATALLY", FmuCallError, r"(?s)returned Fatal.*the instance is lost.*out of memory"),
    ("ASYNCHRONOUS", FmuCallError, r"returned Pending.*asynchronous steps are not supported"),
    ("NEGATIVE_STATUS", FmuCallError, r"fmi2DoStep returned -1.*the instance is lost"),
    ("ODD_STATUS", FmuCallError, r"returned 42.*the instance is lost"),
    ("CLOSE_FILES", FmuWorkerError, r"could not answer: the FMU's code closed files"),
    ("WRITE_INTO_PIPES", FmuWorkerError, r"closed its pipe, or wrote something else into it"),
]


@pytest.mark.parametrize(
    ("what", "kind", "sentence"), IN_THE_THIRD_STEP, ids=[c[0] for c in IN_THE_THIRD_STEP]
)
def test_a_step_that_goes_wrong_is_one_sentence(
    foreign_fmu: Any, described: Binding, scratch: Path, what: str, kind: type[FmuError], sentence: str
) -> None:
    fmu = foreign_fmu("hostile2", what)
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    limits = LIMITS | ({"step_timeout": 0.5} if kind is FmuTimeoutError else {})
    with FmiAsset(fmu, described, **limits) as asset:
        assert [asset.step().values[0] for _ in range(2)] == [1.0, 2.0]
        saved = asset.save_state()
        with pytest.raises(kind, match=sentence) as caught:
            asset.step()
        assert str(fmu) in str(caught.value)
        if what != "NOT_A_NUMBER":
            with pytest.raises(FmuWorkerError, match="reset the asset"):
                asset.step()
        # The same instance is never used again; another one goes on from the last state.
        asset.restore_state(saved)
        assert (asset.step_index, asset.observe().values[0]) == (2, 2.0)
    assert not left_behind(scratch)
    assert len(list(Path("/proc/self/fd").iterdir())) == descriptors


def test_a_refused_step_can_be_made_otherwise(foreign_fmu: Any, described: Binding) -> None:
    with FmiAsset(foreign_fmu("hostile2", "REFUSE"), described, **LIMITS) as asset:
        asset.step(), asset.step()
        with pytest.raises(FmuCallError, match=r"(?s)step 2 from t = 2 s.*returned Discard.*u is too large"):
            asset.step({"u": 6.0})
        assert asset.step({"u": 5.0}).values[0] == 7.0


def test_a_slow_leak_is_noticed_between_short_steps(foreign_fmu: Any, described: Binding) -> None:
    def fly(asset: FmiAsset) -> None:
        for _ in range(100):
            asset.step()
            time.sleep(0.02)

    with (
        FmiAsset(foreign_fmu("hostile2", "LEAK_SLOWLY"), described, **LIMITS) as asset,
        pytest.raises(FmuMemoryError, match=r"more than the limit of 400 MiB"),
    ):
        fly(asset)


AT_THE_START = [
    ("CRASH_AT_LOAD", FmuWorkerError, r"During loading and instantiation .*SIGSEGV"),
    ("EXIT_AT_LOAD", FmuWorkerError, r"During loading and instantiation .*exit status 4"),
    ("HANG_AT_LOAD", FmuTimeoutError, r"longer than 2 s for loading and instantiation.*more `load_time`"),
    (
        "MISSING_LIBRARY_FUNCTION",
        FmuCallError,
        r"cannot be loaded on this machine \(undefined symbol: function",
    ),
    ("NO_INSTANCE", FmuCallError, r"(?s)could not be instantiated.*no licence"),
    ("HANG_IN_INITIALISATION", FmuTimeoutError, r"longer than 2 s for initialisation"),
    (
        "NEGATIVE_STATUS_AT_THE_START",
        FmuCallError,
        r"fmi2EnterInitializationMode returned -1 in initialisation",
    ),
    ("REFUSE_INITIALISATION", FmuCallError, r"(?s)returned Error in initialisation.*table file is missing"),
]


@pytest.mark.parametrize(("what", "kind", "sentence"), AT_THE_START, ids=[case[0] for case in AT_THE_START])
def test_a_start_that_goes_wrong_is_one_sentence(
    foreign_fmu: Any, described: Binding, scratch: Path, what: str, kind: type[FmuError], sentence: str
) -> None:
    limit = 2.0 if kind is FmuTimeoutError else 30.0
    asset = FmiAsset(foreign_fmu("hostile2", what), described, load_timeout=limit)
    for _ in range(2):
        with pytest.raises(kind, match=sentence):
            asset.reset()
        assert not left_behind(scratch)


@pytest.mark.parametrize(
    "what", ["CRASH_IN_FREE", "HANG_IN_FREE", "START_PROCESS", "CHATTER", "NEST_FOLDERS", "HOP"]
)
def test_what_goes_wrong_at_the_end_leaves_nothing(
    foreign_fmu: Any, described: Binding, scratch: Path, what: str
) -> None:
    with FmiAsset(foreign_fmu("hostile2", what), described) as asset:
        assert [asset.step().values[0] for _ in range(4)] == [1.0, 2.0, 3.0, 4.0]
    assert not left_behind(scratch)


def test_an_fmu_that_removes_its_files_is_extracted_again(
    foreign_fmu: Any, described: Binding, scratch: Path
) -> None:
    limits = described.limits.model_copy(update={"programs": True})  # it removes them by a program
    free = described.model_copy(update={"limits": limits})
    with FmiAsset(foreign_fmu("hostile2", "REMOVE_FILES"), free) as asset:
        for _ in range(4):
            asset.step()
        asset.close()
        asset.reset()
        assert asset.step().values[0] == 1.0
    assert not list(scratch.iterdir())


STATES = [
    (
        "STATE_ERROR",
        FmuCallError,
        r"(?s)fmi2GetFMUstate returned Error in saving the state.*`state = \"replay\"`.*not implemented",
    ),
    ("STATE_CRASH", FmuWorkerError, r"During restoring the state .*SIGSEGV"),
    (
        "STATE_NOT_RESTORED",
        FmuStateError,
        r'gives y = 3\.0 instead of 2\.0: it declares canGetAndSetFMUstate but does not .*`state = "replay"`',
    ),
]


@pytest.mark.parametrize(("what", "kind", "sentence"), STATES, ids=[case[0] for case in STATES])
def test_a_state_that_lies_is_found_and_can_be_replayed(
    foreign_fmu: Any, described: Binding, what: str, kind: type[FmuError], sentence: str
) -> None:
    fmu = foreign_fmu("hostile2", what)
    with FmiAsset(fmu, described) as asset:
        asset.step(), asset.step()
        with pytest.raises(kind, match=sentence):  # noqa: PT012 - either of the two may tell
            saved = asset.save_state()
            asset.step()
            asset.restore_state(saved)
    header = {**HOSTILE["binding"], "state": "replay"}
    with FmiAsset(fmu, parse_binding({**HOSTILE, "binding": header})) as asset:
        asset.step(), asset.step({"u": 3.0})
        saved = asset.save_state()
        asset.step()
        asset.restore_state(saved)
        assert asset.observe().values[0] == 4.0


def test_what_cannot_be_replayed_says_so(foreign_fmu: Any) -> None:
    header = {**HOSTILE["binding"], "state": "replay"}
    with FmiAsset(
        foreign_fmu("hostile2", "NOT_DETERMINISTIC"), parse_binding({**HOSTILE, "binding": header})
    ) as asset:
        asset.step()
        saved = asset.save_state()
        asset.close()
        with pytest.raises(FmuStateError, match="does not give equal outputs for equal inputs"):
            asset.restore_state(saved)


ELSEWHERE = [("START_PROCESS_ELSEWHERE", "GROUP=setpgid(0,0)"), ("START_PROCESS_ELSEWHERE", "GROUP=setsid()")]


@pytest.mark.parametrize("what", ELSEWHERE, ids=["group", "session"])
def test_a_process_that_leaves_the_group_is_ended(
    foreign_fmu: Any, described: Binding, scratch: Path, what: tuple[str, str]
) -> None:
    with FmiAsset(foreign_fmu("hostile2", *what), described) as asset:
        for _ in range(4):
            asset.step()
        assert len(processes(scratch)) == 3  # the keeper, the worker, and what the FMU has started
    assert not left_behind(scratch)


@pytest.mark.parametrize("end", ["(void)0", "hang()", "kill(getppid(),SIGKILL)"])
def test_nothing_is_left_when_the_keeper_is_killed(
    foreign_fmu: Any, described: Binding, scratch: Path, end: str
) -> None:
    """The worker has cleared its parent-death signal, and what it has started is in a session of its own."""
    free = described.model_copy(update={"limits": described.limits.model_copy(update={"sandbox": False})})
    with FmiAsset(foreign_fmu("hostile2", f"ESCAPE={end}"), free, step_timeout=1.0) as asset:
        asset.step(), asset.step()
        if end == "hang()":
            threading.Timer(0.3, kill_keeper, [asset.worker_process_id]).start()
            with pytest.raises(FmuTimeoutError, match=r"longer than 1 s"):
                asset.step()
        else:
            asset.step()
            if end == "(void)0":
                kill_keeper(asset.worker_process_id)
            assert asset.step().values[0] == 4.0
            await_processes(scratch, 1, 2)  # the worker, and mostly the process that has left it
    assert not left_behind(scratch)


@contextmanager
def twin(fmu: Path, binding: dict[str, Any], *lines: str) -> Iterator[subprocess.Popen[bytes]]:
    """A twin in another process that carries out these lines with its asset, and is killed in the end."""
    program = (
        "import json, sys\n"
        "from fmu_asset.door.binding import parse_binding\n"
        "from fmu_asset.door.session import FmiAsset\n"
        "asset = FmiAsset(sys.argv[1], parse_binding(json.loads(sys.argv[2])))\n"
    )
    command = [sys.executable, "-c", program + "\n".join(lines), fmu, json.dumps(binding)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def await_processes(of: Path, *counts: int) -> None:
    deadline = time.monotonic() + 20.0
    while (found := len(processes(of))) not in counts:  # a second look may find one that ends just now
        assert time.monotonic() < deadline, found
        time.sleep(0.01)


def keeper_of(worker: int | None) -> int:
    match = re.search(r"PPid:\s+(\d+)", Path(f"/proc/{worker}/status").read_text())
    assert match is not None
    return int(match[1])


def kill_keeper(worker: int | None) -> None:
    os.kill(keeper_of(worker), signal.SIGKILL)


def test_nothing_is_left_when_twin_and_worker_end_before_the_keeper_looks(
    foreign_fmu: Any, scratch: Path
) -> None:
    lines = "asset.step()", "print(asset.worker_process_id, flush=True)", "sys.stdin.read()"
    with twin(foreign_fmu("hostile2"), HOSTILE, *lines) as process:
        worker = int(process.stdout.readline())
        keeper = keeper_of(worker)
        os.kill(keeper, signal.SIGSTOP)
    deadline = time.monotonic() + 20.0
    while "\nState:\tZ" not in Path(f"/proc/{worker}/status").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(keeper, signal.SIGCONT)
    assert not left_behind(scratch)


def test_what_a_dead_twin_without_a_keeper_left_is_ended_by_the_next(foreign_fmu: Any, scratch: Path) -> None:
    lines = "asset.step(), asset.step()", "print(asset.worker_process_id, flush=True)", "asset.step()"
    with twin(foreign_fmu("hostile2", "ESCAPE=hang()"), HOSTILE, *lines) as process:
        worker = int(process.stdout.readline())
        await_processes(scratch, 3)
        os.kill(process.pid, signal.SIGSTOP)
        kill_keeper(worker)
    await_processes(scratch, 2)
    program = "from fmu_asset.folders import plain_folder, remove_folder; remove_folder(plain_folder())"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
    assert not left_behind(scratch)


@pytest.mark.parametrize("in_one_go", [False, True], ids=["steps", "run"])
def test_two_processes_that_return_from_one_step(
    foreign_fmu: Any, described: Binding, scratch: Path, in_one_go: bool
) -> None:
    with FmiAsset(foreign_fmu("hostile2", "FORK_AND_RETURN"), described) as asset:
        pushes = [float(k) for k in range(1, 11)]
        if in_one_go:
            seen = asset.simulate({"u": pushes}).values[:, 0].tolist()
        else:
            seen = []
            for push in pushes:
                seen.append(asset.step({"u": push}).values[0])
                time.sleep(0.01)
        assert seen == [sum(pushes[: k + 1]) for k in range(10)]
    assert not left_behind(scratch)


def test_an_answer_to_another_request_is_not_taken(foreign_fmu: Any, described: Binding) -> None:
    """A reply that is whole but bears another number, as one that comes late."""
    with FmiAsset(foreign_fmu("hostile2"), described) as asset:
        asset.step()
        instance = asset._housing.instance
        assert isinstance(instance, WorkerInstance)
        question = instance._pickled("read")
        os.write(instance._out, HEADER.pack(CALL, 0, 77, len(question)) + question)
        with pytest.raises(FmuWorkerError, match="wrote something else into it"):
            asset.step()


@pytest.mark.parametrize("what", ["HANG", "START_PROCESS", "ATTEMPT=(hold_pipes(),hang(),0)"])
def test_nothing_is_left_when_the_twin_is_killed_during_a_step(
    foreign_fmu: Any, scratch: Path, what: str
) -> None:
    begin = "asset.step(), asset.step()", "print('third', flush=True)", "asset.step()"
    lines = *begin, "print('fourth', flush=True)", "sys.stdin.read()"
    with twin(foreign_fmu("hostile2", what), HOSTILE, *lines) as process:
        assert process.stdout.readline() == b"third\n"
        if what == "START_PROCESS":
            assert process.stdout.readline() == b"fourth\n"
            assert len(processes(scratch)) == 3  # with the keeper
    assert not left_behind(scratch, 30.0)


def test_what_a_dead_twin_left_is_removed_by_the_next(
    foreign_fmu: Any, described: Binding, scratch: Path
) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    with FmiAsset(foreign_fmu("hostile2"), described) as asset:
        own = next(scratch.iterdir()).name
        asset.step()
    (scratch / own.replace(f"-{os.getpid()}-", f"-{dead.pid}-")).mkdir()
    (scratch / "somebody-else").mkdir()
    program = "import sys\nfrom fmu_asset.folders import plain_folder\nprint(plain_folder())\n"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True
    )
    left = {Path(done.stdout.strip()).parent.name, "somebody-else"}
    assert {path.name for path in scratch.iterdir()} == left


# ---------------------------------------------------------------------- the file


def packed(path: Path, entries: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


@pytest.fixture
def parts(foreign_fmu: Any) -> dict[str, bytes]:
    with zipfile.ZipFile(foreign_fmu("hostile2")) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def in_utf_16(text: str) -> bytes:
    return text.replace('encoding="UTF-8"', 'encoding="UTF-16"').encode("utf-16")


def with_entities(text: str) -> str:
    entities = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'
    return text.replace("?>", f"?>{entities}", 1)


def leading_elsewhere(text: str) -> bytes:
    return text.replace('"hostile2"', '"../../../../tmp/x"').encode()


DESCRIPTION = "modelDescription.xml"
UNSAFE = [
    ("resources/zeros", bytes(300 * 1024**2), r"would extract to 300 MiB, which looks like an archive made"),
    (f"{3000 * 'd/'}x", b"", r"an entry 3001 folders deep; no tool exports that .*refused"),
    (DESCRIPTION, lambda text: with_entities(text).encode(), "defines a document type or entities"),
    (DESCRIPTION, lambda text: in_utf_16(with_entities(text)), "defines a document type or entities"),
    (DESCRIPTION, leading_elsewhere, "is no name of a C function"),
]


@pytest.mark.parametrize(
    ("entry", "content", "sentence"),
    UNSAFE,
    ids=["disk", "nested folders", "memory", "encoding", "elsewhere"],
)
def test_an_archive_that_is_not_safe_to_read(
    parts: dict[str, bytes], tmp_path: Path, entry: str, content: Any, sentence: str
) -> None:
    written = content(parts[DESCRIPTION].decode()) if callable(content) else content
    with pytest.raises(FmuFileError, match=sentence):
        read_fmu(packed(tmp_path / "unsafe.fmu", {**parts, entry: written}))


def test_a_description_in_another_encoding(parts: dict[str, bytes], tmp_path: Path) -> None:
    text = in_utf_16(parts["modelDescription.xml"].decode())
    path = packed(tmp_path / "sound.fmu", {**parts, "modelDescription.xml": text})
    assert read_fmu(path).model_name == "hostile"


def test_a_binary_of_another_processor(
    parts: dict[str, bytes], described: Binding, tmp_path: Path, scratch: Path
) -> None:
    library = bytearray(parts["binaries/linux64/hostile2.so"])
    struct.pack_into("<H", library, 18, 183)  # ELF e_machine: AArch64
    path = packed(tmp_path / "arm.fmu", {**parts, "binaries/linux64/hostile2.so": bytes(library)})
    with pytest.raises(FmuCallError, match=r"binary cannot be loaded on this machine .*another processor"):
        FmiAsset(path, described).reset()
    assert not list(scratch.iterdir())


def test_an_fmu_without_its_authoring_tool(foreign_fmu: Any, described: Binding, tmp_path: Path) -> None:
    fmu = foreign_fmu("hostile2", "NO_INSTANCE")
    with zipfile.ZipFile(fmu) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    text = entries["modelDescription.xml"]
    entries["modelDescription.xml"] = text.replace(
        b"<CoSimulation ", b'<CoSimulation needsExecutionTool="true" '
    )
    with pytest.raises(FmuCallError, match=r"could not be instantiated .*needs its authoring tool"):
        FmiAsset(packed(tmp_path / "tool.fmu", entries), described).reset()


SPOILT = [
    (10, FmuCallError, r"(?s)fmi2DoStep returned Fatal.*the FMU says: .*the spring broke"),
    (11, FmuWorkerError, r"wrote something else into it"),
    (12, FmuCallError, r"(?s)fmi2DoStep returned Fatal.*\\x1b\[2J.*the spring \\x9b31mcreaks"),
]


@pytest.mark.parametrize(("misbehaviour", "kind", "sentence"), SPOILT, ids=["json", "builtins", "escapes"])
def test_an_fmu_in_python_that_spoils_what_we_share(
    spring_mass: Path, spring_binding: Binding, misbehaviour: int, kind: type[FmuError], sentence: str
) -> None:
    with FmiAsset(spring_mass, spring_binding) as asset:
        with pytest.raises(kind, match=sentence) as caught:
            asset.step(load={"misbehaviour": misbehaviour})
        said = [str(caught.value), *(text for _, text in asset.log)]
        assert not [text for text in said if re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", text)]
        asset.reset()
        assert asset.step({"push": 1.0}).extra == {"steps": 1.0}


@pytest.mark.parametrize("misbehaviour", [8, 9], ids=["loop", "hold"])
def test_an_fmu_in_python_that_loops(
    spring_mass: Path, spring_binding: Binding, scratch: Path, misbehaviour: int
) -> None:
    """It holds the interpreter of the worker; neither the limit nor the death of the twin needs that."""
    with (
        FmiAsset(spring_mass, spring_binding, step_timeout=0.5) as asset,
        pytest.raises(FmuTimeoutError, match=r"longer than 0\.5 s for the step"),
    ):
        asset.step(load={"misbehaviour": misbehaviour})
    described = spring_binding.model_dump(exclude_none=True, mode="json")
    last = f"asset.step(load={{'misbehaviour': {misbehaviour}}})"
    with twin(spring_mass, described, "asset.step()", "print('loops', flush=True)", last) as process:
        assert process.stdout.readline() == b"loops\n"
    assert not left_behind(scratch, 30.0)


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_description_with_one_odd_attribute(
    foreign_fmu: Any, tmp_path_factory: Any, data: st.DataObject
) -> None:
    """Whatever one attribute says, or if it is missing: a description and a draft, or one sentence."""
    model = data.draw(st.sampled_from(["lag1", "room2", "array3", "swing3", "ball2"]))
    with zipfile.ZipFile(foreign_fmu(model)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    text = entries["modelDescription.xml"].decode()
    places = list(re.finditer(r'\s[A-Za-z]+="([^"]*)"', text))
    place = data.draw(st.sampled_from(places))
    odd = st.sampled_from(["", "-1", "1e999", "nan", "x", "0", "99999999999999999999", "true", "1 2", "<"])
    if data.draw(st.booleans()):
        text = text[: place.start()] + text[place.end() :]
    else:
        text = text[: place.start(1)] + data.draw(odd).replace("<", "&lt;") + text[place.end(1) :]
    entries["modelDescription.xml"] = text.encode()
    path = packed(tmp_path_factory.mktemp("odd") / "odd.fmu", entries)
    sentence = ""
    try:
        draft_binding(read_fmu(path))
    except FmuError as error:
        sentence = str(error)
    assert "\n" not in sentence
