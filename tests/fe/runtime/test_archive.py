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


@given(
    hnp.arrays(
        dtype=st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.dtype("U3")]),
        shape=hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    )
)
def test_archives_give_back_what_they_were_given(values: np.ndarray) -> None:
    content = arrays_to_bytes({"values": values, "text": np.array("µ"), "number": np.array(3.5)})
    with np.load(io.BytesIO(content), allow_pickle=False) as loaded:
        for arrays in (loaded, arrays_from_bytes(content, "It")):
            np.testing.assert_array_equal(arrays["values"], values)
            assert arrays["values"].shape == values.shape
            assert arrays["values"].dtype == values.dtype
            assert str(arrays["text"]) == "µ"
            assert arrays["number"].shape == ()


def test_bytes_depend_on_the_arrays_only() -> None:
    values = np.arange(6.0).reshape(2, 3)
    first = arrays_to_bytes({"a": values, "b": values[0]})
    assert first == arrays_to_bytes({"b": values[0].copy(), "a": np.asfortranarray(values)})
    assert first != arrays_to_bytes({"a": values, "b": values[1]})
    with zipfile.ZipFile(io.BytesIO(first)) as archive:
        assert archive.namelist() == ["a.npy", "b.npy"]
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_objects_are_refused() -> None:
    with pytest.raises(ValueError, match="Object arrays"):
        arrays_to_bytes({"bad": np.array([object()])})


def refused(content: bytes, words: str = "not a sound archive of plain arrays") -> None:
    with pytest.raises(ReducedModelFileError, match=words) as caught:
        arrays_from_bytes(content, "x.npz", ["a"])
    assert "\n" not in str(caught.value)


def test_every_truncation_and_every_flipped_byte_is_noticed() -> None:
    whole = arrays_to_bytes({"a": np.arange(5)})
    for length in range(0, len(whole), 7):
        refused(whole[:length])
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        with suppress(ReducedModelFileError):  # or it is a date of the archive, which means nothing here
            found = arrays_from_bytes(bytes(damaged), "x.npz", ["a"])
            np.testing.assert_array_equal(found["a"], np.arange(5))


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1, }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904, 2)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 5000 + ",)}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': " + "[" * 4000 + "]" * 4000 + ", 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': ()}",
        "{'descr': '<q9', 'fortran_order': False, 'shape': ()}",
        "\n" * 8,
    ],
)
def test_a_member_that_is_no_plain_array_is_one_sentence(header: str) -> None:
    text = header.encode("latin-1")
    member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(16)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("a.npy", member)
    refused(content.getvalue())


def test_a_locked_archive_is_one_sentence() -> None:
    whole = bytearray(arrays_to_bytes({"a": np.arange(5)}))
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.index(signature) + flags] |= 1
    refused(bytes(whole), "password")
