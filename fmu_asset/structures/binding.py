"""The binding of a structure's FMU, which follows from its names."""

import json
from collections.abc import Mapping
from typing import NamedTuple

from fe.runtime.reduced import ReducedModel
from fe.structure.design import StructureDesign
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.errors import BindingError
from reporting.toml_file import parse_toml


class StructureNames(NamedTuple):
    """Names of all that a structure's FMU takes and gives; controls with their units."""

    name: str
    controls: Mapping[str, str]
    regions: tuple[str, ...]
    parameters: tuple[str, ...]
    masses: tuple[str, ...]
    gauges: tuple[str, ...]
    displacements: tuple[str, ...]
    accelerations: tuple[str, ...]


def names_of_model(model: ReducedModel) -> StructureNames:
    """Return the names of a reduced structure."""
    return StructureNames(
        model.name,
        dict(zip(model.controls, model.control_units.split(), strict=True)),
        model.regions,
        model.parameters,
        model.masses,
        model.gauges,
        model.displacements,
        model.accelerations,
    )


def names_of_design(design: StructureDesign) -> StructureNames:
    """Return the names that the reduced model of a structure file will have."""
    return StructureNames(
        design.name,
        {part.name: part.unit for part in design.control},
        tuple(part.name for part in design.damage),
        tuple(part.name for part in design.parameter),
        tuple(part.name for part in design.mass if part.free),
        tuple(part.name for part in design.gauge),
        tuple(part.name for part in design.displacement),
        tuple(part.name for part in design.acceleration),
    )


def structure_binding_text(names: StructureNames, frequencies: int = 0) -> str:
    """Return the binding file of a structure's FMU: control, health, parameters, observations, monitors.

    Parameters
    ----------
    names : StructureNames
        Of the structure.
    frequencies : int
        How many natural frequencies are observed, too; they cost the FMU more than all the rest.
    """
    title = json.dumps(names.name)
    tables = [f"[binding]\nname = {title}\nstep_size = 1.0 # s; no matter where quasi-static\n"]

    def scalar(role: str, name: str, variable: str, unit: str) -> None:
        tables.append(f'[{role}.{name}]\nvariable = "{variable}"\nunit = {json.dumps(unit)}\n')

    for name, unit in names.controls.items():
        scalar("control", name, name, unit)
    for name in names.regions:
        scalar("health", name, f"health.{name}", "1")
    for name in names.parameters:
        scalar("parameter", name, name, "1")
    for name in names.masses:
        scalar("parameter", name, f"mass.{name}", "kg")
    for name, variable, unit in (
        ("damping_alpha", "damping.alpha", "1/s"),
        ("damping_beta", "damping.beta", "s"),
        ("response", "response", "1"),
    ):
        scalar("parameter", name, variable, unit)
    for role, outputs, unit in (
        ("strain", names.gauges, "1"),
        ("displacement", names.displacements, "m"),
        ("acceleration", names.accelerations, "m/s2"),
    ):
        if outputs:
            variables = json.dumps([f"{role}.{name}" for name in outputs])
            tables.append(f'[observation.{role}]\nvariables = {variables}\nunit = "{unit}"\n')
    if frequencies:
        variables = json.dumps([f"frequency[{mode}]" for mode in range(1, frequencies + 1)])
        tables.append(f'[observation.frequency]\nvariables = {variables}\nunit = "Hz"\n')
    for what, outputs, unit in (("strain", names.gauges, "1"), ("displacement", names.displacements, "m")):
        if outputs:
            scalar("monitor", f"{what}_error_bound", f"{what}_error_bound", unit)
    return "\n".join(tables)


def structure_binding(names: StructureNames, frequencies: int = 0) -> Binding:
    """Return the binding of a structure's FMU; see `structure_binding_text`."""
    where = f"the binding of {names.name}"
    return parse_binding(
        parse_toml(structure_binding_text(names, frequencies), where, BindingError), where=where
    )
