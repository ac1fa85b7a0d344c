"""A cart on a spring with dry friction that is released, with a wire and an accelerometer.

Mass, stiffness, damping and friction have a common factor that free motion does not show.
"""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import fit
from discrepancy.model_choice import load_model
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from tests import command_line

MASS, STIFFNESS, DAMPING, FRICTION = 3.05, 1215.0, 1.3, 0.45
RATE, COUNT = 250.0, 700
RELEASES = (25.0, 18.0, 10.0, 14.0)

MODEL = """
format = 1
name = "Cart on a spring"
mass = 3.0
stiffness = 1200.0
damping = { matrix = 1.2 }
input = [{ name = "tip_load", vector = 1.0, quantity = "force" }]
output = [
    { name = "x", vector = 1.0 },
    { name = "a", vector = 1.0, quantity = "acceleration" },
]
port = [{ name = "rail", vector = 1.0 }]
parameter = [
    { name = "stiffness", terms = "stiffness", deviation = 0.03, low = 0.7, high = 1.3 },
    { name = "damping", terms = "damping", deviation = 0.3, low = 0.2, high = 4.0 },
    { name = "mass", terms = "mass", deviation = 0.02, low = 0.8, high = 1.2 },
]
"""

CAMPAIGN = """
format = 1
name = "Releases"
noise = { file = "rest.csv" }
channel = [
    { name = "wire", quantity = "displacement", unit = "mm", output = "x", offset_deviation = 0.2 },
    { name = "acc", quantity = "acceleration", unit = "g", output = "a", gain_deviation = 0.01 },
]
"""

TRIAL = """
[[trial]]
name = "release from {release} mm"
kind = "ringdown"
file = "release_{release}.csv"
release = {{ displacement = {release}, unit = "mm", deviation = 0.01 }}
held_out = {held_out}
"""


def released_cart(release):
    """Return position [m] and acceleration [m/s^2] after a release [m], in closed form.

    Between two reversals friction has one sign, and the cart swings about the point where the
    spring balances it.
    """
    time = np.arange(COUNT) / RATE
    position = np.zeros(COUNT)
    acceleration = np.zeros(COUNT)
    decay = DAMPING / (2.0 * MASS)
    frequency = np.sqrt(STIFFNESS / MASS - decay**2)
    begin = 0.0
    turn = release
    while abs(STIFFNESS * turn) > FRICTION:
        balance = np.sign(turn) * FRICTION / STIFFNESS
        end = begin + np.pi / frequency
        swing = (time >= begin) & (time < end)
        phase = frequency * (time[swing] - begin)
        envelope = (turn - balance) * np.exp(-decay * (time[swing] - begin))
        stretch = envelope * (np.cos(phase) + decay / frequency * np.sin(phase))
        speed = -envelope * STIFFNESS / MASS / frequency * np.sin(phase)
        position[swing] = balance + stretch
        acceleration[swing] = -(STIFFNESS * stretch + DAMPING * speed) / MASS
        turn = balance - (turn - balance) * np.exp(-decay * np.pi / frequency)
        begin = end
    position[time >= begin] = turn
    return position, acceleration


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cart")
    generator = np.random.default_rng(11)

    def write(name, wire, acceleration):
        time = np.arange(len(wire)) / RATE
        wire = wire + generator.normal(0.0, 0.03, len(wire))
        acceleration = acceleration / 9.80665 + generator.normal(0.0, 0.002, len(wire))
        columns = np.column_stack((time, wire, acceleration))
        np.savetxt(folder / name, columns, "%.5f", ",", header="time,wire,acc", comments="")

    write("rest.csv", np.zeros(400), np.zeros(400))
    campaign = CAMPAIGN
    for release in RELEASES:
        position, acceleration = released_cart(1e-3 * release)
        zero = 0.1 * generator.standard_normal()
        write(f"release_{release}.csv", 1e3 * position + zero, acceleration)
        campaign += TRIAL.format(release=release, held_out=str(release == RELEASES[-1]).lower())
    (folder / "campaign.toml").write_text(campaign, "utf-8")
    (folder / "model.toml").write_text(MODEL, "utf-8")
    return folder


@pytest.fixture(scope="module")
def problem(folder):
    model = load_model(folder / "model.toml")
    campaign, _ = check_and_prepare(read_campaign(folder), model)
    return problem_without_wrong_ends(campaign, model)


FRICTION_AT_RAIL = Candidate(
    (EffectTerm(next(e for e in library() if e.identifier == "coulomb_friction"), "rail"),)
)


def test_no_reading_depends_on_the_common_factor(problem):
    # the log-normal prior of the friction: one part in a hundred of it, in prior deviations
    def friction(scaled):
        return FRICTION_AT_RAIL.patch(problem.setting, [scaled]).primitives[0].coefficient

    point = replace(problem.prior_mean_point(FRICTION_AT_RAIL), effect=np.array([0.4]))
    friction_step = 1e-2 / np.log(friction(0.5) / friction(0.4)) * 0.1
    derivatives = problem.linearise(0, point, FRICTION_AT_RAIL)
    by_factor = (
        1e-2
        * (
            derivatives.by_parameters[0] / 0.03
            + derivatives.by_parameters[1] / 0.3
            + derivatives.by_parameters[2] / 0.02
        )
        + friction_step * derivatives.by_effect[0]
    )
    noises = problem.trials[0].standardise(by_factor)
    # the stiffness alone changes them by 200 noises for one part in a hundred
    assert np.abs(noises).max() < 0.05


@pytest.fixture(scope="module")
def friction_fit(problem):
    start = replace(problem.prior_mean_point(FRICTION_AT_RAIL), effect=np.array([0.4]))
    return fit(problem, FRICTION_AT_RAIL, start)


def test_a_fit_converges_though_reversals_pass_samples(friction_fit):
    assert friction_fit.converged


def test_the_mass_is_known_as_little_as_before(friction_fit):
    deviation = np.sqrt(friction_fit.covariance[2, 2])
    assert 0.4 < deviation < 1.0  # of its prior
    assert abs(friction_fit.shared[2] - (MASS / 3.0 - 1.0) / 0.02) < 3.0 * deviation


def test_the_friction_over_the_mass_is_found(problem, friction_fit):
    patch = FRICTION_AT_RAIL.patch(problem.setting, friction_fit.effect)
    mass = 3.0 * (1.0 + 0.02 * friction_fit.shared[2])
    assert patch.primitives[0].coefficient / mass == pytest.approx(FRICTION / MASS, rel=3e-3)


@pytest.mark.long
def test_friction_alone_is_named_and_nothing_is_missing_once_it_is_applied(folder, tmp_path):
    def discrepancy(*words):
        done = command_line.command("discrepancy", *map(str, words))
        assert done.returncode == 0, done.stderr
        return done.stdout

    first = discrepancy("run", folder, "--model", folder / "model.toml", "--out", tmp_path / "first")
    discrepancy("apply", tmp_path / "first", "--out", tmp_path / "patched.toml")
    second = discrepancy("run", folder, "--model", tmp_path / "patched.toml", "--out", tmp_path / "second")
    assert "The model lacks Coulomb friction at rail" in first
    assert "Verdict: nothing missing" in second
