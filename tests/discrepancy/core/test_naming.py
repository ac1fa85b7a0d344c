"""Names on simulated campaigns of the chain: half the time steps, nuisances and parameters drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import SHAPE_GAIN
from discrepancy.judgement.naming import SURE, UNSURE, Case, name
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import SENTENCES
from discrepancy.verdict import VerdictKind
from fe.runtime.patch import ModelPatch, PowerDamping

NO_NAME = (
    VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT, VerdictKind.UNEXPLAINED, VerdictKind.GROUP,
    VerdictKind.FAMILY,
)  # fmt: skip
CHOSEN = (
    "point_mass", "root_compliance", "coulomb_friction", "quadratic_damping", "cubic_stiffness",
    "stiffness_drift", "seating_offset", "gauge_gain", "load_place", "load_cell", "clock_error",
)  # fmt: skip
FEW = (
    "coulomb_friction", "quadratic_damping", "cubic_stiffness", "seating_offset", "gauge_gain", "load_cell",
)  # fmt: skip
"""Where more rivals would only take time."""


@pytest.fixture(scope="module")
def small(kit):  # type: ignore[no-untyped-def]
    """A short test: three static trials, two releases of small amplitude."""
    return kit.chain_bench(amplitudes=(0.004, 0.002), samples=150)


@pytest.fixture(scope="module")
def effects(catalogue):  # type: ignore[no-untyped-def]
    return tuple(effect for effect in catalogue if effect.identifier in CHOSEN)


@pytest.fixture(scope="module")
def few(catalogue):  # type: ignore[no-untyped-def]
    return tuple(effect for effect in catalogue if effect.identifier in FEW)


TRUTHS = {
    "gauge_gain": ({"gain_error": 0.08}, "g1"),
    "load_cell": ({"gain_error": 0.05, "tare_ratio": 0.02}, ""),
    "point_mass": ({"mass_ratio": 0.06, "station_ratio": 0.7}, ""),
    "coulomb_friction": ({"friction_ratio": 0.02}, "joint"),
    "quadratic_damping": ({"equivalent_damping_ratio": 0.01}, "end"),
    "seating_offset": ({"offset_ratio": 0.05}, None),
}


QUICK = ("gauge_gain", "coulomb_friction")


@pytest.mark.parametrize(
    "identifier",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in TRUTHS],
)
def test_an_effect_is_named_with_intervals_that_hold_it(small, effects, catalogue, identifier: str) -> None:  # type: ignore[no-untyped-def]
    values, place = TRUTHS[identifier]
    if place is None:
        effect = next(item for item in catalogue if item.identifier == identifier)
        place = effect.places(small.setting)[0]
    problem = small.problem(small.measured(11, small.patch(identifier, values, place)))
    verdict, found, fit = name(problem, effects)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [effect.identifier for effect in verdict.effects] == [identifier]
    assert verdict.probability >= 0.95
    assert all(gate.passed is not False for gate in verdict.gates)
    (effect,) = verdict.effects
    assert effect.place == place
    for estimate in effect.parameters:
        truth = values[estimate.name]
        # 90 % intervals, widened to 99.9 %: twice as wide
        middle, half = 0.5 * (estimate.low + estimate.high), 0.5 * (estimate.high - estimate.low)
        assert abs(truth - middle) <= 2.0 * half + 0.005 * abs(truth), estimate
    assert fit.candidate.identifiers == (identifier,)
    assert sum(found.set_probabilities().values()) == pytest.approx(1.0)


@pytest.mark.parametrize("slip_ratio", [pytest.param(0.3, marks=pytest.mark.long), 1.5])
def test_a_joint_that_slips_is_named_with_many_elements(small, catalogue, slip_ratio: float) -> None:  # type: ignore[no-untyped-def]
    """A joint of 400 elements; with few of its own the model would take their dents for knowledge."""
    values = {"stiffness_share": 0.3, "slip_ratio": slip_ratio}
    (joint,) = small.patch("joint_micro_slip", values, "joint")
    problem = small.problem(small.measured(5, ModelPatch((replace(joint, element_count=400),))))
    laws = [item for item in catalogue if item.family == "rate-independent hysteresis"]
    verdict, _, _ = name(problem, laws)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert effect.identifier == "joint_micro_slip"
    (found,) = effect.patch
    assert found.element_count == SEARCH.fine_joint
    for estimate in effect.parameters:
        middle, half = 0.5 * (estimate.low + estimate.high), 0.5 * (estimate.high - estimate.low)
        assert abs(values[estimate.name] - middle) <= 2.0 * half, estimate


@pytest.mark.long
def test_a_law_that_has_become_another_one_is_not_named(small, catalogue) -> None:  # type: ignore[no-untyped-def]
    """A joint that slips at a ten-thousandth of its motion is a soft one; micro-slip alone fits it."""
    soft = small.patch("joint_micro_slip", {"stiffness_share": 0.2, "slip_ratio": 1e-4}, "joint")
    problem = small.problem(small.measured(11, soft))
    alone = [item for item in catalogue if item.identifier == "joint_micro_slip"]
    verdict, _, _ = name(problem, alone)
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "slip_ratio of joint_micro_slip beside its prior" in verdict.sentence


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3, 4))])
def test_nothing_is_missing_where_nothing_is(small, catalogue, seed: int) -> None:  # type: ignore[no-untyped-def]
    """With the whole catalogue."""
    verdict, _, _ = name(small.problem(small.measured(seed)), catalogue)
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence
    assert verdict.log_bayes_factor < 3.0
    assert verdict.effects == ()


def test_two_effects_are_found_together(small, few) -> None:  # type: ignore[no-untyped-def]
    patch = small.patch("gauge_gain", {"gain_error": 0.10}, "g1")
    patch = patch + small.patch("quadratic_damping", {"equivalent_damping_ratio": 0.01}, "end")
    verdict, found, _ = name(small.problem(small.measured(5, patch)), few)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert sorted(item.identifier for item in verdict.effects) == ["gauge_gain", "quadratic_damping"]
    # both were tried alone as well: deletion has its comparison
    tried = {item.candidate.identifiers for item in found.all().values()}
    assert {("gauge_gain",), ("quadratic_damping",)} <= tried


def test_clock_and_load_cell_are_a_group(bench, effects) -> None:  # type: ignore[no-untyped-def]
    """All frequencies up by 0.5 %: the clock, or a stiffness 1 % up with a load cell that reads 1 % wrong."""
    patch = bench.patch("clock_error", {"rate_error": 0.005, "phase_zero": 0.0})
    verdict, _, _ = name(bench.problem(bench.measured(1, patch)), effects)
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    assert set(verdict.group) == {"clock_error", "load_cell"}


def test_static_displacement_gives_a_group(kit, effects) -> None:  # type: ignore[no-untyped-def]
    test = kit.chain_bench(amplitudes=(), static_channels=("x3",), gain_deviation=0.0)
    known = {"stiffness_factor": (1.0, 1e-3), "joint_factor": (1.0, 1e-3), "damping_factor": (1.0, 0.1)}
    test = replace(test, campaign=replace(test.campaign, parameters=known))
    patch = test.patch("root_compliance", {"compliance_share": 0.05})
    campaign = test.measured(2, patch)
    verdict, _, _ = name(test.problem(campaign), effects)
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    # the load cell is in reach too (test_separability), but pays for a tare that nothing asks for
    assert {"root_compliance", "load_place"} <= set(verdict.group)


@pytest.mark.parametrize(
    "left_out", [pytest.param("coulomb_friction", marks=pytest.mark.long), "quadratic_damping"]
)
def test_what_the_catalogue_lacks_gets_no_wrong_name(small, few, left_out: str) -> None:  # type: ignore[no-untyped-def]
    values, place = TRUTHS[left_out]
    rest = tuple(effect for effect in few if effect.identifier != left_out)
    campaign = small.measured(7, small.patch(left_out, values, place))
    verdict, _, _ = name(small.problem(campaign), rest)
    assert verdict.kind in (VerdictKind.UNEXPLAINED, VerdictKind.FAMILY), verdict.sentence


# ---------------------------------------------------------------- traps


def coloured(generator, shape):  # type: ignore[no-untyped-def]
    white = generator.standard_normal((shape[0] + 200, *shape[1:]))
    return np.sqrt(1.0 - 0.49) * lfilter([1.0], [1.0, -0.7], white, axis=0)[200:]


def outliers(generator, shape):  # type: ignore[no-untyped-def]
    noise = generator.standard_normal(shape)
    return np.where(generator.random(shape) < 0.01, 15.0 * noise, noise)


@pytest.mark.parametrize(
    "how",
    [
        pytest.param({"noise_scale": 3.0}, marks=pytest.mark.long),
        {"noise_scale": 0.4},
        {"noise": coloured},
        pytest.param({"noise": outliers}, marks=pytest.mark.long),
    ],
    ids=["understated", "overstated", "correlated", "outliers"],
)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_wrong_noise_makes_no_name(small, effects, how, seed: int) -> None:  # type: ignore[no-untyped-def]
    """Records that say a third of the noise, or too much, or white where it is not: nothing is named."""
    verdict, _, _ = name(small.problem(small.measured(seed, **how)), effects)
    assert verdict.kind in NO_NAME, verdict.sentence


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [pytest.param({"noise_scale": 2.0}, marks=pytest.mark.long), {"noise": coloured}],
    ids=["understated", "correlated"],
)
def test_wrong_noise_makes_no_wrong_name(small, few, how) -> None:  # type: ignore[no-untyped-def]
    patch = small.patch("gauge_gain", {"gain_error": 0.10}, "g1")
    verdict, _, _ = name(small.problem(small.measured(3, patch, **how)), few)
    if verdict.kind is VerdictKind.NAMED:
        assert [item.identifier for item in verdict.effects] == ["gauge_gain"]


def test_an_effect_below_detectability_is_not_named(small, effects) -> None:  # type: ignore[no-untyped-def]
    patch = small.patch("gauge_gain", {"gain_error": 0.004}, "g1")  # within the gauge's own gain error
    for seed in (1, 2):
        verdict, _, _ = name(small.problem(small.measured(seed, patch)), effects)
        assert verdict.kind in (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT), verdict.sentence


def test_without_a_noise_record_the_sentence_says_so(kit) -> None:  # type: ignore[no-untyped-def]
    """Neither that nothing is missing nor that the name is all can be said of an absolute fit."""
    effects = (kit.offset_effect(),)
    verdict, _, _ = name(kit.closed_problem(seed=3, known_noise=False), effects)
    assert verdict.kind is VerdictKind.NOTHING_MISSING
    assert "No noise record" in verdict.sentence
    verdict, _, _ = name(kit.closed_problem(seed=3, effect=0.4, known_noise=False), effects)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert "No noise record" in verdict.sentence
    verdict, _, _ = name(kit.closed_problem(seed=3, effect=0.4), effects)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert "record" not in verdict.sentence


@pytest.fixture(scope="module")
def searched(small, few):  # type: ignore[no-untyped-def]
    """A campaign with friction, and what a search has found there."""
    values, place = TRUTHS["coulomb_friction"]
    problem = small.problem(small.measured(11, small.patch("coulomb_friction", values, place)))
    return problem, name(problem, few)[1]


@pytest.mark.long
def test_members_that_do_not_fit_are_no_part_of_a_group(searched, few) -> None:  # type: ignore[no-untyped-def]
    """Patch and proof are those of a member; the probability is that of the members together."""
    problem, found = searched
    candidate = Candidate((Term(next(item for item in few if item.identifier == "load_cell")),))
    wrong = fit(problem, candidate, problem.start(candidate))
    found.keep(wrong, exact=True)
    right = ("coulomb_friction",)
    shares = {wrong.candidate.identifiers: 0.6, right: 0.38, (): 0.02}
    verdict, _, nearest = Case(problem, found, shares).open()
    assert verdict.kind is VerdictKind.GROUP
    assert verdict.group == right
    assert "cannot tell which" not in verdict.sentence
    assert verdict.probability == pytest.approx(0.38)
    assert nearest.candidate.identifiers == right
    assert verdict.gates[0].passed


def test_what_all_probable_sets_hold_is_named_where_it_fits_alone(searched, few) -> None:  # type: ignore[no-untyped-def]
    """Which further effect stands beside it stays open; what does not fit alone is no name so."""
    problem, found = searched
    place = TRUTHS["coulomb_friction"][1]
    friction, cell, gain = (
        Term(next(item for item in few if item.identifier == identifier), place)
        for identifier, place in (("coulomb_friction", place), ("load_cell", ""), ("gauge_gain", "g1"))
    )
    for terms in ((cell,), (friction, gain), (cell, gain)):
        found.keep(fit(problem, Candidate(terms), problem.start(Candidate(terms))), exact=True)
    right, more = ("coulomb_friction",), Candidate((friction, gain)).identifiers
    outcome = Case(problem, found, {more: 0.7, right: 0.3}).shared()
    assert outcome is not None
    assert outcome[0].kind is VerdictKind.NAMED
    assert [item.identifier for item in outcome[0].effects] == list(right)
    assert outcome[0].probability == pytest.approx(1.0)
    for shares in ({Candidate((cell, gain)).identifiers: 0.6, ("load_cell",): 0.4}, {right: 0.8, (): 0.2}):
        assert Case(problem, found, shares).shared() is None


def test_the_rules_stand_in_the_page_in_their_order() -> None:
    page = (Path(__file__).parents[3] / "docs" / "discrepancy.md").read_text(encoding="utf-8")
    rules = SENTENCES["rule"]
    assert len(rules) == len((*UNSURE, *SURE))
    table = "".join(f"| {rule['verdict']} | {rule['when']} |\n" for rule in rules)
    assert f"| verdict | where |\n| --- | --- |\n{table}\n" in page


# ---------------------------------------------------------------- families


@pytest.mark.long
def test_a_law_between_two_named_ones_is_their_family_once(small, few) -> None:  # type: ignore[no-untyped-def]
    """|v|^0.5 lies between dry friction and viscous damping: one family, beside those of other laws."""
    law = PowerDamping("end", 1.0, 0.5, 0.0, 1.0, 1.0)
    campaign = small.measured(3, ModelPatch((law,)))
    verdict, found, fit = name(small.problem(campaign), few)
    assert verdict.kind is VerdictKind.FAMILY, verdict.sentence
    families = [item for item in found.exact.values() if item.candidate.is_family]
    laws = [(term.effect.family, term.place) for item in families for term in item.candidate.terms]
    assert len(laws) == len(set(laws))
    shape = {item.name: item for effect in verdict.effects for item in effect.shape}
    assert shape["velocity_exponent"].low < 0.5 < shape["velocity_exponent"].high
    # what is free pays for it before the data speak
    for item in families:
        named = Candidate(tuple(replace(term, free_shape=False) for term in item.candidate.terms))
        assert found.log_prior(item.candidate) == pytest.approx(found.log_prior(named) - SHAPE_GAIN)
    assert fit.candidate.is_family


@pytest.mark.long
def test_a_law_of_free_shape_beside_two_effects_is_no_verdict(small, few) -> None:  # type: ignore[no-untyped-def]
    """With three effects and a shape to choose nearly anything fits."""
    law = ModelPatch((PowerDamping("end", 0.15, 1.0, 0.0, 1.0, 1.0),))
    others = small.patch("gauge_gain", {"gain_error": 0.08}, "g1")
    run = next(item for item in few if item.identifier == "seating_offset").places(small.setting)[0]
    others = others + small.patch("seating_offset", {"offset_ratio": 0.05}, run)
    verdict, found, _ = name(small.problem(small.measured(3, law + others)), few)
    assert len(found.best().candidate.terms) == SEARCH.largest_set
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "free shape gains" in verdict.sentence
    assert {"gauge_gain", "seating_offset"} < set(verdict.resembles)
