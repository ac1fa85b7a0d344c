"""The wing against CalculiX, and runs of CalculiX that fail."""

from dataclasses import dataclass
from typing import Any

import pytest

from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.verification.calculix_comparison import agreement
from fe.verification.calculix_deck import wing_deck
from fe.verification.calculix_run import read_frequencies, read_tables, run_calculix
from fe.wing.operators import assemble
from tests.calculix_decks import needs_calculix
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
TABLES = INPUTS.text("tables.dat")
EIGENVALUES = INPUTS.text("eigenvalues.dat")

FEW_CELLS = {"edge_size": None, "span_size": 0.2, "chord_size": 0.2}
LIMITS = {
    "nodal displacements": 1e-5,
    "displacement outputs": 1e-5,
    "strains at integration points": 2e-5,
}
"""The largest relative differences."""


@dataclass(frozen=True)
class Compared:
    """A wing that is compared with CalculiX.

    Attributes
    ----------
    state : dict
        Values of its digital state.
    changes : dict
        Of the coarse design.
    compares_gauges : bool
        Whether the strains at gauges are compared, too.
    """

    state: dict[str, Any]
    changes: dict[str, Any]
    compares_gauges: bool


COMPARED = {
    "damaged, with other masses": Compared(
        state={
            "young_modulus_factor": 1.0073,
            "stiffness_loss": (0.4, 0.6),
            "servo_mass": 0.0,
            "pitot_mass": 0.3,
        },
        changes={},
        compares_gauges=True,
    ),
    "with a rod and no wall at its nose": Compared(
        state={},
        changes={
            "rods": [
                {
                    "web": 1,
                    "reach": 0.25,
                    "diameter": 0.012,
                    "young_modulus": 120e9,
                    "density": 1600.0,
                }
            ],
            "skin": {"closed_leading_edge": False},
        },
        compares_gauges=False,
    ),
}


@pytest.fixture(scope="module", params=COMPARED)
def compared(request):
    return COMPARED[request.param]


@pytest.fixture(scope="module")
def differences(compared, coarse_design, tmp_path_factory):
    """Differences between the wing and CalculiX."""
    wing = assemble(coarse_design.changed(mesh=FEW_CELLS, **compared.changes))
    deck = wing_deck(wing, DigitalState(**compared.state))
    return agreement(deck, tmp_path_factory.mktemp("calculix"), 6)


@needs_calculix
@pytest.mark.parametrize("load", ["tip force", "lift"])
def test_statics_agree_with_calculix(compared, differences, load):
    of_load = differences.loads[load]

    for name, limit in LIMITS.items():
        assert of_load[name] < limit, name
    if compared.compares_gauges:
        assert of_load["gauge strains"] < 1e-5


@needs_calculix
def test_both_loads_are_compared_with_calculix(differences):
    assert list(differences.loads) == ["tip force", "lift"]


@needs_calculix
def test_frequencies_agree_with_calculix(differences):
    assert len(differences.ours) == 6
    assert differences.modal < 1e-5


# ---------------------------------------------------------------- runs that fail


@needs_calculix
def test_an_input_that_calculix_refuses_is_one_sentence(tmp_path):
    with pytest.raises(CalculixError, match=r"did not finish .*bad\.inp.*bad\.log"):
        run_calculix("*NONSENSE\n*STEP\n*STATIC\n*END STEP\n", tmp_path, "bad")


def test_calculix_that_is_not_there_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))

    with pytest.raises(CalculixError, match="apt-get install calculix-ccx"):
        run_calculix("", tmp_path, "job")


# ---------------------------------------------------------------- printed tables


def test_printed_tables_are_read():
    tables = {
        name: [rows.tolist() for rows in blocks] for name, blocks in read_tables(TABLES).items()
    }

    assert tables == {"NALL": [[[1, 0.1, -2, 0], [2, 0.3, 4, 5]]], "E0": [[[1, 1, 2.5]]]}


def test_printed_frequencies_are_read():
    assert read_frequencies(EIGENVALUES).tolist() == [5.632151, 15.09876]


def test_a_number_that_overflowed_is_refused():
    overflowed = TABLES.replace("-2.000000E+00", "*************")

    with pytest.raises(CalculixError, match="not a row of numbers"):
        read_tables(overflowed)


def test_tables_without_eigenvalues_are_refused():
    with pytest.raises(CalculixError, match="no eigenvalues"):
        read_frequencies(TABLES)
