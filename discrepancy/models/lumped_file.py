"""A lumped model as a TOML file: matrices, named vectors and calibrated parameters, checked strictly."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError
from discrepancy.models.acting import order_of
from discrepancy.models.lumped_sections import (
    ControllerSection,
    CouplingSection,
    Damping,
    InputSection,
    LawSection,
    LoadSection,
    Matrix,
    NamedVector,
    OutputSection,
    PartSection,
    PlaceSection,
    PortSection,
    RootSection,
    ScaledParameter,
)
from discrepancy.models.model_file import ModelDescription, check_unique
from reporting.section import Positive, checked
from reporting.toml_file import read_toml
from reporting.words import counted

SHIPPED_MODELS = Path(__file__).parents[1] / "lumped_models"
"""Models that come with the package, by file name without the ending."""


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
    law: tuple[LawSection, ...] = ()
    controller: tuple[ControllerSection, ...] = ()
    parameter: tuple[ScaledParameter, ...] = ()

    @property
    def size(self) -> int:
        """Displacements n."""
        return len(self.mass)

    def unknowns(self, kind: str) -> slice:
        """Return which of the unknowns the matrix of a kind is of."""
        return slice(self.size, self.size + self.states) if kind in OF_STATES else slice(self.size)

    @property
    def states(self) -> int:
        """States m of first order."""
        return len(self.capacity)

    @cached_property
    def width(self) -> int:
        """Displacements, states, and the integrals of controllers."""
        return self.size + self.states + sum(item.integral != 0.0 for item in self.controller)

    def padded(self, row: Sequence[float] | FloatArray) -> FloatArray:
        """Return a row of the file with the integrals of controllers after it."""
        found = np.zeros(self.width)
        found[: len(row)] = row
        return found

    @cached_property
    def is_plain(self) -> bool:
        """Whether it is a structure at rest on springs under one force at a time."""
        motion = any(item.quantity.moving or item.through for item in self.input)
        parts = self.states or self.free or self.load or self.damping_part or self.controller
        acts = any(item.acts for item in self.port)
        reads = any(item.reaction or item.constant for item in self.output)
        return not (parts or motion or acts or reads)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        self._check_matrices()
        if self.is_plain and not self.input:
            raise ValueError("[[input]] is missing: at least one force must be able to act")
        for kind in ("input", "output", "port", "place", "load", "controller"):
            for item in getattr(self, kind):
                self._check_vectors(kind, item)
        n = self.size
        if self.root is not None and (len(self.root.lever) != n or not any(self.root.lever)):
            raise ValueError(f"lever of root needs {counted(n, 'entry', 'entries')}, not all zero")
        if self.damping is not None and self.damping.ratios is not None and len(self.damping.ratios) != n:
            came = counted(len(self.damping.ratios), "value")
            raise ValueError(f"damping.ratios needs one value for each mode, {n} in all, but {came} came")
        self._check_names()
        return self

    def _check_matrices(self) -> None:
        """Refuse matrices of another size, that are not symmetric, feed energy or leave something loose."""
        n, m = self.size, self.states
        if n == 0 and m == 0:
            raise ValueError("mass is missing (or capacity, of states of first order)")
        if n and not (self.stiffness or self.stiffness_part or self.free):
            raise ValueError("stiffness is missing: give it, or [[stiffness_part]], or say `free = true`")
        if n and self.damping is None and not self.free:
            raise ValueError("'damping' is missing")
        for kind in KINDS:
            where, content = ("damping.matrix" if kind == "damping" else kind), self._base(kind)
            count, reference = (m, "capacity") if kind in OF_STATES else (n, "mass")
            parts = [(f"{kind}_part {part.name!r}", part.matrix) for part in self.parts(kind)]
            if content or (kind == "conductance" and m and not parts):
                parts.append((where, content))
            for place, matrix in parts:
                if not count:
                    raise ValueError(f"{place} is there, but {reference} is missing")
                _check_matrix(place, matrix, count, reference, symmetric=kind != "conductance")
            loose, own = _LOOSE if kind == "stiffness" else "", self.unknowns(kind)
            least, most = np.linalg.eigvalsh(self.whole(kind)[own, own])[[0, -1]] if count else (1.0, 1.0)
            singular = kind == "stiffness" and self.free and least >= -1e-9 * max(abs(most), 1e-300)
            if kind in ("mass", "capacity", "stiffness") and least <= 0.0 and not singular:
                raise ValueError(f"{kind} (with its parts) must be positive definite{loose}")
        for name, rows, columns in (
            ("force_of_states", n, m), ("flow_of_speeds", m, n), ("flow_of_displacements", m, n),
        ):  # fmt: skip
            content = getattr(self.coupling, name)
            if content is not None and [len(row) for row in content] != [columns] * rows:
                raise ValueError(f"coupling.{name} must be a {rows} x {columns} matrix by rows")

    def _base(self, kind: str) -> Matrix:
        """Return the matrix of a kind without its parts, empty where there is none."""
        if kind == "damping":
            return (self.damping and self.damping.matrix) or ()
        found: Matrix = getattr(self, kind)
        return found

    def whole(self, kind: str, factors: Mapping[str, float] = MappingProxyType({})) -> FloatArray:
        """Return the matrix (N, N) of a kind with its parts, each times its factor.

        The factor of the matrix itself is that of the whole. Damping by modes is left out.
        """
        whole = self.placed(self._base(kind), kind)
        for part in self.parts(kind):
            whole += factors.get(part.name, 1.0) * self.placed(part.matrix, kind)
        return whole * factors.get(kind, 1.0)

    def placed(self, matrix: Matrix, kind: str) -> FloatArray:
        """Return a matrix of a kind, zero where there is none, among all unknowns (N, N)."""
        found, own = np.zeros((self.width, self.width)), self.unknowns(kind)
        if matrix:
            found[own, own] = matrix
        return found

    def _check_vectors(self, kind: str, item: NamedVector | OutputSection | ControllerSection) -> None:
        """Refuse vectors of another length and zero ones, and what sees both displacements and states."""
        n, m = self.size, self.states
        for key in ("vector", "acts", "station_derivative", "chord_derivative"):
            vector = getattr(item, key, None)
            if vector is not None and len(vector) != n + m:
                came, has = counted(len(vector), "entry", "entries"), counted(n + m, "unknown")
                raise ValueError(f"{key} of {kind} {item.name!r} has {came}, but the model has {has}")
        row = np.array(item.vector or ())
        if item.vector is not None and not any(row):
            raise ValueError(f"vector of {kind} {item.name!r} is zero")
        if kind in ("port", "controller") and any(row[:n]) and any(row[n:]):
            raise ValueError(f"the {kind} {item.name!r} sees displacements or states, not both")
        if isinstance(item, PortSection) and item.acts is not None:
            push, capacity = np.array(item.acts), self.whole("capacity")[n : n + m, n : n + m]
            of_states = not any(row[:n]) and not any(push[:n])
            if not of_states or row[n:] @ np.linalg.solve(capacity, push[n:]) <= 0.0:
                raise ValueError(
                    f"`acts` of the port {item.name!r} is for states, and must take from what its vector sees"
                )
        if isinstance(item, ControllerSection):
            order, what = order_of(item.quantity), "a state" if any(row[n:]) else "a speed"
            if order == 2:
                raise ValueError(f"the controller {item.name!r} cannot follow an acceleration")
            if item.derivative and (any(row[n:]) or order == 1):
                raise ValueError(
                    f"the controller {item.name!r} measures {what}, whose derivative it cannot take: "
                    "leave `derivative` out"
                )

    def _check_names(self) -> None:
        """Refuse names that are there twice, and those that name nothing."""
        references = [item.reference for item in self.controller if item.reference]
        parts = [part.name for kind in KINDS for part in self.parts(kind)]
        names = {
            kind: [item.name for item in getattr(self, kind)]
            for kind in ("output", "port", "place", "load", "controller", "law", "parameter", "input")
        }
        names["input or reference"] = [*names["input"], *references]
        names["place station"] = [f"{place.station:g}" for place in self.place]
        names["part"] = [*parts, *KINDS]
        for kind, given in names.items():
            check_unique(kind, given)
        kinds = (*(KINDS[:3] if self.size else ()), *(OF_STATES if self.states else ()))
        terms, gains = [*kinds, *parts], [f"{name}.{gain}" for name in names["controller"] for gain in GAINS]
        more = ("law",) if self.is_plain else ("input", "load", "law", "controller")
        scaled = list(dict.fromkeys([*terms, *(name for kind in more for name in names[kind]), *gains]))
        driven = [item.name for item in self.input if item.quantity.moving]
        named = list[tuple[str, str | None, Sequence[str]]]()
        for pushing in (*self.input, *self.load):
            named.append((f"{pushing.name!r} acts through", pushing.through, terms))
        for law in self.law:
            named.append((f"the law {law.name!r} acts on the port", law.port, names["port"]))
        for output in self.output:
            is_ = f"the output {output.name!r} is"
            named.append((f"{is_} the reaction of the prescribed motion", output.reaction, driven))
            named.append((f"{is_} what a controller gives,", output.controller, names["controller"]))
        for item in self.parameter:
            named += [(f"parameter {item.name!r} scales", term, scaled) for term in item.terms]
        for what, name, known in named:
            if name is not None and name not in known:
                raise ValueError(f"{what} {name!r}, but there are {', '.join(known) or 'none'}")

    def parts(self, kind: str) -> tuple[PartSection, ...]:
        """Return the parts of the matrix of a kind."""
        found: tuple[PartSection, ...] = getattr(self, f"{kind}_part")
        return found


KINDS = ("mass", "stiffness", "damping", "capacity", "conductance")
"""Matrices of a lumped model; each can have parts."""
OF_STATES = KINDS[3:]
GAINS = ("proportional", "derivative", "integral")
"""Gains of a controller; NAME.proportional is what a parameter scales."""
_LOOSE = (
    "; a structure that can float away has no static response: say `free = true` if it can, "
    "as a cart or a falling body"
)


def _check_matrix(where: str, content: Matrix, count: int, reference: str, *, symmetric: bool) -> None:
    """Refuse a matrix of another size than the reference, that is not symmetric or feeds energy."""
    if [len(row) for row in content] != [count] * count:
        raise ValueError(
            f"{where} must be a {count} x {count} matrix (or {counted(count, 'diagonal value')}), as "
            f"{reference} has {counted(count, 'row')}"
        )
    full = np.array(content)
    size = float(np.max(np.abs(full)))
    if symmetric and np.max(np.abs(full - full.T)) > 1e-9 * max(size, 1e-300):
        raise ValueError(f"{where} must be symmetric")
    if where.startswith("damping") and np.min(np.linalg.eigvalsh(full)) < -1e-9 * size:
        raise ValueError(f"{where} must not feed energy: it has a negative eigenvalue")


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
