"""What records say of parameters, and of inputs between samples."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import Channel, Hold, NoiseRecord, Quantity, RecordedInput, Start, TrialKind
from discrepancy.checks.fault import FaultKind
from discrepancy.checks.model_check import (
    check_against_model,
    posterior_to_prior_ratios,
    unobservable_parameter_faults,
)
from tests.discrepancy.rigs import asked, campaign, model_of
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
CART_FILE = INPUTS.text("cart.toml")
CART = model_of(CART_FILE)


def of_cart(time, values, drive, hold=None, forced=False):
    """Return the campaign of a cart that begins at rest, its place [m] beside what its motor did [N]."""
    given = {"force": drive, "hold": hold}
    if not forced:
        given = {"inputs": (RecordedInput("motor", Quantity.FORCE, values=drive, hold=hold),)}
    kind, values = TrialKind.FORCED if forced else TrialKind.DRIVEN, values[:, None]
    push = asked(kind, time, channels=("x",), values=values, begins=Start.STILL, **given)
    return campaign(push, x=Channel("x", Quantity.DISPLACEMENT, "cart", NoiseRecord(5e-4)))


def pushed(scale=1.0):
    time = np.linspace(0.0, 2.0, 81)
    return of_cart(time, scale * 0.25 * time**2, np.ones(81))


def fatal(campaign):
    return [fault.kind for fault in check_against_model(campaign, CART) if fault.fatal]


def test_what_is_left_of_each_prior():
    """Beside least squares of x by the two parameters, by hand; a short push of a cart is not a short
    record.
    """
    campaign = pushed()
    left = posterior_to_prior_ratios(campaign, CART)
    time = campaign.trials[0].time

    def x(mass, damping):
        tau = mass / damping
        return (time - tau * (1.0 - np.exp(-time / tau))) / damping

    step = 1e-5
    columns = np.stack((
        (x(2.0 * (1 + step), 0.5) - x(2.0 * (1 - step), 0.5)) / (2 * step) * 0.2,
        (x(2.0, 0.5 * (1 + step)) - x(2.0, 0.5 * (1 - step))) / (2 * step) * 0.01,
    ), axis=1) / 5e-4  # fmt: skip
    expected = np.sqrt(np.diag(np.linalg.inv(np.eye(2) + columns.T @ columns)))
    assert [left["mass_factor"], left["damping_factor"]] == pytest.approx(expected, rel=2e-3)
    assert left["mass_factor"] < 0.1
    assert not fatal(campaign)
    assert fatal(pushed(1000.0))  # mm for m, or kN for N
    for scale in (100.0, 9.81):  # no plausible slip
        assert not fatal(pushed(scale))
    slippery = model_of(CART_FILE.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }"))
    (found,) = unobservable_parameter_faults(campaign, slippery)
    assert "do not determine the calibrated parameter 'damping_factor' (100%)" in found.sentence
    (fault,) = check_against_model(campaign, slippery)
    assert (fault.kind, fault.fatal) == (FaultKind.UNOBSERVABLE, False)


@pytest.mark.parametrize("hold", [None, Hold.LINEAR, Hold.SMOOTH])
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(samples, forced, hold):
    time = np.arange(12 * samples) / samples
    campaign = of_cart(time, 0.01 * time, np.sin(2.0 * np.pi * time), hold, forced)
    faults = check_against_model(campaign, CART)
    found = [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]
    assert bool(found) is (samples == 9 and hold is None)
    loud = tuple(replace(trial, noise_factor=1e4) for trial in campaign.trials)
    loud = check_against_model(replace(campaign, trials=loud), CART)
    assert not any(fault.kind is FaultKind.BETWEEN_SAMPLES for fault in loud)
    name, where = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    for fault in found:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {where}' in fault.sentence
