"""The wing against CalculiX on a coarse mesh; the parsers and the input without it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.verification.calculix_comparison import ring_down_agreement, wing_agreement
from fe.verification.calculix_job import read_frequencies, read_tables, run_calculix
from fe.verification.calculix_models import wing_deck
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble
from tests.calculix_decks import needs_calculix

DAMAGED = (0.4, 0.6)


@needs_calculix
@pytest.mark.parametrize("stiffness_loss", [(0.0, 0.0), DAMAGED], ids=["healthy", "damaged"])
def test_statics_and_frequencies_agree(
    coarse_operators: AffineOperators, tmp_path: Path, stiffness_loss: tuple[float, float]
) -> None:
    state = DigitalState(young_modulus_factor=1.0073, stiffness_loss=stiffness_loss)
    agreement = wing_agreement(coarse_operators, tmp_path, state)
    assert list(agreement.loads) == ["tip force", "lift"]
    for differences in agreement.loads.values():
        assert max(differences["nodal displacements"], differences["displacement outputs"]) < 1e-5
        assert max(differences["gauge strains"], differences["strains at integration points"]) < 2e-5
    assert len(agreement.ours) == 6
    assert agreement.modal < 1e-5


@needs_calculix
def test_a_wing_with_a_rod_and_no_wall_at_its_nose_agrees(coarse_design: WingDesign, tmp_path: Path) -> None:
    rod = {"web": 1, "reach": 0.25, "diameter": 0.012, "young_modulus": 120e9, "density": 1600.0}
    design = coarse_design.changed(rods=[rod], skin={"closed_leading_edge": False})
    agreement = wing_agreement(assemble(design), tmp_path, DigitalState(), 3)
    for differences in agreement.loads.values():
        assert max(differences["nodal displacements"], differences["displacement outputs"]) < 1e-5
        assert differences["strains at integration points"] < 2e-5
    assert agreement.modal < 1e-5


@needs_calculix
def test_point_masses_count(coarse_operators: AffineOperators, tmp_path: Path) -> None:
    heavy = replace(DigitalState(), servo_mass=0.0, pitot_mass=0.3)
    assert wing_agreement(coarse_operators, tmp_path, heavy, 3).modal < 1e-5


@pytest.mark.long
@needs_calculix
def test_a_ring_down_agrees(coarse_operators: AffineOperators, tmp_path: Path) -> None:
    agreement = ring_down_agreement(
        coarse_operators, tmp_path, DigitalState(), periods=0.125, steps_per_period=80
    )
    assert agreement.relative < 0.01
    assert agreement.relative_same_rule < 3e-4  # what is left is not the time integration
    assert np.all(agreement.calculix < agreement.initial)


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


TABLES = """
 displacements (vx,vy,vz) for set NALL and time  0.1000000E+01

         1  1.000000E-01 -2.000000E+00  0.000000E+00
         2  3.000000E-01  4.000000E+00  5.000000E+00

 internal energy density (elem, integ.pnt.,eneri) for set E0 and time  0.2000000E+01

         1   1  2.5E+00
"""
EIGENVALUES = """
     E I G E N V A L U E   O U T P U T

 MODE NO    EIGENVALUE                       FREQUENCY
                                     REAL PART            IMAGINARY PART
                           (RAD/TIME)      (CYCLES/TIME     (RAD/TIME)

      1   0.1252300E+04   0.3538785E+02   0.5632151E+01   0.0000000E+00
      2   0.9000000E+04   0.9486833E+02   0.1509876E+02   0.0000000E+00

     P A R T I C I P A T I O N   F A C T O R S
"""


def test_printed_tables_are_read() -> None:
    tables = {name: [rows.tolist() for rows in own] for name, own in read_tables(TABLES).items()}
    assert tables == {"NALL": [[[1, 0.1, -2, 0], [2, 0.3, 4, 5]]], "E0": [[[1, 1, 2.5]]]}
    assert read_frequencies(EIGENVALUES).tolist() == [5.632151, 15.09876]


def test_damaged_results_are_one_sentence() -> None:
    with pytest.raises(CalculixError, match="not a row of numbers"):
        read_tables(TABLES.replace("-2.000000E+00", "*************"))
    with pytest.raises(CalculixError, match="no eigenvalues"):
        read_frequencies(TABLES)
