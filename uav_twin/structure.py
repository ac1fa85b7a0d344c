"""`uav-twin structure ...`, `uav-twin wing` and `uav-twin wing verify`, and how checks end."""

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import inf, nan
from os.path import relpath
from pathlib import Path
from typing import Any, Literal

import typer

from fe.runtime.errors import DesignFileError
from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing, refuse_filled
from reporting.progress import stage
from scenarios import structure_files
from uav_twin import parts
from uav_twin.options import answer, said, show


def wing(*, design: Path | None = None, vtu: Path | None = None, as_json: bool = False) -> None:
    """Say what the wing weighs, how it vibrates and how stiff its tip is."""
    drawn, state, written = parts.load_design(design), DigitalState(), list[Path]()
    model = parts.reduced_model(drawn)
    modes, structure = model.modes(state.values, state.stiffness_loss), parts.structural_mass(drawn)
    shapes = dict(zip(modes.followed, ("first flapwise bending", "second flapwise bending"), strict=True))
    if vtu is not None:
        fields = parts.wing_fields(drawn)
        vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
        written = [vtu, vtu.with_name(f"{vtu.stem}-modes{vtu.suffix}")]
        parts.write_wing_vtu(written[0], fields, vector)
        parts.write_modes_vtu(written[1], fields, vector)
    record = {
        "design": drawn.name,
        "design_hash": drawn.hash,
        "structural_mass": structure,
        "mass": structure + 2 * state.servo_mass + state.pitot_mass,
        "tip_stiffness": float(model.tip_stiffness(state.young_modulus_factor)),
        "modes": [
            {"number": index + 1, "frequency": float(frequency), "shape": shapes.get(index, "")}
            for index, frequency in enumerate(modes.frequency)
        ],
        "written": [*map(str, written)],
    }
    answer("wing", record=record, json=as_json)


def verify_wing(*, design: Path | None = None, out: Path | None = None, quick: bool = False) -> None:
    """Check a wing's finite element model: balances, convergence, and CalculiX where it is installed."""
    drawn = parts.load_design(design)
    refuse_filled(out)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        checks = parts.all_checks(drawn, (out or Path(scratch)) / "calculix", quick=quick)
    show("checks", checks=checks)
    if parts.calculix_program() is None:
        terminal.say("CalculiX is not installed (apt-get install calculix-ccx): its checks are left out.")
    if out is not None:
        rows = [asdict(check) | {"passed": check.passed} for check in checks]
        record = parts.plain({"design": drawn.name, "design_hash": drawn.hash, "checks": rows})
        path = atomic_write_text(out / "verification.json", json.dumps(record, indent=2) + "\n")
        terminal.say(f"Wrote {path}")
    end_with(checks)


def end_with(checks: "Sequence[parts.Check]") -> None:
    """End with 1, and say which limits are broken, if any is."""
    broken = [f"{check.group}, {check.name}" for check in checks if not check.passed]
    if broken:
        raise terminal.error_exit(
            f"{len(broken)} of {len(checks)} checks broke their limit: {'; '.join(broken)}."
        )


RESPONSE_LIMIT, FREQUENCY_LIMIT = 1e-5, 1e-6
"""Largest differences to CalculiX, each relative to the largest of its kind."""


def located(file: Path) -> Path:
    """Return a structure file, or the shipped one of that name where there is no such file."""
    return file if file.exists() else structure_files().get(str(file), file)


def names_structure(design: Path) -> bool:
    """Return whether a design is that of a structure, and not of a wing."""
    return parts.is_structure(parts.read_toml(located(design), DesignFileError, what="wing design"))


def in_bytes(gibibytes: float | None) -> float | None:
    """Return a limit that is typed in GiB."""
    return None if gibibytes is None else 2.0**30 * gibibytes


def assembled(
    file: Path, memory_limit: float | None, *, mass_as_stiffness: bool = False
) -> "parts.Structure":
    """Return the full model of a mesh."""
    with stage("Reading the mesh and assembling"):
        limit = in_bytes(memory_limit)
        return parts.load_and_assemble(located(file), limit, mass_as_stiffness=mass_as_stiffness)


def assembled_of_any(file: Path, memory_limit: float | None) -> "parts.AffineStructure":
    """Return the full model of a mesh or of matrices."""
    with stage("Reading and assembling"):
        return parts.assemble(located(file), in_bytes(memory_limit))


def info(file: Path, *, modes: int = 6, memory_limit: float | None = None, json: bool = False) -> None:
    """Say what a structure is made of, what it weighs, how it vibrates and what its loads do to it."""
    structure = assembled_of_any(file, memory_limit)
    with stage("Solving the loads and the modes"):
        record = structure_record(structure, modes)
    answer("structure info", record=record, json=json)
    for load in () if json else record["loads"]:
        outputs = [("gauge", name, 1e6 * value, "microstrain") for name, value in load["strain"].items()]
        outputs += [("displacement", name, 1e3 * value, "mm") for name, value in load["output"].items()]
        show("load of a structure", load=load, outputs=outputs)


def structure_record(structure: "parts.AffineStructure", modes: int) -> dict[str, Any]:
    """Return what is known of a structure without damage, at nominal values, by name.

    Lengths carry the unit of the mesh where `length_unit` stands beside them; everything else is in SI units.
    """
    design, heavy = structure.design, structure.mass().diagonal().any()
    return {
        "name": design.name,
        "design_hash": structure.design_hash,
        "unknowns": structure.unknowns,
        "length_unit": design.length_unit,
        "remarks": [],
        "parts": [],
        **(_of_mesh(structure) if isinstance(structure, parts.Structure) else {"matrices": [*design.files]}),
        "frequencies": parts.natural_frequencies(structure, modes)[0].tolist() if heavy else [],
        "loads": [
            {
                "name": name,
                "control": structure.loads[name],
                "value": structure.control_value_alone(name),
                "largest_displacement": found.largest,
                "strain": dict(zip(structure.gauges, map(float, found.strain), strict=True)),
                "output": dict(zip(structure.displacements, map(float, found.output), strict=True)),
            }
            for name, found in parts.static_responses(structure).items()
        ],
    }


def _of_mesh(structure: "parts.Structure") -> dict[str, Any]:
    mesh = structure.mesh
    mass, centre = parts.mass_and_centre(structure)
    return {
        "mesh": structure.design.mesh,
        "remarks": list(mesh.remarks),
        "kind": mesh.kind.name,
        "linear_elements": not mesh.kind.edges,
        "elements": len(mesh.cells),
        "nodes": len(mesh.points),
        "loose_nodes": mesh.loose.tolist(),
        "held": mesh.unknowns - structure.unknowns,
        "memory": parts.memory_estimate(mesh),
        "mass": mass,
        "centre_of_gravity": (centre / mesh.unit).tolist(),
        "lower": (mesh.points.min(axis=0) / mesh.unit).tolist(),
        "upper": (mesh.points.max(axis=0) / mesh.unit).tolist(),
        "parts": [
            dict(zip(("what", "name", "set", "count", "of", "note"), row, strict=True))
            for row in _parts(structure)
        ],
    }


def _parts(structure: "parts.Structure") -> Iterator[tuple[str, str, str | None, int, str, str]]:
    """Yield what each part is, its name, its set, how much of what it holds, and a note."""
    design, mesh = structure.design, structure.mesh
    for number, material in enumerate(design.material):
        count = int((structure.material_of == number).sum())
        note = f"scaled by {material.scaled_by}" if material.scaled_by else ""
        yield "material", material.name, material.set, count, "elements", note
    for number, damage in enumerate(design.damage):
        count = int((structure.region_of == number).sum())
        yield "damage region", damage.name, damage.set, count, "elements", ""
    for number, support in enumerate(design.support, start=1):
        count = len(mesh.nodes_of(support.set, f"support[{number}]"))
        notes = ["rigid"] * (support.rigid_about is not None)
        notes += [f"holds {', '.join(support.hold)}"] * bool(support.hold)
        notes += ["springs"] * bool(support.springs)
        yield "support", str(number), support.set, count, "nodes", ", ".join(notes)
    for load in design.load:
        if load.set is not None:
            nodes = mesh.nodes_of(load.set, load.name)
            faces = len(mesh.faces_between(load.set, nodes))
            yield "load", load.name, load.set, faces or len(nodes), "faces" if faces else "nodes", ""
    for port in design.port:
        if port.set is not None:
            yield "port", port.name, port.set, len(mesh.nodes_of(port.set, port.name)), "nodes", ""
    for gauge, distance in zip(design.gauge, structure.gauges_moved.tolist(), strict=True):
        moved = f"put onto the surface, {distance / mesh.unit:.3g} {mesh.unit_name} away"
        yield "gauge", gauge.name, "", 1, "place", moved if distance > 1e-6 * mesh.size else ""


def verify(
    file: Path,
    *,
    out: Path | None = None,
    modes: int = 6,
    memory_limit: float | None = None,
    json: bool = False,
) -> None:
    """Solve the loads and the modes by CalculiX on the same mesh, and compare."""
    parts.required_calculix()
    refuse_filled(out)
    structure = assembled(file, memory_limit, mass_as_stiffness=True)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch, stage("CalculiX on the same mesh"):
        found = parts.agreement(parts.structure_deck(structure), out or Path(scratch), modes)
    checks = [
        parts.Check(f"load {load}", what, value, RESPONSE_LIMIT)
        for load, differences in found.loads.items()
        for what, value in differences.items()
    ]
    checks.append(parts.Check(f"{len(found.ours)} modes", "frequencies", found.modal, FREQUENCY_LIMIT))
    keys = {"of": "group", "what": "name", "difference": "value", "limit": "limit"}
    record = {
        "checks": [{key: getattr(check, own) for key, own in keys.items()} for check in checks],
        "frequencies": {key: getattr(found, key).tolist() for key in ("ours", "calculix")},
        "passed": all(check.passed for check in checks),
    }
    answer("checks", record=record, json=json, checks=checks)
    if out is not None and not json:
        terminal.say(f"Wrote the decks and results of CalculiX to {out}")
    end_with(checks)


def field(
    file: Path,
    *,
    out: Path,
    at: list[str] | None = None,
    replace: bool = False,
    memory_limit: float | None = None,
) -> None:
    """Solve the full structure under all its loads, and write its field as VTU for ParaView."""
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
    with stage("Solving and writing the field"):
        parts.write_structure_vtu(out, structure, values)
    terminal.say(f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss")


def reduce(file: Path, *, states: int = 4, memory_limit: float | None = None, json: bool = False) -> None:
    """Make the reduced model of a structure, keep it in the cache, and measure its errors."""
    model, errors = parts.reduced_model(located(file), memory_limit=in_bytes(memory_limit)), None
    if states:
        structure = assembled_of_any(file, memory_limit)
        with stage("Comparing it with the full model"):
            errors = parts.measured_errors(structure, model, states)
    record = {
        "name": model.name,
        "design_hash": model.design_hash,
        "static_basis": len(model.static_load.T),
        "modal_basis": len(model.modal_load.T),
        "ranges": {name: list(ends) for name, ends in model.validity.items()},
        "errors": None if errors is None else asdict(errors),
    }
    answer("structure reduce", record=record, json=json, model=model, kinds=_kinds(model))


def _kinds(model: "parts.ReducedModel") -> dict[str, str]:
    """Return what each of the names is that a reduced model holds for."""
    kinds = dict.fromkeys(model.parameters, "parameter") | dict.fromkeys(model.regions, "stiffness loss")
    controls = zip(model.controls, model.control_units, strict=True)
    return kinds | dict.fromkeys(model.masses, "mass [kg]") | {n: f"control [{unit}]" for n, unit in controls}


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
    version: Literal[2, 3] = 3 if fmi == 3 else 2
    parts.check_form(kind, version)
    if version == 3 and (binding is not None or rig is not None):
        raise typer.BadParameter("--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding.")
    source = located(file)
    target = parts.checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    taken = {source.resolve(): "the structure file", target.resolve(): "the FMU"}
    for option, path in (("--binding", binding), ("--rig", rig)):
        if path is not None:
            if path.resolve() in taken:
                raise FileNotWrittenError(f"{path} is {taken[path.resolve()]}: choose another {option}.")
            taken[path.resolve()] = f"the file of {option}"
            refuse_existing(path, replace=replace, option=option)
    design, others = parts.load_structure(source), list[tuple[Path, str, str]]()
    if binding is not None:
        others.append((binding, parts.structure_binding_text(design), "its binding"))
    if rig is not None:
        use = f"the model of `uav-twin calibrate campaign` and `discrepancy run CAMPAIGN --model {rig}`"
        others.append((rig, parts.rig_text(design, relpath(target, rig.parent)), use))
    model = parts.reduced_model(source, memory_limit=in_bytes(memory_limit))
    show("packed", info=parts.build_fmu(model, target, kind=kind, fmi=version, replace=replace))
    for path, text, what in others:
        atomic_write_text(path, text)
        terminal.say(f"{path}: {what}")
