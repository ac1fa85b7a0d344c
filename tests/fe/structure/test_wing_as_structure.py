"""The wing's own mesh, written as a deck of CalculiX and read as a structure, is the wing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.cells import rotate_elasticity
from fe.reduction.reduced_basis import reduce_structure
from fe.structure.operators import load_and_assemble
from fe.wing.design import WingDesign
from fe.wing.mesh import WingMesh
from fe.wing.operators import assemble, cell_axes, cell_density, cell_elasticity

FloatArray = NDArray[np.float64]


STATES = (({}, {}), ({"e": 0.95}, {"z1": 0.3, "z2": 0.7}), ({"e": 1.08}, {"z1": 0.8}))


def _deck(mesh: WingMesh) -> str:
    """Nodes, elements, a set of each cell and of each stiffness term; numbers as precise as they are."""
    points, cells = mesh.points, mesh.cells + 1
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
    axes = cell_axes(mesh)
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


def _gauges(mesh: WingMesh) -> list[dict[str, Any]]:
    """The wing's gauges as points in space, along the span."""
    found = []
    for number, (distance, chord) in enumerate(mesh.design.gauges.positions, start=1):
        plan = mesh.design.planform
        place = mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span))
        point = mesh.positions(np.array([place.cell]), np.array([place.local]))[0, 0]
        found.append({"name": f"g{number}", "point": point.tolist(), "direction": [0, 1, 0]})
    return found


def _toml(table: dict[str, Any]) -> str:
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


def _skin(young_modulus: float) -> dict[str, Any]:
    return {"stations": [{"station": place, "young_modulus": young_modulus} for place in (0.0, 1.0)]}


@pytest.mark.long
def test_the_wing_is_a_structure(coarse_design: WingDesign, tmp_path: Path) -> None:
    """To 1e-10: stiffness, mass and gauges of the box on its rigid rib. To 1e-5: the reduced model.

    Skin of 0.6 mm in solid cells is badly conditioned: rounding of the stiffness moves strains by 6e-7.
    Two things of the shipped wing are left out, for a structure file has no counterpart: a modulus that
    changes inside a cell, and gauges averaged over a rectangle of the plan and in the middle of the skin.
    """
    gauges = {"averaging_chordwise": 0.0, "averaging_spanwise": 0.0, "surface": "outer"}
    wing = assemble(coarse_design.changed(skin=_skin(9.6e9), gauges=gauges))
    mesh, root = wing.wing_mesh, wing.wing_mesh.design.root
    (tmp_path / "wing.inp").write_text(_deck(mesh))
    rib = {"set": "ROOT", "rigid_about": [0, 0, 0], "hold": ["x", "y", "ry"]}
    springs = [0.0, 0.0, root.transverse_spring, root.flap_spring, 0.0, root.yaw_spring]
    tables: list[tuple[str, dict[str, Any]]] = [
        ("parameter", {"name": "e"}),
        ("control", {"name": "g"}),
        ("load", {"name": "weight", "control": "g", "acceleration": [0, 0, -9.81]}),
        ("support", rib | {"springs": springs}),
        *(("damage", {"name": name, "set": f"REGION{n}"}) for n, name in enumerate(wing.regions)),
        *(("material", material) for material in _materials(mesh, cell_elasticity(mesh), cell_density(mesh))),
        *(("gauge", gauge) for gauge in _gauges(mesh)),
    ]
    text = 'name = "wing"\nmesh = "wing.inp"\nlength_unit = "m"\n'
    text += "".join(f"[[{key}]]\n{_toml(table)}\n" for key, table in tables)
    (tmp_path / "wing.toml").write_text(text)
    structure = load_and_assemble(tmp_path / "wing.toml")

    def apart(ours: sparse.csr_array, theirs: sparse.csr_array) -> float:
        return float(abs(ours - theirs).max() / abs(theirs).max())

    found = {(term.parameter, term.region): term.matrix for term in structure.stiffness_terms}
    pairs = (("e", None), *((None, name) for name in wing.regions), (None, None))
    for pair, term in zip(pairs, wing.stiffness_terms, strict=True):
        assert apart(found[pair], term.matrix) < 1e-10, pair
    assert apart(structure.mass_terms[0], wing.mass_terms[0]) < 1e-10
    assert apart(structure.gauge_output, -wing.gauge_output) < 1e-10  # the wing's are positive in compression
    terms = tuple(replace(term, parameter="e" if term.parameter else None) for term in wing.stiffness_terms)
    same = replace(
        structure, stiffness_terms=terms, mass_terms=wing.mass_terms[:1], gauge_output=-wing.gauge_output
    )
    one, other = (reduce_structure(item, "wing").model for item in (structure, same))
    for parameters, losses in STATES:
        first, second = (model.static_response(parameters | losses) for model in (one, other))
        assert np.abs(first.strain - second.strain).max() < 1e-5 * np.abs(second.strain).max()
        np.testing.assert_allclose(
            *(model.modes(parameters | losses).frequency for model in (one, other)), rtol=1e-5
        )
