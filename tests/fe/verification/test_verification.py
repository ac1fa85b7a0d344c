"""Balances of the wing, and the wing against CalculiX on a coarse mesh; its input and parsers without it."""

import math

import numpy as np
import pytest

from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.verification import calculix_comparison as comparison
from fe.verification import wing_checks as answers
from fe.verification.calculix_comparison import wing_deck
from fe.wing.operators import assemble
from tests.calculix_decks import needs_calculix
from tests.refusals import Inputs


def test_sums_that_must_agree(coarse_operators):
    """Masses, the force and the moment at the root, and the energy."""
    for one, other, unit in answers.wing_balance(coarse_operators).values():
        assert one == pytest.approx(other, rel=1e-6), unit


@pytest.mark.long
def test_the_mesh_converges(shipped_design):
    found = answers.mesh_convergence(shipped_design, (0.25, 0.5, 1.0))
    assert (np.diff(found["unknowns"]) > 0).all()
    for name in ("tip stiffness", "first bending", "second bending"):
        coarse, half, one = found[name]
        assert one == pytest.approx(half, rel=0.025)
        assert half == pytest.approx(coarse, rel=0.025)
    assert np.sqrt(np.mean((found["strain"][2] / found["strain"][1] - 1.0) ** 2)) < 0.05


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.7])
@pytest.mark.parametrize("refinements", [(0.5, 1.0, 2.0), (1.0, 1.5, 2.25), (0.25, 0.5, 1.5, 4.5)])
def test_the_order_of_a_power_law_is_found(refinements, order):
    values = [7.0 - 0.3 * refinement**-order for refinement in refinements]
    assert answers.observed_order(refinements[-1] / refinements[-2], values) == pytest.approx(order, abs=1e-6)


@pytest.mark.parametrize("values", [(1.0, 2.0, 1.5), (1.0, 2.0, 4.0), (1.0, 1.0, 1.0)])
def test_no_order_where_values_do_not_settle(values):  # to and fro, running away, standing still
    assert math.isnan(answers.observed_order(2.0, values))


# ---------------------------------------------------------------- the wing against CalculiX


ROD = {"web": 1, "reach": 0.25, "diameter": 0.012, "young_modulus": 120e9, "density": 1600.0}
DAMAGED = {"young_modulus_factor": 1.0073, "stiffness_loss": (0.4, 0.6), "servo_mass": 0.0, "pitot_mass": 0.3}
FEW_CELLS = {"edge_size": None, "span_size": 0.2, "chord_size": 0.2}
PLACES = {"nodal displacements": 1e-5, "displacement outputs": 1e-5, "strains at integration points": 2e-5}


@needs_calculix
@pytest.mark.parametrize(
    ("state", "changes"),
    [
        (DAMAGED, {}),
        ({}, {"rods": [ROD], "skin": {"closed_leading_edge": False}}),
    ],
    ids=["damaged, with other masses", "with a rod and no wall at its nose"],
)
def test_statics_and_frequencies_agree(state, changes, coarse_design, tmp_path):
    wing = assemble(coarse_design.changed(mesh=FEW_CELLS, **changes))
    found = comparison.agreement(wing_deck(wing, DigitalState(**state)), tmp_path, 6)
    assert list(found.loads) == ["tip force", "lift"]
    for differences in found.loads.values():
        assert all(differences[name] < most for name, most in PLACES.items())
        assert changes or differences["gauge strains"] < 1e-5
    assert len(found.ours) == 6
    assert found.modal < 1e-5


@needs_calculix
def test_an_input_that_calculix_refuses_is_one_sentence(tmp_path):
    with pytest.raises(CalculixError, match=r"did not finish .*bad\.inp.*bad\.log"):
        comparison.run_calculix("*NONSENSE\n*STEP\n*STATIC\n*END STEP\n", tmp_path, "bad")


def test_calculix_that_is_not_there_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CalculixError, match="apt-get install calculix-ccx"):
        comparison.run_calculix("", tmp_path, "job")


TABLES, EIGENVALUES = (Inputs(__file__).text(f"{name}.dat") for name in ("tables", "eigenvalues"))


def test_printed_tables_are_read_or_refused():
    tables = {name: [rows.tolist() for rows in own] for name, own in comparison.read_tables(TABLES).items()}
    assert tables == {"NALL": [[[1, 0.1, -2, 0], [2, 0.3, 4, 5]]], "E0": [[[1, 1, 2.5]]]}
    assert comparison.read_frequencies(EIGENVALUES).tolist() == [5.632151, 15.09876]
    with pytest.raises(CalculixError, match="not a row of numbers"):
        comparison.read_tables(TABLES.replace("-2.000000E+00", "*************"))
    with pytest.raises(CalculixError, match="no eigenvalues"):
        comparison.read_frequencies(TABLES)
