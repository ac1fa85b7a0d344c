"""A phone that fell, measured by others: the model that lacks drag, and the drag that explains it."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured.falling_phone import write_campaign
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.checks.model_check import check_against_model
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.model_choice import load_model
from discrepancy.models.interface import Model

RECORDS = Path(__file__).parents[2].parent / "shared" / "reference" / "measured" / "falling_phone"


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, Model]:
    if not RECORDS.is_dir():
        pytest.skip("the published records of the falling phone are not here")
    folder = write_campaign(RECORDS, tmp_path_factory.mktemp("phone") / "campaign")
    return read_campaign(folder), load_model(folder / "model.toml")


def test_a_fall_is_no_short_record(phone: tuple[Campaign, Model]) -> None:
    assert not [fault for fault in check_against_model(*phone) if fault.fatal]


def test_drag_closes_the_gap_and_its_exponent_is_two_or_three(phone: tuple[Campaign, Model]) -> None:
    campaign, model = phone
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    drag = effect_by_identifier("quadratic_damping", library())
    sums = {}
    for name, candidate in (
        ("nothing", Candidate()),
        ("drag", Candidate((Term(drag, "air"),))),
        ("family", Candidate((Term(drag, "air", free_shape=True),))),
    ):
        found = fit(problem, candidate, problem.start(candidate), iterations=40)
        sums[name] = float(problem.group_sums(found.residuals).sum())
        if name == "family":
            at = [item.name for item in candidate.terms[0].parameters].index("velocity_exponent")
            middle, prior = float(found.point.effect[at]), drag.shape[0].prior
            reach = 1.645 * float(np.sqrt(found.effect_covariance[at, at]))
            assert prior.value(middle - reach) > 1.5
            assert prior.value(middle + reach) > 2.5
    assert sums["drag"] < 0.02 * sums["nothing"]
