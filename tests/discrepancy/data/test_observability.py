"""What records tell of calibrated parameters, in a campaign where it can be said by hand."""

from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model, prior_left, unobservable
from discrepancy.models.lumped import LumpedModel
from tests.discrepancy.rigs import model_of
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
MODEL = INPUTS.text("cart.toml")
TOML = INPUTS.text("cart_campaign.toml")


@pytest.fixture
def model() -> LumpedModel:
    return model_of(MODEL)


def campaign_of(folder: Path, scale: float = 1.0) -> Campaign:
    time = np.linspace(0.0, 2.0, 81)
    rows = [f"{t!r},1.0,{scale * 250.0 * t * t!r}" for t in time.tolist()]
    (folder / "push.csv").write_text("\n".join(["time,motor,x", *rows]))
    (folder / "campaign.toml").write_text(TOML)
    return read_campaign(folder)


def test_what_is_left_of_each_prior(tmp_path: Path, model: LumpedModel) -> None:
    campaign = campaign_of(tmp_path)
    left = prior_left(campaign, model)
    # by hand: least squares of x by the two parameters, beside their priors
    time = campaign.trials[0].time

    def x(mass: float, damping: float) -> np.ndarray:
        tau = mass / damping
        return (time - tau * (1.0 - np.exp(-time / tau))) / damping

    step = 1e-5
    columns = np.stack((
        (x(2.0 * (1 + step), 0.5) - x(2.0 * (1 - step), 0.5)) / (2 * step) * 0.2,
        (x(2.0, 0.5 * (1 + step)) - x(2.0, 0.5 * (1 - step))) / (2 * step) * 0.01,
    ), axis=1) / 5e-4  # fmt: skip
    expected = np.sqrt(np.diag(np.linalg.inv(np.eye(2) + columns.T @ columns)))
    assert left["mass_factor"] == pytest.approx(expected[0], rel=2e-3)
    assert left["damping_factor"] == pytest.approx(expected[1], rel=2e-3)
    assert left["mass_factor"] < 0.1


def test_a_short_push_of_a_cart_is_no_short_record(tmp_path: Path, model: LumpedModel) -> None:
    assert not [fault for fault in check_against_model(campaign_of(tmp_path), model) if fault.fatal]


def test_what_cannot_be_observed_is_said(tmp_path: Path) -> None:
    text = MODEL.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }")
    model = model_of(text)
    campaign = campaign_of(tmp_path)
    (found,) = unobservable(campaign, model)
    assert "do not tell the calibrated parameter 'damping_factor' (100%)" in found.sentence
    faults = check_against_model(campaign, model)
    assert [fault.kind for fault in faults] == [FaultKind.UNOBSERVABLE]
    assert not faults[0].fatal


def test_only_plausible_unit_slips_are_looked_for(tmp_path: Path, model: LumpedModel) -> None:
    def slips(scale: float) -> list[FaultKind]:
        folder = tmp_path / f"{scale:g}"
        folder.mkdir()
        return [fault.kind for fault in check_against_model(campaign_of(folder, scale), model) if fault.fatal]

    assert slips(1000.0)  # mm for m, or kN for N
    assert not slips(100.0)
    assert not slips(9.81)


@pytest.mark.parametrize("hold", ["", 'hold = "linear"', 'hold = "smooth"'])
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(
    tmp_path: Path, model: LumpedModel, samples: int, forced: bool, hold: str
) -> None:
    time = np.arange(12 * samples) / samples
    rows = [f"{t!r},{float(1.0 * np.sin(2.0 * np.pi * t))!r},{10.0 * t!r}" for t in time.tolist()]
    (tmp_path / "push.csv").write_text("\n".join([f"time,{'force' if forced else 'motor'},x", *rows]))
    before, _, after = TOML.partition("[[input]]")
    section, _, last = after.partition("[[trial]]")
    toml = f"{before}[[input]]{section}{hold}\n[[trial]]{last}"
    if forced:
        toml = f"{before}[[trial]]{last.replace('driven', 'forced')}{hold}\n"
    (tmp_path / "campaign.toml").write_text(toml)
    faults = check_against_model(read_campaign(tmp_path), model)
    found = [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]
    assert bool(found) is (samples == 9 and not hold)
    name, where = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    for fault in found:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {where}' in fault.sentence
