"""Arrays in files, of every kind that is kept: reproducible, read to the last bit, or refused in words."""

import io
import zipfile
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fe.runtime import kept_arrays
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.kept_arrays import KeptArrays, arrays_from_bytes, arrays_to_bytes
from fe.runtime.reduced import ReducedModel
from tests.refusals import refused

KINDS = st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.dtype("U3")])
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
WHOLE = arrays_to_bytes({"a": np.arange(5)})


@given(hnp.arrays(dtype=KINDS, shape=SHAPES))
def test_archives_give_back_what_they_were_given(values: np.ndarray) -> None:
    content = arrays_to_bytes({"values": values, "text": np.array("µ"), "number": np.array(3.5)})
    with np.load(io.BytesIO(content), allow_pickle=False) as loaded:
        for arrays in (loaded, arrays_from_bytes(content, "It")):
            np.testing.assert_array_equal(arrays["values"], values)
            assert (arrays["values"].shape, arrays["values"].dtype) == (values.shape, values.dtype)
            assert (str(arrays["text"]), arrays["number"].shape) == ("µ", ())


def test_bytes_depend_on_the_arrays_only() -> None:
    values = np.arange(6.0).reshape(2, 3)
    first = arrays_to_bytes({"a": values, "b": values[0]})
    assert first == arrays_to_bytes({"b": values[0].copy(), "a": np.asfortranarray(values)})
    assert first != arrays_to_bytes({"a": values, "b": values[1]})
    with zipfile.ZipFile(io.BytesIO(first)) as archive:
        assert archive.namelist() == ["a.npy", "b.npy"]
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    with pytest.raises(ValueError, match="Object arrays"):
        arrays_to_bytes({"bad": np.array([object()])})


def refuses(content: bytes, words: str = "not a sound archive of plain arrays") -> None:
    with refused(ReducedModelFileError, words):
        arrays_from_bytes(content, "x.npz", ["a"])


def test_every_truncation_flipped_byte_and_lock_is_noticed() -> None:
    for length in range(0, len(WHOLE), 7):
        refuses(WHOLE[:length])
    for place in range(len(WHOLE)):
        damaged = bytearray(WHOLE)
        damaged[place] ^= 0xFF
        with suppress(ReducedModelFileError):  # or it is a date of the archive, which means nothing here
            found = arrays_from_bytes(bytes(damaged), "x.npz", ["a"])
            np.testing.assert_array_equal(found["a"], np.arange(5))
    locked = bytearray(WHOLE)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.index(signature) + flags] |= 1
    refuses(bytes(locked), "password")


def test_a_member_that_is_no_plain_array_is_one_sentence() -> None:
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
def kept(request: pytest.FixtureRequest) -> KeptArrays:
    found: KeptArrays = request.getfixturevalue(request.param)
    return found


def test_what_is_kept_comes_back_to_the_last_bit_or_is_refused(kept: KeptArrays, tmp_path) -> None:
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
    "value", [np.array(1.0), np.array("a"), np.zeros(5), np.zeros(0), np.zeros((0, 0, 0)), np.array(1j)]
)
def test_arrays_of_a_wrong_kind_are_refused(kept: KeptArrays, value: np.ndarray, monkeypatch) -> None:
    arrays = arrays_from_bytes(kept.to_bytes(), "it")
    for item in fields(kept):
        if item.type is str or (arrays[item.name].shape == value.shape == () and value.dtype.kind == "f"):
            continue
        given = {**arrays, item.name: value}
        monkeypatch.setattr(kept_arrays, "arrays_from_bytes", lambda *_, own=given: own)
        with pytest.raises(ReducedModelFileError):
            type(kept).from_bytes(b"")


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("static_load", lambda load: load * np.nan, "finite"),
        ("mode_count", lambda _: 0, "modes"),
        ("rounding_allowance", lambda _: -1.0, "rounding_allowance"),
        *((name, lambda rows: rows[:-1], "field basis") for name in ("points", "cells", "region")),
        *((f"{kind}_displacement", lambda rows: rows[:-1], "field basis") for kind in ("static", "modal")),
        ("load_tip", lambda _: np.full(3, np.nan), "array"),
        ("flap_spring", lambda _: 0.0, "flap_spring"),
        ("straight_chord_line", lambda _: 2.0, "straight_chord_line"),
        ("weight", lambda _: np.zeros(2), "weight"),
        ("strip_of", lambda strips: np.array([99, *strips[1:]]), "strips"),
        ("stations", lambda stations: stations[::-1].copy(), "stations that rise"),
    ],
)
def test_values_that_cannot_be_are_refused(
    coarse_fields: ReducedModel, coarse_patch_arrays, name: str, change: Any, sentence: str
) -> None:
    kept = coarse_fields if hasattr(coarse_fields, name) else coarse_patch_arrays
    with refused(ReducedModelFileError, sentence):
        replace(kept, **{name: change(getattr(kept, name))})
