"""The wing against CalculiX on a coarse mesh; the parsers and the input without it."""

from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.verification.calculix_comparison import agreement, ring_down_agreement
from fe.verification.calculix_deck import wing_deck
from fe.verification.calculix_job import read_frequencies, read_tables, run_calculix
from fe.wing.operators import AffineOperators, assemble
from tests.calculix_decks import needs_calculix
from tests.refusals import Inputs

DAMAGED = (0.4, 0.6)


ROD = {"web": 1, "reach": 0.25, "diameter": 0.012, "young_modulus": 120e9, "density": 1600.0}
PLACES = {"nodal displacements": 1e-5, "displacement outputs": 1e-5, "strains at integration points": 2e-5}


@needs_calculix
@pytest.mark.parametrize(
    ("state", "changes", "count"),
    [
        (DigitalState(young_modulus_factor=1.0073), {}, 6),
        (DigitalState(young_modulus_factor=1.0073, stiffness_loss=DAMAGED), {}, 6),
        (DigitalState(), {"rods": [ROD], "skin": {"closed_leading_edge": False}}, 3),
        (DigitalState(servo_mass=0.0, pitot_mass=0.3), {}, 3),
    ],
    ids=["healthy", "damaged", "with a rod and no wall at its nose", "other masses"],
)
def test_statics_and_frequencies_agree(
    state, changes, count: int, coarse_design, coarse_operators, tmp_path
) -> None:
    wing = assemble(coarse_design.changed(**changes)) if changes else coarse_operators
    found = agreement(wing_deck(wing, state), tmp_path, count)
    assert list(found.loads) == ["tip force", "lift"]
    for differences in found.loads.values():
        assert all(differences[name] < most for name, most in PLACES.items())
        assert changes or differences["gauge strains"] < 2e-5
    assert len(found.ours) == count
    assert found.modal < 1e-5


@pytest.mark.long
@needs_calculix
def test_a_ring_down_agrees(coarse_operators: AffineOperators, tmp_path: Path) -> None:
    ours, calculix, same_rule = ring_down_agreement(
        coarse_operators, tmp_path, DigitalState(), periods=0.125, steps_per_period=80
    )
    assert np.abs(calculix - ours).max() < 0.01
    assert np.abs(calculix - same_rule).max() < 3e-4  # what is left is not the time integration
    assert np.all(calculix < 1.0)


@needs_calculix
def test_an_input_that_calculix_refuses_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(CalculixError, match=r"did not finish .*bad\.inp.*bad\.log"):
        run_calculix("*NONSENSE\n*STEP\n*STATIC\n*END STEP\n", tmp_path, "bad")


def test_calculix_that_is_not_there_is_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CalculixError, match="apt-get install calculix-ccx"):
        run_calculix("", tmp_path, "job")


def test_every_cell_has_its_nodes_material_and_axes(coarse_operators: AffineOperators) -> None:
    lines = wing_deck(coarse_operators, DigitalState(stiffness_loss=DAMAGED)).text().splitlines()
    cells = len(coarse_operators.wing_mesh.cells)
    assert sum(line.startswith("*SOLID SECTION, ELSET=E") for line in lines) == cells
    assert sum(line.startswith("*ORIENTATION") for line in lines) == cells
    assert all(len(number) <= 20 for line in lines if line[0] != "*" for number in line.split(","))


TABLES, EIGENVALUES = (Inputs(__file__).text(f"{name}.dat") for name in ("tables", "eigenvalues"))


def test_printed_tables_are_read_or_refused() -> None:
    tables = {name: [rows.tolist() for rows in own] for name, own in read_tables(TABLES).items()}
    assert tables == {"NALL": [[[1, 0.1, -2, 0], [2, 0.3, 4, 5]]], "E0": [[[1, 1, 2.5]]]}
    assert read_frequencies(EIGENVALUES).tolist() == [5.632151, 15.09876]
    with pytest.raises(CalculixError, match="not a row of numbers"):
        read_tables(TABLES.replace("-2.000000E+00", "*************"))
    with pytest.raises(CalculixError, match="no eigenvalues"):
        read_frequencies(TABLES)
