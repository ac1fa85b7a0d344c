"""Open rigs: equations beside the model files, and what is written; the bracket; every module is imported."""

import tomllib
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import numpy as np
import pytest

import benchmarks
import evidence
from benchmarks.open_rigs.__main__ import judge, outcome_of
from benchmarks.open_rigs.campaigns import ALONE, GAPS, SHARES, Bench, drawn, simulate, write
from benchmarks.open_rigs.rigs import RIGS, Truth
from benchmarks.study_structure_effects import IN_MOTION, campaign, outcome, rig
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.model_choice import load_model
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.lumped_file import LumpedDescription
from discrepancy.workflow import investigate
from fe.runtime.patch import BoucWen, FreePlay, ModelPatch, Overflow, PowerDamping, PowerStiffness, Primitive
from tests.refusals import Inputs

SAMPLES = 40


def small(name: str) -> Bench:
    return Bench(RIGS[name], np.random.default_rng(3), SAMPLES)


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
    bench = small(name)
    write(tmp_path / "case", bench, Truth(bench.factors), "plain", (1, 2))
    campaign = read_campaign(tmp_path / "case")
    model = LumpedModel(
        LumpedDescription.parse(tomllib.loads((tmp_path / "case/model.toml").read_text("utf-8")))
    )
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
    assert bench.left(truth, bench.bare) > 1.0  # the law is seen beside calibration and zeros


@pytest.mark.parametrize("number", [1, 4, 27])
def test_what_is_hidden_has_its_size(number):
    bench, truth, facts = drawn(number, 1, SAMPLES)
    if number == 27:  # the last campaigns hide a remainder alone
        assert (facts["identifiers"], truth.law) == ([], "")
        assert ALONE[0] * 0.9 < facts["remainder"] < ALONE[1] * 1.1
        return
    assert GAPS[0] * 0.9 < facts["gap"] < GAPS[1] * 1.1
    assert SHARES[0] * 0.9 < facts["remainder"] / facts["gap"] < SHARES[1] * 1.1
    without = bench.stacked(replace(truth, amount=0.0))
    assert bench.left(truth, without) == pytest.approx(facts["remainder"])


FIRST, *OTHERS = Inputs(__file__).table("outcomes.toml")["rigs"]


@pytest.mark.parametrize(
    ("seed", "number", "kind", "named"),
    [FIRST, *(pytest.param(*row, marks=pytest.mark.long) for row in OTHERS)],
)
def test_what_is_left_takes_no_name(seed, number, kind, named, tmp_path):
    row = judge(tmp_path, seed, number, "plain")
    assert (row["kind"], row["named"]) == (kind, named), row["sentence"]
    if [seed, number] == FIRST[:2]:
        assert "'mass' 12.8 stated deviations off" in row["sentence"]
        assert "with one channel these data cannot tell them apart" in row["sentence"]


@pytest.mark.parametrize(("left", "outcome"), [("law", "family"), ("push", "wrong")])
def test_the_family_of_a_law_that_is_left_alone_is_right(left, outcome):
    families = {item.identifier: item.family for item in library()}
    row = {"outcome": "wrong", "family": families["cubic_stiffness"]}
    assert outcome_of(row, {"rig": "damper", "identifiers": [], "left": left}) == outcome
    assert outcome_of(row, {"rig": "stores", "identifiers": [], "left": left}) == "wrong"
    assert outcome_of(row, {"rig": "damper", "identifiers": ["outflow"], "left": left}) == "wrong"


# ---------------------------------------------------------------- structures


CHOSEN = ("", "gauge_gain", "breathing_crack", "coulomb_friction")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("bracket")
    rig(made)
    return made


@pytest.mark.long
@pytest.mark.parametrize("hidden", [item for item in IN_MOTION if item.identifier in CHOSEN])
def test_ring_downs_of_the_bracket_have_their_effect_named(folder, hidden):
    made = campaign(folder / "bracket.toml", hidden, 2021, ringdown=True)
    verdict = investigate(made, load_model(folder / "rig.toml"), seed=2021, thorough=False).verdict
    assert outcome(hidden, verdict) == ("named" if hidden.identifier else "none"), verdict.sentence


@pytest.mark.parametrize("package", [benchmarks, evidence], ids=["benchmarks", "evidence"])
def test_every_module_can_be_imported(package):
    """Few of them run in tests; a name that went elsewhere must not wait for whoever needs the others."""
    found = [module.name for module in walk_packages(package.__path__, f"{package.__name__}.")]
    assert found
    for name in found:
        import_module(name)
