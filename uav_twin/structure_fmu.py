"""`uav-twin structure fmu`."""

from collections.abc import Mapping
from os.path import relpath
from pathlib import Path
from typing import Annotated, Literal

import typer

from reporting import terminal
from uav_twin.structure_arguments import File, MemoryLimit, located, reduced


def fmu(
    file: File,
    out: Annotated[
        Path | None,
        typer.Option(help="The FMU to write; by default beside the structure file, with its name."),
    ] = None,
    kind: Annotated[
        Literal["python", "compiled", "source"],
        typer.Option(help="Run by Python, compiled C, or C sources to be compiled elsewhere."),
    ] = "python",
    fmi: Annotated[int, typer.Option(min=2, max=3, help="Version of FMI: 3 for compiled and source.")] = 2,
    binding: Annotated[
        Path | None, typer.Option(help="Write the binding of the FMU to this file, too.")
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="Write the file by which `calibrate campaign` and `discrepancy` take the FMU as a model."
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the files if they exist.")] = False,
    memory_limit: MemoryLimit = None,
) -> None:
    """Pack the reduced model of a structure as an FMU; equal input gives equal bytes."""
    from fe.structure.design import load_structure
    from fmu_asset.compiled.compiler import find_compiler
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.structure_fmu import build_fmu, check_version
    from fmu_asset.structures.binding import structure_binding_text
    from fmu_asset.structures.rig import rig_text
    from reporting.files import atomic_write_text

    version: Literal[2, 3] = 3 if fmi == 3 else 2
    check_version(kind, version)
    if version == 3 and (binding is not None or rig is not None):
        raise typer.BadParameter("--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding.")
    target = checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    _check_targets(located(file), target, {"binding": binding, "rig": rig}, replace=replace)
    design = load_structure(located(file))
    text = None if rig is None else rig_text(design, relpath(target, rig.parent))
    if kind == "compiled":
        find_compiler()  # before the structure is reduced, which can take minutes
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
