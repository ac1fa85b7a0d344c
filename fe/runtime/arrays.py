"""Array types, columns of a law's memory, and records of arrays that are stored as `.npz` files.

A record is checked where it is made and read back to the last bit. Its file has reproducible bytes
and holds no pickled objects. NumPy and relative imports only: this file is copied into the FMU.
"""

import io
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field, dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar, Self, get_args

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError
from .state import MOST_REGIONS, Losses, LossValues, losses_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
AnyArray = npt.NDArray[Any]

STUCK, POSITION, LAGGED_FORCE, FADING_POSITION, FORCE, FIRST_ELEMENT = range(6)
"""Columns of a law's memory, see `laws.interface`; from `FIRST_ELEMENT` on its hysteretic
elements."""


def nan_where_masked(values: npt.ArrayLike) -> FloatArray:
    """Return values as an array; a masked array becomes floats, with NaN where masked."""
    if isinstance(values, np.ma.MaskedArray):
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))
    return np.asarray(values)


_TIMESTAMP = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip archive can hold


def arrays_to_bytes(arrays: Mapping[str, AnyArray]) -> bytes:
    """Return the bytes of an `.npz` archive; equal arrays give equal bytes everywhere.

    It is not compressed, since compressed bytes depend on the version of zlib.

    Raises
    ------
    ValueError
        If an array holds Python objects, which would need pickle.
    """
    members = {}
    for name, array in arrays.items():
        content = io.BytesIO()
        np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
        members[f"{name}.npy"] = content.getvalue()
    return archive_bytes(members)


def archive_bytes(members: Mapping[str, bytes], first: str = "") -> bytes:
    """Return the bytes of an uncompressed zip archive whose dates and order are fixed.

    Parameters
    ----------
    members : mapping of str to bytes
        The files of the archive by name.
    first : str
        Name of the file that comes first; the others are sorted.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(members, key=lambda name: (name != first, name)):
            entry = zipfile.ZipInfo(name, date_time=_TIMESTAMP)
            entry.create_system = 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, members[name])
    return buffer.getvalue()


def arrays_from_bytes(
    content: bytes, where: str, required: Collection[str] = ()
) -> dict[str, AnyArray]:
    """Return the arrays of an `.npz` archive by name, after checking its checksums.

    `where` is the name of the source in error messages; `required` are names that must be there.

    Raises
    ------
    ReducedModelFileError
        If the archive is damaged, cut short, lacks an array or holds anything but plain arrays.
    """
    arrays: dict[str, AnyArray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.namelist():
                member = io.BytesIO(archive.read(entry))
                array = np.lib.format.read_array(member, allow_pickle=False)
                arrays[entry.removesuffix(".npy")] = array
                if member.read(1):
                    raise ValueError("bytes follow an array")
    except Exception as cause:  # zipfile and NumPy answer damage with nearly every exception
        reason = " ".join(str(cause).split()) or type(cause).__name__
        raise ReducedModelFileError(
            f"{where} is not a valid archive of plain arrays ({reason}); delete it and build it "
            "again."
        ) from cause
    missing_names = [name for name in required if name not in arrays]
    if missing_names:
        raise ReducedModelFileError(f"{where} lacks {', '.join(missing_names)}; build it again.")
    return arrays


@dataclass(frozen=True, repr=False)
class StoredArrays:
    """A checked record of arrays and numbers of one design, stored as an `.npz` file.

    A subclass declares the fields. An array is declared with the lengths of its axes,
    `Annotated[FloatArray, "loads", 2]`. A number is the length itself; a name stands for one length
    in all arrays of the record, given by `_axis_lengths` or else by the first array with that axis.
    A number may be declared with its least and largest value, `Annotated[float, 0.0, 1.0]`. A tuple
    holds names.

    Class attributes
    ----------------
    record_name : str
        The noun of the record, with its article, for messages.
    version : int
        Version of the layout of its file.

    Attributes
    ----------
    regions : tuple of str
        Names of the K damage regions, 1 to 8, in the order of their stiffness terms.

    Raises
    ------
    ReducedModelFileError
        If an array has another shape or type than declared, or a number is out of its range.
    """

    record_name: ClassVar[str]
    version: ClassVar[int]

    design_hash: str
    regions: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 1 <= len(self.regions) <= MOST_REGIONS:
            raise self._error(
                f"must have 1 to {MOST_REGIONS} damage regions, but names {len(self.regions)}"
            )
        lengths = self._axis_lengths()
        for field in fields(self):
            declared: tuple[str | int | float, ...] = getattr(field.type, "__metadata__", ())
            if not declared:
                continue
            if get_args(field.type)[0] is float:
                self._check_range(field, declared)
            else:
                self._check_shape(field, declared, lengths)

    def _check_range(self, field: Field[object], limits: tuple[str | int | float, ...]) -> None:
        """Raise `ReducedModelFileError` unless a number lies within its declared limits."""
        value = getattr(self, field.name)
        low, high = map(float, limits)
        if not (isfinite(value) and low <= value <= high):
            raise self._error(
                f"must have a {field.name} between {low:.2g} and {high:g}, but has {value!r}"
            )

    def _check_shape(
        self,
        field: Field[object],
        axes: tuple[str | int | float, ...],
        lengths: dict[str, int],
    ) -> None:
        """Raise `ReducedModelFileError` unless an array fits its declaration and is finite.

        `axes` are the declared lengths, or names of lengths that several arrays share. `lengths`
        has the known lengths by name; those that this array is the first to have are added.
        """
        array = getattr(self, field.name)
        (dtype,) = get_args(get_args(get_args(field.type)[0])[1])
        for axis, length in zip(axes, array.shape, strict=False):
            if isinstance(axis, str):
                lengths.setdefault(axis, length)
        shape = tuple(lengths.get(axis, 0) if isinstance(axis, str) else axis for axis in axes)
        if array.shape != shape or array.dtype != dtype or not np.isfinite(array).all():
            raise self._error(
                f"must hold finite numbers in shape {shape} in its array {field.name}, but that "
                f"has shape {array.shape} and type {array.dtype}"
            )

    def __repr__(self) -> str:
        values = self.field_values()
        plain_values = [
            f"{name}={value!r}"
            for name, value in values.items()
            if not isinstance(value, np.ndarray)
        ]
        return f"{type(self).__name__}({', '.join(plain_values)})"

    def _error(self, fault: str) -> ReducedModelFileError:
        """Return the error for an inconsistent record; `fault` completes the sentence."""
        name = f"{self.record_name[0].upper()}{self.record_name[1:]}"
        return ReducedModelFileError(f"{name} {fault}; build it again.")

    def field_values(self, record: "type[StoredArrays] | None" = None) -> dict[str, Any]:
        """Return the values of the fields by name: of all, or of those that a base class has."""
        return {field.name: getattr(self, field.name) for field in fields(record or self)}

    def losses(self, stiffness_loss: LossValues) -> Losses:
        """Return one stiffness loss for each region; see `fe.runtime.state.losses_of`."""
        return losses_of(stiffness_loss, self.regions)

    def _axis_lengths(self) -> dict[str, int]:
        """Return the lengths of axes that follow from other fields."""
        return {}

    def to_bytes(self) -> bytes:
        """Return the bytes of an `.npz` file; equal records give equal bytes."""
        arrays: dict[str, AnyArray] = {"format": np.array(self.version)}
        for name, value in self.field_values().items():
            if isinstance(value, tuple):
                arrays[name] = np.array(value, dtype=np.str_)  # also of no names at all
            else:
                arrays[name] = np.array(value)
        return arrays_to_bytes(arrays)

    @classmethod
    def from_bytes(cls, content: bytes, where: str = "") -> Self:
        """Return the record that `to_bytes` packed, equal to the last bit.

        `where` is the name of the source in error messages.

        Raises
        ------
        ReducedModelFileError
            If the archive is damaged, incomplete or of another layout.
        """
        where = where or f"The {cls.record_name.removeprefix('a ')}"
        arrays = arrays_from_bytes(content, where, ["format"])
        if arrays["format"].tolist() != cls.version:
            raise ReducedModelFileError(
                f"{where} has the format {arrays['format']}, but this version reads {cls.version}; "
                "build it again."
            )
        try:
            values = {field.name: _value_from_array(field, arrays) for field in fields(cls)}
            return cls(**values)
        except KeyError as missing:
            raise ReducedModelFileError(
                f"{where} lacks {missing.args[0]}; build it again."
            ) from missing
        except (TypeError, ValueError, IndexError) as cause:
            raise ReducedModelFileError(
                f"{where} does not hold the arrays of {cls.record_name} ({cause}); build it again."
            ) from cause

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a record from a file.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ReducedModelFileError
            If the file is damaged, incomplete or of another layout.
        """
        return cls.from_bytes(Path(path).read_bytes(), str(path))


def _value_from_array(field: Field[object], arrays: Mapping[str, AnyArray]) -> Any:
    """Convert a stored array to the type of a field: a number, text, names or an array.

    Raises `KeyError` if it is missing, and `TypeError` or `ValueError` if it cannot be converted.
    """
    array = arrays[field.name]
    declared_type = getattr(field.type, "__origin__", field.type)
    convert = _CONVERSIONS.get(declared_type)
    return array if convert is None else convert(array)


def _names_from_array(array: AnyArray) -> tuple[str, ...]:
    """Return the names in an array of text; raise `ValueError` for any other array."""
    if array.dtype.kind != "U" or array.ndim != 1:
        raise ValueError(f"names are expected, not {array.dtype} of shape {array.shape}")
    return tuple(array.tolist())


_CONVERSIONS: Mapping[object, Callable[[AnyArray], object]] = {
    str: str,
    int: int,
    float: float,
    tuple: _names_from_array,
}
"""Conversions of stored arrays to the values of fields that are not arrays, by their type."""
