"""Cost and errors of reduced structures with many damage regions.

Shown in docs/how_to/structures.md.

`python -m benchmarks.studies.regions plate --regions 6` makes a plate with a hole, a tube, the
shipped bracket or the wing with so many regions, packs it as an FMU in this process, and compares
it with its full model at random states.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from evidence.make_meshes import hexahedra
from fe.reduction.reduced_basis import MeasuredErrors, measured_errors, reduce_structure
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import static_response
from fe.structure.operators import Structure, load_and_assemble
from fe.wing.design import WingDesign, load_design
from fe.wing.operators import AffineOperators, assemble, wing_values
from fmu_asset.packing.structure_fmu import build_fmu
from scenarios import structure_files

FloatArray = NDArray[np.float64]

LARGEST_BOUND = 1e-3
"""The largest certified bound that passes, of the largest strain or displacement."""

COMMON = """
length_unit = "mm"
parameter = [{ name = "e" }]

[[material]]
name = "alloy"
density = 2700
young_modulus = 7e10
poisson_ratio = 0.33
scaled_by = "e"
"""
PLATE = """name = "plate"
mesh = "plate.vtu"
set = [
    { name = "left", of = "nodes", box = [[-100, -50, 0], [-100, 50, 4]] },
    { name = "right", of = "nodes", box = [[100, -50, 0], [100, 50, 4]] },
]
control = [
    { name = "pull", unit = "N", nominal = 1e4 },
    { name = "bend", unit = "N", nominal = 50 },
]
support = [{ set = "left", hold = ["x", "y", "z"] }]
load = [
    { name = "pull", control = "pull", set = "right", force = [1, 0, 0] },
    { name = "bend", control = "bend", set = "right", force = [0, 0, 1] },
]
displacement = [{ name = "end", point = [100, 0, 2], direction = [0, 0, 1] }]
"""
TUBE = """name = "tube"
mesh = "tube.vtu"
set = [
    { name = "root", of = "nodes", box = [[-21, -21, 0], [21, 21, 0]] },
    { name = "end", of = "nodes", box = [[-21, -21, 400], [21, 21, 400]] },
]
control = [{ name = "push", unit = "N", nominal = 200 }, { name = "load_factor" }]
support = [{ set = "root", hold = ["x", "y", "z"] }]
load = [
    { name = "push", control = "push", set = "end", force = [1, 0, 0] },
    { name = "weight", control = "load_factor", acceleration = [0, -9.81, 0] },
]
displacement = [
    { name = "end_x", point = [0, 20, 400], direction = [1, 0, 0] },
    { name = "end_y", point = [0, 20, 400], direction = [0, 1, 0] },
]
"""


def _gauges(places: FloatArray, directions: FloatArray) -> str:
    return "".join(
        f'\n[[gauge]]\nname = "g{number}"\npoint = {place}\ndirection = {direction}\nlength = 2\n'
        for number, (place, direction) in enumerate(
            zip(places.tolist(), directions.tolist(), strict=True), 1
        )
    )


def _written(
    folder: Path, text: str, points: FloatArray, cells: NDArray[np.int64], region: NDArray[np.int64]
) -> Path:
    """Write a structure file and its mesh with merged points and a damage region by number."""
    name = text.split('"')[1]
    points, numbers = np.unique(np.round(points, 6) + 0.0, axis=0, return_inverse=True)
    mesh = meshio.Mesh(
        points, [("hexahedron20", numbers.ravel()[cells])], cell_data={"region": [region]}
    )
    meshio.write(folder / f"{name}.vtu", mesh)
    file = folder / f"{name}.toml"
    damage = "".join(
        f'\n[[damage]]\nname = "z{number}"\nset = "region={number}"\n'
        for number in range(1, region.max() + 1)
    )
    file.write_text(text + damage, encoding="utf-8")
    return file


def plate(folder: Path, regions: int, around: int = 32, across: int = 8) -> Path:
    """Write a plate of 200 x 100 x 4 mm with a 40 mm hole; its regions are sectors of the hole.

    Parameters
    ----------
    folder : Path
        Folder to write to.
    regions : int
        Number of damage regions.
    around, across : int
        Elements around the hole, and from the hole to the edge.
    """
    # Elements in coordinates 0 to 1 from the hole to the edge and around the hole, and height
    from_hole = np.linspace(0.0, 1.0, across + 1) ** 1.5
    around_hole = np.linspace(0.0, 1.0, around + 1)
    nodes, cells = hexahedra((from_hole, around_hole, [0.0, 2.0, 4.0]), lambda *_: True)
    outward, turn, height = nodes.T
    angle = 2.0 * np.pi * turn
    circle = 20.0 * np.column_stack((np.cos(angle), np.sin(angle)))

    # Along the edge by equal eighths, so that the corners are nodes
    corners = np.array(
        [(100, 0), (100, 50), (0, 50), (-100, 50), (-100, 0), (-100, -50), (0, -50), (100, -50)]
    )
    edge = np.column_stack(
        [np.interp(8.0 * turn, np.arange(9), np.append(row, row[0])) for row in corners.T]
    )
    plane = circle + outward[:, None] * (edge - circle)

    # Regions at the hole
    centre_outward, centre_turn, _ = nodes[cells[:, :8]].mean(axis=1).T
    region = np.where(centre_outward < 0.5, 1 + (centre_turn * regions).astype(np.int64), 0)

    # Tangential gauges around the hole
    middle = 2.0 * np.pi * (np.arange(8) + 0.5) / 8
    radial = np.column_stack((np.cos(middle), np.sin(middle)))
    tangential = np.column_stack((-np.sin(middle), np.cos(middle)))
    gauges = _gauges(
        np.column_stack((26.0 * radial, np.full(8, 4.0))),
        np.column_stack((tangential, np.zeros(8))),
    )
    points = np.column_stack((plane, height))
    return _written(folder, PLATE + COMMON + gauges, points, cells, region)


def tube(folder: Path, regions: int, along: int = 24) -> Path:
    """Write a tube of 400 mm length, 40 mm width and 2 mm wall; its regions are half rings.

    Parameters
    ----------
    folder : Path
        Folder to write to.
    regions : int
        Number of damage regions.
    along : int
        Elements along the tube.
    """
    nodes, cells = hexahedra(
        ([18.0, 20.0], np.linspace(0.0, 1.0, 17), np.linspace(0.0, 400.0, along + 1)),
        lambda *_: True,
    )
    radius, turn, height = nodes.T
    angle = 2.0 * np.pi * turn
    points = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), height))
    _, centre_turn, centre_height = nodes[cells[:, :8]].mean(axis=1).T
    region = 1 + (centre_height / 400.0 * regions).astype(np.int64)
    region[centre_turn > 0.5] = 0

    # Gauges along the tube, on two sides by turns
    side = 0.5 * np.pi * (np.arange(8) % 2)
    gauge_points = np.column_stack(
        (20.0 * np.cos(side), 20.0 * np.sin(side), 25.0 + 50.0 * np.arange(8))
    )
    gauges = _gauges(gauge_points, np.tile((0.0, 0.0, 1.0), (8, 1)))
    return _written(folder, TUBE + COMMON + gauges, points, cells, region)


def bracket(folder: Path, regions: int) -> Path:
    """Write the shipped bracket, with its heel and arm divided into other damage regions.

    Parameters
    ----------
    folder : Path
        Folder to write to.
    regions : int
        Number of damage regions.
    """
    file = structure_files()["bracket"]
    mesh = meshio.read(file.with_suffix(".inp"))
    cells = mesh.cells[0].data

    # Regions by distance down the back and along the arm
    x, _, z = mesh.points[cells[:, :8]].mean(axis=1).T
    distance = np.where(x < 6.0, 60.0 - z, 60.0 + x)
    limits = np.quantile(distance, np.arange(1, regions + 1) / (regions + 1))
    number = np.searchsorted(limits, distance, side="right")
    sets = {f"R{region}": [np.flatnonzero(number == region)] for region in range(1, regions + 1)}
    mesh.cell_sets = {**mesh.cell_sets, **sets}

    # meshio writes the name of another element type
    mesh.write(folder / "bracket.inp")
    deck = (folder / "bracket.inp").read_text(encoding="utf-8")
    (folder / "bracket.inp").write_text(deck.replace("C3D20RH", "C3D20"), encoding="utf-8")

    text = file.read_text(encoding="utf-8")
    text = text[: text.index("[[damage]]")] + text[text.index("[[gauge]]") :]
    for region in range(1, regions + 1):
        text += f'\n[[damage]]\nname = "z{region}"\nset = "R{region}"\n'
    (folder / "bracket.toml").write_text(text, encoding="utf-8")
    return folder / "bracket.toml"


def wing(regions: int) -> WingDesign:
    """Return the wing with up to six damage regions in its upper skin, two in each span."""
    first, second = load_design(None).model_dump(mode="python")["defects"][:2]
    spans = [(patch["span_start"], patch["span_end"]) for patch in (first, second)]
    spans.insert(1, (0.45, 0.95))
    chords = [(first["chord_start"], first["chord_end"]), (0.66, 0.86)]
    places = [
        {"span_start": span[0], "span_end": span[1], "chord_start": chord[0], "chord_end": chord[1]}
        for chord in chords
        for span in spans
    ]
    return load_design(None).changed(defects=tuple(places[:regions]))


def wing_errors(operators: AffineOperators, model: ReducedModel, states: int) -> MeasuredErrors:
    """Compare strains of a reduced wing and its full model at random states under lift."""
    random = np.random.default_rng(2021)
    lowest, highest = model.validity_box[: 1 + len(model.regions)].T
    largest_error = 0.0
    largest_bound = 0.0
    broken = 0
    for _ in range(states):
        e, *losses = random.uniform(lowest, highest).tolist()
        values = wing_values(operators, e, tuple(losses), load_factor=3.0)
        exact = static_response(operators, values).strain
        reduced = model.static_response(
            young_modulus_factor=e, stiffness_loss=tuple(losses), load_factor=3.0
        )
        error = float(np.abs(reduced.strain - exact).max())
        largest_strain = float(np.abs(exact).max())
        largest_error = max(largest_error, error / largest_strain)
        largest_bound = max(largest_bound, reduced.strain_error_bound / largest_strain)
        if error > reduced.strain_error_bound:
            broken += 1
    return MeasuredErrors(
        strain=largest_error,
        displacement=np.nan,
        bound=largest_bound,
        frequency=np.nan,
        states=states,
        broken=broken,
    )


STRUCTURES: dict[str, Callable[[Path, int], Path]] = {
    "plate": plate,
    "tube": tube,
    "bracket": bracket,
}
"""Functions that write a structure file with so many damage regions to a folder, by name."""


def full_model(name: str, regions: int, folder: Path) -> AffineOperators | Structure:
    """Return the operators of the wing or of a structure with so many damage regions."""
    if name == "wing":
        return assemble(wing(regions))
    return load_and_assemble(STRUCTURES[name](folder, regions))


def measure_reduction(name: str, regions: int, states: int, folder: Path) -> dict[str, float]:
    """Return the cost of a reduced structure from mesh to FMU, and its errors at random states."""
    begin_processor = time.process_time()
    begin = time.monotonic()
    full = full_model(name, regions, folder)
    reduction = reduce_structure(full)
    build_fmu(reduction.model, folder / f"{name}.fmu")
    cost = {
        "regions": regions,
        "unknowns": full.unknowns,
        "solutions": len(reduction.snapshots),
        "vectors": len(reduction.model.static_load.T),
        "processor_seconds": time.process_time() - begin_processor,
        "seconds": time.monotonic() - begin,
        "gibibytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    if isinstance(full, AffineOperators):
        errors = wing_errors(full, reduction.model, states)
    else:
        errors = measured_errors(full, reduction.model, states)
    return cost | asdict(errors)


def main() -> int:
    """Print the figures as JSON; exit code 1 if an error exceeds its bound or a bound 1e-3."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=("plate", "tube", "bracket", "wing"))
    parser.add_argument("--regions", type=int, default=6)
    parser.add_argument("--states", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        figures = measure_reduction(
            arguments.name, arguments.regions, arguments.states, Path(folder)
        )
    print(json.dumps({"name": arguments.name} | figures))
    return int(figures["broken"] > 0 or figures["bound"] > LARGEST_BOUND)


if __name__ == "__main__":
    sys.exit(main())
