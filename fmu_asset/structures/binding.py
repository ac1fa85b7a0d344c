"""The binding of a structure's FMU, which follows from its names."""

import json

from fe.runtime.structure_model import StructureModel
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.errors import BindingError
from reporting.toml_file import parse_toml


def structure_binding_text(model: StructureModel) -> str:
    """Return the binding file of a structure's FMU: controls, health, parameters, observations, monitors."""
    tables: list[str] = [
        f"[binding]\nname = {json.dumps(model.name)}\nstep_size = 1.0 # s; no matter where quasi-static\n"
    ]

    def scalar(role: str, name: str, variable: str, unit: str) -> None:
        tables.append(f'[{role}.{name}]\nvariable = "{variable}"\nunit = {json.dumps(unit)}\n')

    for name, unit in zip(model.controls, model.control_units.split(), strict=True):
        scalar("control", name, name, unit)
    for name in model.regions:
        scalar("health", name, f"health.{name}", "1")
    for name in model.parameters:
        scalar("parameter", name, name, "1")
    for name in model.masses:
        scalar("parameter", name, f"mass.{name}", "kg")
    scalar("parameter", "damping_alpha", "damping.alpha", "1/s")
    scalar("parameter", "damping_beta", "damping.beta", "s")
    scalar("parameter", "response", "response", "1")
    for role, names, unit in (
        ("strain", model.gauges, "1"),
        ("displacement", model.displacements, "m"),
        ("acceleration", model.accelerations, "m/s2"),
    ):
        if names:
            variables = json.dumps([f"{role}.{name}" for name in names])
            tables.append(f'[observation.{role}]\nvariables = {variables}\nunit = "{unit}"\n')
    for name, unit in (("strain_error_bound", "1"), ("displacement_error_bound", "m")):
        if model.gauges if unit == "1" else model.displacements:
            scalar("monitor", name, name, unit)
    return "\n".join(tables)


def structure_binding(model: StructureModel) -> Binding:
    """Return the binding of a structure's FMU."""
    where = f"the binding of {model.name}"
    return parse_binding(parse_toml(structure_binding_text(model), where, BindingError), where=where)
