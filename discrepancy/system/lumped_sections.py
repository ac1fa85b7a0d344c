"""Tables of a lumped model's file: damping, loads, outputs, ports, laws and controllers."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from discrepancy.campaign.records import Quantity
from discrepancy.system.model_file import NamedSection, ParameterSection, Section
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch
from reporting.formats.toml_file import Check, Name, NotNegative, Number

GAINS = ("proportional", "derivative", "integral")
"""Gains of a controller; a parameter scales one under the name CONTROLLER.proportional etc."""


def as_list(value: object) -> list[object] | tuple[object, ...]:
    """Return a single number as a list, since a system with one unknown may omit the brackets."""
    return value if isinstance(value, list | tuple) else [value]


_VECTOR_FORMS = "a number or a list of numbers is expected, as 1.0 or [1.0, 0.0]"
_ROWS_FORMS = (
    "a number, a list of numbers (the only row) or a list of rows is expected, as 2.0, "
    "[2.0, 1.0] or [[2.0, 0.0], [0.0, 1.0]]"
)
_MATRIX_FORMS = (
    "a number, a list of numbers (the diagonal) or a list of rows is expected, as 2.0, "
    "[2.0, 1.0] or [[2.0, 0.0], [0.0, 1.0]]"
)


def _refuse_other_forms(value: object, expected: str) -> None:
    """Raise `ValueError` unless a value is a number, a list of numbers, or a list of lists.

    A list that mixes numbers and lists is refused, too. `expected` names the forms in the message.
    """
    entries = as_list(value)
    are_lists = [isinstance(entry, list | tuple) for entry in entries]
    are_numbers = [
        isinstance(entry, int | float) and not isinstance(entry, bool) for entry in entries
    ]
    if not all(are_lists) and not all(are_numbers):
        raise ValueError(f"{expected}, but {value!r} was given")


def _as_numbers(value: object) -> object:
    """Return a vector as a list of numbers, given the list or one number."""
    _refuse_other_forms(value, _VECTOR_FORMS)
    return as_list(value)


def _as_rows(value: object) -> object:
    """Return a matrix as a list of rows, given the rows, the only row, or one number."""
    _refuse_other_forms(value, _ROWS_FORMS)
    entries = as_list(value)
    if entries and isinstance(entries[0], list | tuple):
        return entries
    return [entries]


def _as_matrix(value: object) -> object:
    """Return a matrix as a list of rows, given the rows, its diagonal, or one number."""
    _refuse_other_forms(value, _MATRIX_FORMS)
    entries = as_list(value)
    if entries and isinstance(entries[0], list | tuple):
        return entries
    rows: list[list[object]] = []
    for row, entry in enumerate(entries):
        rows.append([0.0] * len(entries))
        rows[row][row] = entry
    return rows


_NumbersOrRows = Number | tuple[Number, ...] | tuple[tuple[Number, ...], ...]
"""What a file may state for a matrix: one number, a row or diagonal, or all rows."""
Vector = Annotated[
    tuple[Number, ...],
    Field(min_length=1),
    BeforeValidator(_as_numbers, json_schema_input_type=Number | tuple[Number, ...]),
]
Rows = Annotated[
    tuple[tuple[Number, ...], ...],
    BeforeValidator(_as_rows, json_schema_input_type=_NumbersOrRows),
]
Matrix = Annotated[
    tuple[tuple[Number, ...], ...],
    BeforeValidator(_as_matrix, json_schema_input_type=_NumbersOrRows),
]
Ratio = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=3.0)]
"""Fraction of critical damping. Above one a mode is overdamped; a value above three is an error."""


class Damping(Section):
    """`[damping]`: modal ratios, a matrix, or Rayleigh coefficients alpha M + beta K."""

    ratios: (
        Annotated[
            tuple[Ratio, ...],
            BeforeValidator(as_list, json_schema_input_type=Ratio | tuple[Ratio, ...]),
        ]
        | None
    ) = None
    """Damping ratio of each mode, as a fraction of critical damping [1]."""
    matrix: Matrix | None = None
    """Damping matrix, its diagonal, or one number [SI]."""
    alpha: NotNegative | None = None
    """Factor on the mass matrix [1/s]."""
    beta: NotNegative | None = None
    """Factor on the stiffness matrix [s]."""

    def checks(self) -> Iterator[Check]:
        """Yield a fault unless exactly one kind of damping is given."""
        has_coefficients = self.alpha is not None or self.beta is not None
        kinds = [self.ratios is not None, self.matrix is not None, has_coefficients]
        yield kinds.count(True) != 1, "give exactly one of ratios, matrix, or alpha and beta"


class PartSection(NamedSection):
    """`[[mass_part]]` and the like: a part that a parameter can scale, added to the base matrix."""

    matrix: Matrix
    """Matrix of the part, its diagonal, or one number [SI]."""


class NamedVector(NamedSection):
    """A row of the unknowns with a name."""

    vector: Vector
    """One number for each unknown, displacements before states [SI]."""


class LoadSection(NamedVector):
    """`[[load]]`: a constant load; with `through`, the matrix of that name times the vector."""

    through: Name | None = None
    """Name of a matrix, such as "mass", by which the vector is multiplied."""


class InputSection(LoadSection):
    """`[[input]]`: a load, or a prescribed motion or state, that a trial records.

    A motion (displacement, velocity or acceleration, linear or angular) is prescribed to vector .
    u. Another quantity is prescribed to vector . x, a state such as the temperature of a room, if
    `prescribes_state` is true. Otherwise it is a load: its value times the vector, or, with
    `through`, its value times the matrix of that name times the vector. `station_derivative` is the
    change of the vector if the load moves along the structure [1/m].
    """

    quantity: Quantity = Quantity.FORCE
    """What the input is; a motion is prescribed, anything else is a load."""
    station_derivative: Vector | None = None
    """Change of the vector for each metre that the load moves along the structure [1/m]."""
    prescribes_state: bool = False
    """Whether the input prescribes its value to a state (vector . x), and is not a load."""

    @property
    def is_prescribed(self) -> bool:
        """Whether the input prescribes a motion or a state, and is not a load."""
        return self.prescribes_state or bool(self.quantity.motion_chain)


class OutputSection(NamedSection):
    """`[[output]]`: a quantity that channels can measure.

    It is vector . u + constant, or the force by which a motion is prescribed (`reaction`, the name
    of its input), or the output of a controller (`controller`, its name). Velocity and acceleration
    are derived from a displacement.
    """

    vector: Vector | None = None
    """One number for each unknown; the output is their sum times these [SI]."""
    quantity: Quantity = Quantity.DISPLACEMENT
    """What the output is."""
    reaction: Name | None = None
    """Name of an input: the output is the force by which its motion is prescribed."""
    controller: Name | None = None
    """Name of a controller: the output is what it gives."""
    constant: Number = 0.0
    """Number that is added [SI]."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks on an output: it is of one kind only, and a reaction is a force."""
        kinds = [kind for kind in (self.vector, self.reaction, self.controller) if kind is not None]
        yield (
            len(kinds) != 1,
            f"the output {self.name!r} needs one of a vector, a reaction and a controller",
        )
        is_force = self.quantity in (Quantity.FORCE, Quantity.TORQUE)
        yield (
            self.reaction is not None and not is_force,
            f'output {self.name!r} is a reaction: give it quantity = "force" or "torque"',
        )


class CouplingSection(Section):
    """`[coupling]` between n displacements and m states."""

    force_of_states: Rows | None = None
    """Matrix F (n, m): forces on the displacements for each state [SI]."""
    flow_of_speeds: Rows | None = None
    """Matrix G (m, n): flows into the states for each speed [SI]."""
    flow_of_displacements: Rows | None = None
    """Matrix H (m, n): flows into the states for each displacement [SI]."""


class PortSection(NamedVector):
    """`[[port]]`: where an internal force can act, between structure and ground or within it.

    The position of a port is vector . u, or its value is vector . x for a port of states. A law at
    the port acts against it along the same vector, or along `acts` if that is given: a flow out of
    a first tank, by its own level, into a second has the vector [1, 0] and acts along [1, -1].
    """

    acts: Vector | None = None
    """Vector along which a law acts, if it is not `vector` [SI]."""


class LawSection(Section):
    """`[[law]]`: a law that the model has at a port; other keys are the numbers of its `kind`."""

    model_config = ConfigDict(extra="allow", frozen=True)

    name: Name
    """Name of the law, which is unique."""
    kind: Name
    """Kind of the law, a primitive at a port."""
    port: Name
    """Name of the port."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks on a law: its kind is known, and its numbers are allowed for it."""
        kinds = [law.kind for law in LAWS]
        yield (
            self.kind not in kinds,
            f"the law {self.name!r} has the kind {self.kind!r}, but the known ones are "
            f"{', '.join(kinds)}",
        )
        try:
            self.scaled_force(1.0).check()
        except InvalidPatchError as cause:
            yield True, f"the law {self.name!r}: {cause}"

    def scaled_force(self, factor: float) -> PortForce:
        """Return the law of this table, with its force multiplied by a factor."""
        row = {"kind": self.kind, "port": self.port, **(self.model_extra or {})}
        (law,) = ModelPatch.from_list([row], f"the law {self.name!r}")
        assert isinstance(law, PortForce)  # the kind is checked
        return law.scaled(factor)


class ControllerSection(NamedSection):
    """`[[controller]]`: a force acts . (P e + D e' + I s), e = reference - vector . z, s' = e.

    z are the unknowns, or their speeds where `quantity` is a speed; the reference is an input of
    the campaign with the controller's `reference` as its name, and zero in a trial that does not
    record it. With `derivative_of = "measurement"` D acts on -vector . z' alone.
    """

    vector: Vector
    """One number for each unknown; the controller measures their sum times these [SI]."""
    acts: Vector
    """One number for each unknown: where what it gives acts [SI]."""
    quantity: Quantity
    """What it measures."""
    reference: Name | None = None
    """Name of the input of the campaign that it follows; by default zero."""
    proportional: Number = 0.0
    """Gain P of the error [SI]."""
    derivative: Number = 0.0
    """Gain D of the slope of the error [SI]."""
    integral: Number = 0.0
    """Gain I of the integral of the error [SI]."""
    derivative_of: Literal["error", "measurement"] = "error"
    """Whether D acts on the slope of the error, or of the measurement alone."""

    def checks(self) -> Iterator[Check]:
        """Yield the fault of a controller without a gain."""
        has_gain = self.proportional or self.derivative or self.integral
        yield not has_gain, f"controller {self.name!r} has no gain: give one of {', '.join(GAINS)}"


class PlaceSection(NamedVector):
    """`[[place]]`: a place along the structure, by its station [m], where a mass can be added."""

    station: Number
    """Place along the structure [m]."""


class RootSection(Section):
    """`[root]`: motion of the unknowns if the structure rotates rigidly about its root [m/rad]."""

    lever: Vector
    """Motion of each unknown if the base turns [m/rad]."""


class ScaledParameter(ParameterSection):
    """`[[parameter]]`: a calibrated factor that scales the terms that it names."""

    terms: Annotated[
        tuple[Name, ...],
        BeforeValidator(as_list, json_schema_input_type=Name | tuple[Name, ...]),
    ]
    """Names of what the factor scales: a matrix, a part, an input, a load, a law, a controller or
    one of its gains; one or several."""
    mean: Number = 1.0
    """Mean of the posterior [1]."""
    low: NotNegative
    """Least possible value [1]."""
