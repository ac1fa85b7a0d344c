"""The screen: which effects may be added to an estimate, and where their estimates begin."""

from pathlib import Path

import pytest

from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.screen import screen_effects, values_to_try
from discrepancy.fits.candidate import EffectTerm
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.workflow import check_and_prepare
from tests.discrepancy.core import kit
from tests.discrepancy.rigs import MODEL, simulated

EXPLOSIVE = Path(kit.__file__).parent / "inputs" / "explosive.toml"


@pytest.fixture(scope="module")
def search() -> ForceSearch:
    """Return the search in simulated releases of a single mass."""
    model = LumpedModel.load(MODEL)
    hidden = "coulomb_friction", {"friction_ratio": 0.01}, "slide"
    campaign, _ = check_and_prepare(simulated(model, "ringdown", 0, hidden), model)
    return ForceSearch(kit.problem_of(campaign, model))


def test_rate_and_zero_of_a_clock_are_also_tried_alone():
    """Their ratio is not known: with a wrong one, a clock explains nothing."""
    (clock,) = kit.chosen("clock_error")
    tried = [tuple(values != 0.0) for values in values_to_try(EffectTerm(clock, ""))]
    assert set(tried) == {(True, True), (True, False), (False, True)}


def test_an_effect_that_grows_without_bound_is_left_out_with_the_reason(search):
    explosive = effects_of_file(EXPLOSIVE)
    screened = screen_effects(search, search.best_port_estimate, explosive)
    assert not screened
    reason = search.ported.problem_with_laws.refusals["explosive"]
    assert reason.endswith("is not a finite number at every time.")


def test_laws_that_are_the_same_with_free_exponents_are_compared_once(search):
    """Dry friction and structural damping are named apart; with free exponents they are one law."""
    damping = kit.chosen("coulomb_friction", "structural_damping")
    screened = screen_effects(search, search.best_port_estimate, damping)
    named = [effect.term.effect.identifier for effect in screened if not effect.term.free_shape]
    assert sorted(named) == ["coulomb_friction", "structural_damping"]
    assert [effect.term.free_shape for effect in screened].count(True) == 1
