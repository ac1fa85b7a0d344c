"""Archives of arrays: reproducible, and read as a whole or refused in one sentence."""

from __future__ import annotations

import io
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fe.runtime.errors import ReducedModelFileError
from fe.runtime.kept_arrays import arrays_from_bytes, arrays_to_bytes

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


def refused(content: bytes, words: str = "not a sound archive of plain arrays") -> None:
    with pytest.raises(ReducedModelFileError, match=words) as caught:
        arrays_from_bytes(content, "x.npz", ["a"])
    assert "\n" not in str(caught.value)


def test_every_truncation_flipped_byte_and_lock_is_noticed() -> None:
    for length in range(0, len(WHOLE), 7):
        refused(WHOLE[:length])
    for place in range(len(WHOLE)):
        damaged = bytearray(WHOLE)
        damaged[place] ^= 0xFF
        with suppress(ReducedModelFileError):  # or it is a date of the archive, which means nothing here
            found = arrays_from_bytes(bytes(damaged), "x.npz", ["a"])
            np.testing.assert_array_equal(found["a"], np.arange(5))
    locked = bytearray(WHOLE)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.index(signature) + flags] |= 1
    refused(bytes(locked), "password")


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("'<f8'", "(1, "),
        ("'<f8'", "(-1,)"),
        ("'<f8'", "(4611686018427387904, 2)"),
        ("'<f8'", "(" + "9" * 5000 + ",)"),
        ("'|O'", "(1,)"),
        ("[" * 4000 + "]" * 4000, "(1,)"),
        ("'<f8'", "()"),
        ("'<q9'", "()"),
        (None, "\n" * 8),
    ],
)
def test_a_member_that_is_no_plain_array_is_one_sentence(kind: str | None, shape: str) -> None:
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}" if kind else shape
    text, content = header.encode("latin-1"), io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(16))
    refused(content.getvalue())
