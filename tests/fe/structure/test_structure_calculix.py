"""Structures against CalculiX on the same mesh: every kind that it integrates in the same way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import CalculixError
from fe.structure.operators import load_and_assemble
from fe.verification.calculix_comparison import structure_agreement
from fe.verification.calculix_deck import structure_deck
from tests.calculix_decks import needs_calculix
from tests.refusals import Inputs

CURVED = ("hexahedron20", "tetra10", "wedge15")
FLANGE = (
    ('"root", hold = ["x", "y", "z"]',
     '"root", rigid_about = [-5, 10, 3], hold = ["x", "rz"], springs = [0, 2e6, 1e6, 300, 500, 0]'),
    ("point = [31, 11, 10]", "point = [9, 11, 10]"),
    ('name = "push", set = "tip=1"', 'name = "push", set = "root"'),
)  # fmt: skip


@pytest.fixture
def body(box, write):
    """A maker of a bent body of a kind of cells, with texts of its file exchanged."""

    def make(kind: str, *changes: tuple[str, str], **options: bool):
        points, cells = box(kind, (4, 2, 1 if kind in CURVED else 2))
        bent = points * (100, 25, 10)
        if kind in CURVED:  # curved edges, in the plane of the top
            bent[:, 1] += 12.0 * (bent[:, 0] / 100.0) ** 2 * (bent[:, 1] / 25.0)
        data = {"top": (points[:, 2] == 1.0).astype(np.int64), "tip": (points[:, 0] == 1.0).astype(np.int64)}
        text = Inputs(__file__).text("body.toml", *changes)
        return load_and_assemble(write(bent, kind, cells, text, point_data=data), **options)

    return make


@needs_calculix
@pytest.mark.parametrize(
    ("kind", "changes"),
    [*((kind, ()) for kind in ("tetra", "hexahedron", *CURVED)), ("hexahedron", FLANGE)],
)
def test_both_codes_agree(kind: str, changes: tuple[tuple[str, str], ...], body, tmp_path: Path) -> None:
    """The last one stands on a rigid flange, which the push and two gauges near it load, on springs."""
    agreement = structure_agreement(body(kind, *changes, mass_as_stiffness=True), tmp_path / "ccx", 5)
    assert list(agreement.loads) == ["weight", "suction", "push"]
    for differences in agreement.loads.values():
        assert list(differences) == ["nodal displacements", "gauge strains", "displacement outputs"]
        assert max(differences.values()) < 1e-5
    assert len(agreement.ours) == 5
    assert agreement.modal < 1e-6


def test_wedges_cannot_be_compared(body) -> None:
    with pytest.raises(CalculixError, match=r"integrates 6-node wedges \(C3D6\) in another way"):
        structure_deck(body("wedge"))
