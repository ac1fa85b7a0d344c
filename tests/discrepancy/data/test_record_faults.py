"""Records that no sensor made: copied channels, other units, noise records that move."""

import numpy as np
import pytest
from scipy.signal import lfilter

from discrepancy.campaign.records import NoiseRecord, Quantity
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.quality import check_data
from discrepancy.checks.rest import disturbance_phrase
from discrepancy.checks.unit_slips import find_slip
from tests.discrepancy.data.rings import MODEL, TIME, campaign_of, only
from tests.refusals import Inputs

INPUTS = Inputs(__file__)


def test_sound_rings_have_no_fault():
    """A motion that begins somehow tells its parameters, and none does not."""
    for digit in (1e-6, 0.5):
        campaign = campaign_of(digit=digit)
        assert [item for item in check_data(campaign) if item.kind is not FaultKind.NOISE_LABEL] == []
        assert check_against_model(campaign, MODEL) == ()

    def still(values):
        values[:] = 0.02 * np.random.default_rng(1).standard_normal(values.shape)

    fault = only(check_against_model(campaign_of(still), MODEL), FaultKind.UNOBSERVABLE)
    assert "'oil'" in fault.sentence


# ---------------------------------------------------------------- copied


@pytest.mark.parametrize(
    ("copy", "how", "digit"),
    [
        (lambda x: x.copy(), "digit for digit in", 0.05),
        (lambda x: -0.3937 * x, "times -0.3937 in", 1e-6),
        (lambda x: 2.0 * x + 3.0, "times 2 in", 0.05),
        (lambda x: np.roll(x, 7), "digit for digit, 7 samples later, in", 1e-6),
        (lambda x: 1.5 * np.roll(x, -40), "times 1.5, 40 samples earlier, in", 0.05),
    ],
)
def test_a_channel_that_is_another_one(copy, how, digit):
    def spoil(values):
        values[:, 0] = np.round(values[:, 0] / digit) * digit
        values[:, 1] = copy(values[:, 0])

    fault = only(check_data(campaign_of(spoil)), FaultKind.COPIED)
    assert fault.fatal
    assert (
        f"The channel 'y' is a copy of the channel 'x' {how} the column 'y [mm]' of 0.csv" in fault.sentence
    )
    assert "(the trial 'ring 0', 0 to 7.995 s), and in 1 more trial" in fault.sentence


def oscillation_without_noise(values):
    values[:, 0] = 20.0 * np.exp(-0.2 * TIME) * np.cos(21.0 * TIME)
    values[:, 1] = -0.5 * values[:, 0]


def switched(values):
    values[:, 0] = np.sign(np.cos(21.0 * TIME))
    values[:, 1] = -0.5 * values[:, 0]


def warmed(values):
    values[:, 0] = np.round(20.0 + TIME, 1)
    values[:, 1] = np.round(18.0 + 1.1 * TIME, 1)


def stepped(values):
    values[:, 1] = np.sign(np.cos(21.0 * TIME))
    values[:, 0] = values[:, 1]


def copied_without_noise(values):
    oscillation_without_noise(values)
    values[:, 1] = values[:, 0]


@pytest.mark.parametrize("change", [oscillation_without_noise, switched, warmed, stepped])
def test_what_moves_alike_is_no_copy(change):
    kinds = {fault.kind for fault in check_data(campaign_of(change))}
    assert FaultKind.COPIED not in kinds


def test_a_copy_without_noise_is_one():
    fault = only(check_data(campaign_of(copied_without_noise)), FaultKind.COPIED)
    assert "digit for digit" in fault.sentence


# ---------------------------------------------------------------- units


@pytest.mark.parametrize(
    ("scale", "quantity", "stated", "drive", "pair"), INPUTS.table("faults.toml")["slips"]
)
def test_a_factor_names_its_pair_of_units(scale, quantity, stated, drive, pair):
    assert str(find_slip(scale, Quantity(quantity), stated, is_input=drive) or "").strip("(?)") == pair


# ---------------------------------------------------------------- at rest


def _record(samples):
    return NoiseRecord(float(np.std(samples)), len(samples) - 1.0, samples - samples.mean(), 0.005)


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_any_colour_is_at_rest(seed):
    white = np.random.default_rng(seed).standard_normal(1300)
    mains = np.sin(2.0 * np.pi * 50.0 * 0.005 * np.arange(800) + 0.3)
    for samples in (
        white[500:],
        np.round(0.6 * white[500:]),
        lfilter([1.0], [1.0, -0.8], white)[500:],
        lfilter([1.0], [1.0, -1.6, 0.8], white)[500:],
        white[500:] + 2.0 * mains,
        np.random.default_rng(seed).standard_t(3, 800),
    ):
        assert disturbance_phrase(_record(samples)) is None
        assert disturbance_phrase(_record(samples), 3.2) is None


@pytest.mark.parametrize(
    ("motion", "what"),
    [
        (lambda t: 0.03 * np.cos(20.5 * t), "a line near the model's 3.18 Hz with"),
        (lambda t: 0.3 * np.exp(-2.0 * t) * np.cos(30.0 * t), "scatters "),
        (lambda t: 0.03 * t, "drifts by 0.000121 (SI) over its length, "),
    ],
)
def test_a_noise_record_that_moves_is_a_limit(motion, what):
    def move(values):
        values[:, 1] += motion(TIME[: len(values)])

    campaign = campaign_of(rest=move)
    faults = [
        item
        for item in (*check_data(campaign), *check_against_model(campaign, MODEL))
        if item.kind is FaultKind.MOVES_AT_REST
    ]
    assert {(item.channel, item.fatal) for item in faults} == {("y", False)}
    assert any("the column 'y [mm]' of rest.csv, " in item.sentence for item in faults)
    assert any(what in item.sentence for item in faults), [item.sentence for item in faults]
