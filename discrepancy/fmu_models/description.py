"""The TOML file of an FMU as a model: which variables are parameters, inputs, outputs and ports."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field

from discrepancy.campaign.records import Quantity
from discrepancy.system.load_change import DEFAULT_PLACE
from discrepancy.system.model_file import (
    ModelDescription,
    NamedSection,
    ParameterSection,
    Section,
)
from fe.runtime.patch import (
    LOADS,
    PRIMITIVES,
    ROOT_TURN,
    STRUCTURE,
    StiffnessDrift,
    SupportCompliance,
)
from reporting.formats.toml_file import Check, Name, Number, Positive
from scenarios import binding_files

CARRIED = tuple(primitive.kind for primitive in (*STRUCTURE, *LOADS, StiffnessDrift))
"""Kinds of primitives that an FMU can carry as its own parameters."""


def _as_table(force: object) -> object:
    """Return the force inputs by load place; a single input without a place is allowed."""
    return {DEFAULT_PLACE: force} if isinstance(force, str) else force


Forces = Annotated[
    dict[Name, Name], BeforeValidator(_as_table, json_schema_input_type=Name | dict[Name, Name])
]
"""Force inputs by load place."""


class FmuInputsSection(Section):
    """`[inputs]`: the inputs that a trial sets, by names of the binding or of the FMU."""

    force: Forces = Field(default_factory=dict)
    """Applied force [N]; a table by the load places of the campaign."""
    load_factor: Name | None = None
    """Load factor [1]."""
    temperature: Name | None = None
    """Temperature less the reference [K], or the temperature itself [degC] with
    `temperature_reference`."""
    temperature_reference: Number | None = None
    """Temperature at which the FMU's model holds [degC]."""
    z1: Name | None = None
    """Stiffness loss of the damage region z1 [1]."""
    z2: Name | None = None
    """Stiffness loss of the damage region z2 [1]."""
    health: dict[Name, Name] = Field(default_factory=dict)
    """Stiffness losses [1] by damage region; z1 and z2 can stand in it, too."""
    bending_moment: Name | None = None
    """Moment [N m] that a force gives when it acts a metre further outboard."""
    torque: Name | None = None
    """Moment [N m] that a force gives when it acts a metre further aft."""

    @property
    def regions(self) -> dict[str, str]:
        """Inputs of the stiffness losses, by damage region."""
        regions: dict[str, str] = {}
        if self.z1 is not None:
            regions["z1"] = self.z1
        if self.z2 is not None:
            regions["z2"] = self.z2
        return regions | self.health


class StaticSection(Section):
    """`[static]`: how a state at rest is reached."""

    settle: bool = False
    """False if the FMU is quasi-static, so that a step gives the equilibrium; true if its motion is
    followed until it rests."""
    step: Positive = 1.0
    """Communication step [s]."""
    limit: Positive = 600.0
    """Longest motion that is waited for [s]."""
    tolerance: Positive = 1e-9
    """At rest, no output moves by more than this fraction of its largest value [1]."""
    parameters: dict[Name, Number] = Field(default_factory=dict)
    """Parameters of the FMU in such trials, in its units [unit of the FMU]."""


class MotionSection(Section):
    """`[motion]`: ring-downs and forced trials; `step` [s] only if the FMU has one step size."""

    step: Positive | None = None
    """Communication step; needed only if the FMU has one step size [s]."""
    parameters: dict[Name, Number] = Field(default_factory=dict)
    """Parameters of the FMU in ring-downs and forced trials, in its units [unit of the FMU]."""


class ReleaseSection(Section):
    """`[release]`: how a ring-down starts."""

    displacement: Name | None = None
    """Parameter: displacement [m] from which the FMU is released at its start."""
    velocity: Name | None = None
    """Parameter: velocity [m/s] at the start, for records that do not begin at rest."""
    hold: Name | None = None
    """In place of a parameter: force input that holds the release point until the start."""
    output: Name | None = None
    """Displacement output that shows where the release point is. Needed with `hold`; with a
    parameter it is for one that is not the release point's own displacement."""

    def checks(self) -> Iterator[Check]:
        """Yield a fault if there is not exactly one way of release, or no output for `hold`."""
        has_none_or_both = (self.displacement is None) == (self.hold is None)
        yield (
            has_none_or_both,
            "give exactly one of displacement (a parameter) and hold (a force input)",
        )
        lacks_output = self.hold is not None and self.output is None
        yield lacks_output, "hold needs output, the displacement output of the release point"


Variable = Annotated[Name, Field(default_factory=lambda section: section.get("name", ""))]
"""A variable of the FMU, of the section's own name by default."""


class FmuOutputSection(NamedSection):
    """`[[output]]`: an output for channels; `{a..b}` stands for the numbers from a to b."""

    variable: Variable
    """Name in the binding or in the FMU, in which `{a..b}` stands for the numbers a to b; by
    default `name`."""
    quantity: Quantity = Quantity.DISPLACEMENT
    """What it is."""


class FmuInputSection(FmuOutputSection):
    """`[[input]]`: an input that static trials hold in each row; `name` as in the campaign."""

    quantity: Quantity = Quantity.SIGNAL


class FmuPortSection(NamedSection):
    """`[[port]]`: where an internal force can act; `rotation`: a moment and an angle."""

    force: Name
    """Input of the force or moment."""
    displacement: Name
    """Output of the displacement or angle."""
    velocity: Name | None = None
    """Output of the velocity or angular velocity."""
    rotation: bool = False
    """Whether the port turns."""


class FmuParameterSection(ParameterSection):
    """`[[parameter]]`: a calibrated parameter that is a variable of the FMU."""

    variable: Variable
    """Name in the binding or in the FMU; by default `name`."""


class ScalesSection(Section):
    """`[scales]`: natural scales that cannot be computed with the FMU, as in `Scales`; all SI."""

    length: Positive | None = None
    """Characteristic length [m]."""
    tip_stiffness: Positive | None = None
    """Force at the place of the load for each metre of its displacement [N/m]."""
    modal_mass: Positive | None = None
    """Mass of the first mode [kg]."""
    angular_frequency: Positive | None = None
    """Angular frequency of the first mode [rad/s]."""


class FmuModelDescription(ModelDescription):
    """Content of the file."""

    what: ClassVar[str] = "an FMU model"
    kind: Literal["fmu"]
    """Kind of the model."""
    fmu: Name
    """The FMU, seen from the file's folder."""
    binding: Name | None = None
    """A binding file, seen from the file's folder, or a shipped binding by name. Without one, names
    here are variables of the FMU."""
    inputs: FmuInputsSection = Field(default_factory=FmuInputsSection)
    """Inputs that a trial sets."""
    static: StaticSection = Field(default_factory=StaticSection)
    """How a state at rest is reached."""
    motion: MotionSection = Field(default_factory=MotionSection)
    """How a motion is computed."""
    release: ReleaseSection | None = None
    """How a ring-down starts."""
    input: tuple[FmuInputSection, ...] = ()
    """Inputs that static trials hold in each row, and that drive driven trials."""
    output: tuple[FmuOutputSection, ...] = Field(min_length=1)
    """What channels can measure."""
    port: tuple[FmuPortSection, ...] = ()
    """Where an internal force can act."""
    parameter: tuple[FmuParameterSection, ...] = ()
    """Calibrated parameters, which are variables of the FMU."""
    effects: dict[Name, Name] = Field(default_factory=dict)
    """Kind of a primitive to the id of the FMU's effect (`effect.<id>.active`,
    `effect.<id>.<number>`)."""
    scales: ScalesSection = Field(default_factory=ScalesSection)
    """Natural scales that cannot be computed with the FMU."""
    superposition: bool = True
    """Whether motions are superposed if the FMU proves to be linear; if false, every motion is
    stepped."""
    isolated: bool = True
    """Whether the FMU runs in a process of its own."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks on the whole file: on names, effects and the reference temperature."""
        for kind in ("port", "parameter", "output", "input"):
            yield from self.repeated_name_checks(
                kind, [section.name for section in getattr(self, kind)]
            )
        for kind in self.effects:
            why = " (internal forces act at ports)" if kind in PRIMITIVES else ""
            yield (
                kind not in CARRIED,
                f"effects.{kind} is not a primitive that an FMU can carry itself{why}; the known "
                f"ones are {', '.join(CARRIED)}",
            )
        inputs = self.inputs
        lacks_temperature = inputs.temperature_reference is not None and inputs.temperature is None
        yield lacks_temperature, "temperature_reference needs the input temperature"

    @property
    def support_motions(self) -> tuple[tuple[str, str], ...]:
        """The turn of the root if the FMU carries its compliance, else none."""
        return (ROOT_TURN,) if SupportCompliance.kind in self.effects else ()

    def binding_file(self, folder: Path) -> Path | None:
        """Return the path of the named binding, shipped or in a folder; None if none is named."""
        if self.binding is None:
            return None
        return binding_files().get(self.binding, folder / self.binding)
