"""FMUs that reach for what is not theirs: nothing is touched, and the sentence says what to do."""

import ctypes
import logging
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from fmu_asset import errors
from fmu_asset.client import instance_host
from fmu_asset.client.session import FmiAsset
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component
from fmu_asset.folders import remove_folder
from fmu_asset.worker.sandbox import landlock_version
from tests.fmu_asset.client.kinds import BINDINGS_FOLDER, HOSTILE, SPRING_BINDING
from tests.fmu_asset.making import ROOT, bound, changed, run_python, system
from tests.fmu_asset.worker.test_hostile import MISBEHAVIOURS
from twin_master.library.grid import SamplingGrid
from twin_master.library.sampling import sample_library

pytestmark = pytest.mark.skipif(
    landlock_version() < 6, reason="the kernel is older than Linux 6.12"
)


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """Return a private key."""
    path = tmp_path / "id_ed25519"
    path.write_text("the private key")
    path.chmod(0o600)
    return path


Attempting = Callable[..., FmiAsset]


@pytest.fixture
def attempting(foreign_fmu: Any, monkeypatch: pytest.MonkeyPatch) -> Attempting:
    """Return what makes an asset whose FMU makes an attempt upon a target in its third step."""

    def make(attempt: str, target: object = "", *more: str, **limits: Any) -> FmiAsset:
        monkeypatch.setenv("HOSTILE_TARGET", str(target))
        fmu = foreign_fmu("hostile2", f"ATTEMPT={attempt}", *more)
        return FmiAsset(fmu, changed(HOSTILE, limits=limits))

    return make


def listening(
    cleaner: ExitStack, family: int, kind: int, address: Any = ("127.0.0.1", 0)
) -> object:
    line = cleaner.enter_context(socket.socket(family, kind))
    line.bind(address)
    if kind == socket.SOCK_STREAM:
        line.listen()
    return line.getsockname()[1] if family == socket.AF_INET else address


def shared(cleaner: ExitStack, kind: str, *size: int) -> int:
    libc = ctypes.CDLL(None)
    number = getattr(libc, f"{kind}get")(0, *size, 0o600)
    remove_now = (0, 0) if kind == "sem" else (0,)  # IPC_RMID, of a semaphore after its number
    cleaner.callback(getattr(libc, f"{kind}ctl"), number, *remove_now, None)
    return int(number)


def process(cleaner: ExitStack) -> int:
    running = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    cleaner.callback(running.communicate)
    cleaner.callback(running.kill)
    return running.pid


Target = Callable[[str], str]


@pytest.fixture
def target(tmp_path: Path, key: Path) -> Iterator[Target]:
    """Return what the FMU is told to reach, by name; it says whether it reached it."""
    inet, unix, stream, datagram = (
        socket.AF_INET,
        socket.AF_UNIX,
        socket.SOCK_STREAM,
        socket.SOCK_DGRAM,
    )
    queue = f"uav-twin-{os.getpid()}"
    ways: dict[str, Callable[[], object]] = {
        "file": lambda: key,
        "project": lambda: ROOT / "pyproject.toml",  # beside the packages of a checkout
        "spy": lambda: f"/proc/{os.getpid()}/environ",
        "make": lambda: tmp_path / "made",
        "call": lambda: listening(cleaner, inet, stream),
        "datagram": lambda: listening(cleaner, inet, datagram),
        "service": lambda: listening(cleaner, unix, stream, str(tmp_path / "service")),
        "mailbox": lambda: listening(cleaner, unix, datagram, str(tmp_path / "mailbox")),
        "watch": lambda: tmp_path,
        "share": lambda: shared(cleaner, "shm", 4096),
        "semaphore": lambda: shared(cleaner, "sem", 1),
        "message": lambda: shared(cleaner, "msg"),
        "queue": lambda: (
            cleaner.callback(ctypes.CDLL(None).mq_unlink, f"/{queue}".encode()) and queue
        ),
        "process": lambda: process(cleaner),
    }
    with ExitStack() as cleaner:
        yield lambda what: str(ways[what]())


def granted(asset: FmiAsset) -> None:
    """Let an asset make its attempt, which nothing hinders."""
    with asset:
        assert [asset.step().values[0] for _ in range(4)] == [1.0, 2.0, 3.0, 4.0]


def refused(asset: FmiAsset, sentence: str, kind: type[Exception] = errors.FmuCallError) -> Any:
    """Let an asset make its attempt, and return the error that it must be."""
    with asset:
        asset.step(), asset.step()
        with pytest.raises(kind, match=sentence) as caught:
            asset.step()
    return caught.value


@pytest.mark.parametrize("row", MISBEHAVIOURS["attempt"], ids=lambda row: row["call"])
def test_what_is_not_its_own_is_out_of_reach(attempting, target, key, row) -> None:
    """And the same FMU reaches it where the sandbox is off: it is the sandbox that holds."""
    reason, told = row.get("reason", "Permission denied"), target(row["what"])
    error = refused(attempting(row["call"], told), rf"(?s)step 2 .*it cannot have {told}: {reason}")
    assert ("grant what it needs by `read`, `write`, `ports`" in str(error)) == (
        reason == "Permission denied"
    )
    assert key.read_text() == "the private key"
    assert not (key.parent / "made").exists()
    granted(attempting(row["call"], told, sandbox=False))


def test_what_was_refused_is_named_also_where_the_fmu_does_not_say_it(
    attempting, key, spring_mass
) -> None:
    silent = attempting("look_into(TARGET)", key, "SILENT")
    refused(silent, r"The system refused a call of the FMU \(Permission denied\)")
    words = rf"\(Permission denied; the last .* tried was open\('{key}', 'r'\)\)"
    with (
        FmiAsset(spring_mass, SPRING_BINDING) as asset,
        pytest.raises(errors.FmuCallError, match=words),
    ):
        asset.step(load={"misbehaviour": 13.0})


def test_rights_of_files_stay_as_they_are(attempting, key) -> None:
    """Landlock does not know them: calls that change them return OK, in vain."""
    for attempt in ("chmod(TARGET,0777)", "chown(TARGET,1,1)"):
        before = key.stat()
        granted(attempting(attempt, key))
        assert key.stat() == before
        if os.geteuid() == 0 or "chmod" in attempt:
            granted(attempting(attempt, key, sandbox=False))
            assert key.stat() != before


@pytest.mark.parametrize(("what", "attempt", "limit"), MISBEHAVIOURS["granted"])
def test_what_is_granted_can_be_had(attempting, target, what, attempt, limit) -> None:
    told = target(what)
    granted(attempting(attempt, told, **{limit: [int(told) if limit == "ports" else told]}))


@pytest.mark.parametrize(("what", "attempt", "port"), MISBEHAVIOURS["closed"])
def test_a_port_beside_the_granted_one_and_another_protocol_stay_closed(
    attempting, target, what, attempt, port
) -> None:
    told = target(what)
    refused(attempting(attempt, told, ports=[port or int(told)]), "Permission denied")


def test_a_program_that_is_granted_is_as_confined_as_the_fmu(attempting, tmp_path) -> None:
    """It makes a file where the FMU may write, and none elsewhere."""
    given = tmp_path / "given"
    given.mkdir()
    for place in (given / "made", tmp_path / "made"):
        granted(attempting("start_program(TARGET)", place, programs=True, write=[str(given)]))
    assert list(tmp_path.rglob("made")) == [given / "made"]


def test_its_own_folder_is_its_own(attempting) -> None:
    """Also that for temporary files, which is the same; that of the extracted FMU by a key."""
    for attempt in ("create(TARGET)", 'rename("worker.log",TARGET)', "create(in_temporary())"):
        granted(attempting(attempt, "notes.txt"))
    granted(attempting("create(beside_binary())", write=["."]))
    refused(attempting("create(beside_binary())"), "Permission denied")


def test_keys_that_are_wrong_are_one_sentence(foreign_fmu) -> None:
    for limits, kind, sentence in MISBEHAVIOURS["limits"]:
        with pytest.raises(getattr(errors, kind), match=sentence):
            FmiAsset(foreign_fmu("hostile2"), changed(HOSTILE, limits=limits)).reset()


def test_what_is_not_confined_is_said_once(foreign_fmu, caplog, monkeypatch) -> None:
    """Of an FMU whose binding says so, and of a kernel without Landlock."""
    fmu, said = foreign_fmu("hostile2", "CASE=said"), []
    for binding in (changed(HOSTILE, limits={"sandbox": False}), HOSTILE):
        caplog.clear()
        for _ in range(2):
            with caplog.at_level(logging.WARNING), FmiAsset(fmu, binding):
                pass
        said += caplog.messages
        monkeypatch.setattr(instance_host, "landlock_version", lambda: 0)
    assert (
        said[0]
        == f"{fmu}: its binding turns the sandbox off, so that it has all rights of its user."
    )
    assert said[1].startswith("This kernel has no Landlock (Linux 5.13 or later)")
    assert len(said) == 2


def sampled(fmu: Path) -> SamplingGrid:
    """Return a grid of two points."""
    return SamplingGrid(
        fmu=str(fmu),
        binding=str(BINDINGS_FOLDER / "hostile2_damaged.toml"),
        role="y",
        parameter="",
        draws=(0.0,),
        settling_steps=5,
        states={"damage": (0.0, 0.1)},
        controls={"go": {"u": 1.0}},
    )


def test_components_and_samplers_are_confined_too(attempting, key, tmp_path) -> None:
    """A system of FMUs, and a library."""
    fmu = attempting("unlink(TARGET)", key).description.path
    binding = bound(1.0, {"y": ("thief.y", "m")}, control={"u": ("thief.u", "m/s")})
    words = rf"it cannot have {key}: Permission denied"
    refused(
        CoupledAsset(system([Component("thief", fmu)], []), binding),
        f"(?s)component thief: .*{words}",
    )
    with pytest.raises(errors.FmuCallError, match=words):
        sample_library(sampled(fmu), tmp_path / "library.nc", workers=1)
    assert key.exists()


def test_what_a_sampled_fmu_writes_to_its_descriptors_is_not_carried_out(
    attempting, tmp_path
) -> None:
    """The processes of a sampling send each other pickles, and the FMU is in none of them."""
    made = tmp_path / "made"
    order = f"cos\nmkdir\n(V{made}\ntR."  # who unpickles it makes the folder
    grid = sampled(attempting("write_message(TARGET)", order).description.path)
    with pytest.raises(
        errors.FmuWorkerError, match="closed its pipe, or wrote something else into it"
    ):
        sample_library(grid, tmp_path / "library.nc", workers=1)
    assert not made.exists()


@pytest.mark.parametrize("version", [1, 3, 5, 6])
def test_what_older_kernels_know_is_asked_of_them(tmp_path, key, version) -> None:
    """By the rights of that version, which newer kernels take, too; its own files can be made."""
    own = tmp_path / "own"
    own.mkdir()
    program = (
        "import os, sys\n"
        "from fmu_asset.worker import sandbox\n"
        "sandbox.landlock_version = lambda: int(sys.argv[1])\n"
        "sandbox.confine(sandbox.Grants(ports=(9,)), sys.argv[2], sys.argv[2])\n"
        "for attempt in (os.unlink, os.listdir, open, lambda path: os.truncate(path, 0)):\n"
        "    try: attempt(sys.argv[3])\n"
        "    except (PermissionError, NotADirectoryError): continue\n"
        "    sys.exit(f'{attempt} went')\n"
        "open(f'{sys.argv[2]}/mine', 'w').close()\n"
        "os.rename(f'{sys.argv[2]}/mine', f'{sys.argv[2]}/renamed')\n"
    )
    run_python(program, version, own, key)
    assert (own / "renamed").exists()
    assert key.read_text() == "the private key"


@pytest.mark.parametrize("trap", ['symlink(TARGET,"worker.log")', 'mkfifo("worker.log",0600)'])
def test_a_trap_in_the_place_of_the_log(attempting, key, trap) -> None:
    """The twin may read the key, but reads the last words of a worker that died, not the key."""
    asset = attempting(f'(unlink("worker.log"),{trap},raise(SIGKILL))', key)
    assert not refused(asset, "SIGKILL", errors.FmuWorkerError).messages


def test_a_link_that_takes_the_place_of_a_folder_while_it_is_removed(tmp_path, monkeypatch) -> None:
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
