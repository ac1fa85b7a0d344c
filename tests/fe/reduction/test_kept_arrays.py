"""What is kept: arrays in files, read to the last bit or refused; entries of the cache, built once; loops."""

import errno
import importlib
import io
import multiprocessing
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from threading import Timer
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
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
from fe.runtime import arrays as array_records
from fe.runtime.arrays import StoredArrays, arrays_from_bytes, arrays_to_bytes
from fe.runtime.errors import ReducedModelFileError
from fe.structure.tables import StructureSettings
from fe.wing.design import WingDesign
from tests.refusals import Inputs, refused

KINDS = st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.dtype("U3")])
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
WHOLE = arrays_to_bytes({"a": np.arange(5)})


@given(hnp.arrays(dtype=KINDS, shape=SHAPES))
def test_archives_give_back_what_they_were_given(values):
    content = arrays_to_bytes({"values": values, "text": np.array("µ"), "number": np.array(3.5)})
    with np.load(io.BytesIO(content), allow_pickle=False) as loaded:
        for arrays in (loaded, arrays_from_bytes(content, "It")):
            np.testing.assert_array_equal(arrays["values"], values)
            assert (arrays["values"].shape, arrays["values"].dtype) == (values.shape, values.dtype)
            assert (str(arrays["text"]), arrays["number"].shape) == ("µ", ())


def refuses(content: bytes, words: str = "not a sound archive of plain arrays") -> None:
    with refused(ReducedModelFileError, words):
        arrays_from_bytes(content, "x.npz", ["a"])


def test_every_truncation_flipped_byte_and_lock_is_noticed():
    for length in range(0, len(WHOLE), 7):
        refuses(WHOLE[:length])
    for place in range(len(WHOLE)):
        damaged = bytearray(WHOLE)
        damaged[place] ^= 0xFF
        with suppress(
            ReducedModelFileError
        ):  # or it is a date of the archive, which means nothing here
            found = arrays_from_bytes(bytes(damaged), "x.npz", ["a"])
            np.testing.assert_array_equal(found["a"], np.arange(5))
    locked = bytearray(WHOLE)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.index(signature) + flags] |= 1
    refuses(bytes(locked), "password")


def test_a_member_that_is_no_plain_array_is_one_sentence():
    for kind, shape in (
        ("'<f8'", "(1, "), ("'<f8'", "(-1,)"), ("'<f8'", "(4611686018427387904, 2)"),
        ("'<f8'", "(" + "9" * 5000 + ",)"), ("'|O'", "(1,)"), ("[" * 4000 + "]" * 4000, "(1,)"),
        ("'<f8'", "()"), ("'<q9'", "()"), (None, "\n" * 8),
    ):  # fmt: skip
        header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}" if kind else shape
        text, content = header.encode("latin-1"), io.BytesIO()
        with zipfile.ZipFile(content, "w") as archive:
            member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(16)
            archive.writestr("a.npy", member)
        refuses(content.getvalue())


# ---------------------------------------------------------------- what is kept in them


@pytest.fixture(scope="module", params=["model", "coarse_fields", "coarse_patch_arrays"])
def kept(request: pytest.FixtureRequest) -> StoredArrays:
    found: StoredArrays = request.getfixturevalue(request.param)
    return found


def test_what_is_kept_comes_back_to_the_last_bit_or_is_refused(kept, tmp_path):
    kind, path, content = type(kept), tmp_path / "kept.npz", kept.to_bytes()
    path.write_bytes(content)
    again = kind.load(path)
    for item in fields(kept):
        np.testing.assert_array_equal(getattr(again, item.name), getattr(kept, item.name))
    assert again.to_bytes() == content
    path.write_bytes(content[:1000])
    with refused(ReducedModelFileError, r"kept\.npz is not a sound archive"):
        kind.load(path)
    arrays = arrays_from_bytes(content, "it")
    for wrong, sentence in (
        ({name: array for name, array in arrays.items() if name != "regions"}, "lacks regions"),
        (arrays | {"format": np.array(99)}, "has the format 99"),
    ):
        with refused(ReducedModelFileError, sentence):
            kind.from_bytes(arrays_to_bytes(wrong))


@pytest.mark.parametrize(
    "value",
    [np.array(1.0), np.array("a"), np.zeros(5), np.zeros(0), np.zeros((0, 0, 0)), np.array(1j)],
)
def test_arrays_of_a_wrong_kind_are_refused(kept, value, monkeypatch):
    arrays = arrays_from_bytes(kept.to_bytes(), "it")
    for item in fields(kept):
        if item.type is str or (
            arrays[item.name].shape == value.shape == () and value.dtype.kind == "f"
        ):
            continue
        given = {**arrays, item.name: value}
        monkeypatch.setattr(array_records, "arrays_from_bytes", lambda *_, own=given: own)
        with pytest.raises(ReducedModelFileError):
            type(kept).from_bytes(b"")


SPOILT: dict[str, Callable[[Any], Any]] = {
    "nan": lambda values: values * np.nan,
    "zero": lambda values: 0 * values,
    "more": lambda values: values + 99,
    "less": lambda values: -1.0 - values,
    "short": lambda values: values[:-1],
    "turned": lambda values: values[::-1].copy(),
}


@pytest.mark.parametrize(("name", "how", "sentence"), Inputs(__file__).refused("values"))
def test_values_that_cannot_be_are_refused(coarse_fields, coarse_patch_arrays, name, how, sentence):
    kept = coarse_fields if hasattr(coarse_fields, name) else coarse_patch_arrays
    with refused(ReducedModelFileError, sentence):
        replace(kept, **{name: SPOILT[how](getattr(kept, name))})


# ---------------------------------------------------------------- the cache


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "uav-twin"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch, coarse_fields, coarse_patch_arrays) -> list[str]:
    """Names of the designs that were built; the builds themselves are replaced by finished ones."""
    built: list[str] = []

    def building(made: StoredArrays) -> Callable[..., StoredArrays]:
        def build(design: WingDesign, *_: object) -> StoredArrays:
            built.append(design.name)
            return replace(made, design_hash=design.hash)

        return build

    monkeypatch.setattr(model_cache, "build_fields", building(coarse_fields))
    monkeypatch.setattr(model_cache, "build_patch_arrays", building(coarse_patch_arrays))
    return built


def test_what_is_unchanged_is_built_once_and_what_is_changed_anew(
    builds, coarse_design, shipped_design, monkeypatch
):
    first, again, wing = (
        make(coarse_design.changed()) for make in (reduced_model, reduced_model, wing_fields)
    )
    assert builds == [coarse_design.name]
    assert first.to_bytes() == again.to_bytes() == wing.model.to_bytes()
    assert wing.static_displacement.shape[-1] == first.static_stiffness.shape[-1]
    changed = coarse_design.changed(skin={"thickness": 0.0007})
    for _ in range(2):
        assert reduced_model(changed).design_hash == changed.hash != coarse_design.hash
        reduced_model(coarse_design, settings=StructureSettings(bound_tolerance=1e-3))
        patch_arrays(coarse_design)
        assert reduced_model().design_hash == shipped_design.hash  # the default
    assert len(builds) == 5
    monkeypatch.setattr(model_cache, "modelling_hash", lambda: "another")
    reduced_model(coarse_design)
    assert len(builds) == 6


@pytest.mark.parametrize(
    ("kind", "make"), [("wing", reduced_model), ("fields", wing_fields), ("patches", patch_arrays)]
)
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "missing"])
def test_damaged_entry_is_built_anew(builds, coarse_design, caplog, kind, make, damage):
    good, path = make(coarse_design).to_bytes(), cache_file(kind, coarse_design.hash, None)
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[len(content) // 3] ^= 0x55
    path.write_bytes({"cut": content[: len(content) // 2], "flipped": content}.get(damage, b""))
    if damage == "missing":
        path.unlink()
    for _ in range(2):
        assert make(coarse_design).to_bytes() == good
    assert damage == "missing" or "built anew" in caplog.text
    assert len(builds) == 1 + (kind != "wing")  # the model alone is among the fields


def test_without_a_place_to_keep_it_the_model_is_still_given(
    builds, coarse_design, tmp_path, monkeypatch, caplog
):
    (tmp_path / "a file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))
    assert reduced_model(coarse_design).design_hash == coarse_design.hash
    assert "could not be kept" in caplog.text
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "uav-twin"


def test_every_file_that_shapes_the_model_counts_for_the_key():
    code = "import sys, fe.reduction.patch_basis; print(*(n for n in sys.modules if n.startswith('fe.')))"
    words = [sys.executable, "-c", code]
    result = subprocess.run(
        words, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3]
    )
    modules = {name.split(".")[1] for name in result.stdout.split()}
    assert modules - {"designs", "sentences"} == set(MODELLING_PACKAGES)


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


def ours(path: Path) -> str:
    return built_once(path, path.read_text, lambda: "ours", path.write_text)


def theirs(path: Path, began: Any, finish: Any) -> None:
    """Build in another process, until that is told."""

    def build() -> str:
        began.set()
        finish.wait(60.0)
        return "theirs"

    built_once(path, path.read_text, build, path.write_text)


@pytest.mark.parametrize("killed", [False, True])
def test_a_wait_is_said_and_ends_with_the_other(tmp_path, caplog, killed):
    """With what it made, or, where it was killed, with what is made here."""
    path, context = tmp_path / "cache" / "model.npz", multiprocessing.get_context("spawn")
    began, finish = context.Event(), context.Event()
    other = context.Process(target=theirs, args=(path, began, finish), daemon=True)
    other.start()
    assert began.wait(60.0)
    Timer(0.3, other.kill if killed else finish.set).start()
    assert ours(path) == path.read_text() == ("ours" if killed else "theirs")
    assert caplog.messages == [
        f"Waiting for another process (number {other.pid}) that makes {path}."
    ]
    other.join(60.0)


def test_a_full_disk_stops_no_build_and_a_build_that_fails_keeps_nothing(tmp_path, monkeypatch):
    def full(handle: int, content: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def failing() -> str:
        raise KeyboardInterrupt

    path = tmp_path / "model.npz"
    with pytest.raises(KeyboardInterrupt):
        built_once(path, path.read_text, failing, path.write_text)
    assert [left.suffix for left in tmp_path.iterdir()] == [".lock"]
    monkeypatch.setattr(os, "pwrite", full)
    assert ours(path) == "ours"


# ---------------------------------------------------------------- loops


def test_without_a_folder_for_the_cache_it_still_compiles(monkeypatch):
    assert compiled(lambda value: 2.0 * value)(3.0) == 6.0
    njit, asked = numba.njit, []

    def no_folder(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_folder)
    assert compiled(lambda value: 2.0 * value)(3.0) == 6.0
    assert [options.get("cache", False) for options in asked] == [True, False]


INNER = "from fe.compilation import compiled\nSTEP = {step}\n@compiled\ndef inner(x):\n    return x + {added}\n"
OUTER = (
    "from fe.compilation import compiled\nfrom inner import STEP, inner\n"
    "@compiled\ndef outer(x):\n    return STEP * inner(x)\n"
)


@pytest.mark.parametrize("change", [{"added": 5.0}, {"step": 7.0}])
def test_loops_are_kept_by_content_and_a_changed_source_never_meets_old_ones(
    tmp_path, monkeypatch, change
):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))

    def outer(**numbers: float) -> tuple[float, int]:
        """Write both modules; return what the outer gives for 1, and how often it compiled."""
        (tmp_path / "inner.py").write_text(INNER.format_map({"step": 1.0, "added": 1.0} | numbers))
        (tmp_path / "outer.py").write_text(OUTER)
        for name in ("inner", "outer"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        loop = importlib.import_module("outer").outer
        return loop(1.0), sum(loop.stats.cache_misses.values())

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    assert outer() == (2.0, 1)
    assert outer() == (2.0, 0)
    changed = change.get("step", 1.0) * (1.0 + change.get("added", 1.0))
    assert outer(**change) == (changed, 1)
    assert outer() == (2.0, 0)
