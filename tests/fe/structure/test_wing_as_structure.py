"""The wing's own mesh, written as a deck of CalculiX and read as a structure, has the wing's matrices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse
from skfem import ElementHexS2

from fe.full.assembly import Discretisation, cell_axes, rotate_elasticity
from fe.full.operators import AffineOperators, cell_density, cell_elasticity
from fe.structure.elements import HEXAHEDRA_20
from fe.structure.operators import load_and_assemble
from fe.wing.mesh import WingMesh

FloatArray = NDArray[np.float64]


def _deck(mesh: WingMesh, discretisation: Discretisation, order: list[int]) -> str:
    """Nodes, elements, a set of each cell and of each stiffness term; numbers as precise as they are."""
    points, cells = discretisation.node_points, discretisation.cell_nodes[:, order] + 1
    lines = ["*NODE, NSET=NALL"]
    lines += [f"{n}, " + ", ".join(map(repr, point)) for n, point in enumerate(points.tolist(), start=1)]
    for number, nodes in enumerate(cells.tolist(), start=1):
        row = [number, *nodes]
        lines += [f"*ELEMENT, TYPE=C3D20, ELSET=C{number}", ", ".join(map(str, row[:15])) + ","]
        lines += [", ".join(map(str, row[15:]))]
    for term in range(len(mesh.design.regions)):
        chosen = np.flatnonzero(mesh.stiffness_term == term + 1) + 1
        lines += [f"*ELSET, ELSET=REGION{term}", *(f"{number}," for number in chosen.tolist())]
    root = np.flatnonzero(np.abs(points[:, 1]) < 1e-9) + 1
    lines += ["*NSET, NSET=ROOT", *(f"{number}," for number in root.tolist())]
    return "\n".join(lines) + "\n"


def _materials(mesh: WingMesh, elasticity: FloatArray, density: FloatArray) -> list[dict[str, Any]]:
    """A material of each cell by its engineering constants in its own axes; the plain skin is scaled by e."""
    axes = cell_axes(mesh.corners)
    compliance = np.linalg.inv(rotate_elasticity(elasticity, axes.swapaxes(1, 2)))
    found = []
    for number, own in enumerate(compliance):
        moduli = 1.0 / np.diag(own)
        ratios = [-own[i, j] * moduli[i] for i, j in ((0, 1), (0, 2), (1, 2))]
        material = {
            "name": f"m{number + 1}", "set": f"C{number + 1}", "density": float(density[number]),
            "young_moduli": moduli[:3].tolist(), "poisson_ratios": [float(ratio) for ratio in ratios],
            "shear_moduli": moduli[:2:-1].tolist(), "axes": axes[number, :2].tolist(),
        }  # fmt: skip
        if mesh.stiffness_term[number] == 0:
            material["scaled_by"] = "e"
        found.append(material)
    return found


def _toml(table: dict[str, Any]) -> str:
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


@pytest.mark.long
def test_the_box_of_the_wing_has_the_same_stiffness_and_mass(
    coarse_operators: AffineOperators, tmp_path: Path
) -> None:
    """To 1e-10 of the largest entry, in each term: plain skin, both regions, webs and ribs; and the mass.

    The root section is held: the rigid rib on springs, on which the wing stands, has no counterpart in a
    structure file; nor have gauges averaged over an area, and a modulus that changes inside a cell.
    """
    mesh, discretisation = coarse_operators.wing_mesh, coarse_operators.discretisation
    elasticity, density = cell_elasticity(mesh), cell_density(mesh)
    distance = np.linalg.norm(HEXAHEDRA_20.places[:, None] - ElementHexS2().doflocs, axis=2)
    (tmp_path / "wing.inp").write_text(_deck(mesh, discretisation, distance.argmin(axis=1).tolist()))
    regions = coarse_operators.regions
    tables: list[tuple[str, dict[str, Any]]] = [
        ("parameter", {"name": "e"}),
        ("support", {"set": "ROOT", "hold": ["x", "y", "z"]}),
        *(("damage", {"name": name, "set": f"REGION{n}"}) for n, name in enumerate(regions)),
        *(("material", material) for material in _materials(mesh, elasticity, density)),
    ]
    text = 'name = "wing"\nmesh = "wing.inp"\nlength_unit = "m"\n'
    text += "".join(f"[[{key}]]\n{_toml(table)}\n" for key, table in tables)
    (tmp_path / "wing.toml").write_text(text)
    structure = load_and_assemble(tmp_path / "wing.toml")
    found = {(term.parameter, term.region): term.matrix for term in structure.stiffness_terms}
    rows = np.flatnonzero(~structure.unknowns_held.held)

    def apart(ours: sparse.csr_array, theirs: sparse.csr_array) -> float:
        free = theirs[rows][:, rows]
        return float(abs(ours - free).max() / abs(free).max())

    names = (("e", None), *((None, name) for name in regions), (None, None))
    for term, pair in enumerate(names):
        cells = np.flatnonzero(mesh.stiffness_term == term)
        assert apart(found[pair], discretisation.stiffness(cells, elasticity[cells])) < 1e-10, pair
    mass = discretisation.mass(np.arange(len(mesh.cells)), density)
    assert apart(structure.mass_terms[0], mass) < 1e-10
