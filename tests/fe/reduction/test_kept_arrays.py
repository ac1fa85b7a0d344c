"""Arrays in files: read to the last bit, or refused in a sentence."""

import io
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fe.runtime import arrays as array_records
from fe.runtime.arrays import StoredArrays, arrays_from_bytes, arrays_to_bytes
from fe.runtime.errors import ReducedModelFileError
from tests.refusals import Inputs, refused

# ---------------------------------------------------------------- archives

TYPES = st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.dtype("U3")])
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
ARCHIVE = arrays_to_bytes({"a": np.arange(5)})


@given(hnp.arrays(dtype=TYPES, shape=SHAPES))
def test_archives_give_back_what_they_were_given(values):
    """To us and to NumPy."""
    content = arrays_to_bytes({"values": values, "text": np.array("µ"), "number": np.array(3.5)})

    assert_holds(arrays_from_bytes(content, "It"), values)
    with np.load(io.BytesIO(content), allow_pickle=False) as loaded:
        assert_holds(loaded, values)


def assert_holds(arrays: Any, values: Any) -> None:
    """Assert that an archive has values, a text and a number."""
    np.testing.assert_array_equal(arrays["values"], values)
    assert (arrays["values"].shape, arrays["values"].dtype) == (values.shape, values.dtype)
    assert (str(arrays["text"]), arrays["number"].shape) == ("µ", ())


def assert_archive_refused(
    content: bytes, sentence: str = "not a valid archive of plain arrays"
) -> None:
    with refused(ReducedModelFileError, sentence):
        arrays_from_bytes(content, "x.npz", ["a"])


@pytest.mark.parametrize("length", range(0, len(ARCHIVE), 7))
def test_a_truncation_is_noticed(length):
    assert_archive_refused(ARCHIVE[:length])


def test_every_flipped_byte_is_noticed():
    """Or it is a date of the archive, which means nothing here."""
    for position in range(len(ARCHIVE)):
        damaged = bytearray(ARCHIVE)
        damaged[position] ^= 0xFF
        with suppress(ReducedModelFileError):
            arrays = arrays_from_bytes(bytes(damaged), "x.npz", ["a"])
            np.testing.assert_array_equal(arrays["a"], np.arange(5))


def test_an_archive_with_a_password_is_refused():
    locked = bytearray(ARCHIVE)
    for signature, offset_of_flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.index(signature) + offset_of_flags] |= 1

    assert_archive_refused(bytes(locked), "password")


def header_of(kind: str, shape: str) -> str:
    """Return the header of an array in the format of NumPy."""
    return f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}"


BAD_HEADERS = {
    "an unfinished shape": header_of("'<f8'", "(1, "),
    "a negative shape": header_of("'<f8'", "(-1,)"),
    "too large a shape": header_of("'<f8'", "(4611686018427387904, 2)"),
    "a shape of 5000 digits": header_of("'<f8'", "(" + "9" * 5000 + ",)"),
    "Python objects": header_of("'|O'", "(1,)"),
    "a nested type": header_of("[" * 4000 + "]" * 4000, "(1,)"),
    "more bytes than its shape": header_of("'<f8'", "()"),
    "an unknown type": header_of("'<q9'", "()"),
    "no header": "\n" * 8,
}


@pytest.mark.parametrize("name", BAD_HEADERS)
def test_a_member_that_is_no_plain_array_is_one_sentence(name):
    header = BAD_HEADERS[name].encode("latin-1")
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(16)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("a.npy", member)

    assert_archive_refused(content.getvalue())


# ---------------------------------------------------------------- records of arrays


@pytest.fixture(scope="module", params=["model", "coarse_fields", "coarse_patch_arrays"])
def record(request: pytest.FixtureRequest) -> StoredArrays:
    """A record that is kept in files."""
    stored: StoredArrays = request.getfixturevalue(request.param)
    return stored


def test_a_record_comes_back_to_the_last_bit(record, tmp_path):
    path = tmp_path / "kept.npz"
    path.write_bytes(record.to_bytes())

    read = type(record).load(path)

    for field in fields(record):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(record, field.name))
    assert read.to_bytes() == record.to_bytes()


def test_a_truncated_record_is_refused_with_its_file(record, tmp_path):
    path = tmp_path / "kept.npz"
    path.write_bytes(record.to_bytes()[:1000])

    with refused(ReducedModelFileError, r"kept\.npz is not a valid archive"):
        type(record).load(path)


def test_a_record_that_lacks_an_array_is_refused(record):
    arrays = arrays_from_bytes(record.to_bytes(), "it")
    others = {name: array for name, array in arrays.items() if name != "regions"}

    with refused(ReducedModelFileError, "lacks regions"):
        type(record).from_bytes(arrays_to_bytes(others))


def test_a_record_of_another_format_is_refused(record):
    arrays = arrays_from_bytes(record.to_bytes(), "it")
    of_another_format = arrays | {"format": np.array(99)}

    with refused(ReducedModelFileError, "has the format 99"):
        type(record).from_bytes(arrays_to_bytes(of_another_format))


@pytest.mark.parametrize(
    "value",
    [
        np.array(1.0),
        np.array("a"),
        np.zeros(5),
        np.zeros(0),
        np.zeros((0, 0, 0)),
        np.array(1j),
    ],
)
def test_arrays_of_a_wrong_kind_are_refused(record, value, monkeypatch):
    arrays = arrays_from_bytes(record.to_bytes(), "it")
    for field in fields(record):
        is_number = arrays[field.name].shape == value.shape == () and value.dtype.kind == "f"
        if field.type is str or is_number:
            continue
        changed = {**arrays, field.name: value}
        monkeypatch.setattr(array_records, "arrays_from_bytes", lambda *_, changed=changed: changed)

        with pytest.raises(ReducedModelFileError):
            type(record).from_bytes(b"")


SPOILERS: dict[str, Callable[[Any], Any]] = {
    "nan": lambda values: values * np.nan,
    "zero": lambda values: 0 * values,
    "more": lambda values: values + 99,
    "less": lambda values: -1.0 - values,
    "short": lambda values: values[:-1],
    "turned": lambda values: values[::-1].copy(),
}


@pytest.mark.parametrize(("name", "spoiler", "sentence"), Inputs(__file__).refused("values"))
def test_impossible_values_are_refused(coarse_fields, coarse_patch_arrays, name, spoiler, sentence):
    record = coarse_fields if hasattr(coarse_fields, name) else coarse_patch_arrays
    spoilt = SPOILERS[spoiler](getattr(record, name))

    with refused(ReducedModelFileError, sentence):
        replace(record, **{name: spoilt})
