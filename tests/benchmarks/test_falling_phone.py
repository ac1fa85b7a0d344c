"""A phone that fell, measured by others: the model that lacks drag, and the drag that explains it."""

import re
from pathlib import Path

import pytest

from benchmarks.measured.falling_phone import write_campaign
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.checks.model_check import check_against_model
from discrepancy.model_choice import load_model
from discrepancy.models.interface import Model
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate

RECORDS = Path(__file__).parents[2].parent / "shared" / "reference" / "measured" / "falling_phone"


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, Model]:
    if not RECORDS.is_dir():
        pytest.skip("the published records of the falling phone are not here")
    folder = write_campaign(RECORDS, tmp_path_factory.mktemp("phone") / "campaign")
    return read_campaign(folder), load_model(folder / "model.toml")


def test_a_fall_is_no_short_record(phone: tuple[Campaign, Model]) -> None:
    assert not [fault for fault in check_against_model(*phone) if fault.fatal]


def test_drag_is_named_with_its_exponent_and_nothing_that_only_describes(
    phone: tuple[Campaign, Model],
) -> None:
    campaign, model = phone
    chosen = (
        "quadratic_damping", "coulomb_friction", "cubic_stiffness", "joint_micro_slip", "gauge_zero_drift",
        "clock_error",
    )  # fmt: skip
    effects = [effect_by_identifier(item, library()) for item in chosen]
    found = investigate(campaign, model, effects, thorough=False)
    verdict = found.verdict
    assert verdict.kind is VerdictKind.NAMED_IN_PART, verdict.sentence
    assert [effect.identifier for effect in verdict.effects] == ["quadratic_damping"]
    assert verdict.explained is not None
    assert verdict.explained.trials == "held-out"
    assert verdict.explained.low > 0.9
    told = re.search(r"exponent of the speed \S+ \((\S+) to (\S+)\)", verdict.sentence)
    assert told is not None, verdict.sentence
    low, high = map(float, told.groups())
    assert 1.0 < low < 2.0 < high
    assert {"joint_micro_slip", "cubic_stiffness"} <= {item.identifier for item in verdict.not_fitted}
