"""The binding of a structure's FMU, which follows from its names."""

import json

from fe.structure.tables import StructureDesign
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.errors import BindingError
from reporting.toml_file import parse_toml


def structure_binding_text(design: StructureDesign, frequencies: int = 0) -> str:
    """Return the binding file of a structure's FMU: control, health, parameters, observations, monitors.

    Parameters
    ----------
    design : StructureDesign
        The structure; its reduced model has the same names.
    frequencies : int
        How many natural frequencies are observed, too; they cost the FMU more than all the rest.
    """
    title = json.dumps(design.name)
    tables = [f"[binding]\nname = {title}\nstep_size = 1.0 # s; no matter where quasi-static\n"]

    def scalar(role: str, name: str, variable: str, unit: str) -> None:
        tables.append(f'[{role}.{name}]\nvariable = "{variable}"\nunit = {json.dumps(unit)}\n')

    for control in design.control:
        scalar("control", control.name, control.name, control.unit)
    for region in design.damage:
        scalar("health", region.name, f"health.{region.name}", "1")
    for factor in design.parameter:
        scalar("parameter", factor.name, factor.name, "1")
    for mass in design.mass:
        if mass.free:
            scalar("parameter", mass.name, f"mass.{mass.name}", "kg")
    for name, variable, unit in (
        ("damping_alpha", "damping.alpha", "1/s"),
        ("damping_beta", "damping.beta", "s"),
        ("response", "response", "1"),
    ):
        scalar("parameter", name, variable, unit)
    for role, outputs, unit in (
        ("strain", design.gauge, "1"),
        ("displacement", design.displacement, "m"),
        ("acceleration", design.acceleration, "m/s2"),
    ):
        if outputs:
            variables = json.dumps([f"{role}.{part.name}" for part in outputs])
            tables.append(f'[observation.{role}]\nvariables = {variables}\nunit = "{unit}"\n')
    if frequencies:
        variables = json.dumps([f"frequency[{mode}]" for mode in range(1, frequencies + 1)])
        tables.append(f'[observation.frequency]\nvariables = {variables}\nunit = "Hz"\n')
    for what, outputs, unit in (("strain", design.gauge, "1"), ("displacement", design.displacement, "m")):
        if outputs:
            scalar("monitor", f"{what}_error_bound", f"{what}_error_bound", unit)
    return "\n".join(tables)


def structure_binding(design: StructureDesign, frequencies: int = 0) -> Binding:
    """Return the binding of a structure's FMU; see `structure_binding_text`."""
    where = f"the binding of {design.name}"
    return parse_binding(
        parse_toml(structure_binding_text(design, frequencies), where, BindingError), where=where
    )
