"""Records of arrays that live in one `.npz` file: checked where they are made, read back to the last bit.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from .archive import arrays_from_bytes, arrays_to_bytes, require_arrays, write_bytes_atomically
from .errors import ReducedModelFileError


@dataclass(frozen=True, repr=False)
class KeptArrays:
    """Arrays and plain numbers that were made of one design; a kind of record is a subclass with its fields.

    Class attributes
    ----------------
    what : str
        What it is, with its article, for sentences.
    layout : (str, int) or None
        Name and value of the entry of the file that tells the version of its layout.
    kinds : mapping of str to type
        Types of the arrays that are not of float64.

    Attributes
    ----------
    design_hash : str
        Hash of the design.
    """

    what: ClassVar[str]
    layout: ClassVar[tuple[str, int] | None] = None
    kinds: ClassVar[Mapping[str, type[Any]]] = {}

    design_hash: str

    def __post_init__(self) -> None:
        for name, expected in self._expected_shapes().items():
            array = getattr(self, name)
            kind = self.kinds.get(name, np.float64)
            if array.shape != expected or array.dtype != kind or not np.isfinite(array).all():
                raise ReducedModelFileError(
                    f"The array {name} of {self.what} must hold finite numbers in the shape {expected}, but "
                    f"it has shape {array.shape} and type {array.dtype}; build it anew."
                )

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape that each array must have."""
        raise NotImplementedError

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
