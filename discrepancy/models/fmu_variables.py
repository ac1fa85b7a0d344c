"""The variables of an FMU that its description as a model names: the binding to them, in SI units."""

from collections.abc import Mapping
from math import pi
from pathlib import Path

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.sentences import said
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector, expand, load_binding
from reporting.words import counted

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
