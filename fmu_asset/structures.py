"""What follows from the names of a structure: the binding of its FMU, and the file by which that is a model.

With the latter campaigns are calibrated, and effects searched for: `docs/fmu_models.md`.
"""

import numpy as np

from fe.structure.design import MeshDesign, MeshLoad, PointOutput
from fe.structure.matrix_design import MatrixDesign, MatrixLoad, NodeOutput
from fe.structure.tables import StructureDesign
from fmu_asset.description import rendered
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.errors import BindingError, FmuBuildError
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
    modes = [f"[{mode}]" for mode in range(1, frequencies + 1)]
    return rendered("structure_binding.toml", design=design, modes=modes).decode().rstrip() + "\n"


def structure_binding(design: StructureDesign, frequencies: int = 0) -> Binding:
    """Return the binding of a structure's FMU; see `structure_binding_text`."""
    where = f"the binding of {design.name}"
    return parse_binding(
        parse_toml(structure_binding_text(design, frequencies), where, BindingError), where=where
    )


def rig_text(design: MeshDesign | MatrixDesign, fmu: str) -> str:
    """Return the model file of a structure's FMU: forces, outputs, ports and parameters as its file has them.

    A control in N is a force, and one of the name load_factor the load factor of flights, which
    stand for any rest under it. Where a load of 1 N at a point meets a displacement output along
    it, there is a port. Ports of the structure file are named in a comment alone: the FMU has no
    input for a force there.

    Parameters
    ----------
    design : MeshDesign or MatrixDesign
        The structure.
    fmu : str
        Path of its FMU, seen from the folder of the file.

    Raises
    ------
    FmuBuildError
        If no control is a force or a load factor.
    """
    forces = [part.name for part in design.control if part.unit == "N"]
    flies = any(part.name == "load_factor" for part in design.control)
    if not forces and not flies:
        raise FmuBuildError(
            f"The structure {design.name} has no control in N and no load_factor, and a campaign "
            'needs a load that is recorded: give a [[control]] with unit = "N" and a [[load]] of 1 '
            "N tied to it, or a [[control]] load_factor."
        )
    ports = [
        (load.control, output.name)
        for load in design.load
        for output in design.displacement
        if load.control in forces and _meet(load, output)
    ]
    text = rendered("rig.toml", design=design, fmu=fmu, forces=forces, flies=flies, ports=ports)
    return text.decode().rstrip() + "\n"


def _meet(load: MeshLoad | MatrixLoad, output: PointOutput | NodeOutput) -> bool:
    """Return whether a load is 1 N at the place of an output and along it."""
    place, read = (getattr(part, "point", getattr(part, "node", None)) for part in (load, output))
    if place is None or load.force is None or place != read or output.direction is None:
        return False
    direction = np.asarray(output.direction) / np.linalg.norm(output.direction)
    return bool(np.abs(np.asarray(load.force) - direction).max() < 1e-9)
