"""`uav-twin structure ...`."""

import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from math import inf, nan
from os.path import relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from fe.runtime.errors import DesignFileError
from reporting import terminal
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing, refuse_filled
from reporting.toml_file import read_toml
from scenarios import structure_files
from uav_twin.options import say_packed, show, told
from uav_twin.sentences import said
from uav_twin.wing import Check, end_with, print_checks

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from fe.structure.affine import AffineStructure
    from fe.structure.operators import Structure

RESPONSE_LIMIT, FREQUENCY_LIMIT = 1e-5, 1e-6
"""Largest differences to CalculiX, each relative to the largest of its kind."""

structure_app = typer.Typer(
    no_args_is_help=True,
    help="Look at a structure from a mesh or matrices, verify it against CalculiX, reduce it, pack it.",
)


def located(file: Path) -> Path:
    """Return a structure file, or the shipped one of that name where there is no such file."""
    return file if file.exists() else structure_files().get(str(file), file)


def names_structure(design: Path) -> bool:
    """Return whether a design is that of a structure, and not of a wing."""
    from fe.structure.design import is_structure

    return is_structure(read_toml(located(design), DesignFileError, what="wing design"))


def in_bytes(gibibytes: float | None) -> float | None:
    """Return a limit that is typed in GiB."""
    return None if gibibytes is None else 2.0**30 * gibibytes


def assembled(file: Path, memory_limit: float | None, *, mass_as_stiffness: bool = False) -> "Structure":
    """Return the full model of a mesh."""
    from fe.structure.operators import load_and_assemble

    with terminal.progress().stage("Reading the mesh and assembling"):
        return load_and_assemble(located(file), in_bytes(memory_limit), mass_as_stiffness=mass_as_stiffness)


def assembled_of_any(file: Path, memory_limit: float | None) -> "AffineStructure":
    """Return the full model of a mesh or of matrices."""
    from fe.structure.operators import assemble_structure

    with terminal.progress().stage("Reading and assembling"):
        return assemble_structure(located(file), in_bytes(memory_limit))


def reduced(file: Path, memory_limit: float | None) -> "ReducedModel":
    """Return the reduced model, from the cache where it is there."""
    from fe.reduction.model_cache import reduced_structure

    return reduced_structure(located(file), progress=terminal.progress(), memory_limit=in_bytes(memory_limit))


@structure_app.command("info")
@told("structure info")
def info(file: Path, *, modes: int = 6, memory_limit: float | None = None, json: bool = False) -> None:
    """Say what a structure is made of, what it weighs, how it vibrates and what its loads do to it."""
    structure = assembled_of_any(file, memory_limit)
    with terminal.progress().stage("Solving the loads and the modes"):
        record = structure_record(structure, modes)
    if json:
        terminal.print_json(record)
        return
    show("structure info", record=record)
    for load in record["loads"]:
        outputs = [
            (what, name, f"{scale * value:.6g}", unit)
            for what, key, scale, unit in (
                ("gauge", "strain", 1e6, "microstrain"),
                ("displacement", "output", 1e3, "mm"),
            )
            for name, value in load[key].items()
        ]
        show("load of a structure", **load, outputs=outputs)


def structure_record(structure: "AffineStructure", modes: int) -> dict[str, Any]:
    """Return what is known of a structure without damage, at nominal values, by name.

    Lengths carry the unit of the mesh where `length_unit` stands beside them; everything else is in SI units.
    """
    from fe.structure.affine import natural_frequencies, static_responses
    from fe.structure.operators import Structure

    design, heavy = structure.design, structure.mass().diagonal().any()
    frequencies = natural_frequencies(structure, modes)[0].tolist() if heavy else []
    loads = [
        {
            "name": name,
            "control": structure.loads[name],
            "value": 1.0 if structure.loads[name] is None else structure.controls[str(structure.loads[name])],
            "largest_displacement": found.largest,
            "strain": dict(zip(structure.gauges, map(float, found.strain), strict=True)),
            "output": dict(zip(structure.displacements, map(float, found.output), strict=True)),
        }
        for name, found in static_responses(structure).items()
    ]
    return {
        "name": design.name,
        "design_hash": structure.design_hash,
        "unknowns": structure.unknowns,
        "length_unit": design.length_unit,
        "remarks": [],
        "parts": [],
        **(_of_mesh(structure) if isinstance(structure, Structure) else {"matrices": [*design.files]}),
        "frequencies": frequencies,
        "loads": loads,
    }


def _of_mesh(structure: "Structure") -> dict[str, Any]:
    from fe.structure.mesh_file import memory_estimate
    from fe.structure.operators import weighed

    mesh = structure.mesh
    mass, centre = weighed(structure)
    return {
        "mesh": structure.design.mesh,
        "remarks": list(mesh.remarks),
        "kind": mesh.kind.name,
        "linear_elements": not mesh.kind.edges,
        "elements": len(mesh.cells),
        "nodes": len(mesh.points),
        "loose_nodes": [int(number) for number in mesh.loose],
        "held": mesh.unknowns - structure.unknowns,
        "memory": memory_estimate(mesh),
        "mass": mass,
        "centre_of_gravity": [float(value) / mesh.unit for value in centre],
        "lower": [float(value) / mesh.unit for value in mesh.points.min(axis=0)],
        "upper": [float(value) / mesh.unit for value in mesh.points.max(axis=0)],
        "parts": list(_parts(structure)),
    }


def _parts(structure: "Structure") -> Iterator[dict[str, Any]]:
    design, mesh = structure.design, structure.mesh

    def part(what: str, name: str, chosen: str, count: int, of: str, note: str = "") -> dict[str, Any]:
        return {"what": what, "name": name, "set": chosen, "count": count, "of": of, "note": note}

    for number, material in enumerate(design.material):
        count = int((structure.material_of == number).sum())
        note = f"scaled by {material.scaled_by}" if material.scaled_by else ""
        yield part("material", material.name, material.set, count, "elements", note)
    for number, damage in enumerate(design.damage):
        count = int((structure.region_of == number).sum())
        yield part("damage region", damage.name, damage.set, count, "elements")
    for number, support in enumerate(design.support, start=1):
        count = len(mesh.nodes_of(support.set, f"support[{number}]"))
        notes = [f"holds {', '.join(support.hold)}"] * bool(support.hold) + ["springs"] * bool(
            support.springs
        )
        note = ", ".join(["rigid"] * (support.rigid_about is not None) + notes)
        yield part("support", str(number), support.set, count, "nodes", note)
    for load in design.load:
        if load.set is not None:
            nodes = mesh.nodes_of(load.set, load.name)
            faces = len(mesh.faces_between(load.set, nodes))
            yield part("load", load.name, load.set, faces or len(nodes), "faces" if faces else "nodes")
    for gauge, distance in zip(design.gauge, structure.gauges_moved.tolist(), strict=True):
        moved = f"put onto the surface, {distance / mesh.unit:.3g} {mesh.unit_name} away"
        yield part("gauge", gauge.name, "", 1, "place", moved if distance > 1e-6 * mesh.size else "")


@structure_app.command("verify")
@told("structure verify")
def verify(
    file: Path,
    *,
    out: Path | None = None,
    modes: int = 6,
    memory_limit: float | None = None,
    json: bool = False,
) -> None:
    """Solve the loads and the modes by CalculiX on the same mesh, and compare."""
    from fe.verification.calculix_comparison import agreement, required_calculix, structure_deck

    required_calculix()
    refuse_filled(out)
    structure = assembled(file, memory_limit, mass_as_stiffness=True)
    with (
        tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch,
        terminal.progress().stage("CalculiX on the same mesh"),
    ):
        found = agreement(structure_deck(structure), out or Path(scratch), modes)
    checks = [
        Check(f"load {load}", what, value, RESPONSE_LIMIT)
        for load, differences in found.loads.items()
        for what, value in differences.items()
    ]
    checks.append(Check(f"{len(found.ours)} modes", "frequencies", found.modal, FREQUENCY_LIMIT))
    if json:
        terminal.print_json(
            {
                "checks": [
                    {"of": check.group, "what": check.name, "difference": check.value, "limit": check.limit}
                    for check in checks
                ],
                "frequencies": {key: getattr(found, key).tolist() for key in ("ours", "calculix")},
                "passed": all(check.passed for check in checks),
            }
        )
    else:
        print_checks(checks)
        if out is not None:
            terminal.say(f"Wrote the decks and results of CalculiX to {out}")
    end_with(checks)


@structure_app.command("field")
@told("structure field")
def field(
    file: Path,
    *,
    out: Path,
    at: list[str] | None = None,
    replace: bool = False,
    memory_limit: float | None = None,
) -> None:
    """Solve the full structure under all its loads, and write its field as VTU for ParaView."""
    from fe.structure.operators import write_structure_vtu

    refuse_existing(out, replace=replace)
    structure = assembled(file, memory_limit)
    values: dict[str, float] = {}
    for text in at or ():
        name, _, number = text.partition("=")
        low, high = structure.ranges.get(name, (inf, -inf))
        try:
            value = float(number)
        except ValueError:
            value = nan
        if name in values or not low <= value <= high:
            ranges = structure.ranges.items()
            known = [f"{own} from {low:g} to {high:g}" for own, (low, high) in ranges]
            raise typer.BadParameter(said("structure.at", text=text, known=known), param_hint="--at")
        values[name] = value
    with terminal.progress().stage("Solving and writing the field"):
        write_structure_vtu(out, structure, values)
    terminal.say(f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss")


@structure_app.command("reduce")
@told("structure reduce")
def reduce(file: Path, *, states: int = 4, memory_limit: float | None = None, json: bool = False) -> None:
    """Make the reduced model of a structure, keep it in the cache, and measure its errors."""
    from fe.reduction.reduced_basis import measured_errors

    model, errors = reduced(file, memory_limit), None
    if states:
        structure = assembled_of_any(file, memory_limit)
        with terminal.progress().stage("Comparing it with the full model"):
            errors = measured_errors(structure, model, states)
    record = {
        "name": model.name,
        "design_hash": model.design_hash,
        "static_basis": len(model.static_load.T),
        "modal_basis": len(model.modal_load.T),
        "ranges": {name: list(ends) for name, ends in model.validity.items()},
        "errors": None if errors is None else asdict(errors),
    }
    if json:
        terminal.print_json(record)
    else:
        show("structure reduce", model=model, record=record, ranges=list(_ranges(model)))


def _ranges(model: "ReducedModel") -> Iterator[tuple[str, ...]]:
    kinds = dict.fromkeys(model.parameters, "parameter") | dict.fromkeys(model.regions, "stiffness loss")
    kinds |= dict.fromkeys(model.masses, "mass [kg]")
    units = model.control_units
    kinds |= {name: f"control [{unit}]" for name, unit in zip(model.controls, units, strict=True)}
    for (name, (low, high)), nominal in zip(model.validity.items(), model.nominal, strict=True):
        yield kinds[name], name, f"{low:g}", f"{nominal:g}", f"{high:g}"


@structure_app.command("fmu")
@told("structure fmu")
def fmu(
    file: Path,
    *,
    out: Path | None = None,
    kind: Literal["python", "compiled", "source"] = "python",
    fmi: int = 2,
    binding: Path | None = None,
    rig: Path | None = None,
    replace: bool = False,
    memory_limit: float | None = None,
) -> None:
    """Pack the reduced model of a structure as an FMU; equal input gives equal bytes."""
    from fe.structure.design import load_structure
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.structure_fmu import build_fmu, check_form
    from fmu_asset.structures.binding import structure_binding_text
    from fmu_asset.structures.rig import rig_text

    version: Literal[2, 3] = 3 if fmi == 3 else 2
    check_form(kind, version)
    if version == 3 and (binding is not None or rig is not None):
        raise typer.BadParameter("--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding.")
    source = located(file)
    target = checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    taken = {source.resolve(): "the structure file", target.resolve(): "the FMU"}
    design, others = load_structure(source), list[tuple[Path, str, str]]()
    for option, path in (("--binding", binding), ("--rig", rig)):
        if path is None:
            continue
        if path.resolve() in taken:
            raise FileNotWrittenError(f"{path} is {taken[path.resolve()]}: choose another {option}.")
        taken[path.resolve()] = f"the file of {option}"
        refuse_existing(path, replace=replace, option=option)
        if option == "--rig":
            use = f"the model of `uav-twin calibrate campaign` and `discrepancy run CAMPAIGN --model {path}`"
            others.append((path, rig_text(design, relpath(target, path.parent)), use))
        else:
            others.append((path, structure_binding_text(design), "its binding"))
    model = reduced(file, memory_limit)
    info = build_fmu(model, target, kind=kind, fmi=version, replace=replace)
    say_packed(info)
    for path, text, what in others:
        atomic_write_text(path, text)
        terminal.say(f"{path}: {what}")
