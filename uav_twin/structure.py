"""`uav-twin structure ...`, and how the checks of wings and structures end."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf, nan
from os.path import relpath
from pathlib import Path
from typing import Any, Literal

import typer

from fe.runtime.errors import DesignFileError
from reporting import terminal
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing, refuse_filled
from reporting.progress import stage
from reporting.words import comma_list
from scenarios import structure_files
from uav_twin import parts
from uav_twin.options import answer, show


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


def info(
    file: Path, *, modes: int = 6, memory_limit: float | None = None, json: bool = False
) -> None:
    """Say what a structure is made of, what it weighs, how it vibrates and what its loads do to it."""  # noqa: E501
    structure = assembled_of_any(file, memory_limit)
    with stage("Solving the loads and the modes"):
        record = structure_record(structure, modes)
    answer("structure info", record=record, json=json)
    if json:
        return
    for load in record["loads"]:
        strains = [
            ("gauge", name, 1e6 * value, "microstrain") for name, value in load["strain"].items()
        ]
        displacements = [
            ("displacement", name, 1e3 * value, "mm") for name, value in load["output"].items()
        ]
        show("load of a structure", load=load, outputs=strains + displacements)


def structure_record(structure: "parts.AffineStructure", modes: int) -> dict[str, Any]:
    """Return the facts about a structure without damage, at nominal values, by name.

    Lengths carry the unit of the mesh where `length_unit` stands beside them; everything else is in
    SI units.
    """
    design = structure.design
    if isinstance(structure, parts.Structure):
        facts_of_kind = _mesh_facts(structure)
    else:
        facts_of_kind = {"matrices": [*design.files]}
    frequencies: list[float] = []
    if structure.mass().diagonal().any():
        frequencies = parts.natural_frequencies(structure, modes).frequency.tolist()
    responses = parts.static_responses(structure)
    return {
        "name": design.name,
        "design_hash": structure.design_hash,
        "unknowns": structure.unknowns,
        "length_unit": design.length_unit,
        "remarks": [],
        "parts": [],
        **facts_of_kind,
        "frequencies": frequencies,
        "loads": [_load_facts(structure, name, response) for name, response in responses.items()],
    }


def _load_facts(
    structure: "parts.AffineStructure", name: str, response: "parts.AffineResponse"
) -> dict[str, Any]:
    """Return the facts about a load and the response to it alone, by name."""
    strains = response.strain.tolist()
    displacements = response.output.tolist()
    return {
        "name": name,
        "control": structure.loads[name],
        "value": structure.control_value_alone(name),
        "largest_displacement": response.largest,
        "strain": dict(zip(structure.gauges, strains, strict=True)),
        "output": dict(zip(structure.displacements, displacements, strict=True)),
    }


def _mesh_facts(structure: "parts.Structure") -> dict[str, Any]:
    """Return the facts about a structure from a mesh, by name."""
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
        "parts": [asdict(part) for part in _structure_parts(structure)],
    }


@dataclass(frozen=True)
class StructurePart:
    """A part of a structure, as it is listed.

    Attributes
    ----------
    what : str
        The kind of part.
    name : str
        Its name.
    set : str or None
        The set of the mesh that it is on.
    count : int
        How many elements, nodes or faces it has.
    of : str
        Which of these are counted.
    note : str
        A remark.
    """

    what: str
    name: str
    set: str | None
    count: int
    of: str
    note: str = ""


def _structure_parts(structure: "parts.Structure") -> Iterator[StructurePart]:
    """Yield materials, damage regions, supports, loads, ports and gauges of a structure."""
    design = structure.design
    mesh = structure.mesh
    for number, material in enumerate(design.material):
        count = int((structure.material_of == number).sum())
        note = f"scaled by {material.scaled_by}" if material.scaled_by else ""
        yield StructurePart("material", material.name, material.set, count, "elements", note)
    for number, damage in enumerate(design.damage):
        count = int((structure.region_of == number).sum())
        yield StructurePart("damage region", damage.name, damage.set, count, "elements")
    for number, support in enumerate(design.support, start=1):
        count = len(mesh.nodes_of(support.set, f"support[{number}]"))
        notes = []
        if support.rigid_about is not None:
            notes.append("rigid")
        if support.hold:
            notes.append(f"holds {', '.join(support.hold)}")
        if support.springs:
            notes.append("springs")
        yield StructurePart("support", str(number), support.set, count, "nodes", ", ".join(notes))
    for load in design.load:
        if load.set is not None:
            nodes = mesh.nodes_of(load.set, load.name)
            faces = len(mesh.faces_between(load.set, nodes))
            count, counted = (faces, "faces") if faces else (len(nodes), "nodes")
            yield StructurePart("load", load.name, load.set, count, counted)
    for port in design.port:
        if port.set is not None:
            count = len(mesh.nodes_of(port.set, port.name))
            yield StructurePart("port", port.name, port.set, count, "nodes")
    for gauge, distance in zip(design.gauge, structure.gauges_moved.tolist(), strict=True):
        note = ""
        if distance > 1e-6 * mesh.size:
            note = f"put onto the surface, {distance / mesh.unit:.3g} {mesh.unit_name} away"
        yield StructurePart("gauge", gauge.name, "", 1, "place", note)


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
    with (
        tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch,
        stage("CalculiX on the same mesh"),
    ):
        agreement = parts.agreement(parts.structure_deck(structure), out or Path(scratch), modes)
    checks = []
    for load, differences in agreement.loads.items():
        for response, difference in differences.items():
            checks.append(parts.Check(f"load {load}", response, difference, RESPONSE_LIMIT))
    mode_count = len(agreement.ours)
    checks.append(
        parts.Check(f"{mode_count} modes", "frequencies", agreement.modal, FREQUENCY_LIMIT)
    )
    record = {
        "checks": [
            {
                "of": check.group,
                "what": check.name,
                "difference": check.value,
                "limit": check.limit,
            }
            for check in checks
        ],
        "frequencies": {
            "ours": agreement.ours.tolist(),
            "calculix": agreement.calculix.tolist(),
        },
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
    values = _values_at(at or (), structure.ranges)
    with stage("Solving and writing the field"):
        parts.write_structure_vtu(out, structure, values)
    terminal.say(
        f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss"
    )


def _values_at(texts: Sequence[str], ranges: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Return the values that `--at` sets, by name.

    Parameters
    ----------
    texts : sequence of str
        NAME=VALUE, each name once.
    ranges : mapping of str to (float, float)
        Least and largest value of each name.

    Raises
    ------
    BadParameter
        If a text is not of this form, or a value lies outside its range.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, number = text.partition("=")
        low, high = ranges.get(name, (inf, -inf))
        try:
            value = float(number)
        except ValueError:
            value = nan
        if name in values or not low <= value <= high:
            known = [f"{name} from {low:g} to {high:g}" for name, (low, high) in ranges.items()]
            raise typer.BadParameter(
                f"NAME=VALUE is expected, each name once, but {text!r} came; there are "
                f"{comma_list(known)}. Give a value inside, or widen its range in the structure "
                "file.",
                param_hint="--at",
            )
        values[name] = value
    return values


def reduce(
    file: Path, *, states: int = 4, memory_limit: float | None = None, json: bool = False
) -> None:
    """Make the reduced model of a structure, keep it in the cache, and measure its errors."""
    model = parts.reduced_model(located(file), memory_limit=in_bytes(memory_limit))
    errors = None
    if states:
        structure = assembled_of_any(file, memory_limit)
        with stage("Comparing it with the full model"):
            errors = parts.measured_errors(structure, model, states)
    record = {
        "name": model.name,
        "design_hash": model.design_hash,
        "static_basis": len(model.static_load.T),
        "modal_basis": len(model.modal_load.T),
        "ranges": {name: list(limits) for name, limits in model.validity.items()},
        "errors": None if errors is None else asdict(errors),
    }
    answer("structure reduce", record=record, json=json, model=model, kinds=_input_kinds(model))


def _input_kinds(model: "parts.ReducedModel") -> dict[str, str]:
    """Return the kind of each input of a reduced model, by its name."""
    kinds = dict.fromkeys(model.parameters, "parameter")
    kinds |= dict.fromkeys(model.regions, "stiffness loss")
    kinds |= dict.fromkeys(model.masses, "mass [kg]")
    for name, unit in zip(model.controls, model.control_units, strict=True):
        kinds[name] = f"control [{unit}]"
    return kinds


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
        raise typer.BadParameter(
            "--binding and --rig are for FMI 2.0; `uav-twin fmu bind` drafts a binding."
        )
    source = located(file)
    target = parts.checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
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
    # texts of further files, before anything is built or written
    design = parts.load_structure(source)
    binding_text = parts.structure_binding_text(design) if binding is not None else ""
    rig_text = parts.rig_text(design, relpath(target, rig.parent)) if rig is not None else ""
    model = parts.reduced_model(source, memory_limit=in_bytes(memory_limit))
    packed = parts.build_fmu(model, target, kind=kind, fmi=version, replace=replace)
    show("packed", info=packed)
    if binding is not None:
        atomic_write_text(binding, binding_text)
        terminal.say(f"{binding}: its binding")
    if rig is not None:
        atomic_write_text(rig, rig_text)
        terminal.say(
            f"{rig}: the model of `uav-twin calibrate campaign` and "
            f"`discrepancy run CAMPAIGN --model {rig}`"
        )
