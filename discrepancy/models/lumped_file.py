"""A lumped model as a TOML file: matrices, named vectors and calibrated parameters, checked strictly."""

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from discrepancy.errors import ModelError
from discrepancy.models.model_file import (
    ModelDescription,
    Name,
    NotNegative,
    Number,
    ParameterSection,
    Positive,
    Section,
    check_unique,
)
from reporting.section import checked, shown
from reporting.toml_file import read_toml
from reporting.words import counted

FloatArray = NDArray[np.float64]

SHIPPED_MODELS = Path(__file__).parents[1] / "lumped_models"
"""Models that come with the package, by file name without the ending."""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _numbers(value: object) -> tuple[float, ...]:
    """Return one number, or a list of them, as numbers: with one unknown nobody needs brackets."""
    found = value if isinstance(value, list | tuple) else (value,)
    if not found or not all(_is_number(item) for item in found):
        raise ValueError(
            f"a list of finite numbers such as [1.0, 0.0] is expected, or one number, but {shown(value)} came"
        )
    return tuple(float(item) for item in found)


def _matrix(value: object) -> tuple[tuple[float, ...], ...] | tuple[float, ...]:
    """Return a matrix by rows, a diagonal, or one number as what it is."""
    if isinstance(value, list | tuple) and value and all(isinstance(row, list | tuple) for row in value):
        if all(row and all(_is_number(item) for item in row) for row in value):
            return tuple(tuple(float(item) for item in row) for row in value)
    elif not isinstance(value, list | tuple) or value:
        found = value if isinstance(value, list | tuple) else (value,)
        if all(_is_number(item) for item in found):
            return tuple(float(item) for item in found)
    raise ValueError(
        "a matrix of finite numbers by rows such as [[2.0, -1.0], [-1.0, 2.0]] is expected, or its diagonal, "
        f"or one number, but {shown(value)} came"
    )


Vector = Annotated[tuple[Number, ...], BeforeValidator(_numbers)]
Matrix = Annotated[tuple[tuple[Number, ...], ...] | tuple[Number, ...], BeforeValidator(_matrix)]


Ratio = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=3.0)]
"""Share of critical damping; overdamped modes are carried, but far above one a percentage was meant."""


class Damping(Section):
    """`[damping]`: exactly one of modal ratios, a matrix, or Rayleigh coefficients alpha M + beta K."""

    ratios: Annotated[tuple[Ratio, ...], BeforeValidator(_numbers)] | None = None
    matrix: Matrix | None = None
    alpha: NotNegative | None = None
    beta: NotNegative | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        rayleigh = self.alpha is not None or self.beta is not None
        if sum((self.ratios is not None, self.matrix is not None, rayleigh)) != 1:
            raise ValueError("give exactly one of ratios, matrix, or alpha and beta")
        return self


class PartSection(Section):
    """`[[mass_part]]`, `[[stiffness_part]]`: a part that a parameter can scale, added to the base matrix."""

    name: Name
    matrix: Matrix


class NamedVector(Section):
    """A row of the unknowns with a name."""

    name: Name
    vector: Vector


class InputSection(NamedVector):
    """`[[input]]`: where a force acts, and how the vector changes when its place moves [1/m]."""

    station_derivative: Vector | None = None
    chord_derivative: Vector | None = None


class OutputSection(NamedVector):
    """`[[output]]`: what can be measured; velocity and acceleration come from a displacement."""

    quantity: Literal["displacement", "strain", "signal"] = "displacement"


class PortSection(NamedVector):
    """`[[port]]`: where an internal force can act, between the structure and the ground or within it."""


class PlaceSection(NamedVector):
    """`[[place]]`: where a mass can sit; places with a station [m] make a line along the structure."""

    station: Number


class RootSection(Section):
    """`[root]`: motion of the unknowns when the root turns by one radian as a rigid body [m/rad]."""

    lever: Vector


class ScaledParameter(ParameterSection):
    """`[[parameter]]`: a factor of the terms named."""

    terms: Name | tuple[Name, ...]
    mean: Number = 1.0

    @property
    def scaled(self) -> tuple[str, ...]:
        """Names of the terms."""
        return (self.terms,) if isinstance(self.terms, str) else self.terms

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        if not 0.0 < self.low <= self.mean <= self.high:
            raise ValueError("a factor needs 0 < low <= mean <= high")
        return self


class LumpedDescription(ModelDescription):
    """Content of a lumped model's file; vectors have as many entries as the mass matrix has rows, n.

    Attributes
    ----------
    format : int
        1.
    name : str
        For people.
    mass, stiffness : (n, n) matrix, (n,) vector of a diagonal, or for n = 1 a number
        SI.
    damping : Damping
        See there.
    characteristic_length : float, optional
        L [m]; by default the largest station, or 1.
    """

    mass: Matrix
    stiffness: Matrix
    damping: Damping
    characteristic_length: Positive | None = None
    mass_part: tuple[PartSection, ...] = ()
    stiffness_part: tuple[PartSection, ...] = ()
    input: tuple[InputSection, ...] = Field(min_length=1)
    output: tuple[OutputSection, ...] = Field(min_length=1)
    port: tuple[PortSection, ...] = ()
    place: tuple[PlaceSection, ...] = ()
    root: RootSection | None = None
    parameter: tuple[ScaledParameter, ...] = ()

    @property
    def size(self) -> int:
        """Unknowns n."""
        return len(self.mass)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        self._check_matrices()
        for kind, items in (
            ("input", self.input),
            ("output", self.output),
            ("port", self.port),
            ("place", self.place),
        ):
            self._check_vectors(kind, items)
        self._check_root_and_ratios()
        self._check_parameters()
        return self

    def _check_matrices(self) -> None:
        """Refuse matrices of another size, that are not symmetric, feed energy or leave something loose."""
        n = self.size
        matrices = [("mass", self.mass), ("stiffness", self.stiffness)]
        matrices += [(f"mass_part {part.name!r}", part.matrix) for part in self.mass_part]
        matrices += [(f"stiffness_part {part.name!r}", part.matrix) for part in self.stiffness_part]
        if self.damping.matrix is not None:
            matrices.append(("damping.matrix", self.damping.matrix))
        for where, content in matrices:
            lengths = {len(row) for row in content if isinstance(row, tuple)}
            if len(content) != n or (lengths and lengths != {n}):
                raise ValueError(
                    f"{where} must be a {n} x {n} matrix (or {counted(n, 'diagonal value')}), as mass has "
                    f"{counted(n, 'row')}"
                )
            full = matrix_of(content)
            size = float(np.max(np.abs(full)))
            if np.max(np.abs(full - full.T)) > 1e-9 * max(size, 1e-300):
                raise ValueError(f"{where} must be symmetric")
            if where == "damping.matrix" and np.min(np.linalg.eigvalsh(full)) < -1e-9 * size:
                raise ValueError(f"{where} must not feed energy: it has a negative eigenvalue")
        for where, base, added, why in (
            ("mass", self.mass, self.mass_part, ""),
            (
                "stiffness",
                self.stiffness,
                self.stiffness_part,
                "; a structure that can float away has no static response",
            ),
        ):
            whole = matrix_of(base) + sum((matrix_of(part.matrix) for part in added), np.zeros((n, n)))
            if np.min(np.linalg.eigvalsh(whole)) <= 0.0:
                raise ValueError(f"{where} (with its parts) must be positive definite{why}")

    def _check_vectors(self, kind: str, items: Sequence[NamedVector]) -> None:
        """Refuse vectors of another length, zero ones and names that are there twice."""
        n = self.size
        for item in items:
            for key in ("vector", "station_derivative", "chord_derivative"):
                vector = getattr(item, key, None)
                if vector is not None and len(vector) != n:
                    came = counted(len(vector), "entry", "entries")
                    raise ValueError(
                        f"{key} of {kind} {item.name!r} has {came}, but the model has {counted(n, 'unknown')}"
                    )
            if not any(item.vector):
                raise ValueError(f"vector of {kind} {item.name!r} is zero")
        check_unique(kind, [item.name for item in items])

    def _check_root_and_ratios(self) -> None:
        n = self.size
        if self.root is not None and (len(self.root.lever) != n or not any(self.root.lever)):
            raise ValueError(f"lever of root needs {counted(n, 'entry', 'entries')}, not all zero")
        if self.damping.ratios is not None and len(self.damping.ratios) != n:
            came = counted(len(self.damping.ratios), "value")
            raise ValueError(f"damping.ratios needs one value for each mode, {n} in all, but {came} came")

    def _check_parameters(self) -> None:
        check_unique("place station", [f"{place.station:g}" for place in self.place])
        parts = [part.name for part in (*self.mass_part, *self.stiffness_part)]
        check_unique("part", [*parts, "mass", "stiffness", "damping"])
        check_unique("parameter", [item.name for item in self.parameter])
        for parameter in self.parameter:
            for term in parameter.scaled:
                if term not in ("mass", "stiffness", "damping", *parts):
                    raise ValueError(
                        f"parameter {parameter.name!r} scales {term!r}, but there are mass, stiffness, "
                        f"damping" + "".join(f", {part}" for part in parts)
                    )


def matrix_of(content: Matrix) -> FloatArray:
    """Return a matrix from rows or from its diagonal."""
    array = np.array(content, dtype=np.float64)
    return np.diag(array) if array.ndim == 1 else array


def parse_lumped(content: dict[str, Any], source: str = "the lumped model") -> LumpedDescription:
    """Check the content of a lumped model's file.

    Raises
    ------
    ModelError
        One sentence that names `source`, the place, what came and what was expected.
    """
    return checked(LumpedDescription, content, source, ModelError, what="a lumped model")


def load_lumped(path: Path | str) -> LumpedDescription:
    """Read a lumped model from a TOML file, or one of those shipped by its name (`single_mass_rig`).

    Raises
    ------
    ModelError
        If there is no such file, it is not TOML, or its content is no lumped model.
    """
    file = Path(path)
    if not file.suffix and not file.exists():
        file = SHIPPED_MODELS / f"{path}.toml"
        if not file.exists():
            known = ", ".join(sorted(item.stem for item in SHIPPED_MODELS.glob("*.toml")))
            raise ModelError(f"There is no lumped model {str(path)!r}; shipped are {known}, or give a file.")
    return parse_lumped(read_toml(file, ModelError, what="lumped model"), str(file))
