"""Ring-downs of the bracket in the search with the FMU of its reduced model; every module is imported."""

from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pytest

import benchmarks
import evidence
from benchmarks.study_structure_effects import IN_MOTION, campaign, outcome, rig
from discrepancy.model_choice import load_model
from discrepancy.workflow import investigate

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
