"""Files for the FMU of a structure: its binding, and its description as a model of campaigns.

With the latter, campaigns are calibrated and missing effects are searched for:
`docs/how_to/fmu_models.md`.
"""

import numpy as np

from fe.structure.design import MeshDesign, MeshLoad, PointOutput
from fe.structure.matrix_design import MatrixDesign, MatrixLoad, NodeOutput
from fe.structure.tables import StructureDesign
from fmu_asset.client.binding import Binding, parse_binding
from fmu_asset.description import rendered
from fmu_asset.errors import BindingError, FmuBuildError
from reporting.formats.toml_file import parse_toml


def structure_binding_text(design: StructureDesign, frequencies: int = 0) -> str:
    """Return the text of the binding file of a structure's FMU, with all its variables.

    Parameters
    ----------
    design : StructureDesign
        The structure; its reduced model uses the same names.
    frequencies : int
        The number of natural frequencies that are observed as well. They take the FMU longer than
        all other outputs together.
    """
    modes = [f"[{mode}]" for mode in range(1, frequencies + 1)]
    text = rendered("structure_binding.toml", design=design, modes=modes).decode()
    return text.rstrip() + "\n"


def structure_binding(design: StructureDesign, frequencies: int = 0) -> Binding:
    """Return the binding of a structure's FMU; see `structure_binding_text`."""
    where = f"the binding of {design.name}"
    content = parse_toml(structure_binding_text(design, frequencies), where, BindingError)
    return parse_binding(content, where=where)


def rig_text(design: MeshDesign | MatrixDesign, fmu: str) -> str:
    """Return the text of the file that describes a structure's FMU as a model for campaigns.

    It has the forces, outputs, ports and parameters of the structure's file. A control in N is a
    force, and one named load_factor is the load factor of flights. A point with a load of 1 N and a
    displacement output along it becomes a port. Ports of the structure file are only named in a
    comment, since the FMU has no input for a force there.

    Parameters
    ----------
    fmu : str
        Path of its FMU, relative to the folder of the file.

    Raises
    ------
    FmuBuildError
        If no control is a force or a load factor.
    """
    forces = [control.name for control in design.control if control.unit == "N"]
    has_load_factor = any(control.name == "load_factor" for control in design.control)
    if not forces and not has_load_factor:
        raise FmuBuildError(
            f"The structure {design.name} has no control in N and no load_factor, and a campaign "
            'needs a load that is recorded: give a [[control]] with unit = "N" and a [[load]] of '
            "1 N tied to it, or a [[control]] load_factor."
        )
    ports = []
    for load in design.load:
        for output in design.displacement:
            if load.control in forces and _is_unit_force_along(load, output):
                ports.append((load.control, output.name))
    text = rendered(
        "rig.toml",
        design=design,
        fmu=fmu,
        forces=forces,
        flies=has_load_factor,
        ports=ports,
    ).decode()
    return text.rstrip() + "\n"


def _is_unit_force_along(load: MeshLoad | MatrixLoad, output: PointOutput | NodeOutput) -> bool:
    """Return whether a load is a force of 1 N at the location and in the direction of an output."""
    if load.force is None or output.direction is None:
        return False
    load_location = _location(load)
    if load_location is None or load_location != _location(output):
        return False
    direction = np.asarray(output.direction) / np.linalg.norm(output.direction)
    return bool(np.abs(np.asarray(load.force) - direction).max() < 1e-9)


def _location(part: MeshLoad | MatrixLoad | PointOutput | NodeOutput) -> object:
    """Return the point or node of a load or output, or None."""
    return getattr(part, "point", getattr(part, "node", None))
