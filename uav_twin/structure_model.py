"""`uav-twin structure field`, `reduce` and `fmu`, and what the commands of a structure share."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from os.path import relpath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from reporting import terminal
from uav_twin.options import FmiVersion, Kind, Replace

if TYPE_CHECKING:
    from fe.reduction.structure_errors import MeasuredErrors
    from fe.runtime.reduced import ReducedModel
    from fe.structure.affine import DesignedStructure
    from fe.structure.operators import Structure

File = Annotated[
    Path,
    typer.Argument(
        help="A structure file (TOML) beside its mesh or matrices, or a shipped one.", show_default=False
    ),
]
MemoryLimit = Annotated[
    float | None, typer.Option(min=0.1, help="GiB that it may take; what the machine has left by default.")
]


def located(file: Path) -> Path:
    """Return a structure file, or the shipped one of that name where there is no such file."""
    from scenarios import structure_files

    return file if file.exists() else structure_files().get(str(file), file)


def names_structure(design: Path) -> bool:
    """Return whether a design is that of a structure, and not of a wing."""
    from fe.runtime.errors import DesignFileError
    from fe.structure.design import is_structure
    from reporting.toml_file import read_toml

    return is_structure(read_toml(located(design), DesignFileError, what="wing design"))


def assembled(file: Path, memory_limit: float | None, *, mass_as_stiffness: bool = False) -> "Structure":
    """Return the full model of a mesh; `memory_limit` in GiB."""
    from fe.structure.operators import load_and_assemble

    with terminal.progress().stage("Reading the mesh and assembling"):
        return load_and_assemble(located(file), _bytes(memory_limit), mass_as_stiffness=mass_as_stiffness)


def assembled_of_any(file: Path, memory_limit: float | None) -> "DesignedStructure":
    """Return the full model of a mesh or of matrices; `memory_limit` in GiB."""
    from fe.structure.operators import assemble_structure

    with terminal.progress().stage("Reading and assembling"):
        return assemble_structure(located(file), _bytes(memory_limit))


def reduced(file: Path, memory_limit: float | None) -> "ReducedModel":
    """Return the reduced model, from the cache where it is there."""
    from fe.reduction.model_cache import reduced_structure

    return reduced_structure(located(file), progress=terminal.progress(), memory_limit=_bytes(memory_limit))


def _bytes(memory_limit: float | None) -> float | None:
    from fe.structure.mesh_file import GIB

    return None if memory_limit is None else memory_limit * GIB


def field(
    file: File,
    out: Annotated[Path, typer.Option(help="The VTU file to write.", show_default=False)],
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="A parameter, loss, mass or control that is not nominal; may come again.",
        ),
    ] = None,
    replace: Replace = False,
    memory_limit: MemoryLimit = None,
) -> None:
    """Solve the full structure under all its loads, and write its field as VTU for ParaView."""
    from fe.structure.operators import write_structure_vtu
    from reporting.files import refuse_existing

    refuse_existing(out, replace=replace)
    structure = assembled(file, memory_limit)
    known = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    values: dict[str, float] = {}
    for text in at or ():
        name, value = _named(text, known)
        if name in values:
            raise typer.BadParameter(f"{name} is given twice; give it once.", param_hint="--at")
        low, high = structure.ranges[name]
        if not low <= value <= high:
            raise typer.BadParameter(
                f"{name} must lie between {low:g} and {high:g}, but is {value:g}; give a value inside, or "
                "widen its range in the structure file.",
                param_hint="--at",
            )
        values[name] = value
    with terminal.progress().stage("Solving and writing the field"):
        write_structure_vtu(out, structure, values)
    terminal.say(f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss")


def _named(text: str, known: tuple[str, ...]) -> tuple[str, float]:
    """Return name and value of `NAME=VALUE`."""
    name, sign, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        sign = ""
    if not sign or number != number or number in (float("inf"), -float("inf")):
        raise typer.BadParameter(f"{text!r} is not NAME=VALUE with a finite number.", param_hint="--at")
    if name not in known:
        raise typer.BadParameter(
            f"the structure has nothing named {name!r}; it has {', '.join(known)}.", param_hint="--at"
        )
    return name, number


def reduce(
    file: File,
    states: Annotated[
        int, typer.Option(min=0, max=1000, help="Random states at which it is compared with the full model.")
    ] = 4,
    memory_limit: MemoryLimit = None,
    json: terminal.Json = False,
) -> None:
    """Make the reduced model of a structure, keep it in the cache, and measure its errors."""
    from fe.reduction.structure_errors import measured_errors

    model, errors = reduced(file, memory_limit), None
    if states:
        structure = assembled_of_any(file, memory_limit)
        with terminal.progress().stage("Comparing it with the full model"):
            errors = measured_errors(structure, model, states)
    if json:
        terminal.print_json(
            {
                "name": model.name,
                "design_hash": model.design_hash,
                "static_basis": len(model.static_load.T),
                "modal_basis": len(model.modal_load.T),
                "ranges": {name: list(ends) for name, ends in model.validity.items()},
                "errors": None if errors is None else asdict(errors),
            }
        )
        return
    headings = ("what", "name", "least", "nominal", "largest")
    terminal.print_table(headings, list(_ranges(model)))
    terminal.say(
        f"{model.name}: {len(model.static_load.T)} static and {len(model.modal_load.T)} modal basis vectors; "
        f"gauges {len(model.gauges)}, displacements {len(model.displacements)}, "
        f"accelerations {len(model.accelerations)}, modes {model.mode_count}."
    )
    if errors is not None:
        heading = f"largest error at {errors.states} random states"
        terminal.print_table(("of", heading), list(_errors(errors)))


def _ranges(model: "ReducedModel") -> Iterator[tuple[str, ...]]:
    kinds = dict.fromkeys(model.parameters, "parameter") | dict.fromkeys(model.regions, "stiffness loss")
    kinds |= dict.fromkeys(model.masses, "mass [kg]")
    units = model.control_units
    kinds |= {name: f"control [{unit}]" for name, unit in zip(model.controls, units, strict=True)}
    for (name, (low, high)), nominal in zip(model.validity.items(), model.nominal, strict=True):
        yield kinds[name], name, f"{low:g}", f"{nominal:g}", f"{high:g}"


def _errors(errors: "MeasuredErrors") -> Iterator[tuple[str, str]]:
    for what, value in (
        ("strains, of the largest", errors.strain),
        ("displacements, of the largest", errors.displacement),
        ("certified bound of both", errors.bound),
        ("frequencies", errors.frequency),
    ):
        if value == value:  # not where there are no such outputs
            yield what, f"{value:.2g}"
    yield "states in which an error exceeds its bound", f"{errors.broken}"


def fmu(
    file: File,
    out: Annotated[
        Path | None,
        typer.Option(help="The FMU to write; by default beside the structure file, with its name."),
    ] = None,
    kind: Kind = "python",
    fmi: FmiVersion = 2,
    binding: Annotated[
        Path | None, typer.Option(help="Write the binding of the FMU to this file, too.")
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="Write the file by which `calibrate campaign` and `discrepancy` take the FMU as a model."
        ),
    ] = None,
    replace: Replace = False,
    memory_limit: MemoryLimit = None,
) -> None:
    """Pack the reduced model of a structure as an FMU; equal input gives equal bytes."""
    from fe.structure.design import load_structure
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.structure_fmu import build_fmu, check_form
    from fmu_asset.structures.binding import structure_binding_text
    from fmu_asset.structures.rig import rig_text
    from reporting.files import atomic_write_text

    version: Literal[2, 3] = 3 if fmi == 3 else 2
    check_form(kind, version)
    if version == 3 and (binding is not None or rig is not None):
        raise typer.BadParameter("--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding.")
    target = checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    _check_targets(located(file), target, {"binding": binding, "rig": rig}, replace=replace)
    design = load_structure(located(file))
    text = None if rig is None else rig_text(design, relpath(target, rig.parent))
    model = reduced(file, memory_limit)
    info = build_fmu(model, target, kind=kind, fmi=version, replace=replace)
    terminal.say(f"{info.path}: {info.size / 1024:.0f} KiB, GUID {info.guid}, design {info.design_hash[:12]}")
    if binding is not None:
        atomic_write_text(binding, structure_binding_text(design))
        terminal.say(f"{binding}: its binding")
    if rig is not None and text is not None:
        atomic_write_text(rig, text)
        terminal.say(
            f"{rig}: the model of `uav-twin calibrate campaign` and `discrepancy run CAMPAIGN --model {rig}`"
        )


def _check_targets(file: Path, target: Path, others: Mapping[str, Path | None], *, replace: bool) -> None:
    """Refuse files to write that are one another, or are there."""
    from reporting.errors import FileNotWrittenError
    from reporting.files import refuse_existing

    taken = {file.resolve(): "the structure file", target.resolve(): "the FMU"}
    for name, path in others.items():
        if path is None:
            continue
        if path.resolve() in taken:
            raise FileNotWrittenError(f"{path} is {taken[path.resolve()]}: choose another --{name}.")
        taken[path.resolve()] = f"the file of --{name}"
        refuse_existing(path, replace=replace, option=f"--{name}")
