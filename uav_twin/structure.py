"""`uav-twin structure info`, `verify`, `field`, `reduce` and `fmu`."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import inf, isnan, nan
from os.path import relpath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fe.runtime.errors import DesignFileError
from reporting import terminal
from reporting.choices import did_you_mean
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing, refuse_filled
from reporting.progress import stage
from reporting.terminal import JsonOption
from reporting.words import comma_list
from scenarios import structure_files
from uav_twin.options import (
    FmiOption,
    FmuKindOption,
    MemoryLimitOption,
    ModeCountOption,
    PlatformsOption,
    ReplaceOption,
    StructureArgument,
    split_platforms,
)

if TYPE_CHECKING:
    from fe.reduction.reduced_basis import MeasuredErrors
    from fe.runtime.reduced import ReducedModel
    from fe.structure.affine import AffineStructure
    from fe.structure.operators import Structure
    from fmu_asset.packing.contents import FmuInfo

RESPONSE_LIMIT = 1e-5
"""Largest difference of a response to that of CalculiX, relative to the largest of its kind."""
FREQUENCY_LIMIT = 1e-6
"""Largest relative difference of a natural frequency to that of CalculiX."""


def find_structure(file: Path) -> Path:
    """Return the path of a structure file, given as a path or as the name of a shipped structure.

    An argument that is neither is returned unchanged, so that the reader of the file refuses it.

    Raises
    ------
    DesignFileError
        If the argument resembles the name of a shipped structure, which the message then suggests.
    """
    if file.exists():
        return file
    shipped = structure_files()
    if str(file) in shipped:
        return shipped[str(file)]
    question = did_you_mean(str(file), shipped)
    if question:
        raise DesignFileError(f"There is no structure file {file}.{question}")
    return file


def is_structure_file(design: Path) -> bool:
    """Return whether a design file describes a structure, and not a wing."""
    from fe.structure.design import is_structure
    from reporting.formats.toml_file import read_toml

    return is_structure(read_toml(find_structure(design), DesignFileError, what="wing design"))


def _in_bytes(gibibytes: float | None) -> float | None:
    """Return a memory limit [GiB] in bytes; None stays None."""
    return None if gibibytes is None else 2.0**30 * gibibytes


def _assemble_mesh(
    file: Path, memory_limit: float | None, *, mass_as_stiffness: bool = False
) -> "Structure":
    """Return the full finite element model of a structure with a mesh.

    With `mass_as_stiffness`, the mass matrix is integrated with the points of the stiffness matrix,
    as in CalculiX. The memory limit is in GiB.
    """
    from fe.structure.operators import load_and_assemble

    with stage("Reading the mesh and assembling"):
        return load_and_assemble(
            find_structure(file), _in_bytes(memory_limit), mass_as_stiffness=mass_as_stiffness
        )


def _assemble(file: Path, memory_limit: float | None) -> "AffineStructure":
    """Return the full model of a structure with a mesh or with matrices; memory limit in GiB."""
    from fe.structure.operators import assemble_structure

    with stage("Reading and assembling"):
        return assemble_structure(find_structure(file), _in_bytes(memory_limit))


def info(
    file: StructureArgument,
    *,
    modes: ModeCountOption = 6,
    memory_limit: MemoryLimitOption = None,
    json: JsonOption = False,
) -> None:
    """Print the parts, masses, modes and responses to the loads of a structure.

    Example: `uav-twin structure info bracket --modes 3`
    """
    from uav_twin.structure_facts import print_structure, structure_record

    structure = _assemble(file, memory_limit)
    with stage("Solving the loads and the modes"):
        record = structure_record(structure, modes)
    if json:
        terminal.print_json(record)
    else:
        print_structure(record)


def verify(
    file: StructureArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for the decks and results of CalculiX; it must be empty."
        ),
    ] = None,
    modes: ModeCountOption = 6,
    memory_limit: MemoryLimitOption = None,
    json: JsonOption = False,
) -> None:
    """Compare loads and modes with those of CalculiX on the same mesh.

    Example: `uav-twin structure verify bracket --out calculix`
    """
    from fe.verification.calculix_comparison import agreement as compare_with_calculix
    from fe.verification.calculix_deck import structure_deck
    from fe.verification.calculix_run import required_calculix
    from fe.verification.wing_checks import Check
    from uav_twin.check_table import exit_if_broken, print_checks

    required_calculix()
    refuse_filled(out)
    structure = _assemble_mesh(file, memory_limit, mass_as_stiffness=True)
    with (
        tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch,
        stage("CalculiX on the same mesh"),
    ):
        agreement = compare_with_calculix(structure_deck(structure), out or Path(scratch), modes)
    # A check for each kind of response to each load, and one for all frequencies
    checks = []
    for load, differences in agreement.loads.items():
        for response, difference in differences.items():
            checks.append(Check(f"load {load}", response, difference, RESPONSE_LIMIT))
    mode_count = len(agreement.ours)
    checks.append(Check(f"{mode_count} modes", "frequencies", agreement.modal, FREQUENCY_LIMIT))
    if json:
        check_records = [
            {
                "of": check.group,
                "what": check.name,
                "difference": check.value,
                "limit": check.limit,
            }
            for check in checks
        ]
        frequencies = {"ours": agreement.ours.tolist(), "calculix": agreement.calculix.tolist()}
        passed = all(check.passed for check in checks)
        terminal.print_json({"checks": check_records, "frequencies": frequencies, "passed": passed})
    else:
        print_checks(checks)
        if out is not None:
            terminal.say(f"Wrote the decks and results of CalculiX to {out}")
    exit_if_broken(checks)


def field(
    file: StructureArgument,
    *,
    out: Annotated[Path, typer.Option("--out", show_default=False, help="The VTU file to write.")],
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at",
            metavar="NAME=VALUE",
            help=(
                "Value of a parameter, loss, mass or control that is not nominal; may be given "
                "several times."
            ),
        ),
    ] = None,
    replace: ReplaceOption = False,
    memory_limit: MemoryLimitOption = None,
) -> None:
    """Solve the full structure under all its loads, and write its field as VTU for ParaView.

    Example: `uav-twin structure field bracket --out bracket.vtu --at z_heel=0.4`
    """
    from fe.structure.operators import write_structure_vtu

    refuse_existing(out, replace=replace)
    structure = _assemble_mesh(file, memory_limit)
    values = _values_at(at or (), structure.ranges)
    with stage("Solving and writing the field"):
        write_structure_vtu(out, structure, values)
    terminal.say(
        f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss"
    )


def _values_at(texts: Sequence[str], ranges: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Read the options `--at NAME=VALUE`; return the values by name.

    An error is raised unless each name is known and occurs once, and each value lies in its range.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, number = text.partition("=")
        low, high = ranges.get(name, (inf, -inf))  # an empty range for an unknown name
        try:
            value = float(number)
        except ValueError:
            value = nan  # outside every range
        if name in values or not low <= value <= high:
            known_ranges = [
                f"{name} from {low:g} to {high:g}" for name, (low, high) in ranges.items()
            ]
            raise typer.BadParameter(
                f"NAME=VALUE is expected, each name once, but {text!r} was given; there are "
                f"{comma_list(known_ranges)}. Give a value inside, or widen its range in the "
                "structure file.",
                param_hint="--at",
            )
        values[name] = value
    return values


def reduce(
    file: StructureArgument,
    *,
    states: Annotated[
        int,
        typer.Option(
            "--states",
            min=0,
            max=1000,
            help="Random states at which it is compared with the full model.",
        ),
    ] = 4,
    memory_limit: MemoryLimitOption = None,
    json: JsonOption = False,
) -> None:
    """Reduce the model of a structure, store it in the cache, and measure its errors.

    Example: `uav-twin structure reduce bracket --states 10`
    """
    from fe.reduction.model_cache import reduced_model
    from fe.reduction.reduced_basis import measured_errors

    model = reduced_model(find_structure(file), memory_limit=_in_bytes(memory_limit))
    errors = None
    if states:
        structure = _assemble(file, memory_limit)
        with stage("Comparing it with the full model"):
            errors = measured_errors(structure, model, states)
    if json:
        terminal.print_json(
            {
                "name": model.name,
                "design_hash": model.design_hash,
                "static_basis": len(model.static_load.T),
                "modal_basis": len(model.modal_load.T),
                "ranges": {name: list(limits) for name, limits in model.validity.items()},
                "errors": None if errors is None else asdict(errors),
            }
        )
        return
    _print_reduced_model(model)
    if errors is not None:
        _print_errors(errors)


def _print_reduced_model(model: "ReducedModel") -> None:
    """Print the ranges of a reduced model's inputs, and the numbers of its vectors and outputs."""
    kinds = _input_kinds(model)
    rows = []
    for (name, (low, high)), nominal_value in zip(
        model.validity.items(), model.nominal, strict=True
    ):
        rows.append((kinds[name], name, f"{low:g}", f"{nominal_value:g}", f"{high:g}"))
    if rows:
        terminal.print_table(("what", "name", "least", "nominal", "largest"), rows)
    terminal.say(
        f"{model.name}: {len(model.static_load.T)} static and {len(model.modal_load.T)} modal "
        f"basis vectors; gauges {len(model.gauges)}, displacements {len(model.displacements)}, "
        f"accelerations {len(model.accelerations)}, modes {model.mode_count}."
    )


def _input_kinds(model: "ReducedModel") -> dict[str, str]:
    """Return the kind of each input of a reduced model, by its name."""
    kinds = dict.fromkeys(model.parameters, "parameter")
    kinds |= dict.fromkeys(model.regions, "stiffness loss")
    kinds |= dict.fromkeys(model.masses, "mass [kg]")
    for name, unit in zip(model.controls, model.control_units, strict=True):
        kinds[name] = f"control [{unit}]"
    return kinds


def _print_errors(errors: "MeasuredErrors") -> None:
    """Print the largest errors of a reduced model, except NaN for outputs that it does not have."""
    values = {
        "strains, of the largest": errors.strain,
        "displacements, of the largest": errors.displacement,
        "certified bound of both": errors.bound,
        "frequencies": errors.frequency,
    }
    rows = [(name, f"{value:.2g}") for name, value in values.items() if not isnan(value)]
    rows.append(("states in which an error exceeds its bound", str(errors.broken)))
    terminal.print_table(("of", f"largest error at {errors.states} random states"), rows)


def fmu(
    file: StructureArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="The FMU to write; by default beside the structure file, with its name.",
        ),
    ] = None,
    kind: FmuKindOption = "python",
    fmi: FmiOption = 2,
    platforms: PlatformsOption = None,
    binding: Annotated[
        Path | None,
        typer.Option("--binding", help="Write the binding of the FMU to this file, too."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig",
            help="Write the file by which `calibrate campaign` and `discrepancy` take the FMU as a "
            "model.",
        ),
    ] = None,
    replace: ReplaceOption = False,
    memory_limit: MemoryLimitOption = None,
) -> None:
    """Pack the reduced model of a structure as an FMU; equal input gives equal bytes.

    Example: `uav-twin structure fmu bracket --out bracket.fmu --binding bracket.toml`
    """
    from fe.reduction.model_cache import reduced_model
    from fe.structure.design import load_structure
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.structure_fmu import build_fmu, check_form
    from fmu_asset.structures import rig_text, structure_binding_text
    from uav_twin.formats import schema_line

    version: Literal[2, 3] = 3 if fmi == 3 else 2
    chosen_platforms = split_platforms(platforms)
    check_form(kind, version, platforms=chosen_platforms)
    if version == 3 and (binding is not None or rig is not None):
        raise typer.BadParameter(
            "--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding."
        )
    source = find_structure(file)
    target = checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    # No further file may take the path of another one
    used_paths = {source.resolve(): "the structure file", target.resolve(): "the FMU"}
    for option, path in (("--binding", binding), ("--rig", rig)):
        if path is None:
            continue
        if path.resolve() in used_paths:
            raise FileNotWrittenError(
                f"{path} is {used_paths[path.resolve()]}: choose another {option}."
            )
        used_paths[path.resolve()] = f"the file of {option}"
        refuse_existing(path, replace=replace, option=option)
    # Make the texts of the further files before anything is built or written, because this may fail
    design = load_structure(source)
    binding_text = structure_binding_text(design) if binding is not None else ""
    model_text = rig_text(design, relpath(target, rig.parent)) if rig is not None else ""
    model = reduced_model(source, memory_limit=_in_bytes(memory_limit))
    packed_fmu = build_fmu(
        model, target, kind=kind, fmi=version, platforms=chosen_platforms, replace=replace
    )
    print_packed_fmu(packed_fmu)
    if binding is not None:
        atomic_write_text(binding, schema_line("binding") + binding_text)
        terminal.say(f"{binding}: its binding")
    if rig is not None:
        atomic_write_text(rig, schema_line("fmu-model") + model_text)
        terminal.say(
            f"{rig}: the model of `uav-twin calibrate campaign` and "
            f"`discrepancy run CAMPAIGN --model {rig}`"
        )


def print_packed_fmu(packed_fmu: "FmuInfo") -> None:
    """Print the file of an FMU that was packed, its size and its GUID."""
    design = f", design {packed_fmu.design_hash[:12]}" if packed_fmu.design_hash else ""
    terminal.say(
        f"{packed_fmu.path}: {packed_fmu.size / 1024:.0f} KiB, GUID {packed_fmu.guid}{design}"
    )
