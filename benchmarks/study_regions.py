"""Structures with up to eight damage regions: what their reduction takes, and how well it holds.

`python -m benchmarks.study_regions plate --regions 6` makes a plate with a hole, a tube, the shipped bracket
or the wing with so many regions, packs it as an FMU in this process, and compares it with its full model at
random states.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from evidence.make_meshes import hexahedra
from fe.reduction.reduced_basis import MeasuredErrors, measured_errors, reduce_structure
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import static_response
from fe.structure.operators import load_and_assemble
from fe.wing.design import WingDesign, load_design
from fe.wing.operators import AffineOperators, assemble, wing_values
from fmu_asset.packing.structure_fmu import build_fmu
from scenarios import structure_files

FloatArray = NDArray[np.float64]

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
control = [{ name = "pull", unit = "N", nominal = 1e4 }, { name = "bend", unit = "N", nominal = 50 }]
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
        for number, (place, direction) in enumerate(zip(places.tolist(), directions.tolist(), strict=True), 1)
    )


def _written(
    folder: Path, text: str, points: FloatArray, cells: NDArray[np.int64], region: NDArray[np.int64]
) -> Path:
    """Write a structure file and its mesh, coinciding points made one; a damage region of each but 0."""
    name = text.split('"')[1]
    points, numbers = np.unique(np.round(points, 6) + 0.0, axis=0, return_inverse=True)
    mesh = meshio.Mesh(points, [("hexahedron20", numbers.ravel()[cells])], cell_data={"region": [region]})
    meshio.write(folder / f"{name}.vtu", mesh)
    file = folder / f"{name}.toml"
    damage = "".join(
        f'\n[[damage]]\nname = "z{number}"\nset = "region={number}"\n'
        for number in range(1, region.max() + 1)
    )
    file.write_text(text + damage, encoding="utf-8")
    return file


def plate(folder: Path, regions: int, around: int = 32, across: int = 8) -> Path:
    """Write a plate of 200 x 100 x 4 mm with a hole of 40 mm; its regions are sectors around the hole."""
    flat = np.linspace(0.0, 1.0, across + 1) ** 1.5
    turns = np.linspace(0.0, 1.0, around + 1)
    places, cells = hexahedra((flat, turns, [0.0, 2.0, 4.0]), lambda *_: True)
    angle = 2.0 * np.pi * places[:, 1]
    circle = 20.0 * np.column_stack((np.cos(angle), np.sin(angle)))
    # along the sides of the plate by equal parts, so that its corners are nodes
    corners = np.array(
        [(100, 0), (100, 50), (0, 50), (-100, 50), (-100, 0), (-100, -50), (0, -50), (100, -50)]
    )
    eighth = np.column_stack(
        [np.interp(8.0 * places[:, 1], np.arange(9), np.append(corners[:, k], corners[0, k])) for k in (0, 1)]
    )
    plane = circle + places[:, :1] * (eighth - circle)
    centre = places[cells[:, :8]].mean(axis=1)
    near = centre[:, 0] < 0.5
    region = np.where(near, 1 + (centre[:, 1] * regions).astype(np.int64), 0)
    middle = 2.0 * np.pi * (np.arange(8) + 0.5) / 8
    at, along = np.array((np.cos(middle), np.sin(middle))).T, np.array((-np.sin(middle), np.cos(middle))).T
    gauges = _gauges(np.column_stack((26.0 * at, np.full(8, 4.0))), np.column_stack((along, np.zeros(8))))
    return _written(folder, PLATE + COMMON + gauges, np.column_stack((plane, places[:, 2])), cells, region)


def tube(folder: Path, regions: int, along: int = 24) -> Path:
    """Write a tube of 400 mm, 40 mm wide, with a wall of 2 mm; its regions are rings, one after another."""
    places, cells = hexahedra(
        ([18.0, 20.0], np.linspace(0.0, 1.0, 17), np.linspace(0.0, 400.0, along + 1)), lambda *_: True
    )
    angle = 2.0 * np.pi * places[:, 1]
    points = np.column_stack((places[:, 0] * np.cos(angle), places[:, 0] * np.sin(angle), places[:, 2]))
    centre = places[cells[:, :8]].mean(axis=1)
    region = 1 + (centre[:, 2] / 400.0 * regions).astype(np.int64)
    region[centre[:, 1] > 0.5] = 0  # half of each ring
    turn = 0.5 * np.pi * (np.arange(8) % 2)
    at = np.column_stack((20.0 * np.cos(turn), 20.0 * np.sin(turn), 25.0 + 50.0 * np.arange(8)))
    gauges = _gauges(at, np.tile((0.0, 0.0, 1.0), (8, 1)))
    return _written(folder, TUBE + COMMON + gauges, points, cells, region)


def bracket(folder: Path, regions: int) -> Path:
    """Write the shipped bracket, with heel and arm parted anew."""
    file = structure_files()["bracket"]
    mesh = meshio.read(file.with_suffix(".inp"))
    cells = mesh.cells[0].data
    centre = mesh.points[cells[:, :8]].mean(axis=1)
    way = np.where(
        centre[:, 0] < 6.0, 60.0 - centre[:, 2], 60.0 + centre[:, 0]
    )  # down the back, along the arm
    number = np.searchsorted(np.quantile(way, np.arange(1, regions + 1) / (regions + 1)), way, side="right")
    text = file.read_text(encoding="utf-8")
    text = text[: text.index("[[damage]]")] + text[text.index("[[gauge]]") :]
    mesh.cell_sets = {
        **mesh.cell_sets,
        **{f"R{one}": [np.flatnonzero(number == one)] for one in range(1, regions + 1)},
    }
    mesh.write(folder / "bracket.inp")
    deck = (folder / "bracket.inp").read_text(encoding="utf-8")
    (folder / "bracket.inp").write_text(deck.replace("C3D20RH", "C3D20"), encoding="utf-8")
    damage = "".join(f'\n[[damage]]\nname = "z{one}"\nset = "R{one}"\n' for one in range(1, regions + 1))
    (folder / "bracket.toml").write_text(text + damage, encoding="utf-8")
    return folder / "bracket.toml"


def wing(regions: int) -> WingDesign:
    """Return the wing with so many patches of its upper skin, up to two beside each other in three spans."""
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


def _wing_errors(operators: AffineOperators, model: ReducedModel, states: int) -> MeasuredErrors:
    """Compare a reduced wing with its full model at random states under lift."""
    rng, strain, bound, broken = np.random.default_rng(2021), 0.0, 0.0, 0
    for _ in range(states):
        e, *losses = rng.uniform(*model.validity_box[: 1 + len(model.regions)].T).tolist()
        values = wing_values(operators, e, tuple(losses), load_factor=3.0)
        wanted = static_response(operators, values).strain
        found = model.static_response(young_modulus_factor=e, stiffness_loss=tuple(losses), load_factor=3.0)
        missed, size = float(np.abs(found.strain - wanted).max()), float(np.abs(wanted).max())
        strain, bound = max(strain, missed / size), max(bound, found.strain_error_bound / size)
        broken += missed > found.strain_error_bound
    return MeasuredErrors(strain, np.nan, bound, np.nan, states, broken)


def measured(name: str, regions: int, states: int, folder: Path) -> dict[str, float]:
    """Return what it takes from mesh to FMU, and the errors at random states."""
    begin, clock = time.process_time(), time.monotonic()
    if name == "wing":
        design = wing(regions)
        full: Any = assemble(design)
        reduction: Any = reduce_structure(full)
        build_fmu(reduction.model, folder / "wing.fmu")
    else:
        full = load_and_assemble({"plate": plate, "tube": tube, "bracket": bracket}[name](folder, regions))
        reduction = reduce_structure(full)
        build_fmu(reduction.model, folder / f"{name}.fmu")
    found = {
        "regions": regions,
        "unknowns": full.unknowns,
        "solutions": len(reduction.snapshots),
        "vectors": len(reduction.model.static_load.T),
        "processor_seconds": time.process_time() - begin,
        "seconds": time.monotonic() - clock,
        "gibibytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    compared = _wing_errors if name == "wing" else measured_errors
    return found | asdict(compared(full, reduction.model, states))


def main() -> int:
    """Print the figures as JSON; exit code 1 if an error exceeds its bound or a bound 1e-3."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=("plate", "tube", "bracket", "wing"))
    parser.add_argument("--regions", type=int, default=6)
    parser.add_argument("--states", type=int, default=60)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        found = measured(given.name, given.regions, given.states, Path(folder))
    print(json.dumps({"name": given.name} | found))
    return int(found["broken"] > 0 or found["bound"] > 1e-3)


if __name__ == "__main__":
    sys.exit(main())
