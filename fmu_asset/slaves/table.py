"""The table of variables of a structure's FMU; the wing has names and texts of its own.

Copied into the FMU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE, WING_MODEL_NAME

from .variables import QUASI_STATIC, TRANSIENT, Causality, FmuVariable, VariableTable

RESERVED = ("response", "status", "strain_error_bound", "displacement_error_bound")
"""Names of variables of the FMU, which controls and parameters of a structure cannot have."""
MODE_COUNT = 6
"""Number of modes with outputs for frequency and damping ratio, if the model has as many."""
TIP_DISPLACEMENT_LIMIT = 0.5
"""Limit of linear kinematics [m]: generous for the tip of a wing of 1.8 m."""

_TEXTS_OF_WING = {
    "load_factor": "Load factor of the turn, lift over weight",
    "tip_force": "Upward force at the load point near the tip",
    "young_modulus_factor": "Factor on Young's modulus of the skin (e)",
    "mass.servo": "Mass of each of the two servos",
    "mass.pitot": "Mass of the pitot tube at the tip",
    "tip_displacement": "Displacement of the tip, positive upwards",
}
"""Descriptions of variables of the wing that differ from those of a structure."""
_BOUND_TEXT = "Certified bound of the error of any static {} against the full finite element model"


class _ValueGroup(NamedTuple):
    """What the variables of a group have in common; each sets a value of the model.

    Attributes
    ----------
    prefix : str
        Prefix of the variable's name.
    causality : str
        Causality of FMI.
    text : str
        Description, with braces for the name in the model.
    unit, display : str or None
        Unit and display unit; the unit of a control is its own.
    """

    prefix: str
    causality: Causality
    text: str
    unit: str | None = None
    display: str | None = None


_CONTROL = _ValueGroup("", "input", "Control {} of the loads")
_PARAMETER = _ValueGroup("", "parameter", "Factor {} on the stiffness", "1")
_REGION = _ValueGroup(
    "health.", "input", "Stiffness that the region {} has lost, as a fraction", "1", "%"
)
_MASS = _ValueGroup("mass.", "parameter", "Mass of {}", "kg", "g")


@dataclass(frozen=True)
class StructureRoles:
    """The roles of variables in the table.

    Attributes
    ----------
    chosen : tuple of str
        Variables of all values that the model takes, in its order: parameters, losses, masses,
        controls.
    displacement_bound : str or None
        The bound of the displacements; None for the wing, which has no such output.
    point_load : int
        Index of the load that holds the structure displaced before a release; the displacement of
        its point may be an output.
    release, load_point : str or None
        The parameter for the displacement of that point before a release, and the output for its
        displacement.
    """

    chosen: tuple[str, ...]
    displacement_bound: str | None = None
    point_load: int = 0
    release: str | None = None
    load_point: str | None = None


def is_wing(model: ReducedModel) -> bool:
    """Return whether a model is a wing; a structure that only has the wing's name is none."""
    return model.name == WING_MODEL_NAME and len(model.followed_shapes) > 0


def structure_table(
    model: ReducedModel, start: Mapping[str, float]
) -> tuple[tuple[FmuVariable, ...], StructureRoles]:
    """Return the variables of a structure's FMU, and their roles.

    The order of the rows is fixed, since value references depend on it.

    Parameters
    ----------
    start : mapping of str to float
        Start values by variable name that replace the nominal ones.

    Raises
    ------
    ValueError
        If a start value is of no input or parameter, or a name is one of `RESERVED`.
    """
    for name in (*model.controls, *model.parameters):
        if name in RESERVED:
            raise ValueError(
                f"a structure with an FMU can have no control or parameter named {name!r}"
            )
    if is_wing(model):
        return _wing_table(model, start)
    return _table_of_structure(model, start)


def _wing_table(
    model: ReducedModel, start: Mapping[str, float]
) -> tuple[tuple[FmuVariable, ...], StructureRoles]:
    """Return the variables of the wing, and their roles."""
    table = _ModelTable(model, start, _TEXTS_OF_WING)
    table.add_values(_CONTROL, model.controls[:1])
    table.add_values(_REGION, model.regions)
    table.add_values(_CONTROL, model.controls[1:])
    table.add_values(_PARAMETER, model.parameters)
    table.add_damping()
    for name in model.masses:
        table.add_value(_MASS, name, f"mass.{name.removesuffix('_mass')}")
    table.add(
        "initial_tip_displacement",
        "parameter",
        "Transient only: displacement of the tip from its equilibrium, released at the start",
        unit="m",
        display="mm",
        limits=(-TIP_DISPLACEMENT_LIMIT, TIP_DISPLACEMENT_LIMIT),
    )
    table.add_response()
    for number in range(1, len(model.gauges) + 1):
        text = f"Strain at gauge {number}, positive under upward lift"
        table.add_strain(f"strain[{number}]", text)
    for _ in model.displacements:
        text = _TEXTS_OF_WING["tip_displacement"]
        table.add("tip_displacement", "output", text, unit="m", display="mm")
    table.add_accelerations()
    table.add_strain("strain_error_bound", _BOUND_TEXT.format("strain"))
    table.add_status()
    table.add(
        "load_point_displacement",
        "output",
        "Displacement of the point near the tip where tip_force acts, positive upwards",
        unit="m",
        display="mm",
    )
    table.add_modes()
    roles = StructureRoles(
        table.chosen(),
        point_load=TIP_FORCE,
        release="initial_tip_displacement",
        load_point="load_point_displacement",
    )
    return table.rows(), roles


def _table_of_structure(
    model: ReducedModel, start: Mapping[str, float]
) -> tuple[tuple[FmuVariable, ...], StructureRoles]:
    """Return the variables of a structure other than the wing, and their roles."""
    table = _ModelTable(model, start, {})
    table.add_values(_CONTROL, model.controls)
    table.add_values(_REGION, model.regions)
    table.add_values(_PARAMETER, model.parameters)
    table.add_values(_MASS, model.masses)
    table.add_damping()
    table.add_response()
    for name in model.gauges:
        table.add_strain(f"strain.{name}", f"Strain at gauge {name}, positive in tension")
    for name in model.displacements:
        text = f"Displacement {name}"
        table.add(f"displacement.{name}", "output", text, unit="m", display="mm")
    table.add_accelerations()
    table.add_strain("strain_error_bound", _BOUND_TEXT.format("strain"))
    bound_text = _BOUND_TEXT.format("displacement")
    table.add("displacement_error_bound", "output", bound_text, unit="m", display="mm")
    table.add_modes()
    table.add_status()
    roles = StructureRoles(table.chosen(), displacement_bound="displacement_error_bound")
    return table.rows(), roles


class _ModelTable(VariableTable):
    """The table of a reduced model, with the rows that all structures share.

    Parameters
    ----------
    start : mapping of str to float
        Start values that replace the nominal ones, by variable name.
    texts : mapping of str to str
        Descriptions that replace the usual ones, by variable name.
    """

    def __init__(
        self, model: ReducedModel, start: Mapping[str, float], texts: Mapping[str, str]
    ) -> None:
        super().__init__(start)
        self._model = model
        self._texts = texts
        self._nominal = dict(zip(model.input_names, model.nominal.tolist(), strict=True))
        self._control_units = dict(zip(model.controls, model.control_units, strict=True))
        self._variables: dict[str, str] = {}

    def chosen(self) -> tuple[str, ...]:
        """Return the variables of all values that the model takes, in its order."""
        return tuple(self._variables[name] for name in self._model.input_names)

    def add_values(self, group: _ValueGroup, names: Sequence[str]) -> None:
        """Append values of the model under the names that they have there."""
        for name in names:
            self.add_value(group, name, f"{group.prefix}{name}")

    def add_value(self, group: _ValueGroup, name: str, variable: str) -> None:
        """Append a value of the model, given its name there and that of its variable."""
        self.add(
            variable,
            group.causality,
            self._texts.get(variable, group.text.format(name)),
            unit=group.unit or self._control_units[name],
            display=group.display,
            limits=self._model.validity[name],
            default=self._nominal[name],
        )
        self._variables[name] = variable

    def add_damping(self) -> None:
        """Append the two parameters of Rayleigh damping."""
        alpha, beta = self._model.damping.tolist()
        text = "{}-proportional Rayleigh damping"
        self.add(
            "damping.alpha",
            "parameter",
            text.format("Mass"),
            unit="1/s",
            limits=(0.0, None),
            default=alpha,
        )
        self.add(
            "damping.beta",
            "parameter",
            text.format("Stiffness"),
            unit="s",
            limits=(0.0, None),
            default=beta,
        )

    def add_response(self) -> None:
        """Append the parameter that chooses a quasi-static or transient response."""
        self.add(
            "response",
            "parameter",
            "Quasi-static (1) or transient (2)",
            kind="Enumeration",
            limits=(QUASI_STATIC, TRANSIENT),
            default=QUASI_STATIC,
            enumeration="Response",
        )

    def add_strain(self, name: str, text: str) -> None:
        """Append an output that is a strain."""
        self.add(name, "output", text, unit="1", display="microstrain")

    def add_accelerations(self) -> None:
        """Append the accelerations of the model."""
        for name in self._model.accelerations:
            text = f"Acceleration {name}; zero where the response is quasi-static"
            self.add(f"acceleration.{name}", "output", text, unit="m/s2")

    def add_modes(self) -> None:
        """Append the frequencies of the first modes, then their damping ratios."""
        modes = range(1, min(MODE_COUNT, self._model.mode_count) + 1)
        for mode in modes:
            text = f"Natural frequency of mode {mode}"
            self.add(f"frequency[{mode}]", "output", text, unit="Hz")
        for mode in modes:
            text = f"Damping ratio of mode {mode}"
            self.add(f"damping_ratio[{mode}]", "output", text, unit="1", display="%")
