"""The facts about a structure that `uav-twin structure info` prints."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

from fe.structure.affine import (
    AffineResponse,
    AffineStructure,
    natural_frequencies,
    static_responses,
)
from fe.structure.mesh_file import memory_estimate
from fe.structure.operators import Structure, mass_and_centre
from reporting import terminal
from reporting.json_file import JsonObject, JsonRecord

BYTES_OF_A_GIBIBYTE = 2**30


def structure_record(structure: AffineStructure, modes: int) -> JsonObject:
    """Return the facts about an undamaged structure at its nominal values, by name.

    All values are in SI units, except for the lengths `centre_of_gravity`, `lower` and `upper`,
    which are in the `length_unit` of the mesh.

    Parameters
    ----------
    modes : int
        The number of natural frequencies; none is computed for a structure without mass.
    """
    design = structure.design
    if isinstance(structure, Structure):
        facts_of_kind = _mesh_facts(structure)
    else:
        facts_of_kind = {"matrices": [*design.files]}
    frequencies: list[float] = []
    if structure.mass().diagonal().any():
        frequencies = natural_frequencies(structure, modes).frequency.tolist()
    responses = static_responses(structure)
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


def _load_facts(structure: AffineStructure, name: str, response: AffineResponse) -> JsonObject:
    """Return the facts about a load, and the static response to it alone."""
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


def _mesh_facts(structure: Structure) -> JsonObject:
    """Return the facts that only a structure from a mesh has: mesh, mass, extent and parts."""
    mesh = structure.mesh
    mass, centre = mass_and_centre(structure)
    return {
        "mesh": structure.design.mesh,
        "remarks": list(mesh.remarks),
        "kind": mesh.kind.name,
        "linear_elements": not mesh.kind.edges,
        "elements": len(mesh.cells),
        "nodes": len(mesh.points),
        "loose_nodes": mesh.loose.tolist(),
        "held": mesh.unknowns - structure.unknowns,
        "memory": memory_estimate(mesh),
        "mass": mass,
        "centre_of_gravity": (centre / mesh.unit).tolist(),
        "lower": (mesh.points.min(axis=0) / mesh.unit).tolist(),
        "upper": (mesh.points.max(axis=0) / mesh.unit).tolist(),
        "parts": [asdict(part) for part in _structure_parts(structure)],
    }


@dataclass(frozen=True)
class StructurePart:
    """A row in the list of materials, supports, loads and other parts.

    Attributes
    ----------
    what : str
        The kind of part, such as "material".
    set : str
        The set of elements or nodes to which the part is assigned; empty for a gauge.
    count : int
        How many of `of` the part has.
    of : str
        What is counted, such as "elements".
    note : str
        A remark beside the count.
    """

    what: str
    name: str
    set: str
    count: int
    of: str
    note: str = ""


def _structure_parts(structure: Structure) -> Iterator[StructurePart]:
    """Yield materials, damage regions, supports, loads and ports on sets, and gauges."""
    design = structure.design
    mesh = structure.mesh
    for number, material in enumerate(design.material):
        member_count = int((structure.material_of == number).sum())
        note = f"scaled by {material.scaled_by}" if material.scaled_by else ""
        sets = ", ".join(material.sets)
        yield StructurePart("material", material.name, sets, member_count, "elements", note)
    for number, damage in enumerate(design.damage):
        member_count = int((structure.region_of == number).sum())
        yield StructurePart("damage region", damage.name, damage.set, member_count, "elements")
    for number, support in enumerate(design.support, start=1):
        member_count = len(mesh.nodes_of(support.set, f"support[{number}]"))
        notes = []
        if support.rigid_about is not None:
            notes.append("rigid")
        if support.hold:
            notes.append(f"holds {', '.join(support.hold)}")
        if support.springs:
            notes.append("springs")
        yield StructurePart(
            "support", str(number), support.set, member_count, "nodes", ", ".join(notes)
        )
    for load in design.load:
        if load.set is not None:
            nodes = mesh.nodes_of(load.set, load.name)
            faces = len(mesh.faces_between(load.set, nodes))
            member_count, counted = (faces, "faces") if faces else (len(nodes), "nodes")
            yield StructurePart("load", load.name, load.set, member_count, counted)
    for port in design.port:
        if port.set is not None:
            member_count = len(mesh.nodes_of(port.set, port.name))
            yield StructurePart("port", port.name, port.set, member_count, "nodes")
    for gauge, distance in zip(design.gauge, structure.gauges_moved.tolist(), strict=True):
        note = ""
        if distance > 1e-6 * mesh.size:  # more than rounding
            note = f"put onto the surface, {distance / mesh.unit:.3g} {mesh.unit_name} away"
        yield StructurePart("gauge", gauge.name, "", 1, "place", note)


def print_structure(record: JsonRecord) -> None:
    """Print what `structure_record` returns: content, parts, natural frequencies and loads."""
    rows = _mesh_rows(record) if "mesh" in record else _matrix_rows(record)
    terminal.print_table(("fact", "value", "unit"), rows)
    for remark in record["remarks"]:
        terminal.say(f"Note: {remark}")
    if record["parts"]:
        headings = ("part", "name", "set", "holds", "note")
        rows = []
        for part in record["parts"]:
            contents = f"{part['count']:,} {part['of']}"
            rows.append((part["what"], part["name"], part["set"], contents, part["note"]))
        terminal.print_table(headings, rows)
    if record["frequencies"]:
        modes = enumerate(record["frequencies"], start=1)
        rows = [(str(number), f"{frequency:.6g}") for number, frequency in modes]
        terminal.print_table(("mode", "frequency [Hz]"), rows)
    else:
        terminal.say("No modes: nothing has mass. Give the materials a density.")
    for load in record["loads"]:
        _print_load(load)


def _matrix_rows(record: JsonRecord) -> list[tuple[str, ...]]:
    """Return the rows (fact, value, unit) of a structure from matrices."""
    return [
        ("name", record["name"]),
        ("matrices", ", ".join(record["matrices"]), f"N, s, {record['length_unit']}"),
        ("unknowns", f"{record['unknowns']:,} free"),
    ]


def _mesh_rows(record: JsonRecord) -> list[tuple[str, ...]]:
    """Return the rows (fact, value, unit) of a structure from a mesh."""
    length_unit = record["length_unit"]
    elements = f"{record['elements']:,} {record['kind']}"
    rows: list[tuple[str, ...]] = [
        ("name", record["name"]),
        ("mesh", f"{record['mesh']}: {elements}, {record['nodes']:,} nodes"),
    ]
    if record["linear_elements"]:
        rows.append(("elements", "linear: far too stiff in bending; take quadratic ones"))
    loose_nodes = record["loose_nodes"]
    if loose_nodes:
        examples = ", ".join(map(str, loose_nodes[:3]))
        rows.append(
            ("nodes left out", f"{len(loose_nodes)} touch no element, among them {examples}")
        )
    memory = record["memory"] / BYTES_OF_A_GIBIBYTE
    rows += [
        ("unknowns", f"{record['unknowns']:,} free, {record['held']:,} held"),
        ("memory", f"about {memory:.2g}", "GiB"),
        ("mass", f"{record['mass']:.6g}", "kg"),
        ("centre of gravity", _point_text(record["centre_of_gravity"]), length_unit),
        ("from", _point_text(record["lower"]), length_unit),
        ("to", _point_text(record["upper"]), length_unit),
    ]
    return rows


def _point_text(point: list[float]) -> str:
    """Return the coordinates of a point as a text."""
    return ", ".join(f"{coordinate:.6g}" for coordinate in point)


def _print_load(load: JsonRecord) -> None:
    """Print a load, its largest displacement [mm], and the response of all sensors to it."""
    name = load["name"]
    if load["control"]:
        name = f"{name} at {load['control']} = {load['value']:g}"
    largest = 1e3 * load["largest_displacement"]
    terminal.say(f"Load {name}: largest displacement {largest:.6g} mm")
    rows = [
        ("gauge", gauge, f"{1e6 * strain:.6g}", "microstrain")
        for gauge, strain in load["strain"].items()
    ]
    for output, displacement in load["output"].items():
        rows.append(("displacement", output, f"{1e3 * displacement:.6g}", "mm"))
    if rows:
        terminal.print_table(("output", "name", "value", "unit"), rows)
