"""`uav-twin structure ...`."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from uav_twin.structure_model import File, MemoryLimit, assembled, assembled_of_any, field, fmu, reduce
from uav_twin.verify import Check, end_with, print_checks

if TYPE_CHECKING:
    from fe.structure.affine import DesignedStructure
    from fe.structure.operators import Structure
    from fe.verification.calculix_comparison import Agreement

DISPLACEMENT_LIMIT, STRAIN_LIMIT, FREQUENCY_LIMIT = 1e-5, 1e-5, 1e-6
"""Largest differences to CalculiX, each relative to the largest of its kind."""

structure_app = typer.Typer(
    no_args_is_help=True,
    help="Look at a structure from a mesh or matrices, verify it against CalculiX, reduce it, pack it.",
)

Modes = Annotated[int, typer.Option(min=1, max=50, help="Number of modes.")]


@structure_app.command("info")
def info(file: File, modes: Modes = 6, memory_limit: MemoryLimit = None, json: terminal.Json = False) -> None:
    """Say what a structure is made of, what it weighs, how it vibrates and what its loads do to it."""
    structure = assembled_of_any(file, memory_limit)
    with terminal.progress().stage("Solving the loads and the modes"):
        record = structure_record(structure, modes)
    if json:
        terminal.print_json(record)
        return
    terminal.print_table(("fact", "value", "unit"), _facts(record))
    for remark in record["remarks"]:
        terminal.say(f"Note: {remark}")
    parts = [
        (part["what"], part["name"], part["set"], f"{part['count']:,} {part['of']}", part["note"])
        for part in record["parts"]
    ]
    if parts:
        terminal.print_table(("part", "name", "set", "holds", "note"), parts)
    modes_found = [(f"{number}", f"{value:.6g}") for number, value in enumerate(record["frequencies"], 1)]
    if modes_found:
        terminal.print_table(("mode", "frequency [Hz]"), modes_found)
    else:
        terminal.say("No modes: nothing has mass. Give the materials a density.")
    for load in record["loads"]:
        of = f" at {load['control']} = {load['value']:g}" if load["control"] else ""
        largest = f"largest displacement {1e3 * load['largest_displacement']:.6g} mm"
        terminal.say(f"Load {load['name']}{of}: {largest}")
        outputs = [
            (what, name, f"{scale * value:.6g}", unit)
            for what, key, scale, unit in (
                ("gauge", "strain", 1e6, "microstrain"),
                ("displacement", "output", 1e3, "mm"),
            )
            for name, value in load[key].items()
        ]
        if outputs:
            terminal.print_table(("output", "name", "value", "unit"), outputs)


def _facts(record: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    yield "name", record["name"], ""
    if "mesh" not in record:
        yield "matrices", ", ".join(record["matrices"]), f"N, s, {record['length_unit']}"
        yield "unknowns", f"{record['unknowns']:,} free", ""
        return
    yield "mesh", f"{record['mesh']}: {record['elements']:,} {record['kind']}, {record['nodes']:,} nodes", ""
    if record["linear_elements"]:
        yield "elements", "linear: far too stiff in bending; take quadratic ones", ""
    if record["loose_nodes"]:
        first = ", ".join(str(number) for number in record["loose_nodes"][:3])
        yield "nodes left out", f"{len(record['loose_nodes'])} touch no element, among them {first}", ""
    yield "unknowns", f"{record['unknowns']:,} free, {record['held']:,} held", ""
    yield "memory", f"about {record['memory'] / 2**30:.2g}", "GiB"
    yield "mass", f"{record['mass']:.6g}", "kg"
    for key, title in (("centre_of_gravity", "centre of gravity"), ("lower", "from"), ("upper", "to")):
        unit = record["length_unit"]
        yield title, ", ".join(f"{value:.6g}" for value in record[key]), unit


def structure_record(structure: "DesignedStructure", modes: int) -> dict[str, Any]:
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
def verify(
    file: File,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the decks and results of CalculiX; it must be empty.")
    ] = None,
    modes: Modes = 6,
    memory_limit: MemoryLimit = None,
    json: terminal.Json = False,
) -> None:
    """Solve the loads and the modes by CalculiX on the same mesh, and compare."""
    from fe.verification.calculix_comparison import structure_agreement
    from fe.verification.calculix_job import required_calculix
    from reporting.files import refuse_filled

    required_calculix()
    refuse_filled(out)
    structure = assembled(file, memory_limit, mass_as_stiffness=True)
    with (
        tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch,
        terminal.progress().stage("CalculiX on the same mesh"),
    ):
        agreement = structure_agreement(structure, out or Path(scratch), modes)
    checks = list(_differences(agreement))
    if json:
        terminal.print_json(
            {
                "checks": [
                    {"of": check.group, "what": check.name, "difference": check.value, "limit": check.limit}
                    for check in checks
                ],
                "frequencies": {key: getattr(agreement, key).tolist() for key in ("ours", "calculix")},
                "passed": all(check.passed for check in checks),
            }
        )
    else:
        print_checks(checks)
        if out is not None:
            terminal.say(f"Wrote the decks and results of CalculiX to {out}")
    end_with(checks)


def _differences(agreement: "Agreement") -> Iterator[Check]:
    for load, differences in agreement.loads.items():
        for what, value in differences.items():
            limit = STRAIN_LIMIT if what == "gauge strains" else DISPLACEMENT_LIMIT
            yield Check(f"load {load}", what, value, limit)
    yield Check(f"{len(agreement.ours)} modes", "frequencies", agreement.modal, FREQUENCY_LIMIT)


structure_app.command("reduce")(reduce)
structure_app.command("fmu")(fmu)
structure_app.command("field")(field)
