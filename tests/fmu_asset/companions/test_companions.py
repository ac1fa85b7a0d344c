"""The companions of the wing: what they do by their own formulas."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_asset.companions.damage_growth import DamageGrowthBehaviour
from fmu_asset.companions.strain_gauges import StrainGaugesBehaviour
from tests.fmu_asset.making import parameters_of
from tests.fmu_asset.ours import OurFmus

# ---------------------------------------------------------------------- damage growth


@pytest.fixture(scope="module")
def start_damage(ours: OurFmus) -> Callable[..., DamageGrowthBehaviour]:
    """Start a growth of damage with the values that the packed FMU declares, some changed."""
    declared = parameters_of(ours("damage_growth"))

    def start(**changes: float) -> DamageGrowthBehaviour:
        assert not set(changes) - set(declared)
        behaviour = DamageGrowthBehaviour()
        behaviour.start(declared | changes, 0.0, [1.0])
        return behaviour

    return start


RATE = 2e-3
EXPONENT = 3.5


@pytest.fixture
def growing(start_damage) -> DamageGrowthBehaviour:
    """Damage of the first region that grows with the load."""
    return start_damage(**{"rate.z1": RATE, "exponent": EXPONENT, "initial.z1": 0.1})


def test_growth_with_the_load_is_the_law_of_paris(growing):
    time = 0.0
    expected = 0.1
    for load, duration in ((2.0, 1.0), (3.0, 0.4), (-2.5, 2.0), (0.0, 5.0)):
        expected += RATE * (abs(load) / 3.0) ** EXPONENT * duration

        damage = growing.advance(time, duration, [load])

        assert damage == [pytest.approx(expected, abs=1e-11), 0.0]
        time += duration


def test_growth_ends_at_the_ceiling(growing):
    damage, _ = growing.advance(0.0, 1e6, [3.0])

    assert damage == 0.8


@pytest.mark.parametrize("period", [1, 2])
def test_a_script_gives_at_each_mark_what_it_says(start_damage, period):
    """0.02 at each mark from 10 to 19, and 0.2 at 20."""
    behaviour = start_damage(
        **{
            "period": float(period),
            "script[1].first": 10.0,
            "script[1].last": 19.0,
            "script[1].z1": 0.02,
            "script[2].first": 20.0,
            "script[2].last": 20.0,
            "script[2].z1": 0.2,
            "script[2].z2": 0.1,
        }
    )

    damage = [behaviour.advance(float(step), 1.0, [3.0])[0] for step in range(25)]

    expected = []
    for step in range(25):
        marks = [mark for mark in range(0, step + 1, period) if 10 <= mark < 20]
        last_script = 0.2 if step >= 20 else 0.0
        expected.append(round(0.02 * len(marks) + last_script, 12))
    assert damage == expected


@settings(max_examples=60)
@given(st.integers(0, 2**31 - 1), st.lists(st.integers(1, 7), min_size=1, max_size=12))
def test_chance_does_not_depend_on_the_steps(start_damage, seed, tenths):
    """A mark draws by its own number.

    Steps of a tenth to seven tenths of a mark lead to the same damage.
    """
    changes = {"probability.z1": 0.3, "probability.z2": 0.5, "exponent": 1.7, "seed": float(seed)}
    in_steps = start_damage(**changes)
    in_tenths = start_damage(**changes)
    time = 0.0

    for count in tenths:
        duration = 0.1 * count
        damage = in_steps.advance(time, duration, [2.4])
        for _ in range(count):
            damage_in_tenths = in_tenths.advance(time, duration / count, [2.4])
            time += duration / count

        assert damage == damage_in_tenths


TRIALS = 4000


@dataclass(frozen=True)
class Draws:
    """Whether damage grew in each of `TRIALS` trials.

    Attributes
    ----------
    probability : float
        What the probability should be.
    at_first_mark : list of float
        Damage of the first region before the first mark that draws.
    grew : (T, 3) array
        In the first region, in the second region, in the first region at the next mark.
    """

    probability: float
    at_first_mark: list[float]
    grew: NDArray[np.float64]


@pytest.fixture(scope="module", params=[(2.0, 0.25), (3.0, 0.5)], ids=["2 g", "3 g"])
def draws(request, start_damage):
    """Draws with p (n / n_ref)^m, so that 2 g has half the probability of 3 g."""
    load, probability = request.param
    exponent = math.log(2.0) / math.log(1.5)
    at_first_mark = []
    grew = []
    for seed in range(TRIALS):
        changes = {"probability.z1": 0.5, "probability.z2": 0.5}
        behaviour = start_damage(**changes, exponent=exponent, seed=float(seed))
        at_first_mark.append(behaviour.advance(0.0, 1.0, [load])[0])
        # a mark draws with the load before it: another load behind it does not count
        first_z1, first_z2 = behaviour.advance(1.0, 0.5, [9.0])
        behaviour.advance(1.5, 0.5, [load])
        second_z1, _ = behaviour.advance(2.0, 0.5, [9.0])
        grew.append([first_z1 == 0.2, first_z2 == 0.2, second_z1 - first_z1 == 0.2])
    return Draws(probability, at_first_mark, np.array(grew, dtype=float))


def test_nothing_is_drawn_at_the_first_mark(draws):
    assert set(draws.at_first_mark) == {0.0}


def test_chance_has_the_probability_that_it_says(draws):
    expected = TRIALS * draws.probability
    deviation = math.sqrt(expected * (1.0 - draws.probability))

    assert np.abs(draws.grew.sum(axis=0) - expected).max() < 4.0 * deviation


def test_marks_and_regions_are_independent(draws):
    correlation = np.corrcoef(draws.grew.T)

    assert np.abs(correlation - np.eye(3)).max() < 4.0 / math.sqrt(TRIALS)


# ---------------------------------------------------------------------- gauges


@pytest.fixture(scope="module")
def start_gauges(ours: OurFmus) -> Callable[..., Callable[[float], list[float]]]:
    """Start gauges at strains that stay: a function of time, -1 for the start.

    It returns the readings of a step of one second, and then whether each was received.
    """
    declared = parameters_of(ours("strain_gauges"))

    def start(strains: list[float], **changes: float) -> Callable[[float], list[float]]:
        assert not set(changes) - set(declared)
        other_gauges = tuple(f"[{gauge}]" for gauge in range(len(strains) + 1, 25))
        parameters = {
            name: value
            for name, value in (declared | changes).items()
            if not name.endswith(other_gauges)
        }
        behaviour = StrainGaugesBehaviour()
        at_start = behaviour.start(parameters, 0.0, strains)

        def outputs_at(time: float) -> list[float]:
            return at_start if time < 0.0 else behaviour.advance(float(time), 1.0, strains)

        return outputs_at

    return start


GAIN_OFFSET_DRIFT = {
    "gain[1]": 1.02,
    "offset[2]": 5e-6,
    "drift_rate[3]": 2e-6,
    "drift_start[3]": 4.0,
}
STRAINS = [1e-3, -2e-3, 0.5e-3]


def test_gauges_begin_with_their_gain_and_offset(start_gauges):
    outputs_at = start_gauges(STRAINS, **GAIN_OFFSET_DRIFT)

    assert outputs_at(-1) == [1.02e-3, -2e-3 + 5e-6, 0.5e-3, 1.0, 1.0, 1.0]


def test_a_gauge_reads_gain_offset_and_drift(start_gauges):
    outputs_at = start_gauges(STRAINS, **GAIN_OFFSET_DRIFT)

    for step in range(8):
        # As the drift of a scenario that begins at step 4.
        drifted = 0.5e-3 + 2e-6 * max(0.0, step - 4 + 1.0)
        expected = [1.02e-3, -2e-3 + 5e-6, drifted]
        assert outputs_at(step)[:3] == pytest.approx(expected, rel=1e-14)


@pytest.fixture(scope="module")
def lost_rows(start_gauges):
    """Outputs of three gauges: the second is lost for a while, and later all are."""
    changes = {
        "dropout_start[2]": 3.0,
        "dropout_end[2]": 6.0,
        "blackout.start": 8.0,
        "blackout.end": 9.0,
    }
    outputs_at = start_gauges([1e-3] * 3, **changes)
    return [outputs_at(step) for step in range(12)]


LOST_GAUGES = [[]] * 3 + [[1]] * 3 + [[]] * 2 + [[0, 1, 2]] + [[]] * 3


def test_gauges_are_lost_for_a_while(lost_rows):
    lost = [[gauge for gauge in range(3) if row[3 + gauge] == 0.0] for row in lost_rows]

    assert lost == LOST_GAUGES


def test_a_lost_gauge_reads_zero(lost_rows):
    for row, lost in zip(lost_rows, LOST_GAUGES, strict=True):
        assert row[:3] == [0.0 if gauge in lost else 1e-3 for gauge in range(3)]


# ---------------------------------------------------------------------- noise of gauges

NOISE = 150e-6


@pytest.fixture(scope="module")
def noise_rows(start_gauges):
    """Noise of 24 gauges in 500 steps."""
    outputs_at = start_gauges([0.0] * 24, noise=NOISE, seed=3.0)
    return np.array([outputs_at(step)[:24] for step in range(500)])


def test_noise_is_gaussian(noise_rows):
    standard = noise_rows.ravel() / NOISE
    count = standard.size

    assert abs(standard.mean()) < 4.0 / math.sqrt(count)
    assert abs(standard.var() - 1.0) < 4.0 * math.sqrt(2.0 / count)
    assert abs((standard**4).mean() - 3.0) < 4.0 * math.sqrt(96.0 / count)


def test_noise_is_white(noise_rows):
    noise = noise_rows.ravel()

    correlation = np.corrcoef(noise[:-1], noise[1:])[0, 1]

    assert abs(correlation) < 4.0 / math.sqrt(noise.size)


def test_noise_repeats_with_its_seed(start_gauges, noise_rows):
    outputs_at = start_gauges([0.0] * 24, noise=NOISE, seed=3.0)

    assert outputs_at(0)[:24] == noise_rows[0].tolist()


def test_gauges_are_lost_by_chance(start_gauges):
    outputs_at = start_gauges([1e-3] * 24, dropout_probability=0.1, seed=3.0)

    received = [outputs_at(step)[24:] for step in range(400)]

    assert abs(np.mean(received) - 0.9) < 4.0 * math.sqrt(0.09 / (400 * 24))
