"""Structures against CalculiX on the same mesh: every kind that it integrates in the same way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.errors import CalculixError
from fe.structure.operators import Structure, load_and_assemble
from fe.verification.calculix_comparison import structure_agreement
from fe.verification.calculix_models import structure_deck
from tests.calculix_decks import needs_calculix

BODY = """length_unit = "mm"
parameter = [{name = "e", nominal = 1.1}]
control = [{name = "g", nominal = -2.0}]
set = [
  {name = "root", of = "nodes", box = [[0, -1, -99], [0, 99, 99]]},
  {name = "inner", of = "cells", box = [[0, -99, -99], [50, 99, 99]]},
  {name = "outer", of = "cells", box = [[50, -99, -99], [999, 99, 99]]},
]
support = [{set = "root", hold = ["x", "y", "z"]}, {set = "tip=1", springs = [0, 2e4, 1e5]}]
load = [
  {name = "weight", control = "g", acceleration = [0, 3, -9.81]},
  {name = "suction", set = "top=1", pressure = -1e4},
  {name = "push", set = "tip=1", force = [50, 20, -10]},
]
damage = [{name = "z1", set = "inner"}]
mass = [
  {name = "m", point = [71, 11, 5], mass = 0.05},
  {name = "n", point = [100, 15, 5], mass = 0.03, free = true},
]
gauge = [
  {name = "a", point = [31, 11, 10], direction = [1, 0, 0]},
  {name = "b", point = [62, 12, 0], direction = [1, 1, 0], length = 6},
]
displacement = [{name = "w", point = [100, 15, 5], direction = [0, 0, 1]}]
[[material]]
name = "metal"
set = "inner"
density = 2700
young_modulus = 7e10
poisson_ratio = 0.33
scaled_by = "e"
[[material]]
name = "ply"
set = "outer"
density = 1600
young_moduli = [1.3e11, 9e9, 8e9]
poisson_ratios = [0.3, 0.25, 0.4]
shear_moduli = [5e9, 4e9, 3e9]
axes = [[2, 1, 0.3], [0, 1, 1]]
"""


def body(
    box: Callable[..., Any], write: Callable[..., Path], kind: str, text: str = BODY, **options: bool
) -> Structure:
    points, cells = box(kind, (4, 2, 1) if kind in ("hexahedron20", "tetra10", "wedge15") else (4, 2, 2))
    bent = points * (100, 25, 10)
    if kind in ("hexahedron20", "tetra10", "wedge15"):  # curved edges, in the plane of the top
        bent[:, 1] += 12.0 * (bent[:, 0] / 100.0) ** 2 * (bent[:, 1] / 25.0)
    data = {"top": (points[:, 2] == 1.0).astype(np.int64), "tip": (points[:, 0] == 1.0).astype(np.int64)}
    return load_and_assemble(write(bent, kind, cells, text, point_data=data), **options)


HELD = 'set = "root", hold = ["x", "y", "z"]'
FLANGE = 'set = "root", rigid_about = [-5, 10, 3], hold = ["x", "rz"], springs = [0, 2e6, 1e6, 300, 500, 0]'


@needs_calculix
@pytest.mark.parametrize(
    ("kind", "root"),
    [
        *((kind, HELD) for kind in ("tetra", "tetra10", "hexahedron", "hexahedron20", "wedge15")),
        ("hexahedron", FLANGE),
    ],
)
def test_both_codes_agree(
    kind: str, root: str, box: Callable[..., Any], write: Callable[..., Path], tmp_path: Path
) -> None:
    """The last one stands on a rigid flange, which the push and two gauges near it load, on springs."""
    assert HELD in BODY
    text = BODY.replace(HELD, root)
    if root == FLANGE:
        text = text.replace("point = [31, 11, 10]", "point = [9, 11, 10]").replace(
            'name = "push", set = "tip=1"', 'name = "push", set = "root"'
        )
    structure = body(box, write, kind, text, mass_as_stiffness=True)
    agreement = structure_agreement(structure, tmp_path / "ccx", 5)
    assert [load.load for load in agreement.loads] == ["weight", "suction", "push"]
    assert all(max(load.field, load.strain, load.output) < 1e-5 for load in agreement.loads)
    assert len(agreement.ours) == 5
    assert agreement.modal < 1e-6


def test_wedges_cannot_be_compared(box: Callable[..., Any], write: Callable[..., Path]) -> None:
    with pytest.raises(CalculixError, match=r"integrates 6-node wedges \(C3D6\) in another way"):
        structure_deck(body(box, write, "wedge"))
