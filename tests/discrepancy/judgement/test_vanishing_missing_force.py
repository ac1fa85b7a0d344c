"""Where the missing force vanishes beside a law, the law is judged by its simulation."""

import numpy as np
import pytest

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    FloatArray,
    NoiseRecord,
    Quantity,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import Investigation, investigate, problem_without_wrong_ends
from tests.discrepancy.rigs import chosen, integrated, model_of

AXIS = """
format = 1
name = "Axis"
mass = 10.0
free = true
damping = { matrix = 20.0 }
input = [{ name = "push", vector = 1.0 }]
output = [{ name = "x", vector = 1.0, quantity = "displacement" }]
port = [{ name = "slide", vector = 1.0 }]
parameter = [
  { name = "mass", terms = "mass", deviation = 0.05, low = 0.5, high = 1.5 },
  { name = "damping", terms = "damping", deviation = 0.3, low = 0.2, high = 3.0 },
]
"""
NOISE = 2e-5
FRICTION = 19.0
CREEP = 2e-5
"""Speed over which the friction of the true axis changes its sign; the law of the catalogue jumps [m/s]."""


def pushed_axis(friction: float, samples: int = 350) -> Campaign:
    """Return three trials of an axis that a force pushes back and forth, the last one held out."""
    generator = np.random.default_rng(2)
    mass = 10.0 * (1.0 + 0.04 * generator.standard_normal())
    damping = 20.0 * (1.0 + 0.2 * generator.standard_normal())
    trials = []
    for name, amplitude, count in (
        ("one", 60.0, samples),
        ("two", 80.0, samples),
        ("three", 70.0, samples // 3),
    ):
        time = np.arange(count) * 0.002
        frequencies = 2.0 * np.pi * generator.uniform(0.3, 3.0, 8)
        phases = generator.uniform(0.0, 2.0 * np.pi, 8)
        force = amplitude * np.sin(time[:, None] * frequencies + phases).sum(axis=1) / np.sqrt(8.0)

        def rate(
            t: float, state: FloatArray, time: FloatArray = time, force: FloatArray = force
        ) -> list[float]:
            resistance = damping * state[1] + friction * np.tanh(state[1] / CREEP)
            return [state[1], (np.interp(t, time, force) - resistance) / mass]

        x = integrated(rate, time, [0.0, 0.0])[:, :1]
        trials.append(
            Trial.plain(
                name,
                TrialKind.FORCED,
                ("x",),
                time,
                values=x + NOISE * generator.standard_normal(x.shape),
                force=force,
                load_place="push",
                begins=Start.UNKNOWN,
                held_out=name == "three",
            )
        )
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))
    return Campaign("axis", {"x": channel}, tuple(trials), None, {}, "0" * 64)


@pytest.fixture(scope="module")
def sticking() -> Investigation:
    """Return the investigation of an axis whose dry friction creeps a little where it sticks."""
    effects = chosen("coulomb_friction", "quadratic_damping")
    return investigate(pushed_axis(FRICTION), model_of(AXIS), effects, thorough=False)


def test_a_law_that_is_not_exact_is_named_with_what_its_simulation_leaves(sticking: Investigation) -> None:
    assert sticking.verdict.kind in (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
    assert [effect.identifier for effect in sticking.verdict.effects] == ["coulomb_friction"]
    held_out = sticking.after.trials[-1]
    # before, the verdict told values along the missing force, which leave 18 times the noise
    assert np.sqrt(np.mean(held_out.residual**2)) < 1.5 * NOISE


def test_the_value_of_the_law_is_that_of_the_simulation(sticking: Investigation) -> None:
    (effect,) = sticking.verdict.effects
    (law,) = effect.patch
    assert law.coefficient == pytest.approx(FRICTION, rel=1e-3)


def test_a_right_model_leaves_no_force_and_its_evidence_is_that_of_noise() -> None:
    problem = problem_without_wrong_ends(pushed_axis(0.0, 300), model_of(AXIS))
    without_effects = ForceSearch(problem).estimate_without_effects
    count = float(problem.sample_counts.sum())
    assert without_effects.leaves_no_force
    # half the readings, and half the logarithms of how much the readings tell of mass, damping, and
    # the two unknowns of each beginning
    assert -0.5 * count - 80.0 < without_effects.log_evidence_without_force < -0.5 * count
