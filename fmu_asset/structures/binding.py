"""The binding of a structure's FMU, which follows from its names."""

from fe.structure.tables import StructureDesign
from fmu_asset.description import rendered
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
    modes = [f"[{mode}]" for mode in range(1, frequencies + 1)]
    return rendered("structure_binding.toml", design=design, modes=modes).decode().rstrip() + "\n"


def structure_binding(design: StructureDesign, frequencies: int = 0) -> Binding:
    """Return the binding of a structure's FMU; see `structure_binding_text`."""
    where = f"the binding of {design.name}"
    return parse_binding(
        parse_toml(structure_binding_text(design, frequencies), where, BindingError), where=where
    )
