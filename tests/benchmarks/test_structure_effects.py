"""Ring-downs of the bracket, made by its full model, in the search with the FMU of the reduced one."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.study_structure_effects import IN_MOTION, Hidden, campaign, outcome, rig
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
def test_ring_downs_of_the_bracket_have_their_effect_named(folder: Path, hidden: Hidden) -> None:
    made = campaign(folder / "bracket.toml", hidden, 2021, ringdown=True)
    verdict = investigate(made, load_model(folder / "rig.toml"), seed=2021, thorough=False).verdict
    assert outcome(hidden, verdict) == ("named" if hidden.identifier else "none"), verdict.sentence
