"""A lumped model as a TOML file: matrices, named vectors, laws, controllers and calibrated parameters."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.errors import ModelError, said
from discrepancy.system.model_file import ModelDescription, NamedSection, ParameterSection, Section
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch
from reporting.toml_file import Fault, Name, NotNegative, Number, Positive
from reporting.words import counted

SHIPPED_MODELS = Path(__file__).parents[1] / "lumped_models"
"""Models that come with the package, by file name without the ending."""
KINDS = ("mass", "stiffness", "damping", "capacity", "conductance")
"""Matrices of a lumped model; each can have parts."""
BLOCKS = {
    "mass": (2, False, False),
    "stiffness": (0, False, False),
    "damping": (1, False, False),
    "capacity": (2, True, True),
    "conductance": (1, True, True),
    "force_of_states": (1, False, True),
    "flow_of_speeds": (1, True, False),
    "flow_of_displacements": (0, True, False),
}
"""Matrices in the equation of all unknowns z: the derivative of z that each multiplies, and whether its rows
and its columns are of states, which are the speeds of their coordinates."""
LOOSE = "; a structure that can float away has no static response: say `free = true` if it can"
GAINS = ("proportional", "derivative", "integral")
"""Gains of a controller; NAME.proportional is what a parameter scales."""


def _is_definite(matrix: FloatArray) -> bool:
    """Return whether a symmetric matrix is positive definite."""
    return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)


def _listed(value: object) -> list[object] | tuple[object, ...]:
    """Return one number as a list: with one unknown nobody needs brackets."""
    return value if isinstance(value, list | tuple) else [value]


def _rows(value: object, *, diagonal: bool = False) -> object:
    """Return a matrix by rows from these, from its `diagonal` or only row, or from one number."""
    listed = _listed(value)
    if listed and isinstance(listed[0], list | tuple):
        return listed
    if not diagonal:
        return [listed]
    count = range(len(listed))
    return [[listed[row] if row == column else 0.0 for column in count] for row in count]


Vector = Annotated[tuple[Number, ...], Field(min_length=1), BeforeValidator(_listed)]
Rows = Annotated[tuple[tuple[Number, ...], ...], BeforeValidator(_rows)]
Matrix = Annotated[tuple[tuple[Number, ...], ...], BeforeValidator(partial(_rows, diagonal=True))]
Ratio = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=3.0)]
"""Share of critical damping; overdamped modes are carried, but far above one a percentage was meant."""


class Damping(Section):
    """`[damping]`: exactly one of modal ratios, a matrix, or Rayleigh coefficients alpha M + beta K."""

    ratios: Annotated[tuple[Ratio, ...], BeforeValidator(_listed)] | None = None
    matrix: Matrix | None = None
    alpha: NotNegative | None = None
    beta: NotNegative | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield more than one kind."""
        rayleigh = self.alpha is not None or self.beta is not None
        ways = self.ratios is not None, self.matrix is not None, rayleigh
        yield sum(ways) != 1, "give exactly one of ratios, matrix, or alpha and beta"


class PartSection(NamedSection):
    """`[[mass_part]]` and the like: a part that a parameter can scale, added to the base matrix."""

    matrix: Matrix


class NamedVector(NamedSection):
    """A row of the unknowns with a name."""

    vector: Vector


class LoadSection(NamedVector):
    """`[[load]]`: a constant load; with `through` the part or matrix of that name times the vector."""

    through: Name | None = None


class InputSection(LoadSection):
    """`[[input]]`: what acts along a vector, and how this changes when the place of a force moves [1/m].

    A motion (displacement, velocity, acceleration, of an angle too) is prescribed to vector . u; anything
    else is a load, vector times its value, or with `through` the part of that name times vector times it.
    """

    quantity: Quantity = Quantity.FORCE
    station_derivative: Vector | None = None


class OutputSection(NamedSection):
    """`[[output]]`: what can be measured; velocity and acceleration come from a displacement.

    vector . u + constant, or the force by which a prescribed motion is made (`reaction`, an input's name),
    or what a controller gives (`controller`, its name).
    """

    vector: Vector | None = None
    quantity: Quantity = Quantity.DISPLACEMENT
    reaction: Name | None = None
    controller: Name | None = None
    constant: Number = 0.0

    def faults(self) -> Iterator[Fault]:
        """Yield more than one kind, and a reaction that is no force."""
        ways = sum(item is not None for item in (self.vector, self.reaction, self.controller))
        yield ways != 1, f"the output {self.name!r} needs one of a vector, a reaction and a controller"
        forceless = self.reaction is not None and self.quantity not in (Quantity.FORCE, Quantity.TORQUE)
        yield forceless, f'output {self.name!r} is a reaction: give it quantity = "force" or "torque"'


class CouplingSection(Section):
    """`[coupling]` between n displacements and m states."""

    force_of_states: Rows | None = None
    flow_of_speeds: Rows | None = None
    flow_of_displacements: Rows | None = None


class PortSection(NamedVector):
    """`[[port]]`: where an internal force can act, between the structure and the ground or within it.

    A port sees vector . u or vector . x, and a law there acts against it along the same vector, or along
    `acts`: what flows out of one store by its own level and into the next has vector [1, 0], acts [1, -1].
    """

    acts: Vector | None = None


class LawSection(Section):
    """`[[law]]`: a law of a port that the model has as it is; other keys are the numbers of its `kind`."""

    model_config = ConfigDict(extra="allow", frozen=True)

    name: Name
    kind: Name
    port: Name

    def faults(self) -> Iterator[Fault]:
        """Yield what is no law."""
        known = [law.kind for law in LAWS]
        yield self.kind not in known, said("models.law", law=self, known=", ".join(known))
        try:
            self.scaled(1.0).check()
        except InvalidPatchError as cause:
            yield True, f"the law {self.name!r}: {cause}"

    def scaled(self, factor: float) -> PortForce:
        """Return the law with the numbers that its force is in proportion to times a factor."""
        row = {"kind": self.kind, "port": self.port, **(self.model_extra or {})}
        (law,) = ModelPatch.from_list([row], f"the law {self.name!r}")
        assert isinstance(law, PortForce)  # the kind is checked
        return replace(law, **{name: factor * getattr(law, name) for name in law.proportional})


class ControllerSection(NamedSection):
    """`[[controller]]`: acts . (P e + D e' + I s), e = reference - vector . z, s' = e, which closes a loop.

    z are the unknowns, or their speeds where `quantity` is a speed; the reference is an input of the
    campaign with the controller's `reference` as its name, and zero in a trial that does not record it. With
    `derivative_of = "measurement"` D acts on -vector . z' alone.
    """

    vector: Vector
    acts: Vector
    quantity: Quantity
    reference: Name | None = None
    proportional: Number = 0.0
    derivative: Number = 0.0
    integral: Number = 0.0
    derivative_of: Literal["error", "measurement"] = "error"

    def faults(self) -> Iterator[Fault]:
        """Yield a controller without a gain."""
        gains = self.proportional or self.derivative or self.integral
        yield not gains, f"controller {self.name!r} has no gain: give one of {', '.join(GAINS)}"


class PlaceSection(NamedVector):
    """`[[place]]`: where a mass can sit; places with a station [m] make a line along the structure."""

    station: Number


class RootSection(Section):
    """`[root]`: motion of the unknowns when the root turns by one radian as a rigid body [m/rad]."""

    lever: Vector


class ScaledParameter(ParameterSection):
    """`[[parameter]]`: a factor of the terms named."""

    terms: Annotated[tuple[Name, ...], BeforeValidator(_listed)]
    mean: Number = 1.0
    low: NotNegative


class LumpedDescription(ModelDescription):
    """Content of a lumped model's file, SI; vectors have n + m entries, displacements first.

    `mass` and `stiffness` are matrices (n, n), vectors of a diagonal, or for n = 1 numbers; left out where
    there are states only. `capacity` T and `conductance` R (m, m) are those of the states x, and `coupling`
    holds F, G, H: M u'' + C u' + K u = F x + ..., T x' + R x = G u' + H u + ... With `free` the stiffness may
    be singular. `characteristic_length` [m] is by default the largest station, or 1.
    """

    what: ClassVar[str] = "a lumped model"
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

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a TOML file, or one of those shipped by its name (`single_mass_rig`); raises `ModelError`."""
        file = Path(path)
        if not file.suffix and not file.exists():
            file = SHIPPED_MODELS / f"{path}.toml"
            if not file.exists():
                known = ", ".join(sorted(item.stem for item in SHIPPED_MODELS.glob("*.toml")))
                raise ModelError(f"No lumped model is {str(path)!r}; shipped are {known}, or give a file.")
        return super().read(file)

    @property
    def size(self) -> int:
        """Displacements n."""
        return len(self.mass)

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
        """Whether it is a structure on springs under one force at a time."""
        motion = any(item.quantity.moving or item.through for item in self.input)
        parts = self.states or self.free or self.load or self.damping_part or self.controller
        acts = any(item.acts for item in self.port)
        reads = any(item.reaction or item.constant for item in self.output)
        return bool(self.input) and not (parts or motion or acts or reads)

    def given(self, kind: str) -> dict[str, Rows]:
        """Return the matrix of a kind, by that as its name, and its parts by name, those that there are."""
        base = getattr(self if kind in KINDS else self.coupling, kind)
        parts: tuple[PartSection, ...] = getattr(self, f"{kind}_part", ())
        matrix = base.matrix if isinstance(base, Damping) else base
        return ({kind: matrix} if matrix else {}) | {part.name: part.matrix for part in parts}

    def terms(self, factors: Mapping[str, float]) -> dict[str, FloatArray]:
        """Return the matrices (N, N) by kind, with their parts, and the parts by name, each times its factor.

        The factor of the matrix itself is that of the whole. Damping by modes is left out.
        """
        found, n = dict[str, FloatArray](), self.size
        unknowns = slice(n), slice(n, n + self.states)
        for kind, (_, into, of) in BLOCKS.items():
            whole = np.zeros((self.width, self.width))
            for name, matrix in self.given(kind).items():
                found[name] = np.zeros_like(whole)
                found[name][unknowns[into], unknowns[of]] = matrix
                found[name] *= 1.0 if name == kind else factors.get(name, 1.0)
                whole += found[name]
            sign = 1.0 if into is of else -1.0  # what couples stands on the other side
            found[kind] = sign * factors.get(kind, 1.0) * whole
        return found

    def faults(self) -> Iterator[Fault]:
        """Yield what does not fit together."""
        n, m, ratios = self.size, self.states, self.damping.ratios if self.damping is not None else None
        yield not n + m, "mass is missing (or capacity, of states of first order)"
        for kind, wanted, more in (
            ("stiffness", n and not self.free, ", or say `free = true`"),
            ("conductance", m, ""),
        ):
            lacks = wanted and not self.given(kind)
            yield lacks, f"{kind} is missing: give it, or [[{kind}_part]]{more}"
        yield n and not (self.damping or self.free), "'damping' is missing"
        yield from self._wrong_names()
        yield from self._vanishing_matrices()
        yield from self._wrong_matrices()
        for kind in ("input", "output", "port", "place", "load", "controller"):
            for item in getattr(self, kind):
                yield from self._wrong_vectors(kind, item)
        still = self.root is not None and (len(self.root.lever) != n or not any(self.root.lever))
        yield still, f"lever of root needs {counted(n, 'entry', 'entries')}, not all zero"
        came, each = counted(len(ratios or ()), "value"), "damping.ratios needs one value for each mode"
        yield ratios is not None and len(ratios) != n, f"{each}, {n} in all, but {came} came"

    def _wrong_matrices(self) -> Iterator[Fault]:
        """Yield matrices of another size, that are not symmetric, feed energy or leave something loose."""
        counts = self.size, self.states
        for kind, (_, into, of) in BLOCKS.items():
            given, rows, columns = self.given(kind), counts[into], counts[of]
            whole = {"damping": "damping.matrix"}.get(kind, kind if kind in KINDS else f"coupling.{kind}")
            for name, matrix in given.items():
                place = whole if name == kind else f"{kind}_part {name!r}"
                how = f" (or {counted(rows, 'diagonal value')})" if kind in KINDS else " by rows"
                other = [len(row) for row in matrix] != [columns] * rows
                yield other, f"{place} must be a {rows} x {columns} matrix{how}"
                full = np.array(matrix)
                least = -1e-9 * np.abs(full).max()
                skewed = kind in KINDS[:4] and np.min(-np.abs(full - full.T)) < least
                yield skewed, f"{place} must be symmetric"
                feeds = kind == "damping" and np.linalg.eigvalsh(full)[0] < least
                yield feeds, f"{place} must not feed energy: it has a negative eigenvalue"
            if given and kind in ("mass", "stiffness", "capacity"):
                values = np.linalg.eigvalsh(np.sum([*given.values()], axis=0))
                loose, floats = (LOOSE, self.free) if kind == "stiffness" else ("", False)
                holds = values[0] > 0.0 or (floats and values[0] >= -1e-9 * values[-1])
                yield not holds, f"{kind} (with its parts) must be positive definite{loose}"

    def _vanishing_matrices(self) -> Iterator[Fault]:
        """Yield parameters whose `low` of zero leaves no mass, capacity or stiffness that a model needs."""
        needed = ["mass", "capacity"] if self.free else ["mass", "capacity", "stiffness"]
        for item in self.parameter:
            if item.low > 0.0:
                continue
            for kind in needed:
                scaled = kind in item.terms
                kept = [matrix for name, matrix in self.given(kind).items() if name not in item.terms]
                loses = scaled or len(kept) < len(self.given(kind))
                holds = bool(kept) and not scaled and _is_definite(np.sum(kept, axis=0))
                yield (
                    loses and not holds,
                    f"the parameter {item.name!r} has low = 0, which would leave no {kind} at some unknown: "
                    "give a low above 0",
                )

    def _wrong_vectors(
        self, kind: str, item: NamedVector | OutputSection | ControllerSection
    ) -> Iterator[Fault]:
        """Yield vectors of another length and zero ones, and what sees both displacements and states."""
        n, m = self.size, self.states
        for key in ("vector", "acts", "station_derivative"):
            row, where = getattr(item, key, None), f"{key} of {kind} {item.name!r}"
            came, has = counted(len(row or ()), "entry", "entries"), counted(n + m, "unknown")
            yield row is not None and len(row) != n + m, f"{where} has {came}, but the model has {has}"
            yield row is not None and not any(row) and key != "station_derivative", f"{where} is zero"
        row = np.array(item.vector or ())
        both = kind in ("port", "controller") and any(row[:n]) and any(row[n:])
        yield both, f"the {kind} {item.name!r} sees displacements or states, not both"
        if isinstance(item, PortSection) and item.acts is not None:
            push, capacity = np.array(item.acts), np.sum([*self.given("capacity").values()], axis=0)
            of_states = not any(row[:n]) and not any(push[:n])
            takes = of_states and row[n:] @ np.linalg.solve(capacity, push[n:]) > 0.0
            yield not takes, said("models.acts", port=item)
        if isinstance(item, ControllerSection):
            speed = item.quantity.order + any(row[n:]) > 0 and item.derivative
            yield item.quantity.order > 1 or speed, said("models.controller_speed", controller=item)

    def _wrong_names(self) -> Iterator[Fault]:
        """Yield names that are there twice, and those that name nothing."""
        kinds = ("output", "port", "place", "load", "controller", "law", "parameter", "input")
        names = {kind: [item.name for item in getattr(self, kind)] for kind in kinds}
        parts = [part.name for kind in KINDS for part in getattr(self, f"{kind}_part")]
        references = [item.reference for item in self.controller if item.reference]
        further = {
            "part": [*KINDS, *parts],
            "input or reference": [*names["input"], *references],
            "place station": [f"{place.station:g}" for place in self.place],
        }
        for kind, given in (names | further).items():
            yield from self.repeated(kind, given)
        there = self.size, self.states
        terms = [*(kind for kind in KINDS if there[BLOCKS[kind][1]]), *parts]
        gains = [f"{name}.{gain}" for name in names["controller"] for gain in GAINS]
        acting = [name for kind in ("input", "load", "law", "controller") for name in names[kind]]
        driven = [item.name for item in self.input if item.quantity.moving]
        for kind, key, does, known in (
            ("input", "through", "acts through", terms),
            ("load", "through", "acts through", terms),
            ("law", "port", "acts on the port", names["port"]),
            ("output", "reaction", "is the reaction of the prescribed motion", driven),
            ("output", "controller", "is what a controller gives,", names["controller"]),
            ("parameter", "terms", "scales", [*terms, *acting, *gains]),
        ):
            has = ", ".join(known) or "none"
            for item in getattr(self, kind):
                for name in _listed(getattr(item, key)):
                    wrong = f"{kind} {item.name!r} {does} {name!r}, but there are {has}"
                    yield name is not None and name not in known, wrong
