"""An FMU as a model, described by a TOML file: which variables are parameters, inputs, outputs and ports.

First the binding to these variables, in SI units.
"""

from collections.abc import Iterator, Mapping
from math import pi
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError, said
from discrepancy.system.excitation import DEFAULT_PLACE
from discrepancy.system.model_file import ModelDescription, NamedSection, ParameterSection, Section
from fe.runtime.patch import LOADS, PRIMITIVES, STRUCTURE, StiffnessDrift
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector, expand, load_binding
from reporting.toml_file import Fault, Name, Number, Positive
from reporting.words import counted
from scenarios import binding_files

CARRIED = tuple(item.kind for item in (*STRUCTURE, *LOADS, StiffnessDrift))
"""Kinds of primitives that an FMU can carry as its own parameters."""


Forces = Annotated[
    dict[Name, Name],
    BeforeValidator(lambda given: {DEFAULT_PLACE: given} if isinstance(given, str) else given),
]
"""Force inputs by load place, or the only one."""


class Inputs(Section):
    """`[inputs]`: what a trial sets; each name is one of the binding's, or a variable of the FMU.

    Attributes
    ----------
    force : str or table
        Applied force [N]; a table by the load places of the campaign.
    load_factor, z1, z2 : str, optional
        Load factor and stiffness losses [1].
    health : table
        Stiffness losses [1] by damage region; z1 and z2 can stand in it, too.
    temperature : str, optional
        Temperature less the reference [K], or the temperature itself [degC] with `temperature_reference`.
    temperature_reference : float, optional
        Temperature at which the FMU's model holds [degC].
    bending_moment, torque : str, optional
        Moment [N m] that a force gives when it acts a metre further outboard, or aft.
    """

    force: Forces = Field(default_factory=dict)
    load_factor: Name | None = None
    temperature: Name | None = None
    temperature_reference: Number | None = None
    z1: Name | None = None
    z2: Name | None = None
    health: dict[Name, Name] = Field(default_factory=dict)
    bending_moment: Name | None = None
    torque: Name | None = None

    @property
    def regions(self) -> dict[str, str]:
        """Inputs of stiffness losses by damage region."""
        usual = {"z1": self.z1, "z2": self.z2}
        return {name: value for name, value in usual.items() if value is not None} | self.health


class Rest(Section):
    """`[static]`: how a state at rest is reached.

    Attributes
    ----------
    settle : bool
        False: the FMU is quasi-static, and a step gives the equilibrium. True: its motion is followed until
        it rests.
    step : float
        Communication step [s].
    limit : float
        Longest motion that is waited for [s].
    tolerance : float
        At rest, no output moves by more than this share of its largest value.
    parameters : table
        Parameters of the FMU in such trials, in its units.
    """

    settle: bool = False
    step: Positive = 1.0
    limit: Positive = 600.0
    tolerance: Positive = 1e-9
    parameters: dict[Name, Number] = Field(default_factory=dict)


class Moving(Section):
    """`[motion]`: ring-downs and forced trials; `step` [s] only if the FMU has one step size."""

    step: Positive | None = None
    parameters: dict[Name, Number] = Field(default_factory=dict)


class ReleaseOf(Section):
    """`[release]`: how a ring-down starts.

    Attributes
    ----------
    displacement : str, optional
        Parameter: displacement [m] from which the FMU is released at its start.
    velocity : str, optional
        Parameter: velocity [m/s] at the start, for records that do not begin at rest.
    hold : str, optional
        In place of a parameter: force input that holds the release point until the start.
    output : str, optional
        Displacement output that shows where the release point is. Needed with `hold`; with a parameter it is
        for one that is not the release point's own displacement.
    """

    displacement: Name | None = None
    velocity: Name | None = None
    hold: Name | None = None
    output: Name | None = None

    def faults(self) -> Iterator[Fault]:
        """Yield more than one way."""
        both = (self.displacement is None) == (self.hold is None)
        yield both, "give exactly one of displacement (a parameter) and hold (a force input)"
        lacks = self.hold is not None and self.output is None
        yield lacks, "hold needs output, the displacement output of the release point"


Variable = Annotated[Name, Field(default_factory=lambda known: known.get("name", ""))]
"""A variable of the FMU, of the same name where none is said."""


class OutputOf(NamedSection):
    """`[[output]]`: what a channel's `output` names; `{a..b}` stands for all numbers from a to b."""

    variable: Variable
    quantity: Quantity = Quantity.DISPLACEMENT


class InputOf(OutputOf):
    """`[[input]]`: an input that static trials hold in each row; `name` as in the campaign."""

    quantity: Quantity = Quantity.SIGNAL


class PortOf(NamedSection):
    """`[[port]]`: where an internal force can act; `rotation`: a moment and an angle."""

    force: Name
    displacement: Name
    velocity: Name | None = None
    rotation: bool = False


class VariableParameter(ParameterSection):
    """`[[parameter]]`: a calibrated parameter that is a variable of the FMU."""

    variable: Variable


class ScalesOf(Section):
    """`[scales]`: natural scales that the FMU cannot say, as in `Scales`; all SI."""

    length: Positive | None = None
    tip_stiffness: Positive | None = None
    modal_mass: Positive | None = None
    angular_frequency: Positive | None = None


class FmuModelDescription(ModelDescription):
    """Content of the file.

    Attributes
    ----------
    format, kind : 1, "fmu"
        What it is.
    name : str
        For people.
    fmu : str
        The FMU, seen from the file's folder.
    binding : str, optional
        A binding file, seen from the file's folder, or a shipped binding by name. Without one, names here are
        variables of the FMU.
    inputs, static, motion, release, input, output, port, parameter, scales
        See there.
    effects : table
        Kind of a primitive to the id of the FMU's effect (`effect.<id>.active`, `effect.<id>.<number>`).
    superposition : bool
        Whether motions are superposed where the FMU proves to be linear; False: every motion is stepped.
    isolated : bool
        Whether the FMU runs in a process of its own.
    """

    what: ClassVar[str] = "an FMU model"
    kind: Literal["fmu"]
    fmu: Name
    binding: Name | None = None
    inputs: Inputs = Field(default_factory=Inputs)
    static: Rest = Field(default_factory=Rest)
    motion: Moving = Field(default_factory=Moving)
    release: ReleaseOf | None = None
    input: tuple[InputOf, ...] = ()
    output: tuple[OutputOf, ...] = Field(min_length=1)
    port: tuple[PortOf, ...] = ()
    parameter: tuple[VariableParameter, ...] = ()
    effects: dict[Name, Name] = Field(default_factory=dict)
    scales: ScalesOf = Field(default_factory=ScalesOf)
    superposition: bool = True
    isolated: bool = True

    def faults(self) -> Iterator[Fault]:
        """Yield what does not fit together."""
        for kind in ("port", "parameter", "output", "input"):
            yield from self.repeated(kind, [item.name for item in getattr(self, kind)])
        for kind in self.effects:
            why = " (internal forces act at ports)" if kind in PRIMITIVES else ""
            wrong = said("models.effect", kind=kind, why=why, known=", ".join(CARRIED))
            yield kind not in CARRIED, wrong
        lacks = self.inputs.temperature_reference is not None and self.inputs.temperature is None
        yield lacks, "temperature_reference needs the input temperature"

    def binding_file(self, folder: Path) -> Path | None:
        """Return the binding file that is named, a shipped one or one seen from a folder."""
        return None if self.binding is None else binding_files().get(self.binding, folder / self.binding)


REVOLUTIONS = ("1/min", "rpm", "r/min", "rev/min")
"""Units of FMUs in which an angular velocity is revolutions in a minute."""


class FmuVariables:
    """The variables of an FMU that a model needs.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    folder : Path
        Its folder, where relative names begin.

    Attributes
    ----------
    path : Path
        The FMU.
    binding : Binding
        All inputs as loads, by the FMU's names, and all outputs.
    columns : dict of str to int
        Column of each output of the description, and of `port.NAME.displacement` and `.velocity`.
    quantities : dict of str to Quantity
        What each output of the description is.
    input_factors : dict of str to float
        By which an `[[input]]` of the description is multiplied, by the FMU's name: revolutions in a minute
        stand for an angular velocity and have no unit that converts to rad/s.

    Raises
    ------
    FmuError, ModelError
        If FMU or binding are missing, or a variable is missing or of another causality or unit.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        self.path, self._given = folder / description.fmu, description
        step, file = description.motion.step or description.static.step, description.binding_file(folder)
        self._declared = read_fmu(self.path)
        usual = Binding(binding=Header(name=description.name, step_size=step))
        base = usual if file is None else load_binding(file)
        self._variables = dict[str, str]()  # of the FMU by the names of the binding
        for role in ("monitor", "load", "health", "control"):
            for key, item in getattr(base, role).items():
                self._variables |= {key: item.variable, f"{role}.{key}": item.variable}
        self._keys = {item.variable: key for key, item in base.parameter.items()}
        self._keys |= {key: key for key in base.parameter}
        self.input_factors, self.quantities = dict[str, float](), dict[str, Quantity]()
        self.binding = Binding(
            binding=base.with_header(name=description.name, step_size=step, decimation=1).binding,
            limits=base.limits,
            load=self._inputs(),
            parameter=base.parameter | self._parameters(base.parameter),
            observation={"outputs": self._observed()},
        )

    def variable(self, name: str) -> str:
        """Return the FMU's name of an input or output that the description names."""
        return self._variables.get(name, name)

    def parameter(self, name: str) -> str:
        """Return the key under which a parameter is set: that of the binding, or the FMU's own name."""
        return self._keys.get(name, name)

    def _inputs(self) -> dict[str, Input]:
        given, wanted = self._given, self._given.inputs
        units: dict[str | None, str] = {
            **dict.fromkeys(wanted.force.values(), "N"),
            **dict.fromkeys((wanted.load_factor, *wanted.regions.values()), "1"),
            wanted.temperature: "K" if wanted.temperature_reference is None else "degC",
            wanted.bending_moment: "N.m", wanted.torque: "N.m",
            given.release.hold if given.release else None: "N",
            **{port.force: "N.m" if port.rotation else "N" for port in given.port},
        }  # fmt: skip
        for held in given.input:
            unit = self._own_unit(held.variable)
            turning = held.quantity is Quantity.ANGULAR_VELOCITY and unit in REVOLUTIONS
            self.input_factors[self.variable(held.variable)] = 30.0 / pi if turning else 1.0
            units[held.variable] = unit if turning else self._unit(held.quantity, held.variable)
        named = ((self.variable(name), unit) for name, unit in units.items() if name is not None)
        return {variable: Input(variable=variable, unit=unit) for variable, unit in named}

    def _parameters(self, known: Mapping[str, Parameter]) -> dict[str, Parameter]:
        """Return the parameters that are not known so: a value or range in another unit is none of theirs."""
        way, given = self._given.release, self._given.parameter
        units = dict[str | None, str]((item.variable, item.unit) for item in given)
        units |= {way.displacement: "m", way.velocity: "m/s"} if way is not None else {}
        named = ((self.parameter(name), unit) for name, unit in units.items() if name is not None)
        return {
            key: Parameter(variable=known[key].variable if key in known else key, unit=unit)
            for key, unit in named
            if key not in known or unit != known[key].unit
        }

    def _observed(self) -> Vector:
        given, shown = self._given, list[tuple[str, str | None, str]]()
        for item in given.output:
            names, variables = expand(item.name), expand(item.variable)
            if len(names) != len(variables):
                came = counted(len(names), "name"), len(variables)
                raise ModelError(said("models.as_many", model=given, item=item, came=came))
            self.quantities |= dict.fromkeys(names, item.quantity)
            pairs = zip(names, variables, strict=True)
            shown += [(name, variable, self._unit(item.quantity, variable)) for name, variable in pairs]
        for port in given.port:
            unit = "rad" if port.rotation else "m"
            shown.append((f"port.{port.name}.displacement", port.displacement, unit))
            shown.append((f"port.{port.name}.velocity", port.velocity, f"{unit}/s"))
        shown.append(("release", given.release.output if given.release else None, "m"))
        read = [(name, self.variable(variable), unit) for name, variable, unit in shown if variable]
        names, variables, units = zip(*read, strict=True)
        self.columns = {name: column for column, name in enumerate(names)}
        return Vector(variables=variables, unit=units)

    def _unit(self, quantity: Quantity, variable: str) -> str:
        """Return the SI unit of a quantity as FMUs write it, of a signal the variable's own."""
        si = UNITS[quantity].si.replace(" ", ".")
        return self._own_unit(variable) if quantity is Quantity.SIGNAL else si

    def _own_unit(self, variable: str) -> str:
        found = self._declared.variable(self.variable(variable))
        return (found.unit if found is not None else None) or "1"
