"""Examples as a user makes them, and that of docs/campaign.md: written, read and checked."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import TrialKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers
from discrepancy.checks.quality import check_data
from discrepancy.errors import CampaignFileError, ModelError
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for, wing_plan, write_example
from fe.runtime.patch import HighPass, ModelPatch, PointMass, PowerDamping, RootCompliance, SensorGain


@pytest.mark.parametrize("seed", [1, 2])
def test_hidden_effects_are_no_faults_of_the_data(chain, seed):
    plan = plan_for(chain, OUTPUTS, "end")
    scales = chain.scales(example_campaign(chain, "laboratory", seed, plan))
    force = 0.05 * scales.ports["joint"].stiffness * scales.ports["joint"].displacement
    for items in (
        (PointMass(0.3 * scales.modal_mass, 0.6),),
        (RootCompliance(0.3 / scales.tip_stiffness / 0.36),),
        (PowerDamping("joint", force, 0.0, 0.0, 1.0, 1.0),),
        (SensorGain("base_strain", -0.15), HighPass("x3", 0.5)),
    ):
        campaign = example_campaign(chain, "laboratory", seed, plan, ModelPatch(items))
        assert [fault for fault in check_data(campaign) if fault.fatal] == []
        assert check_against_model(campaign, chain) == ()
        assert sum(int((~trial.used).sum()) for trial in mark_outliers(campaign).trials) <= 2


def test_what_cannot_be_an_example(chain):
    with pytest.raises(CampaignFileError, match="no example 'mission': the kinds are static, ringdown"):
        example_campaign(chain, "mission", 1)
    with pytest.raises(ModelError, match="has no output 'x9'"):
        plan_for(chain, ("x9",), "end")


OUTPUTS = ("x3", "x1", "base_strain", "joint_strain")


@pytest.fixture(scope="module")
def chain():
    return LumpedModel.load("three_mass_chain")


def test_written_example_is_sound_and_repeats(chain, tmp_path):
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


def test_plan_of_the_wing_names_its_outputs():
    plan = wing_plan()
    assert [channel.output for channel in plan.channels][-1] == "tip_displacement"
    assert plan.names(TrialKind.FLIGHT) == plan.names(TrialKind.STATIC)[:-1]
    assert np.isfinite([channel.noise.standard_deviation for channel in plan.channels if channel.noise]).all()


def test_the_documented_campaign_is_read(tmp_path):
    """That of docs/campaign.md, which shows how its tables begin; a record is longer."""
    text = (Path(__file__).parents[3] / "docs" / "campaign.md").read_text(encoding="utf-8")
    toml = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    tables = re.search(r"begin with\n\n```\n(.*?)```", text, re.DOTALL)
    (tmp_path / "campaign.toml").write_text(toml.group(1), encoding="utf-8")
    columns = zip(*(re.split(r"\s{3,}", line) for line in tables.group(1).splitlines()), strict=True)
    for name, rows in zip(("noise", "tip_up", "release_1", "turns"), columns, strict=True):
        more = (
            [f"{0.002 * k:.3f},{(-1) ** k}" for k in range(3, 50)] if name in ("noise", "release_1") else []
        )
        (tmp_path / f"{name}.csv").write_text("\n".join([*rows, *more]) + "\n", encoding="utf-8")
    campaign = read_campaign(tmp_path)
    up, release, turns = campaign.trials
    assert [trial.kind.value for trial in campaign.trials] == ["static", "ringdown", "flight"]
    assert up.values[1].tolist() == [54.1e-6, 2.98e-3]
    assert up.temperature.tolist() == [1.5] * 3
    assert release.release.displacement == 0.015
    assert turns.health[2].tolist() == [0.2, 0.0]
    assert campaign.channels["g17"].noise.source == "pre-trigger"
    assert campaign.remarks == ()
