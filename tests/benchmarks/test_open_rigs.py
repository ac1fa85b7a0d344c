"""Open rigs: equations beside the model files, and what is written; what verdicts are worth."""

from dataclasses import replace
from importlib import import_module
from pkgutil import walk_packages
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

import benchmarks
import evidence
from benchmarks.blind.effects import DRAWS
from benchmarks.blind.scoring import FAMILIES, Outcome, coverage, wilson
from benchmarks.blind.scoring import outcome as scored
from benchmarks.open_rigs.__main__ import judge, outcome_of
from benchmarks.open_rigs.campaigns import ALONE, GAPS, SHARES, Bench, drawn, simulate, write
from benchmarks.open_rigs.rigs import RIGS, Truth
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from fe.runtime.patch import BoucWen, FreePlay, ModelPatch, Overflow, PowerDamping, PowerStiffness, Primitive
from tests.refusals import Inputs

SAMPLES = 40
OUTCOMES = Inputs(__file__).table("outcomes.toml")


LAWS: dict[str, tuple[str, float, Primitive]] = {
    "cart": ("quadratic_damping", 0.3, PowerDamping("rail", 0.3 * 6.0, 2.0, 0.0, 1.5, 1.0)),
    "damper": ("cubic_stiffness", 0.3, PowerStiffness("piston", 0.3 * 60.0, 3.0, 0, 0.02)),
    "servo": ("coulomb_friction", 0.1, PowerDamping("bearing", 0.2, 0.0, 0.0, 1.0, 1.0)),
    "support moved": ("free_play", 0.3, FreePlay("mount", 0.3 * 200.0, 0.3 * 0.04)),
    "support shaken": ("bouc_wen_hysteresis", 0.3, BoucWen("mount", 0.3 * 200.0, 0.3 * 0.04, 1.0)),
    "stores": ("overflow", 0.4, Overflow("upper outlet", 0.4 * 0.02, 1.5, 0.3, 0.7)),
    "heated": ("natural_convection", 0.4, PowerDamping("surface", 0.4 * 80.0, 1.25, 0.0, 40.0, 1.0)),
}


@pytest.mark.parametrize("name", RIGS)
def test_equations_and_model_files_agree(name, tmp_path):
    """As they are and with a law, to less than half of the noise, though two integrators moved them."""
    bench = Bench(RIGS[name], np.random.default_rng(3), SAMPLES)
    write(tmp_path / "case", bench, Truth(bench.factors), "plain", (1, 2))
    campaign = read_campaign(tmp_path / "case")
    model = LumpedModel.load(tmp_path / "case" / "model.toml")
    outputs = tuple((channel.output, channel.quantity) for channel in campaign.channels.values())
    factors = np.array([bench.factors[item.name] for item in model.parameters])
    law, size, primitive = LAWS[name]
    for truth, patch in (
        (Truth(bench.factors), ModelPatch()),
        (Truth(bench.factors, law, size), ModelPatch((primitive,))),
    ):
        expected = simulate(bench.rig, truth, bench.courses[:1], bench.stamps[:1])[0]
        found = model.respond(campaign.trials[0], outputs, patch, Conditions(factors, refinement=4)).values
        assert np.sqrt(np.mean(((found - expected) / bench.noise) ** 2)) < 0.5
    assert bench.unexplained(truth, bench.bare) > 1.0  # the law is seen beside calibration and zeros


@pytest.mark.parametrize("number", [1, 4])
def test_a_hidden_law_and_the_remainder_beside_it_have_their_sizes(number):
    bench, truth, facts = drawn(number, 1, SAMPLES)
    assert GAPS[0] * 0.9 < facts["gap"] < GAPS[1] * 1.1
    assert SHARES[0] * 0.9 < facts["remainder"] / facts["gap"] < SHARES[1] * 1.1
    without_law = bench.readings_over_noise(replace(truth, amount=0.0))
    assert bench.unexplained(truth, without_law) == pytest.approx(facts["remainder"])


def test_the_last_campaigns_hide_a_remainder_alone():
    _, truth, facts = drawn(27, 1, SAMPLES)
    assert (facts["identifiers"], truth.law) == ([], "")
    assert ALONE[0] * 0.9 < facts["remainder"] < ALONE[1] * 1.1


@pytest.mark.long
@pytest.mark.parametrize(("seed", "number", "kind", "named"), OUTCOMES["rigs"])
def test_what_is_left_takes_no_name(seed, number, kind, named, tmp_path):
    row = judge(tmp_path, seed, number, "plain")
    assert (row["kind"], row["named"]) == (kind, named), row["sentence"]


@pytest.mark.parametrize(("left", "outcome"), [("law", "family"), ("push", "wrong")])
def test_the_family_of_a_law_that_is_left_alone_is_right(left, outcome):
    families = {item.identifier: item.family for item in library()}
    row = {"outcome": "wrong", "family": families["cubic_stiffness"]}
    assert outcome_of(row, {"rig": "damper", "identifiers": [], "left": left}) == outcome
    assert outcome_of(row, {"rig": "stores", "identifiers": [], "left": left}) == "wrong"
    assert outcome_of(row, {"rig": "damper", "identifiers": ["outflow"], "left": left}) == "wrong"


@pytest.mark.parametrize("package", [benchmarks, evidence], ids=["benchmarks", "evidence"])
def test_every_module_can_be_imported(package):
    """Few of them run in tests; a name that went elsewhere must not wait for whoever needs the others."""
    found = [module.name for module in walk_packages(package.__path__, f"{package.__name__}.")]
    assert found
    for name in found:
        import_module(name)


# ---------------------------------------------------------------- what verdicts are worth


def _truth(**given: Any) -> dict[str, Any]:
    return {"identifiers": [], "kind": "catalogue", "accepted": [], "places": {}, "truth": {}} | given


def _said(**given: Any) -> dict[str, Any]:
    return {"identifiers": []} | given


@pytest.mark.parametrize(("truth", "verdict", "wanted"), OUTCOMES["outcomes"])
def test_outcomes(truth, verdict, wanted):
    assert scored(_truth(**truth), _said(**verdict)) is Outcome[wanted]


def test_every_effect_has_a_family():
    assert set(FAMILIES) == set(DRAWS)


def test_interval_is_compared_at_the_port_where_the_effect_was_named():
    truth = _truth(identifiers=["quadratic_damping"], places={"quadratic_damping": "planform"})
    truth["truth"] = {
        "quadratic_damping.coefficient@planform": 3.0,
        "quadratic_damping.coefficient@span": 10.0,
        "quadratic_damping.coefficient@tip": 0.5,
    }
    name = "quadratic_damping.coefficient"
    for port, low, high, wanted in (
        ("span", 9.0, 11.0, True), ("span", 0.4, 0.6, False), ("tip", 0.4, 0.6, True), ("", 9.0, 11.0, None),
        ("planform", 2.0, 4.0, True), ("planform", 9.0, 11.0, False),
    ):  # fmt: skip
        verdict = _said(kind="named", estimates={name: [low, 1.0, high]}, places={"quadratic_damping": port})
        assert coverage(truth, verdict) == {name: wanted}
    local = _truth(
        identifiers=["free_play"], places={"free_play": "root"}, truth={"free_play.stiffness": 4.0}
    )
    estimates = {"free_play.stiffness": [3.0, 4.0, 5.0], "gauge_gain.gain": [0.0, 0.1, 0.2]}
    for place, wanted in (("root", True), ("tip", None)):
        verdict = _said(kind="named", estimates=estimates, places={"free_play": place})
        assert coverage(local, verdict) == {"free_play.stiffness": wanted}


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (10, 10), (97, 100), (1, 3)])
def test_interval_of_a_share(hits, count):
    wanted = binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((wanted.low, wanted.high), abs=1e-6)
