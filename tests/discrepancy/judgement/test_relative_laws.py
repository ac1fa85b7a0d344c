"""Laws in the difference of a state and a measured input: found, proved, applied and found no more."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    FloatArray,
    Hold,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.errors import ModelError
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import Investigation, investigate
from fe.runtime.patch import ModelPatch, PowerDamping
from tests.discrepancy.rigs import chosen, integrated, model_of

TANK = """
format = 1
name = "Tank beside the sea"
capacity = [1.5, 1.0]
conductance = [[0.02, 0.0], [0.0, 0.0]]
input = [
  { name = "pump", vector = [1.0, 0.0], quantity = "flow" },
  { name = "sea", vector = [0.0, 1.0], quantity = "level", prescribes_state = true },
]
output = [{ name = "tank", vector = [1.0, 0.0], quantity = "level" }]
port = [{ name = "wall", vector = [1.0, -1.0], acts = [1.0, 0.0] }]
parameter = [{ name = "outlet", terms = "conductance", deviation = 0.05, low = 0.4, high = 2.5 }]
"""
SUPPORT = """
format = 1
name = "Body on a support that is moved"
mass = [1.0, 2.0]
stiffness = [[180.0, -180.0], [-180.0, 180.0]]
free = true
damping = { matrix = [[2.5, -2.5], [-2.5, 2.5]] }
input = [{ name = "support", vector = [1.0, 0.0], quantity = "displacement" }]
output = [{ name = "x", vector = [0.0, 1.0], quantity = "displacement" }]
port = [{ name = "mount", vector = [-1.0, 1.0] }]
parameter = [
  { name = "spring", terms = "stiffness", deviation = 0.02, low = 0.4, high = 2.5 },
  { name = "damper", terms = "damping", deviation = 0.1, low = 0.4, high = 2.5 },
]
"""
LEAK = 0.02
"""Flow through the wall of the tank at a difference of levels of 1 m [m3/s]."""
OUTLET = 0.021
STIFFENING = 1.5e5
"""Cubic stiffness of the mount in the difference of body and support [N/m3]."""
SPRING, DAMPER, MASS = 182.0, 2.6, 2.0
LEVEL_NOISE, DISPLACEMENT_NOISE = 2e-4, 2e-5
HALF_STEP = 1e-4
"""Half the time over which the speed of the support is a difference [s]."""


def smooth_course(generator: np.random.Generator, slowest: float, count: int) -> Callable[[float], float]:
    """Return a random smooth function of time with a deviation of about one: a sum of sines."""
    frequencies = 2.0 * np.pi * slowest * generator.uniform(1.0, 6.0, count)
    phases = generator.uniform(0.0, 2.0 * np.pi, count)
    return lambda t: float(np.sin(frequencies * t + phases).sum() * np.sqrt(2.0 / count))


def driven_trial(
    name: str, time: FloatArray, values: FloatArray, channel: str, inputs: tuple[RecordedInput, ...]
) -> Trial:
    return Trial.plain(
        name,
        TrialKind.DRIVEN,
        (channel,),
        time,
        values=values[:, None],
        inputs=inputs,
        begins=Start.UNKNOWN,
        held_out=name == "three",
    )


def tank_campaign() -> Campaign:
    """Return three trials of a tank whose wall leaks to a sea of measured level, by Torricelli's law."""
    generator = np.random.default_rng(5)
    time = 5.0 * np.arange(200.0)
    trials = []
    for name in ("one", "two", "three"):
        tide = smooth_course(generator, 1e-3, 4)
        pumped = smooth_course(generator, 2e-3, 4)

        def sea(t: float, tide: Callable[[float], float] = tide) -> float:
            return 0.8 + 0.4 * tide(t)

        def pump(t: float, pumped: Callable[[float], float] = pumped) -> float:
            return 0.015 + 0.01 * pumped(t)

        def rate(t: float, level: FloatArray, sea=sea, pump=pump) -> list[float]:  # type: ignore[no-untyped-def]
            head = level[0] - sea(t)
            leak = LEAK * np.sign(head) * np.sqrt(abs(head))
            return [(pump(t) - OUTLET * level[0] - leak) / 1.5]

        level = integrated(rate, time, [0.6], max_step=1.0)[:, 0]
        recorded = (
            RecordedInput("pump", Quantity.FLOW, np.array([pump(t) for t in time]), Hold.SMOOTH),
            RecordedInput("sea", Quantity.LEVEL, np.array([sea(t) for t in time])),
        )
        readings = level + LEVEL_NOISE * generator.standard_normal(len(time))
        trials.append(driven_trial(name, time, readings, "tank", recorded))
    channel = Channel("tank", Quantity.LEVEL, "tank", NoiseRecord(LEVEL_NOISE, 500.0))
    return Campaign("tank", {"tank": channel}, tuple(trials), None, {}, "0" * 64)


def support_campaign() -> Campaign:
    """Return three trials of a body whose mount stiffens with its distance from a moved support."""
    generator = np.random.default_rng(6)
    time = 0.03 * np.arange(150.0)
    trials = []
    for name in ("one", "two", "three"):
        course = smooth_course(generator, 0.4, 5)

        # from rest, as its first value is taken off and its first second is faded in
        def support(t: float, course: Callable[[float], float] = course) -> float:
            faded = min(max(t, 0.0), 1.0)
            return 0.01 * faded**3 * (10.0 - 15.0 * faded + 6.0 * faded**2) * course(t)

        def rate(t: float, state: FloatArray, support=support) -> list[float]:  # type: ignore[no-untyped-def]
            distance = state[0] - support(t)
            support_speed = (support(t + HALF_STEP) - support(t - HALF_STEP)) / (2.0 * HALF_STEP)
            speed = state[1] - support_speed
            force = SPRING * distance + DAMPER * speed + STIFFENING * distance**3
            return [state[1], -force / MASS]

        x = integrated(rate, time, [0.0, 0.0], max_step=0.01)[:, 0]
        recorded = (RecordedInput("support", Quantity.DISPLACEMENT, np.array([support(t) for t in time])),)
        readings = x + DISPLACEMENT_NOISE * generator.standard_normal(len(time))
        trials.append(driven_trial(name, time, readings, "x", recorded))
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(DISPLACEMENT_NOISE, 500.0))
    return Campaign("support", {"x": channel}, tuple(trials), None, {}, "0" * 64)


def assert_found_and_proved(found: Investigation, identifier: str, place: str) -> PowerDamping:
    """Check that one effect is named and that it closes the gap, and return its law."""
    assert found.verdict.kind is VerdictKind.NAMED, found.verdict.sentence
    (effect,) = found.verdict.effects
    assert (effect.identifier, effect.place) == (identifier, place)
    assert found.proof is not None
    assert found.proof.closed is not None
    assert found.proof.closed.trials == "held-out"
    assert found.proof.closed.value > 0.99
    (law,) = effect.patch
    return law


@pytest.fixture(scope="module")
def leaking_tank() -> Investigation:
    effects = chosen("outflow", "overflow", "load_cell")
    return investigate(tank_campaign(), model_of(TANK), effects, thorough=False)


def test_a_leak_by_the_difference_to_a_measured_level_is_found_and_proved(
    leaking_tank: Investigation,
) -> None:
    law = assert_found_and_proved(leaking_tank, "outflow", "wall")
    flow = law.coefficient * law.reference_velocity**-law.velocity_exponent
    assert flow == pytest.approx(LEAK, rel=0.02)


@pytest.mark.long
def test_the_law_in_the_model_leaves_nothing_missing(leaking_tank: Investigation) -> None:
    (effect,) = leaking_tank.verdict.effects
    patched = model_of(TANK).with_patch(effect.patch)
    effects = chosen("outflow", "overflow", "load_cell")
    again = investigate(tank_campaign(), patched, effects, thorough=False)
    assert again.verdict.kind is VerdictKind.NOTHING_MISSING, again.verdict.sentence


@pytest.mark.long
def test_a_mount_that_stiffens_with_the_distance_from_a_moved_support_is_found_and_proved() -> None:
    effects = chosen("cubic_stiffness", "quadratic_damping", "coulomb_friction")
    found = investigate(support_campaign(), model_of(SUPPORT), effects, thorough=False)
    law = assert_found_and_proved(found, "cubic_stiffness", "mount")
    stiffening = law.coefficient * law.reference_displacement**-law.exponent
    assert stiffening == pytest.approx(STIFFENING, rel=0.02)


# ---------------------------------------------------------------- prescribed states


def response_of_tank(model: LumpedModel, begins: Start, patch: ModelPatch, level: float = 1.0) -> FloatArray:
    """Return the level of the tank beside a sea of constant level, without a pump."""
    time = 10.0 * np.arange(100.0)
    still = (
        RecordedInput("pump", Quantity.FLOW, np.zeros(len(time)), Hold.SMOOTH),
        RecordedInput("sea", Quantity.LEVEL, np.full(len(time), level)),
    )
    trial = Trial.plain("still", TrialKind.DRIVEN, ("tank",), time, inputs=still, begins=begins)
    outputs = (("tank", Quantity.LEVEL),)
    return model.respond(trial, outputs, patch, Conditions(np.array([1.0]))).values[:, 0]


def test_a_prescribed_state_acts_through_the_conductance() -> None:
    """The level of the sea, which leaks in linearly: G (1 - exp(-R t / T)) / R, or settled G / R."""
    linear = model_of(TANK.replace("[[0.02, 0.0], [0.0, 0.0]]", "[[0.05, -0.03], [0.0, 0.0]]"))
    time = 10.0 * np.arange(100.0)
    risen = response_of_tank(linear, Start.STILL, ModelPatch())
    np.testing.assert_allclose(risen, 0.6 * (1.0 - np.exp(-0.05 * time / 1.5)), atol=1e-6)
    settled = response_of_tank(linear, Start.SETTLED, ModelPatch())
    np.testing.assert_allclose(settled, 0.6, atol=1e-6)


def test_a_law_of_a_difference_moves_the_state_and_not_what_is_prescribed() -> None:
    """A linear leak as a law at the port is the same leak as in the conductance."""
    law = PowerDamping("wall", 0.03, 1.0, 0.0, 1.0, 1.0)
    by_law = response_of_tank(model_of(TANK), Start.STILL, ModelPatch((law,)))
    linear = model_of(TANK.replace("[[0.02, 0.0], [0.0, 0.0]]", "[[0.05, -0.03], [0.0, 0.0]]"))
    np.testing.assert_allclose(by_law, response_of_tank(linear, Start.STILL, ModelPatch()), atol=1e-4)


@pytest.mark.parametrize(
    "changed",
    [
        'name = "sea", vector = [0.0, 1.0], quantity = "displacement"',
        'name = "sea", vector = [0.0, 1.0], through = "conductance", quantity = "level"',
    ],
)
def test_what_prescribes_a_state_is_a_state_alone(changed: str) -> None:
    with pytest.raises(ModelError, match=r"the input 'sea' prescribes a state: give it a vector of states"):
        model_of(TANK.replace('name = "sea", vector = [0.0, 1.0], quantity = "level"', changed))


def test_a_prescribed_state_does_not_go_in_steps() -> None:
    campaign = tank_campaign()
    trial = campaign.trials[0]
    pump, sea = trial.inputs
    stepped = replace(trial, inputs=(pump, replace(sea, hold=Hold.ZERO_ORDER)))
    outputs = (("tank", Quantity.LEVEL),)
    with pytest.raises(ModelError, match=r"is a state that .* prescribes, and no drive goes in steps"):
        model_of(TANK).respond(stepped, outputs, ModelPatch(), Conditions(np.array([1.0])))


def test_the_example_of_the_page_is_a_model(tmp_path: Path) -> None:
    """docs/how_to/lumped_models.md has a block with a prescribed state."""
    page = Path("docs/how_to/lumped_models.md").read_text(encoding="utf-8")
    (block,) = (part for part in page.split("```") if "prescribes_state = true" in part)
    (tmp_path / "model.toml").write_text(block.removeprefix("toml"), encoding="utf-8")
    assert LumpedModel.load(tmp_path / "model.toml").ports == ("surface",)
