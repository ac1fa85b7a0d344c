"""The table of variables of a structure's FMU, of which the wing has names and texts of its own.

Copied into the FMU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE, WING_MODEL_NAME

from .variables import QUASI_STATIC, TRANSIENT, Causality, FmuVariable, Table

RESERVED = ("response", "status", "strain_error_bound", "displacement_error_bound")
"""Names that controls and parameters of a structure cannot have: its FMU has variables of that name."""
MODE_COUNT = 6
"""Number of modes of which frequency and damping ratio are outputs, if the model has as many."""
TIP_DISPLACEMENT_LIMIT = 0.5
"""Linear kinematics: half a metre at the tip of a wing of 1.8 m is already generous."""

_OF_THE_WING = {
    "load_factor": "Load factor of the turn, lift over weight",
    "tip_force": "Upward force at the load point near the tip",
    "young_modulus_factor": "Factor on Young's modulus of the skin (e)",
    "mass.servo": "Mass of each of the two servos",
    "mass.pitot": "Mass of the pitot tube at the tip",
    "tip_displacement": "Displacement of the tip, positive upwards",
}


_CHOSEN: Mapping[str, tuple[str, Causality, str, str, str | None]] = {
    "parameters": ("", "parameter", "Factor {} on the stiffness", "1", None),
    "regions": ("health.", "input", "Stiffness that the region {} has lost, as a fraction", "1", "%"),
    "masses": ("mass.", "parameter", "Mass of {}", "kg", "g"),
    "controls": ("", "input", "Control {} of the loads", "", None),
}
"""Of what can be chosen: prefix of the variable, causality, text, unit (of a control its own), display."""


@dataclass(frozen=True)
class Roles:
    """Which variables of a table are what; the outputs of the model come first among the outputs.

    Attributes
    ----------
    chosen : tuple of str
        Names of all that can be chosen, in the order of the model: parameters, losses, masses, controls.
    displacement_bound : str or None
        The bound of the displacements, where it is an output.
    point_load : int
        Index of the load that holds the structure aside before a release, and whose point may be an output.
    release, load_point : str or None
        The parameter that says how far it is held aside, and the displacement of that point.
    """

    chosen: tuple[str, ...]
    displacement_bound: str | None = None
    point_load: int = 0
    release: str | None = None
    load_point: str | None = None


def is_wing(model: ReducedModel) -> bool:
    """Return whether a model is that of a wing, and no structure that only bears its name."""
    return model.name == WING_MODEL_NAME and len(model.followed_shapes) > 0


def structure_table(model: ReducedModel, start: Mapping[str, float]) -> tuple[tuple[FmuVariable, ...], Roles]:
    """Return the table, inputs, parameters and outputs, and which of its rows is what.

    Parameters
    ----------
    model : ReducedModel
        The reduced structure.
    start : mapping of str to float
        Start values by variable name that take the place of the nominal ones.

    Raises
    ------
    ValueError
        If a start value is of no input or parameter, or a name is one of `RESERVED`.
    """
    for name in (*model.controls, *model.parameters):
        if name in RESERVED:
            raise ValueError(f"a structure with an FMU can have no control or parameter named {name!r}")
    table, wing = Table(start), is_wing(model)
    texts = _OF_THE_WING if wing else {}
    nominal = dict(zip(model.input_names, model.nominal.tolist(), strict=True))
    control_unit = dict(zip(model.controls, model.control_units, strict=True))
    variables: dict[str, str] = {}

    def add(group: str, part: slice = slice(None)) -> None:
        prefix, causality, text, unit, display = _CHOSEN[group]
        for name in getattr(model, group)[part]:
            variable = f"{prefix}{name.removesuffix('_mass') if wing and group == 'masses' else name}"
            table.add(
                variable, causality, texts.get(variable, text.format(name)), display=display,
                unit=unit or control_unit[name], box=model.validity[name], default=nominal[name],
            )  # fmt: skip
            variables[name] = variable

    first = 1 if wing else len(model.controls)  # its value references are those that it always had
    add("controls", slice(first))
    add("regions")
    add("controls", slice(first, None))
    add("parameters")
    if not wing:
        add("masses")
    for name, what, unit, value in zip(
        ("alpha", "beta"), ("Mass", "Stiffness"), ("1/s", "s"), model.damping.tolist(), strict=True
    ):
        table.add(
            f"damping.{name}", "parameter", f"{what}-proportional Rayleigh damping",
            unit=unit, box=(0.0, None), default=value,
        )  # fmt: skip
    if wing:
        add("masses")
        table.add(
            "initial_tip_displacement", "parameter",
            "Transient only: displacement of the tip from its equilibrium, released at the start",
            unit="m", display="mm", box=(-TIP_DISPLACEMENT_LIMIT, TIP_DISPLACEMENT_LIMIT),
        )  # fmt: skip
    table.add(
        "response", "parameter", "Quasi-static (1) or transient (2)", kind="Enumeration",
        box=(QUASI_STATIC, TRANSIENT), default=QUASI_STATIC, enumeration="Response",
    )  # fmt: skip
    for number, name in enumerate(model.gauges, start=1):
        shown, sense = (f"[{number}]", "under upward lift") if wing else (f".{name}", "in tension")
        table.add(
            f"strain{shown}", "output", f"Strain at gauge {number if wing else name}, positive {sense}",
            unit="1", display="microstrain",
        )  # fmt: skip
    for name in model.displacements:
        variable = "tip_displacement" if wing else f"displacement.{name}"
        table.add(variable, "output", texts.get(variable, f"Displacement {name}"), unit="m", display="mm")
    for name in model.accelerations:
        table.add(
            f"acceleration.{name}", "output", f"Acceleration {name}; zero where the response is quasi-static",
            unit="m/s2",
        )  # fmt: skip
    bound = "Certified bound of the error of any static {} against the full finite element model"
    table.add("strain_error_bound", "output", bound.format("strain"), unit="1", display="microstrain")

    if wing:
        table.add_status()
        table.add(
            "load_point_displacement", "output",
            "Displacement of the point near the tip where tip_force acts, positive upwards",
            unit="m", display="mm",
        )  # fmt: skip
    else:
        table.add("displacement_error_bound", "output", bound.format("displacement"), unit="m", display="mm")
    modes = range(1, min(MODE_COUNT, model.mode_count) + 1)
    for mode in modes:
        table.add(f"frequency[{mode}]", "output", f"Natural frequency of mode {mode}", unit="Hz")
    for mode in modes:
        table.add(f"damping_ratio[{mode}]", "output", f"Damping ratio of mode {mode}", unit="1", display="%")
    chosen = tuple(variables[name] for name in model.input_names)
    if wing:
        names = ("initial_tip_displacement", "load_point_displacement")
        return table.rows(), Roles(chosen, None, TIP_FORCE, *names)
    table.add_status()
    return table.rows(), Roles(chosen, "displacement_error_bound")
