"""Examples as a user makes them: written, read and checked, with and without a hidden effect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.records import TrialKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data
from discrepancy.errors import CampaignFileError, ModelError
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for, wing_plan, write_example
from fe.runtime.patch import HighPass, ModelPatch, PointMass, PowerDamping, RootCompliance, SensorGain

OUTPUTS = ("x3", "x1", "base_strain", "joint_strain")


@pytest.fixture(scope="module")
def chain() -> LumpedModel:
    return LumpedModel.load("three_mass_chain")


def test_written_example_is_sound_and_repeats(chain: LumpedModel, tmp_path: Path) -> None:
    plan = plan_for(chain, OUTPUTS, "end")
    one = write_example(chain, tmp_path / "a", "laboratory", 3, plan)
    two = write_example(chain, tmp_path / "b", "laboratory", 3, plan)
    assert one.data_hash == two.data_hash
    assert one.data_hash != write_example(chain, tmp_path / "c", "laboratory", 4, plan).data_hash
    assert check_data(one) == ()
    assert check_against_model(one, chain) == ()
    assert [trial.name for trial in one.held_out] == ["loading again", "release 3"]
    assert choose_held_out(one) is one
    unmarked = replace(one, trials=tuple(replace(trial, held_out=False) for trial in one.trials))
    assert {trial.kind for trial in choose_held_out(unmarked).held_out} >= {TrialKind.RINGDOWN}


@pytest.mark.parametrize("seed", [1, 2])
def test_hidden_effects_are_no_faults_of_the_data(chain: LumpedModel, seed: int) -> None:
    plan = plan_for(chain, OUTPUTS, "end")
    scales = chain.scales(example_campaign(chain, "laboratory", seed, plan))
    force = 0.05 * scales.ports["joint"].stiffness * scales.ports["joint"].displacement
    for patch in (
        ModelPatch((PointMass(0.3 * scales.modal_mass, 0.6),)),
        ModelPatch((RootCompliance(0.3 / scales.tip_stiffness / 0.36),)),
        ModelPatch((PowerDamping("joint", force, 0.0, 0.0, 1.0, 1.0),)),
        ModelPatch((SensorGain("base_strain", -0.15), HighPass("x3", 0.5))),
    ):
        campaign = example_campaign(chain, "laboratory", seed, plan, patch)
        assert [fault for fault in check_data(campaign) if fault.fatal] == []
        assert check_against_model(campaign, chain) == ()
        marked = mark_outliers(campaign)
        assert sum(int((~trial.used).sum()) for trial in marked.trials) <= 2


def test_what_cannot_be_an_example(chain: LumpedModel) -> None:
    with pytest.raises(
        CampaignFileError, match=r"There is no example 'mission': the kinds are static, ringdown"
    ):
        example_campaign(chain, "mission", 1)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="has no output 'x9'"):
        plan_for(chain, ("x9",), "end")


def test_plan_of_the_wing_names_its_outputs() -> None:
    plan = wing_plan()
    assert [channel.output for channel in plan.channels][-1] == "tip_displacement"
    assert plan.names(TrialKind.FLIGHT) == plan.names(TrialKind.STATIC)[:-1]
    assert np.isfinite([channel.noise.standard_deviation for channel in plan.channels if channel.noise]).all()
