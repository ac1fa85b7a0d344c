"""A bar of one hexahedron: loads with a control of zero, and elements that are not built."""

from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import MeshError, SolutionError
from fe.structure.affine import static_responses
from fe.structure.operators import load_and_assemble
from fe.verification.calculix_comparison import agreement
from fe.verification.calculix_deck import structure_deck
from tests.calculix_decks import needs_calculix
from tests.meshes import box

DECK = """*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
5, 0., 0., 2.
6, 1., 0., 2.
7, 1., 1., 2.
8, 0., 1., 2.
*ELEMENT, TYPE=KIND, ELSET=ALL
1, 1, 2, 3, 4, 5, 6, 7, 8
*NSET, NSET=FOOT
1, 2, 3, 4
*NSET, NSET=EVERY
1, 2, 3, 4, 5, 6, 7, 8
*NSET, NSET=TOP
5, 6, 7, 8
"""
STRUCTURE = """name = "bar"
mesh = "bar.inp"
length_unit = "m"
[[control]]
name = "n"
nominal = NOMINAL
minimum = -2.0
maximum = 2.0
[[material]]
name = "steel"
set = "ALL"
density = 7800
young_modulus = 2e11
poisson_ratio = 0.0
[[support]]
set = "HELD"
hold = ["x", "y", "z"]
[[load]]
name = "push"
control = "n"
set = "TOP"
force = [0, 0, 100]
[[displacement]]
name = "top"
point = [1, 1, 2]
direction = [0, 0, 1]
"""


def bar(folder: Path, nominal: float = 0.0, held: str = "FOOT", kind: str = "C3D8") -> Path:
    (folder / "bar.inp").write_text(DECK.replace("KIND", kind))
    file = folder / "bar.toml"
    file.write_text(STRUCTURE.replace("NOMINAL", str(nominal)).replace("HELD", held))
    return file


@pytest.mark.parametrize(("nominal", "factor"), [(0.0, 1.0), (2.0, 2.0), (-1.0, -1.0)])
def test_a_load_whose_control_is_nominally_zero_is_answered_for_one_unit(tmp_path, nominal, factor):
    """The bar is 2 m long, and its section 1 m^2: F L / (E A)."""
    response = static_responses(load_and_assemble(bar(tmp_path, nominal)))["push"]
    np.testing.assert_allclose(response.output, factor * 100.0 * 2.0 / 2e11, rtol=1e-9)


@needs_calculix
def test_calculix_agrees_about_a_load_whose_control_is_nominally_zero(tmp_path):
    structure = load_and_assemble(bar(tmp_path), mass_as_stiffness=True)
    differences = agreement(structure_deck(structure), tmp_path, 2).loads["push"]
    assert differences
    assert max(differences.values()) < 1e-5


def test_a_structure_with_all_nodes_held_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(SolutionError, match="all its nodes are held"):
        static_responses(load_and_assemble(bar(tmp_path, held="EVERY")))


@pytest.mark.parametrize("kind", ["C3D8I", "C3D8R", "C3D8RH", "C3D8IH"])
def test_hexahedra_that_are_not_those_of_this_project_are_refused(tmp_path, kind):
    with pytest.raises(
        MeshError, match=f"line 10: elements of type {kind} cannot be read: .* softer in bending"
    ):
        load_and_assemble(bar(tmp_path, kind=kind))


@pytest.mark.parametrize("kind", ["C3D8RT", "C3D8HT", "C3D8S"])
def test_every_other_variant_of_a_hexahedron_is_refused_by_its_name(tmp_path, kind):
    sentence = (
        f"line 10: elements of type {kind} cannot be read: "
        "they are other elements, not C3D8; .*C3D20R"
    )
    with pytest.raises(MeshError, match=sentence):
        load_and_assemble(bar(tmp_path, kind=kind))


@pytest.mark.parametrize(
    "kind", ["C3D20RI", "C3D10M", "C3D10MH", "C3D10I", "C3D15V", "C3D6R", "B31R", "CPS8R", "S8R"]
)
def test_variants_of_other_elements_are_refused_by_their_names(tmp_path, kind):
    with pytest.raises(
        MeshError, match=f"line 10: elements of type '?{kind}'? cannot be read.*C3D20R"
    ):
        load_and_assemble(bar(tmp_path, kind=kind))


def test_a_variant_of_equal_stiffness_is_told(tmp_path):
    structure = load_and_assemble(bar(tmp_path, 1.0, kind="C3D8H"))
    (remark,) = structure.mesh.remarks
    assert remark.endswith("bar.inp, line 10: elements of type C3D8H are built as C3D8.")


def slender(folder: Path, kind: str) -> Path:
    """Write a beam, two by two elements in its section, bent by a force across its end."""
    points, cells = box("hexahedron20", (4, 2, 2))
    points = points * np.array([1.0, 0.3, 0.2]) / points.max(axis=0)
    numbers = range(1, len(points) + 1)
    rows = ["*NODE", *(f"{n}, {', '.join(map(repr, points[n - 1].tolist()))}" for n in numbers)]
    rows.append(f"*ELEMENT, TYPE={kind}, ELSET=ALL")
    rows += [
        f"{n}, {', '.join(map(str, cell))}" for n, cell in enumerate((cells + 1).tolist(), start=1)
    ]
    for name, place in (("FOOT", 0.0), ("TOP", 1.0)):
        rows += [f"*NSET, NSET={name}", *(f"{n}," for n in numbers if points[n - 1, 0] == place)]
    (folder / "bar.inp").write_text("\n".join(rows) + "\n")
    text = (
        STRUCTURE.replace("NOMINAL", "1.0")
        .replace("HELD", "FOOT")
        .replace("[1, 1, 2]", "[1, 0.3, 0.2]")
    )
    (folder / "bar.toml").write_text(text.replace("poisson_ratio = 0.0", "poisson_ratio = 0.3"))
    return folder / "bar.toml"


@needs_calculix
@pytest.mark.parametrize("kind", ["C3D20", "C3D20R"])
def test_calculix_agrees_about_hexahedra_of_full_and_reduced_integration(tmp_path, kind):
    structure = load_and_assemble(slender(tmp_path, kind), mass_as_stiffness=True)
    assert structure.mesh.kind.calculix == kind
    differences = agreement(structure_deck(structure), tmp_path, 2).loads["push"]
    assert differences
    assert max(differences.values()) < 1e-5


def test_the_integration_of_a_hexahedron_changes_its_displacement(tmp_path):
    """The difference is ten times the tolerance against CalculiX: a wrong rule would be seen."""
    full, reduced = (
        static_responses(load_and_assemble(slender(tmp_path, kind)))["push"].output
        for kind in ("C3D20", "C3D20R")
    )
    assert np.abs(full / reduced - 1.0).max() > 1e-4
