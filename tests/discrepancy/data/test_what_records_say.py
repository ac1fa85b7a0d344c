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


def place_of_cart(time, mass, damping):
    """Return where a cart is that is pushed with 1 N from rest."""
    tau = mass / damping
    return (time - tau * (1.0 - np.exp(-time / tau))) / damping


def test_what_is_left_of_each_prior():
    """Beside least squares of x by the two parameters, by hand."""
    campaign = pushed()
    ratios = posterior_to_prior_ratios(campaign, CART)
    time, step = campaign.trials[0].time, 1e-5
    upper, lower = 1 + step, 1 - step
    by_mass = place_of_cart(time, 2.0 * upper, 0.5) - place_of_cart(time, 2.0 * lower, 0.5)
    by_damping = place_of_cart(time, 2.0, 0.5 * upper) - place_of_cart(time, 2.0, 0.5 * lower)
    derivatives = np.stack((by_mass * 0.2, by_damping * 0.01), axis=1) / (2 * step)
    columns = derivatives / 5e-4
    expected = np.sqrt(np.diag(np.linalg.inv(np.eye(2) + columns.T @ columns)))
    assert [ratios["mass_factor"], ratios["damping_factor"]] == pytest.approx(expected, rel=2e-3)
    assert ratios["mass_factor"] < 0.1


def test_a_short_push_of_a_cart_is_no_short_record():
    assert not fatal(pushed())


def test_a_slip_of_the_unit_of_a_push_is_a_fault_and_no_other_factor():
    """Such a slip is mm for m, or kN for N."""
    assert fatal(pushed(1000.0))
    for factor in (100.0, 9.81):
        assert not fatal(pushed(factor))


def test_a_parameter_that_a_push_does_not_tell_is_named():
    slippery = model_of(CART_FILE.replace("damping = { matrix = 0.5 }", "damping = { matrix = 1e-5 }"))
    (unobservable,) = unobservable_parameter_faults(pushed(), slippery)
    (fault,) = check_against_model(pushed(), slippery)
    sentence = "do not determine the calibrated parameter 'damping_factor' (100%)"
    assert sentence in unobservable.sentence
    assert (fault.kind, fault.fatal) == (FaultKind.UNOBSERVABLE, False)


def between_samples(campaign):
    """Return the faults of inputs of which nobody knows what they did between their samples."""
    faults = check_against_model(campaign, CART)
    return [fault for fault in faults if fault.kind is FaultKind.BETWEEN_SAMPLES]


def driven_cart(samples, forced, hold):
    """Return the campaign of a cart under a sine of so many samples a period."""
    time = np.arange(12 * samples) / samples
    return of_cart(time, 0.01 * time, np.sin(2.0 * np.pi * time), hold, forced)


DRIVES = pytest.mark.parametrize("forced", [False, True], ids=["input", "force"])


@DRIVES
@pytest.mark.parametrize("hold", [None, Hold.LINEAR, Hold.SMOOTH])
@pytest.mark.parametrize("samples", [9, 200])
def test_it_is_asked_what_a_coarse_input_did_between_its_samples(samples, forced, hold):
    """If its hold is stated it is not asked, nor if it is fine enough or lost in the noise."""
    campaign = driven_cart(samples, forced, hold)
    loud = tuple(replace(trial, noise_factor=1e4) for trial in campaign.trials)
    assert bool(between_samples(campaign)) is (samples == 9 and hold is None)
    assert not between_samples(replace(campaign, trials=loud))


@DRIVES
def test_the_question_about_a_coarse_input_says_where_it_is_answered(forced):
    faults = between_samples(driven_cart(9, forced, None))
    name, table = ("force", "[[trial]]") if forced else ("motor", "[[input]]")
    assert faults
    for fault in faults:
        assert f"straight lines and curves between the samples of {name!r}" in fault.sentence
        assert f'hold = "smooth", "zero_order" or "linear" in its {table}' in fault.sentence
