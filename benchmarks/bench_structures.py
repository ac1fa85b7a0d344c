"""Structures from meshes of 30 and 100 thousand unknowns, beside SuperLU and CalculiX.

A beam of 10-node tetrahedra with three damage regions, two loads and a free mass. Processor
seconds, each run once in a process of its own. With UAV_TWIN_BENCH_LARGE=1 also 300 thousand
unknowns, without SuperLU.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from math import log
from pathlib import Path

from benchmarks.measurement import Measurement, agreement_within, peer_version
from fe.verification.calculix_run import calculix_program

DIVISIONS = ((36, 8, 4), (54, 11, 6))
LARGE = (80, 16, 9)
"""Cubes along the beam, each of six tetrahedra."""

STRUCTURE = """
name = "beam"
mesh = "beam.vtu"
length_unit = "mm"
set = [
    { name = "root", of = "nodes", box = [[0, 0, 0], [0, 20, 10]] },
    { name = "end", of = "nodes", box = [[100, 0, 0], [100, 20, 10]] },
    { name = "inner", of = "cells", box = [[0, 0, 0], [25, 20, 10]] },
    { name = "middle", of = "cells", box = [[50, 0, 0], [75, 20, 10]] },
    { name = "outer", of = "cells", box = [[80, 0, 0], [95, 20, 10]] },
]
parameter = [{ name = "e" }]
control = [
    { name = "load_factor", minimum = -4, maximum = 6 },
    { name = "push", unit = "N", nominal = 50 },
]
support = [{ set = "root", hold = ["x", "y", "z"] }]
load = [
    { name = "weight", control = "load_factor", acceleration = [0, 0, -9.81] },
    { name = "pushed", control = "push", set = "end", force = [0, 0, 1] },
]
damage = [
    { name = "z1", set = "inner" },
    { name = "z2", set = "middle" },
    { name = "z3", set = "outer" },
]
mass = [{ name = "pump", point = [80, 10, 10], mass = 0.05, free = true }]
gauge = [
    { name = "g1", point = [20, 10, 10], direction = [1, 0, 0] },
    { name = "g2", point = [60, 10, 10], direction = [1, 0, 0], length = 5 },
    { name = "g3", point = [60, 4, 10], direction = [1, 1, 0] },
]
displacement = [{ name = "tip", point = [100, 10, 5], direction = [0, 0, 1] }]
damping = { alpha = 5.0, beta = 1e-5 }

[[material]]
name = "alloy"
density = 2700
young_modulus = 7e10
poisson_ratio = 0.33
scaled_by = "e"
"""

_MEASURE = """
import json, resource, sys, time
from pathlib import Path

import meshio
import numpy as np
from scipy.sparse.linalg import splu
from skfem import MeshTet

from fe.full.factorisation import Factorisation
from fe.reduction.reduced_basis import reduce_structure
from fe.elements.kinds import KINDS
from fe.structure.operators import load_and_assemble
from fe.verification.calculix_deck import structure_deck

folder = Path(sys.argv[1])
divisions = json.loads(sys.argv[2])
with_superlu = sys.argv[3] == "superlu"
mesh = MeshTet.init_tensor(*(np.linspace(0.0, 1.0, count + 1) for count in divisions))
points, cells = mesh.p.T, mesh.t.T.astype(np.int64)
sides = points[cells[:, 1:]] - points[cells[:, :1]]
cells[np.linalg.det(sides) < 0.0] = cells[np.linalg.det(sides) < 0.0][:, [0, 2, 1, 3]]
ends = np.sort(np.stack([cells[:, list(edge)] for edge in KINDS["tetra10"].edges], axis=1), axis=2)
edges, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
cells = np.concatenate((cells, len(points) + number.reshape(len(cells), -1)), axis=1)
points = np.concatenate((points, points[edges].mean(axis=1))) * (100.0, 20.0, 10.0)
meshio.write(folder / "beam.vtu", meshio.Mesh(points, [("tetra10", cells)]))

def timed(function):
    begin = time.process_time()
    found = function()
    return time.process_time() - begin, found

assembly, structure = timed(lambda: load_and_assemble(folder / "beam.toml"))
stiffness = structure.stiffness()
load = structure.load_terms[0].vector
solution, ours = timed(lambda: Factorisation(stiffness).solve(load))
found = {"unknowns": structure.unknowns, "assembly": assembly, "solution": solution}
deck = structure_deck(structure)
text = deck.text(*deck.loads.values())
(folder / "static.inp").write_text(text, encoding="ascii")
found["reduction"], reduction = timed(lambda: reduce_structure(structure))
found["bound"] = reduction.bound_history[-1]
found["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
if with_superlu:
    columns = stiffness.tocsc()
    options = {"SymmetricMode": True}
    found["superlu"], other = timed(
        lambda: splu(
            columns, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        ).solve(load)
    )
    found["difference"] = float(np.abs(ours - other).max() / np.abs(other).max())
print(json.dumps(found))
"""


def _measured(divisions: tuple[int, int, int], *, superlu: bool) -> dict[str, float]:
    """Return the figures of one size, CalculiX's among them where it is installed."""
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "beam.toml").write_text(STRUCTURE, encoding="utf-8")
        command = [
            sys.executable,
            "-c",
            _MEASURE,
            name,
            json.dumps(divisions),
            "superlu" if superlu else "",
        ]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, check=True, env=one_thread
        )
        figures: dict[str, float] = json.loads(done.stdout)
        program = calculix_program()
        if program is not None:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [program, "-i", "static"]
            subprocess.run(command, cwd=folder, env=one_thread, capture_output=True, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            figures["calculix"] = (
                after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
            )
    return figures


def run() -> Iterator[Measurement]:
    """Measure assembly, factorisation with solution, and reduction, and how they grow with size."""
    sizes = []
    for divisions in DIVISIONS:
        figures = _measured(divisions, superlu=True)
        sizes.append(figures)
        yield from _rows_of_size(figures)
    if os.environ.get("UAV_TWIN_BENCH_LARGE"):
        yield from _rows_of_size(_measured(LARGE, superlu=False))
    first, second = sizes
    growth = log(second["unknowns"] / first["unknowns"])
    for name in ("assembly", "solution", "reduction", "superlu", "calculix"):
        if name in first:
            exponent = log(second[name] / first[name]) / growth
            yield Measurement(f"structure: exponent of growth, {name}", exponent, "1")


def _rows_of_size(figures: dict[str, float]) -> Iterator[Measurement]:
    """Yield the figures of one size."""
    size = f"{int(figures['unknowns']):,} unknowns"
    yield Measurement(f"structure: mesh and assembly, {size}", figures["assembly"], "s")
    solution = Measurement(
        f"structure: factorisation and solution, {size}", figures["solution"], "s"
    )
    if "superlu" in figures:
        solution = solution.beside(
            "SuperLU",
            figures["superlu"],
            peer=peer_version("scipy"),
            agreement=agreement_within("displacements", figures["difference"], 1e-5),
        )
    yield solution
    yield Measurement(f"structure: reduction, {size}", figures["reduction"], "s")
    yield Measurement(f"structure: its certified bound, {size}", figures["bound"], "1", 6e-4)
    yield Measurement(f"structure: peak memory of all that, {size}", figures["memory"], "GiB")
    if "calculix" in figures:
        yield Measurement(
            f"structure: assembly, factorisation and one load, {size}",
            figures["assembly"] + figures["solution"],
            "s",
        ).beside("static run with two loads", figures["calculix"], peer="CalculiX")
