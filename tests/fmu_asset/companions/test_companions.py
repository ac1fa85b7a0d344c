"""The companions of the wing: what they do by their own formulas."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.companions.damage_growth import DamageGrowthBehaviour
from fmu_asset.companions.strain_gauges import StrainGaugesBehaviour
from tests.fmu_asset.making import parameters_of
from tests.fmu_asset.ours import OurFmus

# ---------------------------------------------------------------------- damage growth


@pytest.fixture(scope="module")
def damage(ours: OurFmus) -> Callable[..., DamageGrowthBehaviour]:
    """Return what begins with the start values that the packed FMU declares."""
    declared = parameters_of(ours("damage_growth"))

    def begun(**changes: float) -> DamageGrowthBehaviour:
        assert not set(changes) - set(declared)
        behaviour = DamageGrowthBehaviour()
        behaviour.start(declared | changes, 0.0, [1.0])
        return behaviour

    return begun


def test_growth_with_the_load_is_the_law_of_paris(damage) -> None:
    rate, exponent = 2e-3, 3.5
    behaviour = damage(**{"rate.z1": rate, "exponent": exponent, "initial.z1": 0.1})
    time, expected = 0.0, 0.1
    for load, duration in ((2.0, 1.0), (3.0, 0.4), (-2.5, 2.0), (0.0, 5.0)):
        expected += rate * (abs(load) / 3.0) ** exponent * duration
        assert behaviour.advance(time, duration, [load]) == [pytest.approx(expected, abs=1e-11), 0.0]
        time += duration
    assert behaviour.advance(time, 1e6, [3.0])[0] == 0.8  # the ceiling


@pytest.mark.parametrize("period", [1, 2])
def test_a_script_gives_at_each_mark_what_it_says(damage, period) -> None:
    script = {
        "period": float(period),
        "script[1].first": 10.0, "script[1].last": 19.0, "script[1].z1": 0.02,
        "script[2].first": 20.0, "script[2].last": 20.0, "script[2].z1": 0.2, "script[2].z2": 0.1,
    }  # fmt: skip
    behaviour = damage(**script)
    z1 = [behaviour.advance(float(step), 1.0, [3.0])[0] for step in range(25)]
    marks = [[mark for mark in range(0, step + 1, period) if 10 <= mark < 20] for step in range(25)]
    assert z1 == [round(0.02 * len(passed) + 0.2 * (step >= 20), 12) for step, passed in enumerate(marks)]


@settings(max_examples=60)
@given(st.integers(0, 2**31 - 1), st.lists(st.integers(1, 7), min_size=1, max_size=12))
def test_chance_does_not_depend_on_the_steps(damage, seed, parts) -> None:
    """A mark draws by its own number: steps of a tenth to seven tenths of a mark lead to the same damage."""
    changes = {"probability.z1": 0.3, "probability.z2": 0.5, "exponent": 1.7, "seed": float(seed)}
    whole, fine, time = damage(**changes), damage(**changes), 0.0
    for part in parts:
        duration = 0.1 * part
        coarse_end = whole.advance(time, duration, [2.4])
        for _ in range(part):
            fine_end = fine.advance(time, duration / part, [2.4])
            time += duration / part
        assert coarse_end == fine_end


def test_chance_has_the_probability_that_it_says_and_marks_and_regions_are_independent(damage) -> None:
    """One level more with p (n / n_ref)^m at each mark but the first, and with the load before the mark."""
    exponent, trials = math.log(2.0) / math.log(1.5), 4000
    for load, probability in ((2.0, 0.25), (3.0, 0.5)):
        seen = []
        for seed in range(trials):
            changes = {"probability.z1": 0.5, "probability.z2": 0.5}
            behaviour = damage(**changes, exponent=exponent, seed=float(seed))
            assert behaviour.advance(0.0, 1.0, [load])[0] == 0.0
            moments = (1.0, 9.0), (1.5, load), (2.0, 9.0)
            first, _, second = (behaviour.advance(time, 0.5, [later]) for time, later in moments)
            seen.append([first[0] == 0.2, first[1] == 0.2, second[0] - first[0] == 0.2])
        deviation = math.sqrt(trials * probability * (1.0 - probability))
        assert np.abs(np.sum(seen, axis=0) - trials * probability).max() < 4.0 * deviation
        correlation = np.corrcoef(np.array(seen, dtype=float).T)
        assert np.abs(correlation - np.eye(3)).max() < 4.0 / math.sqrt(trials)


# ---------------------------------------------------------------------- gauges


@pytest.fixture(scope="module")
def gauges(ours: OurFmus) -> Callable[..., Callable[[float], list[float]]]:
    """Return what begins with gauges at equal strains: the readings of a step, and then what is received."""
    declared = parameters_of(ours("strain_gauges"))

    def begun(strains: list[float], **changes: float) -> Callable[[float], list[float]]:
        assert not set(changes) - set(declared)
        outside = tuple(f"[{gauge}]" for gauge in range(len(strains) + 1, 25))
        mine = {name: v for name, v in (declared | changes).items() if not name.endswith(outside)}
        behaviour = StrainGaugesBehaviour()
        started = behaviour.start(mine, 0.0, strains)
        return lambda time: started if time < 0.0 else behaviour.advance(float(time), 1.0, strains)

    return begun


def test_a_gauge_reads_gain_offset_and_drift_and_is_lost_for_a_while(gauges) -> None:
    changes = {"gain[1]": 1.02, "offset[2]": 5e-6, "drift_rate[3]": 2e-6, "drift_start[3]": 4.0}
    at = gauges([1e-3, -2e-3, 0.5e-3], **changes)
    assert at(-1) == [1.02e-3, -2e-3 + 5e-6, 0.5e-3, 1.0, 1.0, 1.0]
    for step in range(8):
        # As the drift of a scenario that begins at step 4.
        expected = 0.5e-3 + 2e-6 * max(0.0, step - 4 + 1.0)
        assert at(step)[:3] == pytest.approx([1.02e-3, -2e-3 + 5e-6, expected], rel=1e-14)
    changes = {"dropout_start[2]": 3.0, "dropout_end[2]": 6.0, "blackout.start": 8.0, "blackout.end": 9.0}
    at = gauges([1e-3] * 3, **changes)
    rows = [at(step) for step in range(12)]
    lost = [[gauge for gauge in range(3) if row[3 + gauge] == 0.0] for row in rows]
    assert lost == [[]] * 3 + [[1]] * 3 + [[]] * 2 + [[0, 1, 2]] + [[]] * 3
    for row, gone in zip(rows, lost, strict=True):
        assert row[:3] == [0.0 if gauge in gone else 1e-3 for gauge in range(3)]


def test_noise_is_gaussian_and_repeats_and_gauges_are_lost_by_chance(gauges) -> None:
    at = gauges([0.0] * 24, noise=150e-6, seed=3.0)
    noise = np.array([at(step)[:24] for step in range(500)])
    standard = noise.ravel() / 150e-6
    count = standard.size
    assert abs(standard.mean()) < 4.0 / math.sqrt(count)
    assert abs(standard.var() - 1.0) < 4.0 * math.sqrt(2.0 / count)
    assert abs((standard**4).mean() - 3.0) < 4.0 * math.sqrt(96.0 / count)
    assert abs(np.corrcoef(standard[:-1], standard[1:])[0, 1]) < 4.0 / math.sqrt(count)
    assert gauges([0.0] * 24, noise=150e-6, seed=3.0)(0)[:24] == noise[0].tolist()
    at = gauges([1e-3] * 24, dropout_probability=0.1, seed=3.0)
    received = [at(step)[24:] for step in range(400)]
    assert abs(np.mean(received) - 0.9) < 4.0 * math.sqrt(0.09 / (400 * 24))
