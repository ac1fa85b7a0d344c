"""The cache: entries that are built once, by one process of several; compiled loops."""

import errno
import importlib
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread
from typing import Any

import numba
import pytest
from threadpoolctl import threadpool_limits

from fe.compilation import compiled
from fe.reduction import model_cache
from fe.reduction.built_once import built_once, cache_folder
from fe.reduction.model_cache import (
    MODELLING_PACKAGES,
    cache_file,
    patch_arrays,
    reduced_model,
    wing_fields,
)
from fe.runtime.arrays import StoredArrays
from fe.structure.tables import StructureSettings
from fe.wing.design import WingDesign

# ---------------------------------------------------------------- entries


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a cache that this test alone has."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "uav-twin"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch, coarse_fields, coarse_patch_arrays) -> list[str]:
    """Names of the designs that were built; finished ones stand for the builds themselves."""
    names: list[str] = []

    def builder_of(stored: StoredArrays) -> Callable[..., StoredArrays]:
        def build(design: WingDesign, *_: object) -> StoredArrays:
            names.append(design.name)
            return replace(stored, design_hash=design.hash)

        return build

    monkeypatch.setattr(model_cache, "build_fields", builder_of(coarse_fields))
    monkeypatch.setattr(model_cache, "build_patch_arrays", builder_of(coarse_patch_arrays))
    return names


def test_an_unchanged_design_is_built_once(builds, coarse_design):
    first = reduced_model(coarse_design.changed())
    again = reduced_model(coarse_design.changed())

    assert builds == [coarse_design.name]
    assert again.to_bytes() == first.to_bytes()


def test_the_fields_of_a_wing_have_its_model(builds, coarse_design):
    model = reduced_model(coarse_design)
    fields = wing_fields(coarse_design)

    assert builds == [coarse_design.name]
    assert fields.model.to_bytes() == model.to_bytes()
    assert fields.static_displacement.shape[-1] == model.static_stiffness.shape[-1]


def test_a_changed_design_is_built_anew_and_once(builds, coarse_design):
    changed = coarse_design.changed(skin={"thickness": 0.0007})
    reduced_model(coarse_design)

    for _ in range(2):
        assert reduced_model(changed).design_hash == changed.hash

    assert changed.hash != coarse_design.hash
    assert len(builds) == 2


@pytest.mark.parametrize(
    "make",
    [
        lambda design: reduced_model(design, settings=StructureSettings(bound_tolerance=1e-3)),
        patch_arrays,
    ],
    ids=["settings", "patches"],
)
def test_other_settings_and_patches_are_built_beside_the_model_and_once(
    builds, coarse_design, make
):
    reduced_model(coarse_design)

    for _ in range(2):
        make(coarse_design)

    assert len(builds) == 2


def test_the_shipped_design_is_the_default(builds, shipped_design):
    assert reduced_model().design_hash == shipped_design.hash


def test_a_changed_program_builds_anew(builds, coarse_design, monkeypatch):
    reduced_model(coarse_design)
    monkeypatch.setattr(model_cache, "modelling_hash", lambda: "another")

    reduced_model(coarse_design)

    assert len(builds) == 2


# ---------------------------------------------------------------- damaged entries


def cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def flip_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x55
    path.write_bytes(content)


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.fixture(
    params=[("wing", reduced_model, 1), ("fields", wing_fields, 2), ("patches", patch_arrays, 2)],
    ids=["wing", "fields", "patches"],
)
def entry(request):
    """The kind of an entry, how it is made, and how often it is built if it was damaged once.

    The model alone is among the fields, so that it is not built again.
    """
    return request.param


@pytest.mark.parametrize("damage", [cut, flip_a_byte, empty])
def test_a_damaged_entry_is_built_anew_and_said(builds, coarse_design, caplog, entry, damage):
    kind, make, build_count = entry
    good = make(coarse_design).to_bytes()
    damage(cache_file(kind, coarse_design.hash, None))

    for _ in range(2):
        assert make(coarse_design).to_bytes() == good

    assert "built again" in caplog.text
    assert len(builds) == build_count


def test_a_missing_entry_is_built_anew(builds, coarse_design, entry):
    kind, make, build_count = entry
    good = make(coarse_design).to_bytes()
    cache_file(kind, coarse_design.hash, None).unlink()

    for _ in range(2):
        assert make(coarse_design).to_bytes() == good

    assert len(builds) == build_count


def test_a_model_that_cannot_be_kept_is_still_given(
    builds, coarse_design, tmp_path, monkeypatch, caplog
):
    (tmp_path / "a file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))

    assert reduced_model(coarse_design).design_hash == coarse_design.hash

    assert "could not be stored" in caplog.text


def test_the_cache_lies_in_the_home_folder_if_nothing_else_is_said(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")

    assert cache_folder() == Path.home() / ".cache" / "uav-twin"


LIST_MODULES = (
    "import sys, fe.reduction.patch_basis\n"
    "print(*(name for name in sys.modules if name.startswith('fe.')))"
)


def test_every_file_that_shapes_the_model_counts_for_the_key():
    root = Path(__file__).parents[3]
    words = [sys.executable, "-c", LIST_MODULES]

    result = subprocess.run(words, capture_output=True, text=True, check=True, cwd=root)

    packages = {name.split(".")[1] for name in result.stdout.split()}
    assert packages - {"designs", "sentences"} == set(MODELLING_PACKAGES)


@pytest.mark.slow
@pytest.mark.long
def test_a_real_build_is_reproducible_in_any_number_of_threads(
    coarse_design, coarse_fields, own_cache
):
    with threadpool_limits(2):
        wing = wing_fields(coarse_design)

    assert wing.to_bytes() == coarse_fields.to_bytes()
    assert wing.model.to_bytes() == reduced_model(coarse_design).to_bytes()
    assert len(list(own_cache.glob("*.npz"))) == 2


# ---------------------------------------------------------------- several builders


HANGS = 600.0
"""After so long [s] another process hangs."""


def build_here(path: Path) -> str:
    return built_once(path, path.read_text, lambda: "ours", path.write_text)


def build_elsewhere(path: Path, began: Any, finish: Any) -> None:
    """Build in another process, until that is told to finish."""

    def build() -> str:
        began.set()
        finish.wait(HANGS)
        return "theirs"

    built_once(path, path.read_text, build, path.write_text)


@dataclass(frozen=True)
class OtherBuilder:
    """A process that builds an entry, and the event that lets it finish."""

    path: Path
    process: Any
    finish: Any


@pytest.fixture
def other_builder(tmp_path):
    path = tmp_path / "cache" / "model.npz"
    context = multiprocessing.get_context("spawn")
    began = context.Event()
    finish = context.Event()
    process = context.Process(target=build_elsewhere, args=(path, began, finish), daemon=True)
    process.start()
    try:
        assert began.wait(HANGS)
        yield OtherBuilder(path, process, finish)
    finally:
        process.kill()
        process.join()


def act_once_waiting(caplog: pytest.LogCaptureFixture, act: Callable[[], None]) -> None:
    """Act when this process has said that it waits."""

    def wait_and_act() -> None:
        limit = time.monotonic() + HANGS
        while not caplog.messages and time.monotonic() < limit:
            time.sleep(0.01)
        act()

    Thread(target=wait_and_act, daemon=True).start()


def test_a_wait_is_said_and_ends_with_what_the_other_made(other_builder, caplog):
    path = other_builder.path
    act_once_waiting(caplog, other_builder.finish.set)

    assert build_here(path) == "theirs"

    process_id = other_builder.process.pid
    sentence = f"Waiting for another process (number {process_id}) that makes {path}."
    assert path.read_text() == "theirs"
    assert caplog.messages == [sentence]


def test_a_wait_for_a_process_that_was_killed_ends_with_a_build_here(other_builder, caplog):
    path = other_builder.path
    act_once_waiting(caplog, other_builder.process.kill)

    assert build_here(path) == "ours"

    process_id = other_builder.process.pid
    sentence = f"Waiting for another process (number {process_id}) that makes {path}."
    assert path.read_text() == "ours"
    assert caplog.messages == [sentence]


def test_a_build_that_fails_keeps_nothing(tmp_path):
    def fail() -> str:
        raise KeyboardInterrupt

    path = tmp_path / "model.npz"
    with pytest.raises(KeyboardInterrupt):
        built_once(path, path.read_text, fail, path.write_text)

    assert [file.suffix for file in tmp_path.iterdir()] == [".lock"]


def test_a_full_disk_stops_no_build(tmp_path, monkeypatch):
    def fail(handle: int, content: bytes, position: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", fail)

    assert build_here(tmp_path / "model.npz") == "ours"


# ---------------------------------------------------------------- loops


def test_a_loop_is_compiled():
    assert compiled(lambda value: 2.0 * value)(3.0) == 6.0


def test_without_a_folder_for_the_cache_a_loop_is_still_compiled(monkeypatch):
    njit = numba.njit
    is_cached = []

    def fail_with_cache(**options):
        is_cached.append(options.get("cache", False))
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    # Numba decorates functions of its own by `njit` when it compiles for the first time.
    with monkeypatch.context() as during_decoration:
        during_decoration.setattr(numba, "njit", fail_with_cache)
        double = compiled(lambda value: 2.0 * value)

    assert double(3.0) == 6.0
    assert is_cached == [True, False]


INNER_MODULE = """
from fe.compilation import compiled
STEP = {step}
@compiled
def inner(x):
    return x + {added}
"""
OUTER_MODULE = """
from fe.compilation import compiled
from inner import STEP, inner
@compiled
def outer(x):
    return STEP * inner(x)
"""


@dataclass(frozen=True)
class LoopRun:
    """What a loop gives for 1, and how often it was compiled."""

    value: float
    compilations: int


@pytest.fixture
def run_outer(tmp_path, monkeypatch) -> Callable[..., LoopRun]:
    """Write both modules with numbers into a folder, import them anew, and run the outer loop."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def run(folder: str = "modules", **numbers: float) -> LoopRun:
        modules = tmp_path / folder
        modules.mkdir(exist_ok=True)
        monkeypatch.syspath_prepend(modules)
        text = INNER_MODULE.format_map({"step": 1.0, "added": 1.0} | numbers)
        (modules / "inner.py").write_text(text)
        (modules / "outer.py").write_text(OUTER_MODULE)
        for name in ("inner", "outer"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        loop = importlib.import_module("outer").outer
        value = loop(1.0)
        return LoopRun(value, sum(loop.stats.cache_misses.values()))

    return run


@pytest.mark.parametrize(("change", "value"), [({"added": 5.0}, 6.0), ({"step": 7.0}, 14.0)])
def test_loops_are_kept_by_content_and_a_changed_source_never_meets_old_ones(
    run_outer, change, value
):
    first = run_outer()
    again = run_outer()
    changed = run_outer(**change)
    changed_back = run_outer()

    assert first == LoopRun(2.0, compilations=1)
    assert again == changed_back == LoopRun(2.0, compilations=0)
    assert changed == LoopRun(value, compilations=1)


def test_a_copy_at_another_path_finds_the_loops_of_the_first(run_outer):
    first = run_outer("a_copy")
    second = run_outer("another_copy")

    assert first == LoopRun(2.0, compilations=1)
    assert second == LoopRun(2.0, compilations=0)


# ---------------------------------------------------------------- imports


def run_in_new_process(code: str, **environment: str) -> str:
    """Return what a program prints, run by a process of its own."""
    process = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return process.stdout.strip()


def test_a_kept_model_is_read_without_the_modelling_code():
    code = "import fe.reduction.model_cache, sys; print('skfem' in sys.modules)"
    assert run_in_new_process(code) == "False"


def test_kept_machine_code_is_read_without_the_compiler(tmp_path):
    """The second process imports nothing of what numba can translate, such as linear algebra."""
    (tmp_path / "kept_loop.py").write_text(
        "from fe.compilation import compiled\n\n@compiled\ndef double(x):\n    return 2.0 * x\n"
    )
    code = "import kept_loop, sys; print(kept_loop.double(3.0), 'numba.np.linalg' in sys.modules)"
    environment = {
        "NUMBA_CACHE_DIR": str(tmp_path / "kept"),
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    assert run_in_new_process(code, **environment) == "6.0 True"
    assert run_in_new_process(code, **environment) == "6.0 False"
