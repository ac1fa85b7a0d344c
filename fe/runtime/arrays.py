"""Types of arrays, columns of one, and records of arrays that live in one `.npz` file.

Records are checked where they are made and read back to the last bit; the file has reproducible bytes, and
nothing in it is pickled. NumPy and relative imports only: this file is copied into the FMU.
"""

import io
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self, get_args

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError
from .state import MOST_REGIONS, GivenLosses, Losses, losses_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

HELD, PLACE, LAGGED, FADING, FORCE, HEAD = range(6)
"""Columns of a law's memory, see `laws.interface`; from `HEAD` on its hysteretic elements."""


_TIMESTAMP = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip archive can hold


def _names(array: npt.NDArray[Any]) -> tuple[str, ...]:
    if array.dtype.kind != "U" or array.ndim != 1:
        raise ValueError(f"names are wanted, not {array.dtype} of shape {array.shape}")
    return tuple(array.tolist())


KINDS: Mapping[object, Callable[[Any], Any]] = {str: str, int: int, float: float, tuple: _names}
"""What makes the value of a field that is no array, by its type, of the array that a file has of it."""


def arrays_to_bytes(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return the bytes of an `.npz` archive; equal arrays give equal bytes on every machine and day.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        The arrays by name; object arrays are refused (they would need pickle).

    Returns
    -------
    bytes
        The archive: not compressed, since the result of a compression depends on the library's version.

    Raises
    ------
    ValueError
        If an array holds Python objects.
    """
    members = {}
    for name, array in arrays.items():
        content = io.BytesIO()
        np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
        members[f"{name}.npy"] = content.getvalue()
    return archive_bytes(members)


def archive_bytes(members: Mapping[str, bytes], first: str = "") -> bytes:
    """Return a zip archive with fixed dates and order; stored, since compression differs between versions."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(members, key=lambda name: (name != first, name)):
            entry = zipfile.ZipInfo(name, date_time=_TIMESTAMP)
            entry.create_system = 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, members[name])
    return buffer.getvalue()


def arrays_from_bytes(
    content: bytes, where: str, wanted: Collection[str] = ()
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an `.npz` archive, checksums verified.

    Parameters
    ----------
    content : bytes
        The archive.
    where : str
        What is being read, for the error message.
    wanted : collection of str
        Names that must be there.

    Returns
    -------
    dict of str to ndarray
        The arrays by name.

    Raises
    ------
    ReducedModelFileError
        If the archive is damaged, cut short, lacks an array or holds anything but plain arrays.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.namelist():
                member = io.BytesIO(archive.read(entry))
                arrays[entry.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                if member.read(1):
                    raise ValueError("bytes follow an array")
    except Exception as cause:  # zipfile and NumPy answer damage with nearly every exception that there is
        reason = " ".join(str(cause).split()) or type(cause).__name__
        raise ReducedModelFileError(
            f"{where} is not a sound archive of plain arrays ({reason}); delete it and build it anew."
        ) from cause
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise ReducedModelFileError(f"{where} lacks {', '.join(missing)}; build it anew.")
    return arrays


@dataclass(frozen=True, repr=False)
class KeptArrays:
    """Arrays and plain numbers that were made of one design with K damage regions, 1 to 8.

    A kind of record is a subclass with its fields. An array is declared with its axes,
    `Annotated[FloatArray, "loads", 2]`: a number is the length, and a name means one length in all arrays,
    which `_lengths` or else the first array with that axis tells. A number may be declared with its least and
    largest value, `Annotated[float, 0.0, 1.0]`. A tuple holds names.

    Class attributes
    ----------------
    what : str
        What it is, with its article, for sentences.
    version : int
        Version of the layout of its file.

    Attributes
    ----------
    design_hash : str
        Hash of the design.
    regions : tuple of str
        Names of the damage regions in the order of their stiffness terms.
    """

    what: ClassVar[str]
    version: ClassVar[int]

    design_hash: str
    regions: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 1 <= len(self.regions) <= MOST_REGIONS:
            self.refuse(f"must have 1 to {MOST_REGIONS} damage regions, but names {len(self.regions)}")
        lengths = self._lengths()
        for item in fields(self):
            axes: tuple[str | int, ...] = getattr(item.type, "__metadata__", ())
            if not axes:
                continue
            array, number = getattr(self, item.name), get_args(item.type)[0]
            if number is float:
                low, high = map(float, axes)
                if not (isfinite(array) and low <= array <= high):
                    self.refuse(f"must have a {item.name} between {low:.2g} and {high:g}, but has {array!r}")
                continue
            (kind,) = get_args(get_args(number)[1])
            lengths = {**dict(zip(axes, array.shape, strict=False)), **lengths}
            expected = tuple(axis if isinstance(axis, int) else lengths.get(axis, 0) for axis in axes)
            if array.shape != expected or array.dtype != kind or not np.isfinite(array).all():
                self.refuse(
                    f"must hold finite numbers in shape {expected} in its array {item.name}, but that has "
                    f"shape {array.shape} and type {array.dtype}"
                )

    def __repr__(self) -> str:
        told = ((item.name, getattr(self, item.name)) for item in fields(self))
        plain = (f"{name}={value!r}" for name, value in told if not isinstance(value, np.ndarray))
        return f"{type(self).__name__}({', '.join(plain)})"

    def refuse(self, fault: str) -> NoReturn:
        """Refuse a record that cannot be: `fault` says what is wrong with it."""
        raise ReducedModelFileError(f"{self.what[0].upper()}{self.what[1:]} {fault}; build it anew.")

    def losses(self, stiffness_loss: GivenLosses) -> Losses:
        """Return one stiffness loss for each region, in their order; see `fe.runtime.state.losses_of`."""
        return losses_of(stiffness_loss, self.regions)

    def _lengths(self) -> dict[str | int, int]:
        """Return the lengths of axes that follow from others or from names."""
        return {}

    def to_bytes(self) -> bytes:
        """Return the bytes of an `.npz` file; equal records give equal bytes."""
        values = {"format": self.version, **{item.name: getattr(self, item.name) for item in fields(self)}}
        kinds = {tuple: np.str_}  # also of no names at all
        return arrays_to_bytes(
            {name: np.array(value, dtype=kinds.get(type(value))) for name, value in values.items()}
        )

    @classmethod
    def from_bytes(cls, content: bytes, where: str = "") -> Self:
        """Return the record that `to_bytes` packed, equal to the last bit.

        Parameters
        ----------
        content : bytes
            An `.npz` archive.
        where : str
            What is being read, for the error message.

        Raises
        ------
        ReducedModelFileError
            If the archive is damaged, incomplete or of another layout.
        """
        where = where or f"The {cls.what.removeprefix('a ')}"
        arrays = arrays_from_bytes(content, where, ["format"])
        if arrays["format"].tolist() != cls.version:
            raise ReducedModelFileError(
                f"{where} has the format {arrays['format']}, but this version reads {cls.version}; build it "
                "anew."
            )
        try:
            values: dict[str, Any] = {
                item.name: KINDS[kind](arrays[item.name]) if kind in KINDS else arrays[item.name]
                for item in fields(cls)
                for kind in (getattr(item.type, "__origin__", item.type),)
            }
            return cls(**values)
        except KeyError as missing:
            raise ReducedModelFileError(f"{where} lacks {missing.args[0]}; build it anew.") from missing
        except (TypeError, ValueError, IndexError) as cause:
            raise ReducedModelFileError(
                f"{where} does not hold the arrays of {cls.what} ({cause}); build it anew."
            ) from cause

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file of `to_bytes`; raises `FileNotFoundError` or `ReducedModelFileError`."""
        return cls.from_bytes(Path(path).read_bytes(), str(path))
