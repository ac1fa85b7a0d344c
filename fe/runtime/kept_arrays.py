"""Records of arrays that live in one `.npz` file: checked where they are made, read back to the last bit.

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self, get_args

import numpy as np
import numpy.typing as npt

from .archive import arrays_from_bytes, arrays_to_bytes, require_arrays, write_bytes_atomically
from .errors import ReducedModelFileError


@dataclass(frozen=True, repr=False)
class KeptArrays:
    """Arrays and plain numbers that were made of one design; a kind of record is a subclass with its fields.

    An array is declared with its axes, `Annotated[FloatArray, "loads", 2]`: a number is the length, and a
    name means one length in all arrays, which `_lengths` or else the first array with that axis tells.

    Class attributes
    ----------------
    what : str
        What it is, with its article, for sentences.
    layout : (str, int) or None
        Name and value of the entry of the file that tells the version of its layout.

    Attributes
    ----------
    design_hash : str
        Hash of the design.
    """

    what: ClassVar[str]
    layout: ClassVar[tuple[str, int] | None] = None

    design_hash: str

    def __post_init__(self) -> None:
        lengths = self._lengths()
        for item in fields(self):
            axes: tuple[str | int, ...] = getattr(item.type, "__metadata__", ())
            if not axes:
                continue
            array, (kind,) = getattr(self, item.name), get_args(get_args(get_args(item.type)[0])[1])
            lengths = {**dict(zip(axes, array.shape, strict=False)), **lengths}
            expected = tuple(axis if isinstance(axis, int) else lengths.get(axis, 0) for axis in axes)
            if array.shape != expected or array.dtype != kind or not np.isfinite(array).all():
                raise ReducedModelFileError(
                    f"The array {item.name} of {self.what} must hold finite numbers in the shape "
                    f"{expected}, but it has shape {array.shape} and type {array.dtype}; build it anew."
                )

    def _lengths(self) -> dict[str | int, int]:
        """Return the lengths of axes that follow from others or from names."""
        return {}

    def to_bytes(self) -> bytes:
        """Return the bytes of an `.npz` file; equal records give equal bytes."""
        arrays: dict[str, npt.NDArray[Any]] = {}
        if self.layout is not None:
            arrays[self.layout[0]] = np.array(self.layout[1])
        for item in fields(self):
            if item.init:
                arrays[item.name] = np.array(getattr(self, item.name))
        return arrays_to_bytes(arrays)

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
        kept = [item for item in fields(cls) if item.init]
        layout = () if cls.layout is None else (cls.layout[0],)
        arrays = arrays_from_bytes(content, where, layout)
        if cls.layout is not None and arrays[cls.layout[0]].tolist() != cls.layout[1]:
            raise ReducedModelFileError(
                f"{where} has the format {arrays[cls.layout[0]]}, but this version reads {cls.layout[1]}; "
                "build it anew."
            )
        require_arrays(arrays, where, (item.name for item in kept))
        try:
            values: dict[str, Any] = {
                item.name: item.type(arrays[item.name])
                if item.type in (str, int, float)
                else arrays[item.name]
                for item in kept
            }
            return cls(**values)
        except (TypeError, ValueError, IndexError) as cause:
            raise ReducedModelFileError(
                f"{where} does not hold the arrays of {cls.what} ({cause}); build it anew."
            ) from cause

    def save(self, path: str | Path) -> None:
        """Write one `.npz` file, whole or not at all; `OSError` if that fails."""
        write_bytes_atomically(Path(path), self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote; raises `FileNotFoundError` or `ReducedModelFileError`."""
        return cls.from_bytes(Path(path).read_bytes(), str(path))
