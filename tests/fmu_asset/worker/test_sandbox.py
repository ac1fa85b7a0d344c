"""FMUs that reach for what is not theirs: nothing is touched, and the sentence says what to do."""

from __future__ import annotations

import ctypes
import logging
import os
import pickle
import resource
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, SystemStructure
from fmu_asset.door import placement
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError, FmuCallError, FmuInputError, FmuWorkerError
from fmu_asset.folders import remove_folder
from fmu_asset.worker.sandbox import landlock_version
from twin_master.errors import InvalidObservationLibraryError
from twin_master.library.grid import SamplingGrid
from twin_master.library.sampling import sample_library

pytestmark = pytest.mark.skipif(landlock_version() < 6, reason="the kernel is older than Linux 6.12")

Attempted = Callable[[], bool]
"""Whether what was attempted has happened."""


def binding(**limits: Any) -> Binding:
    return parse_binding(
        {
            "binding": {"name": "hostile", "step_size": 1.0},
            "control": {"u": {"variable": "u", "unit": "m/s"}},
            "observation": {"y": {"variables": "y", "unit": "m"}},
            "limits": limits,
        }
    )


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """Return a private key."""
    path = tmp_path / "id_ed25519"
    path.write_text("the private key")
    path.chmod(0o600)
    return path


def listening(cleaner: ExitStack, family: int, kind: int, address: Any) -> tuple[object, Attempted]:
    line = cleaner.enter_context(socket.socket(family, kind))
    line.bind(address)
    if kind == socket.SOCK_STREAM:
        line.listen()
    line.setblocking(False)

    def reached() -> bool:
        try:
            line.accept()[0].close() if kind == socket.SOCK_STREAM else line.recv(8)
        except BlockingIOError:
            return False
        return True

    return line.getsockname()[1] if family == socket.AF_INET else address, reached


def shared(cleaner: ExitStack, kind: str, *size: int) -> int:
    libc = ctypes.CDLL(None)
    number = getattr(libc, f"{kind}get")(0, *size, 0o600)
    remove_now = (0, 0) if kind == "sem" else (0,)  # IPC_RMID, of a semaphore after its number
    cleaner.callback(getattr(libc, f"{kind}ctl"), number, *remove_now, None)
    return int(number)


def measured(process: int) -> tuple[object, ...]:
    limits = resource.prlimit(process, resource.RLIMIT_NOFILE)
    way = os.sched_getscheduler(process), os.sched_getaffinity(process)
    return limits, os.getpriority(os.PRIO_PROCESS, process), way


Targets = Callable[[str], tuple[str, Attempted]]


@pytest.fixture
def targets(tmp_path: Path, key: Path) -> Iterator[Targets]:
    """Return what is attempted, by name: the target that the FMU is told, and whether it was reached."""
    place = "127.0.0.1", 0
    made, queue = tmp_path / "made", f"uav-twin-{os.getpid()}"

    def told_by_fmu() -> bool:
        return True

    def process() -> subprocess.Popen[bytes]:
        running = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        cleaner.callback(running.communicate)
        return running

    def kill() -> tuple[object, Attempted]:
        running = process()

        def killed() -> bool:
            try:
                return running.wait(0.0) != 0
            except subprocess.TimeoutExpired:
                return False

        return running.pid, killed

    def hamper() -> tuple[object, Attempted]:
        number = process().pid
        before = measured(number)
        return number, lambda: measured(number) != before

    ways: dict[str, Callable[[], tuple[object, Attempted]]] = {
        "delete": lambda: (key, lambda: not key.exists()),
        "overwrite": lambda: (key, lambda: key.read_text() == ""),
        "read": lambda: (key, told_by_fmu),
        "project": lambda: (Path(__file__).parents[3] / "pyproject.toml", told_by_fmu),
        "spy": lambda: (f"/proc/{os.getpid()}/environ", told_by_fmu),
        "make": lambda: (made, made.exists),
        "call": lambda: listening(cleaner, socket.AF_INET, socket.SOCK_STREAM, place),
        "datagram": lambda: listening(cleaner, socket.AF_INET, socket.SOCK_DGRAM, place),
        "service": lambda: listening(cleaner, socket.AF_UNIX, socket.SOCK_STREAM, str(tmp_path / "service")),
        "mailbox": lambda: listening(cleaner, socket.AF_UNIX, socket.SOCK_DGRAM, str(tmp_path / "mailbox")),
        "watch": lambda: (tmp_path, told_by_fmu),
        "share": lambda: (shared(cleaner, "shm", 4096), told_by_fmu),
        "semaphore": lambda: (shared(cleaner, "sem", 1), told_by_fmu),
        "message": lambda: (shared(cleaner, "msg"), told_by_fmu),
        "queue": lambda: (queue, lambda: ctypes.CDLL(None).mq_unlink(f"/{queue}".encode()) == 0),
        "disturb": lambda: (process().pid, told_by_fmu),
        "hamper": hamper,
        "kill": kill,
    }

    def target(what: str) -> tuple[str, Attempted]:
        told, happened = ways[what]()
        return str(told), happened

    with ExitStack() as cleaner:
        yield target


def refused(asset: FmiAsset | CoupledAsset, sentence: str, kind: type[Exception] = FmuCallError) -> Exception:
    """Let an asset make its attempt, which is in the third step, and return the error that it must be."""
    asset.step(), asset.step()
    with pytest.raises(kind, match=sentence) as caught:
        asset.step()
    return caught.value


ATTEMPTS = [
    ("delete", "unlink(TARGET)", "Permission denied"),
    ("delete", "BY_CHILD(unlink(TARGET))", "Permission denied"),
    ("overwrite", "overwrite(TARGET)", "Permission denied"),
    ("overwrite", "truncate(TARGET,0)", "Permission denied"),
    ("delete", 'rename(TARGET,"mine")', "Permission denied"),
    ("read", "look_into(TARGET)", "Permission denied"),
    ("read", 'link(TARGET,"mine")', "Invalid cross-device link"),
    ("project", "look_into(TARGET)", "Permission denied"),  # beside the packages of a checkout
    ("spy", "look_into(TARGET)", "Permission denied"),
    ("make", "create(TARGET)", "Permission denied"),
    ("make", "mkdir(TARGET,0700)", "Permission denied"),
    ("make", "start_program(TARGET)", "Permission denied"),
    ("call", "call(SOCK_STREAM,0,TARGET)", "Permission denied"),
    ("call", "call(SOCK_STREAM,262,TARGET)", "Permission denied"),  # multipath TCP
    ("datagram", "call(SOCK_DGRAM,0,TARGET)", "Permission denied"),
    ("service", "call_service(TARGET)", "Permission denied"),
    ("mailbox", "send_by_pair(TARGET)", "Permission denied"),
    ("watch", "inotify_add_watch(inotify_init(),TARGET,IN_OPEN)", "Permission denied"),
    ("share", "shmat(atoi(TARGET),NULL,0)==(void*)-1?-1:0", "Permission denied"),
    ("hamper", "prlimit(atoi(TARGET),RLIMIT_NOFILE,&(struct rlimit){9,9},NULL)", "Permission denied"),
    ("hamper", "setpriority(PRIO_PROCESS,atoi(TARGET),9)", "Permission denied"),
    ("hamper", "sched_setaffinity(atoi(TARGET),8,&(long){1})", "Permission denied"),
    ("hamper", "sched_setscheduler(atoi(TARGET),SCHED_BATCH,&(struct sched_param){0})", "Permission denied"),
    (
        "hamper",
        "syscall(SYS_sched_setattr,atoi(TARGET),&(unsigned[12]){48,SCHED_BATCH},0)",
        "Permission denied",
    ),
    ("disturb", "sched_setparam(atoi(TARGET),&(struct sched_param){0})", "Permission denied"),
    ("disturb", "syscall(SYS_ioprio_set,1,atoi(TARGET),16391)", "Permission denied"),
    ("semaphore", "semctl(atoi(TARGET),0,SETVAL,1)", "Permission denied"),
    ("message", "msgsnd(atoi(TARGET),(long[]){1,2},8,IPC_NOWAIT)", "Permission denied"),
    ("queue", "syscall(SYS_mq_open,TARGET,O_RDWR|O_CREAT,0600,NULL)", "Permission denied"),
    ("kill", "kill(atoi(TARGET),SIGKILL)", "Operation not permitted"),
]


WITHOUT_TRACE = ("read", "project", "spy", "watch", "share", "semaphore", "message", "disturb")


@pytest.mark.parametrize(("what", "attempt", "reason"), ATTEMPTS, ids=[case[1] for case in ATTEMPTS])
def test_what_is_not_its_own_is_out_of_reach(
    foreign_fmu: Any, targets: Targets, monkeypatch: pytest.MonkeyPatch, what: str, attempt: str, reason: str
) -> None:
    """And the same FMU reaches it where the sandbox is off: it is the sandbox that holds."""
    fmu = foreign_fmu("hostile2", f"ATTEMPT={attempt}")
    target, happened = targets(what)
    monkeypatch.setenv("HOSTILE_TARGET", target)
    with FmiAsset(fmu, binding()) as asset:
        error = refused(asset, rf"(?s)step 2 .*it cannot have {target}: {reason}")
    assert ("granted by `read`, `write`, `ports`" in str(error)) == (reason == "Permission denied")
    assert what in WITHOUT_TRACE or not happened()
    with FmiAsset(fmu, binding(sandbox=False)) as asset:
        for _ in range(3):
            asset.step()
    assert happened()


def test_an_fmu_that_does_not_say_what_it_was_refused(
    foreign_fmu: Any, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    with FmiAsset(foreign_fmu("hostile2", "ATTEMPT=look_into(TARGET)", "SILENT"), binding()) as asset:
        refused(asset, r"The system refused it something \(Permission denied\)")


def test_an_fmu_in_python_names_what_it_was_refused(
    spring_mass: Path, spring_binding: Binding, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    with (
        FmiAsset(spring_mass, spring_binding) as asset,
        pytest.raises(
            FmuCallError, match=rf"\(Permission denied; the last .* tried was open\('{key}', 'r'\)\)"
        ),
    ):
        asset.step(load={"misbehaviour": 13.0})


def test_rights_of_files_stay_as_they_are(
    foreign_fmu: Any, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Landlock does not know them: calls that change them return OK, in vain."""
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    for attempt in ("chmod(TARGET,0777)", "chown(TARGET,1,1)"):
        fmu = foreign_fmu("hostile2", f"ATTEMPT={attempt}")
        before = key.stat()
        with FmiAsset(fmu, binding()) as asset:
            assert [asset.step().values[0] for _ in range(4)] == [1.0, 2.0, 3.0, 4.0]
        assert key.stat() == before
        if os.geteuid() == 0 or "chmod" in attempt:
            with FmiAsset(fmu, binding(sandbox=False)) as asset:
                asset.step(), asset.step(), asset.step()
            assert key.stat() != before


GRANTED = [
    ("read", "look_into(TARGET)", "read"),
    ("overwrite", "overwrite(TARGET)", "write"),
    ("call", "call(SOCK_STREAM,0,TARGET)", "ports"),
    ("datagram", "call(SOCK_DGRAM,0,TARGET)", "ports"),  # by which the names of hosts are looked up
]


@pytest.mark.parametrize(("what", "attempt", "key_name"), GRANTED, ids=[case[1] for case in GRANTED])
def test_what_is_granted_can_be_had(
    foreign_fmu: Any,
    targets: Targets,
    monkeypatch: pytest.MonkeyPatch,
    what: str,
    attempt: str,
    key_name: str,
) -> None:
    target, happened = targets(what)
    monkeypatch.setenv("HOSTILE_TARGET", target)
    granted = {key_name: [int(target) if key_name == "ports" else target]}
    with FmiAsset(foreign_fmu("hostile2", f"ATTEMPT={attempt}"), binding(**granted)) as asset:
        asset.step(), asset.step(), asset.step()
    assert happened()


def test_a_port_beside_the_granted_one_and_another_protocol_stay_closed(
    foreign_fmu: Any, targets: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    for what, attempt in (
        ("call", "call(SOCK_STREAM,0,TARGET)"),
        ("call", "call(SOCK_STREAM,262,TARGET)"),
        ("service", "call_service(TARGET)"),
    ):
        target, happened = targets(what)
        monkeypatch.setenv("HOSTILE_TARGET", target)
        port = int(target) if "262" in attempt else 9
        with FmiAsset(foreign_fmu("hostile2", f"ATTEMPT={attempt}"), binding(ports=[port])) as asset:
            refused(asset, "Permission denied")
        assert not happened()


def test_a_program_that_is_granted_is_as_confined_as_the_fmu(
    foreign_fmu: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It makes a file where the FMU may write, and none elsewhere."""
    fmu = foreign_fmu("hostile2", "ATTEMPT=start_program(TARGET)")
    given = tmp_path / "given"
    given.mkdir()
    for place in (given / "made", tmp_path / "made"):
        monkeypatch.setenv("HOSTILE_TARGET", str(place))
        with FmiAsset(fmu, binding(programs=True, write=[str(given)])) as asset:
            asset.step(), asset.step(), asset.step()
    assert [path.name for path in tmp_path.rglob("made")] == ["made"]
    assert (given / "made").exists()


def test_its_own_folder_is_its_own(foreign_fmu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also that for temporary files, which is the same; that of the extracted FMU by a key."""
    monkeypatch.setenv("HOSTILE_TARGET", "notes.txt")
    for attempt, granted in (
        ("create(TARGET)", {}),
        ('rename("worker.log",TARGET)', {}),
        ("create(in_temporary())", {}),
        ("create(beside_binary())", {"write": ["."]}),
    ):
        with FmiAsset(foreign_fmu("hostile2", f"ATTEMPT={attempt}"), binding(**granted)) as asset:
            assert [asset.step().values[0] for _ in range(4)] == [1.0, 2.0, 3.0, 4.0]
    with FmiAsset(foreign_fmu("hostile2", "ATTEMPT=create(beside_binary())"), binding()) as asset:
        refused(asset, "Permission denied")


REFUSED = [
    ({"read": ["/there/is/no/such"]}, FmuInputError, r"grants '/there/is/no/such', which does not exist"),
    ({"ports": [0]}, BindingError, r"limits\.ports.*1"),
    ({"ports": ["27000"]}, BindingError, r"limits\.ports.*an integer"),
    ({"read": "/opt"}, BindingError, r"limits\.read.*a list"),
    ({"sandbox": "no"}, BindingError, r"limits\.sandbox.*true or false"),
]


@pytest.mark.parametrize(("limits", "kind", "sentence"), REFUSED, ids=[case[2] for case in REFUSED])
def test_keys_that_are_wrong_are_one_sentence(
    foreign_fmu: Any, limits: dict[str, Any], kind: type[Exception], sentence: str
) -> None:
    with pytest.raises(kind, match=sentence):
        FmiAsset(foreign_fmu("hostile2"), binding(**limits)).reset()


def test_what_is_not_confined_is_said_once(
    foreign_fmu: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an FMU whose binding says so, and of a kernel without Landlock."""
    fmu = foreign_fmu("hostile2", "CASE=said")
    for _ in range(2):
        with caplog.at_level(logging.WARNING), FmiAsset(fmu, binding(sandbox=False)):
            pass
    assert caplog.messages == [
        f"{fmu}: its binding turns the sandbox off, so that it has all rights of its user."
    ]
    caplog.clear()
    monkeypatch.setattr(placement, "landlock_version", lambda: 0)
    for _ in range(2):
        with caplog.at_level(logging.WARNING), FmiAsset(fmu, binding()):
            pass
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("This kernel has no Landlock (Linux 5.13 or later)")


def sampled(fmu: Path, folder: Path) -> tuple[Path, SamplingGrid]:
    """Return the file of a binding, and a grid of two points."""
    file = folder / "hostile.toml"
    file.write_text(
        '[binding]\nname = "hostile"\nstep_size = 1.0\n[control.u]\nvariable = "u"\nunit = "m/s"\n'
        '[health.damage]\nvariable = "d"\nunit = "1"\n'
        '[observation.y]\nvariables = "y"\nunit = "m"\n'
    )
    return file, SamplingGrid(
        fmu=str(fmu), binding=str(file), role="y", parameter="", draws=(0.0,), settling_steps=5,
        states={"damage": (0.0, 0.1)}, controls={"go": {"u": 1.0}},
    )  # fmt: skip


def test_components_and_samplers_are_confined_too(
    foreign_fmu: Any, key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A system of FMUs, and a library."""
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    fmu = foreign_fmu("hostile2", "ATTEMPT=unlink(TARGET)")
    structure = SystemStructure(name="one", components=(Component("thief", fmu),))
    record = {
        "binding": {"name": "one", "step_size": 1.0},
        "health": {"damage": {"variable": "thief.d", "unit": "1"}},
        "control": {"u": {"variable": "thief.u", "unit": "m/s"}},
        "observation": {"y": {"variables": "thief.y", "unit": "m"}},
    }
    with CoupledAsset(structure, parse_binding(record)) as system:
        refused(system, rf"it cannot have {key}: Permission denied")
    file, grid = sampled(fmu, tmp_path)
    with pytest.raises(FmuCallError, match=rf"it cannot have {key}: Permission denied"):
        sample_library(grid, tmp_path / "library.nc", workers=1)
    assert key.exists()
    file.write_text(f"{file.read_text()}[limits]\nsandbox = false\n")
    with pytest.raises(InvalidObservationLibraryError):  # an integrator does not settle
        sample_library(grid, tmp_path / "library.nc", workers=1, replace_existing=True)
    assert not key.exists()


class Order:
    """What is carried out by whoever unpickles it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._path),)


def test_what_a_sampled_fmu_writes_to_its_descriptors_is_not_carried_out(
    foreign_fmu: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processes of a sampling send each other pickles, and the FMU is in none of them."""
    made = tmp_path / "made"
    monkeypatch.setenv("HOSTILE_TARGET", pickle.dumps(Order(made), protocol=0).decode())
    fmu = foreign_fmu("hostile2", "ATTEMPT=write_message(TARGET)")
    with pytest.raises(FmuWorkerError, match="closed its pipe, or wrote something else into it"):
        sample_library(sampled(fmu, tmp_path)[1], tmp_path / "library.nc", workers=1)
    assert not made.exists()


@pytest.mark.parametrize("version", range(1, 7))
def test_what_older_kernels_know_is_asked_of_them(tmp_path: Path, key: Path, version: int) -> None:
    """By the rights of that version, which newer kernels take as well; its own files can be made."""
    own = tmp_path / "own"
    own.mkdir()
    program = (
        "import os, sys\n"
        "from fmu_asset.worker import sandbox\n"
        "sandbox.landlock_version = lambda: int(sys.argv[1])\n"
        "sandbox.confine(sandbox.Grants(ports=(9,)), sys.argv[2], sys.argv[2])\n"
        "for attempt in (os.unlink, os.listdir, open, lambda path: os.truncate(path, 0)):\n"
        "    try: attempt(sys.argv[3])\n"
        "    except PermissionError: continue\n"
        "    except NotADirectoryError: continue\n"
        "    sys.exit(f'{attempt} went')\n"
        "open(f'{sys.argv[2]}/mine', 'w').close()\n"
        "os.rename(f'{sys.argv[2]}/mine', f'{sys.argv[2]}/renamed')\n"
    )
    subprocess.run(
        [sys.executable, "-c", program, str(version), own, key], cwd=Path(__file__).parents[3], check=True
    )
    assert (own / "renamed").exists()
    assert key.read_text() == "the private key"


@pytest.mark.parametrize("trap", ['symlink(TARGET,"worker.log")', 'mkfifo("worker.log",0600)'])
def test_a_trap_in_the_place_of_the_log(
    foreign_fmu: Any, key: Path, monkeypatch: pytest.MonkeyPatch, trap: str
) -> None:
    """The twin, which may read the key, reads the last words of a worker that has died, not the key."""
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    fmu = foreign_fmu("hostile2", f'ATTEMPT=(unlink("worker.log"),{trap},raise(SIGKILL))')
    with FmiAsset(fmu, binding()) as asset:
        error = refused(asset, "SIGKILL", FmuWorkerError)
    assert not error.messages


def test_a_link_that_takes_the_place_of_a_folder_while_it_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, folder = tmp_path / "mine", tmp_path / "folder"
    (folder / "deep").mkdir(parents=True)
    mine.mkdir()
    (mine / "letter.txt").write_text("dear")

    def swapped(source: str, target: str) -> None:
        renamed(source, target)
        renamed(target, f"{target}-away")
        Path(target).symlink_to(mine)

    renamed = os.rename
    monkeypatch.setattr("fmu_asset.folders.os.rename", swapped)
    remove_folder(folder)
    assert [path.name for path in mine.iterdir()] == ["letter.txt"]
