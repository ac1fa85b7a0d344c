"""The tables of a lumped model's file: matrices, named vectors, laws, controllers and parameters."""

from dataclasses import replace
from functools import partial
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from discrepancy.campaign.records import Quantity
from discrepancy.models.model_file import NamedSection, ParameterSection, Section
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch
from reporting.section import Name, NotNegative, Number


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

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        rayleigh = self.alpha is not None or self.beta is not None
        if sum((self.ratios is not None, self.matrix is not None, rayleigh)) != 1:
            raise ValueError("give exactly one of ratios, matrix, or alpha and beta")
        return self


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

    quantity: Annotated[Quantity, Field(strict=False)] = Quantity.FORCE
    station_derivative: Vector | None = None
    chord_derivative: Vector | None = None


class OutputSection(NamedSection):
    """`[[output]]`: what can be measured; velocity and acceleration come from a displacement.

    vector . u + constant, or the force by which a prescribed motion is made (`reaction`, an input's name),
    or what a controller gives (`controller`, its name).
    """

    vector: Vector | None = None
    quantity: Annotated[Quantity, Field(strict=False)] = Quantity.DISPLACEMENT
    reaction: Name | None = None
    controller: Name | None = None
    constant: Number = 0.0

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(item is not None for item in (self.vector, self.reaction, self.controller)) != 1:
            raise ValueError(f"the output {self.name!r} needs one of a vector, a reaction and a controller")
        if self.reaction is not None and self.quantity not in (Quantity.FORCE, Quantity.TORQUE):
            raise ValueError(
                f'the output {self.name!r} is a reaction: give it quantity = "force" or "torque"'
            )
        return self


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

    @property
    def primitive(self) -> PortForce:
        """The law."""
        row = {"kind": self.kind, "port": self.port, **(self.model_extra or {})}
        (found,) = ModelPatch.from_list([row], f"the law {self.name!r}")
        assert isinstance(found, PortForce)  # the kind is checked
        return found

    @model_validator(mode="after")
    def _is_a_law(self) -> Self:
        known = [law.kind for law in LAWS]
        if self.kind not in known:
            raise ValueError(
                f"the law {self.name!r} has the kind {self.kind!r}, but known are {', '.join(known)}"
            )
        try:
            self.primitive.check()
        except InvalidPatchError as cause:
            raise ValueError(f"the law {self.name!r}: {cause}") from cause
        return self

    def scaled(self, factor: float) -> PortForce:
        """Return the law with the numbers that its force is in proportion to times a factor."""
        law = self.primitive
        return replace(law, **{name: factor * getattr(law, name) for name in law.proportional})


class ControllerSection(NamedSection):
    """`[[controller]]`: acts . (P e + D e' + I s), e = reference - vector . z, s' = e, which closes a loop.

    z are the unknowns, or their speeds where `quantity` is a speed; the reference is an input of the
    campaign with the controller's `reference` as its name, and zero in a trial that does not record it. With
    `derivative_of = "measurement"` D acts on -vector . z' alone.
    """

    vector: Vector
    acts: Vector
    quantity: Annotated[Quantity, Field(strict=False)]
    reference: Name | None = None
    proportional: Number = 0.0
    derivative: Number = 0.0
    integral: Number = 0.0
    derivative_of: Literal["error", "measurement"] = "error"

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if not (self.proportional or self.derivative or self.integral):
            raise ValueError(
                f"the controller {self.name!r} has no gain: give proportional, derivative or integral"
            )
        if not any(self.vector) or not any(self.acts):
            raise ValueError(f"vector and acts of the controller {self.name!r} must not be zero")
        return self


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

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        if not 0.0 < self.low <= self.mean <= self.high:
            raise ValueError("a factor needs 0 < low <= mean <= high")
        return self
