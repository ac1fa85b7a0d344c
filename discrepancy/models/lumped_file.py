"""A lumped model as a TOML file: matrices, named vectors and calibrated parameters, checked strictly."""

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from discrepancy.campaign.records import Quantity
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
    """`[[mass_part]]` and the like: a part that a parameter can scale, added to the base matrix."""

    name: Name
    matrix: Matrix


class NamedVector(Section):
    """A row of the unknowns with a name."""

    name: Name
    vector: Vector


class InputSection(NamedVector):
    """`[[input]]`: what acts along a vector, and how this changes when the place of a force moves [1/m].

    A motion (displacement, velocity, acceleration, of an angle too) is prescribed to vector . u; anything
    else is a load, vector times its value, or with `through` the part of that name times vector times it.
    """

    quantity: Annotated[Quantity, Field(strict=False)] = Quantity.FORCE
    through: Name | None = None
    station_derivative: Vector | None = None
    chord_derivative: Vector | None = None


class OutputSection(Section):
    """`[[output]]`: what can be measured; velocity and acceleration come from a displacement.

    vector . u + constant, or the force by which a prescribed motion is made (`reaction`, an input's name).
    """

    name: Name
    vector: Vector | None = None
    quantity: Annotated[Quantity, Field(strict=False)] = Quantity.DISPLACEMENT
    reaction: Name | None = None
    constant: Number = 0.0

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.vector is None) == (self.reaction is None):
            raise ValueError(f"the output {self.name!r} needs either a vector or a reaction")
        if self.reaction is not None and self.quantity not in (Quantity.FORCE, Quantity.TORQUE):
            raise ValueError(
                f'the output {self.name!r} is a reaction: give it quantity = "force" or "torque"'
            )
        return self


class LoadSection(NamedVector):
    """`[[load]]`: a constant load; with `through` the part or matrix of that name times the vector."""

    through: Name | None = None


class CouplingSection(Section):
    """`[coupling]` between n displacements and m states."""

    force_of_states: Matrix | None = None
    flow_of_speeds: Matrix | None = None
    flow_of_displacements: Matrix | None = None


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
        SI; left out where there are states only.
    damping : Damping
        See there.
    capacity, conductance : (m, m) matrix, (m,) vector of a diagonal, or for m = 1 a number
        T and R of the states x, T x' + R x = inputs. Vectors then have n + m entries, displacements first.
    coupling : CouplingSection
        F, G, H of M u'' + C u' + K u = F x + ..., T x' + R x = G u' + H u + ...
    free : bool
        Whether the structure may float: its stiffness may be singular.
    characteristic_length : float, optional
        L [m]; by default the largest station, or 1.
    """

    mass: Matrix = ()
    stiffness: Matrix = ()
    damping: Damping | None = None
    capacity: Matrix = ()
    conductance: Matrix = ()
    coupling: CouplingSection = CouplingSection()
    free: bool = False
    characteristic_length: Positive | None = None
    mass_part: tuple[PartSection, ...] = ()
    stiffness_part: tuple[PartSection, ...] = ()
    damping_part: tuple[PartSection, ...] = ()
    capacity_part: tuple[PartSection, ...] = ()
    conductance_part: tuple[PartSection, ...] = ()
    load: tuple[LoadSection, ...] = ()
    input: tuple[InputSection, ...] = ()
    output: tuple[OutputSection, ...] = Field(min_length=1)
    port: tuple[PortSection, ...] = ()
    place: tuple[PlaceSection, ...] = ()
    root: RootSection | None = None
    parameter: tuple[ScaledParameter, ...] = ()

    @property
    def size(self) -> int:
        """Displacements n."""
        return len(self.mass)

    @property
    def states(self) -> int:
        """States m of first order."""
        return len(self.capacity)

    @property
    def is_plain(self) -> bool:
        """Whether it is a structure at rest on springs under one force at a time."""
        motion = any(item.quantity.moving or item.through for item in self.input)
        further = self.states or self.free or self.load or self.damping_part or motion
        reads = any(item.reaction or item.constant for item in self.output)
        return not (further or reads)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        self._check_matrices()
        if self.is_plain and not self.input:
            raise ValueError("[[input]] is missing: at least one force must be able to act")
        for kind, items in (
            ("input", self.input),
            ("output", self.output),
            ("port", self.port),
            ("place", self.place),
            ("load", self.load),
        ):
            self._check_vectors(kind, items)
        self._check_root_and_ratios()
        self._check_parameters()
        return self

    def _check_matrices(self) -> None:
        """Refuse matrices of another size, that are not symmetric, feed energy or leave something loose."""
        n, m = self.size, self.states
        if n == 0 and m == 0:
            raise ValueError("mass is missing (or capacity, of states of first order)")
        second = [("stiffness", self.stiffness)] if self.stiffness or not self.free else []
        second += [(f"{kind} {part.name!r}", part.matrix) for kind, part in self._parts_of(n)]
        if n and self.damping is None and not self.free:
            raise ValueError("'damping' is missing")
        if self.damping is not None and self.damping.matrix is not None:
            second.append(("damping.matrix", self.damping.matrix))
        first = [("conductance", self.conductance)]
        first += [(f"{kind} {part.name!r}", part.matrix) for kind, part in self._parts_of(0)]
        for reference, count, matrices in (("mass", n, second), ("capacity", m, first)):
            if count:
                matrices = [(reference, getattr(self, reference)), *matrices]
            for where, content in matrices if count else ():
                _check_matrix(where, content, count, reference)
            if not count and any(len(content) for _, content in matrices):
                raise ValueError(f"{matrices[0][0]} is there, but {reference} is missing")
        for where, loose in (("mass", ""), ("capacity", ""), ("stiffness", _LOOSE)):
            whole = self.whole(where)
            least, most = np.linalg.eigvalsh(whole)[[0, -1]] if len(whole) else (1.0, 1.0)
            singular = where == "stiffness" and self.free and least >= -1e-9 * max(abs(most), 1e-300)
            if least <= 0.0 and not singular:
                raise ValueError(f"{where} (with its parts) must be positive definite{loose}")
        for name, rows, columns in (
            ("force_of_states", n, m), ("flow_of_speeds", m, n), ("flow_of_displacements", m, n),
        ):  # fmt: skip
            content = getattr(self.coupling, name)
            if content is not None and _shape(content) != (rows, columns):
                raise ValueError(f"coupling.{name} must be a {rows} x {columns} matrix by rows")

    def _parts_of(self, of_displacements: int) -> list[tuple[str, PartSection]]:
        names = ("mass_part", "stiffness_part", "damping_part") if of_displacements else _STATE_PARTS
        return [(name, part) for name in names for part in getattr(self, name)]

    def whole(self, name: str, factors: Mapping[str, float] = MappingProxyType({})) -> FloatArray:
        """Return "mass", "stiffness", "capacity" or "conductance" with its parts, each times its factor.

        The factor of the matrix itself is that of the whole.
        """
        count = self.size if name in ("mass", "stiffness") else self.states
        base = getattr(self, name)
        whole = matrix_of(base) if len(base) else np.zeros((count, count))
        for part in getattr(self, f"{name}_part"):
            whole = whole + factors.get(part.name, 1.0) * matrix_of(part.matrix)
        return np.asarray(whole * factors.get(name, 1.0))

    def _check_vectors(self, kind: str, items: Sequence[NamedVector] | Sequence[OutputSection]) -> None:
        """Refuse vectors of another length, zero ones and names that are there twice."""
        n = self.size + self.states
        for item in items:
            for key in ("vector", "station_derivative", "chord_derivative"):
                vector = getattr(item, key, None)
                if vector is not None and len(vector) != n:
                    came = counted(len(vector), "entry", "entries")
                    raise ValueError(
                        f"{key} of {kind} {item.name!r} has {came}, but the model has {counted(n, 'unknown')}"
                    )
            if item.vector is not None and not any(item.vector):
                raise ValueError(f"vector of {kind} {item.name!r} is zero")
            if kind == "port" and item.vector is not None and self.size:
                sides = any(item.vector[: self.size]), any(item.vector[self.size :])
                if all(sides):
                    raise ValueError(f"the port {item.name!r} is of displacements or of states, not of both")
            through = getattr(item, "through", None)
            if through is not None and through not in self.terms:
                raise ValueError(
                    f"{kind} {item.name!r} acts through {through!r}, but there are {', '.join(self.terms)}"
                )
        check_unique(kind, [item.name for item in items])
        prescribed = {item.name for item in self.input if item.quantity.moving}
        for item in items:
            reaction = getattr(item, "reaction", None)
            if reaction is not None and reaction not in prescribed:
                raise ValueError(
                    f"the output {item.name!r} is the reaction of {reaction!r}, which is no input that "
                    "prescribes a motion"
                )

    @property
    def terms(self) -> dict[str, Matrix | None]:
        """Matrices by what a parameter or `through` calls them; None for those that have parts."""
        kinds = ("mass", "stiffness", "damping") if self.size else ()
        found: dict[str, Matrix | None] = dict.fromkeys(
            (*kinds, *(("capacity", "conductance") if self.states else ()))
        )
        for name in (*_PARTS, *_STATE_PARTS):
            found |= {part.name: part.matrix for part in getattr(self, name)}
        return found

    def _check_root_and_ratios(self) -> None:
        n = self.size
        if self.root is not None and (len(self.root.lever) != n or not any(self.root.lever)):
            raise ValueError(f"lever of root needs {counted(n, 'entry', 'entries')}, not all zero")
        if self.damping is not None and self.damping.ratios is not None and len(self.damping.ratios) != n:
            came = counted(len(self.damping.ratios), "value")
            raise ValueError(f"damping.ratios needs one value for each mode, {n} in all, but {came} came")

    def _check_parameters(self) -> None:
        check_unique("place station", [f"{place.station:g}" for place in self.place])
        parts = [part.name for name in (*_PARTS, *_STATE_PARTS) for part in getattr(self, name)]
        check_unique("part", [*parts, "mass", "stiffness", "damping", "capacity", "conductance"])
        check_unique("parameter", [item.name for item in self.parameter])
        known = list(self.terms)
        known += [item.name for item in (*self.input, *self.load) if item.name not in known]
        if self.is_plain:
            known = list(self.terms)
        for parameter in self.parameter:
            for term in parameter.scaled:
                if term not in known:
                    raise ValueError(
                        f"parameter {parameter.name!r} scales {term!r}, but there are {', '.join(known)}"
                    )


_PARTS = ("mass_part", "stiffness_part", "damping_part")
_STATE_PARTS = ("capacity_part", "conductance_part")
_LOOSE = (
    "; a structure that can float away has no static response: say `free = true` if it can, "
    "as a cart or a falling body"
)


def _shape(content: Matrix) -> tuple[int, int]:
    array = np.array(content)
    return (1, len(array)) if array.ndim == 1 else (array.shape[0], array.shape[1])


def _check_matrix(where: str, content: Matrix, count: int, reference: str) -> None:
    """Refuse a matrix of another size than the reference, that is not symmetric or feeds energy."""
    lengths = {len(row) for row in content if isinstance(row, tuple)}
    if len(content) != count or (lengths and lengths != {count}):
        raise ValueError(
            f"{where} must be a {count} x {count} matrix (or {counted(count, 'diagonal value')}), as "
            f"{reference} has {counted(count, 'row')}"
        )
    if reference == "capacity" and where.startswith("conductance"):
        return
    full = matrix_of(content)
    size = float(np.max(np.abs(full)))
    if np.max(np.abs(full - full.T)) > 1e-9 * max(size, 1e-300):
        raise ValueError(f"{where} must be symmetric")
    if where.startswith("damping") and np.min(np.linalg.eigvalsh(full)) < -1e-9 * size:
        raise ValueError(f"{where} must not feed energy: it has a negative eigenvalue")


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
