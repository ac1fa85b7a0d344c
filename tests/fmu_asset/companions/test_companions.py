"""The companions of the wing: what they do by their own formulas, and that they are sound FMUs."""

from __future__ import annotations

import math
import random
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.check import check_fmu
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.companions.build import companion_bytes
from fmu_asset.companions.damage_growth import DamageGrowth
from fmu_asset.companions.strain_gauges import StrainGauges, normal
from fmu_asset.door.binding import parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuInputError
from fmu_asset.folders import scratch_folder
from reporting.files import atomic_write_bytes


@cache
def start_values(name: str) -> dict[str, float]:
    """Return the start values of the parameters, as the packed FMU declares them."""
    with scratch_folder() as folder:
        packed = read_fmu(atomic_write_bytes(folder / f"{name}.fmu", companion_bytes(name)))
    return {v.name: float(v.start or 0.0) for v in packed.variables if v.causality == "parameter"}


def parameters(name: str, **changes: float) -> dict[str, float]:
    assert not set(changes) - set(start_values(name))
    return start_values(name) | changes


def damage(**changes: float) -> tuple[DamageGrowth, list[float]]:
    behaviour = DamageGrowth()
    return behaviour, behaviour.start(parameters("damage_growth", **changes), 0.0, [1.0])


# ---------------------------------------------------------------------- damage growth


def test_growth_with_the_load_is_the_law_of_paris() -> None:
    rate, exponent = 2e-3, 3.5
    behaviour, _ = damage(**{"rate.z1": rate, "exponent": exponent, "initial.z1": 0.1})
    time, expected = 0.0, 0.1
    for load, duration in ((2.0, 1.0), (3.0, 0.4), (-2.5, 2.0), (0.0, 5.0)):
        (z1, z2) = behaviour.advance(time, duration, [load])
        expected += rate * (abs(load) / 3.0) ** exponent * duration
        time += duration
        assert z1 == pytest.approx(expected, abs=1e-11)
        assert z2 == 0.0
    assert behaviour.advance(time, 1e6, [3.0])[0] == 0.8  # the ceiling


def test_a_script_gives_at_each_mark_what_it_says() -> None:
    script = {
        "script[1].first": 10.0, "script[1].last": 19.0, "script[1].z1": 0.02,
        "script[2].first": 20.0, "script[2].last": 20.0, "script[2].z1": 0.2, "script[2].z2": 0.1,
    }  # fmt: skip
    behaviour, _ = damage(**script)
    z1 = [behaviour.advance(float(step), 1.0, [3.0])[0] for step in range(25)]
    assert z1 == [round(0.02 * min(max(step - 9, 0), 10) + 0.2 * (step >= 20), 12) for step in range(25)]


@settings(max_examples=60)
@given(st.integers(0, 2**31 - 1), st.lists(st.integers(1, 7), min_size=1, max_size=12))
def test_chance_does_not_depend_on_the_steps(seed: int, parts: list[int]) -> None:
    """A mark draws by its own number: steps of a tenth to seven tenths of a mark lead to the same damage."""
    changes = {"probability.z1": 0.3, "probability.z2": 0.5, "exponent": 1.7, "seed": float(seed)}
    whole, _ = damage(**changes)
    fine, _ = damage(**changes)
    time = 0.0
    for part in parts:
        duration = 0.1 * part
        coarse_end = whole.advance(time, duration, [2.4])
        for _ in range(part):
            fine_end = fine.advance(time, duration / part, [2.4])
            time += duration / part
        assert coarse_end == fine_end


def test_chance_has_the_probability_that_it_says() -> None:
    """One level more with p (n / n_ref)^m at each mark but the first, and with the load before the mark."""
    exponent = math.log(2.0) / math.log(1.5)
    counts = {2.0: 0, 3.0: 0}
    trials = 4000
    for load in counts:
        for seed in range(trials):
            behaviour, _ = damage(**{"probability.z1": 0.1, "exponent": exponent, "seed": float(seed)})
            assert behaviour.advance(0.0, 1.0, [load])[0] == 0.0
            counts[load] += behaviour.advance(1.0, 1.0, [9.0])[0] == 0.2
    for load, probability in ((2.0, 0.05), (3.0, 0.10)):
        deviation = math.sqrt(trials * probability * (1.0 - probability))
        assert abs(counts[load] - trials * probability) < 4.0 * deviation


def test_regions_and_marks_are_independent() -> None:
    seen = []
    for seed in range(3000):
        behaviour, _ = damage(**{"probability.z1": 0.5, "probability.z2": 0.5, "seed": float(seed)})
        behaviour.advance(0.0, 1.0, [3.0])
        first = behaviour.advance(1.0, 1.0, [3.0])
        second = behaviour.advance(2.0, 1.0, [3.0])
        seen.append([first[0] > 0, first[1] > 0, second[0] > first[0]])
    correlation = np.corrcoef(np.array(seen, dtype=float).T)
    assert np.abs(correlation - np.eye(3)).max() < 4.0 / math.sqrt(3000)


# ---------------------------------------------------------------------- gauges


def gauges(count: int = 3, **changes: float) -> tuple[StrainGauges, dict[str, float]]:
    values = parameters("strain_gauges", **changes)
    outside = tuple(f"[{gauge}]" for gauge in range(count + 1, 25))
    return StrainGauges(), {name: value for name, value in values.items() if not name.endswith(outside)}


def test_a_gauge_reads_gain_offset_and_drift() -> None:
    behaviour, values = gauges(
        **{"gain[1]": 1.02, "offset[2]": 5e-6, "drift_rate[3]": 2e-6, "drift_start[3]": 4.0}
    )
    strains = [1e-3, -2e-3, 0.5e-3]
    assert behaviour.start(values, 0.0, strains) == [1.02e-3, -2e-3 + 5e-6, 0.5e-3, 1.0, 1.0, 1.0]
    for step in range(8):
        reading = behaviour.advance(float(step), 1.0, strains)
        # As the drift of a scenario that begins at step 4.
        expected = 0.5e-3 + 2e-6 * max(0.0, step - 4 + 1.0)
        assert reading[:3] == pytest.approx([1.02e-3, -2e-3 + 5e-6, expected], rel=1e-14)


def test_dropouts_and_blackouts() -> None:
    behaviour, values = gauges(
        **{"dropout_start[2]": 3.0, "dropout_end[2]": 6.0, "blackout.start": 8.0, "blackout.end": 9.0}
    )
    behaviour.start(values, 0.0, [1e-3] * 3)
    rows = [behaviour.advance(float(step), 1.0, [1e-3] * 3) for step in range(12)]
    lost = [[gauge for gauge in range(3) if row[3 + gauge] == 0.0] for row in rows]
    assert lost == [[]] * 3 + [[1]] * 3 + [[]] * 2 + [[0, 1, 2]] + [[]] * 3
    assert all(row[gauge] == (0.0 if gauge in gone else 1e-3) for row, gone in zip(rows, lost, strict=True)
               for gauge in range(3))  # fmt: skip


def test_noise_is_gaussian_and_repeats() -> None:
    behaviour, values = gauges(24, noise=150e-6, seed=3.0)
    behaviour.start(values, 0.0, [0.0] * 24)
    noise = np.array([behaviour.advance(float(step), 1.0, [0.0] * 24)[:24] for step in range(500)])
    standard = noise.ravel() / 150e-6
    count = standard.size
    assert abs(standard.mean()) < 4.0 / math.sqrt(count)
    assert abs(standard.var() - 1.0) < 4.0 * math.sqrt(2.0 / count)
    assert abs((standard**4).mean() - 3.0) < 4.0 * math.sqrt(96.0 / count)
    assert abs(np.corrcoef(standard[:-1], standard[1:])[0, 1]) < 4.0 / math.sqrt(count)
    again, _ = gauges(24)
    again.start(values, 0.0, [0.0] * 24)
    assert again.advance(0.0, 1.0, [0.0] * 24)[:24] == noise[0].tolist()


def test_lost_by_chance() -> None:
    behaviour, values = gauges(24, dropout_probability=0.1, seed=3.0)
    behaviour.start(values, 0.0, [1e-3] * 24)
    received = [behaviour.advance(float(step), 1.0, [1e-3] * 24)[24:] for step in range(400)]
    share, count = np.mean(received), 400 * 24
    assert abs(share - 0.9) < 4.0 * math.sqrt(0.09 / count)


def test_normal_numbers_come_from_the_formula_of_box_and_muller() -> None:
    generator, same = random.Random(1), random.Random(1)
    first, second = same.random(), same.random()
    assert normal(generator) == math.sqrt(-2.0 * math.log(1.0 - first)) * math.cos(2.0 * math.pi * second)


# ---------------------------------------------------------------------- as FMUs


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("companions")
    return {
        name: atomic_write_bytes(folder / f"{name}.fmu", companion_bytes(name)) for name in COMPANION_NAMES
    }


@pytest.mark.parametrize("name", COMPANION_NAMES)
def test_a_companion_is_a_sound_fmu(fmus: dict[str, Path], name: str) -> None:
    """`fmpy validate`, the standard's rules, one step in a worker; units and ranges everywhere."""
    check = check_fmu(fmus[name])
    assert check.problems == ()
    assert "warning" not in {finding.verdict for finding in check.findings}


def test_equal_input_gives_equal_bytes(fmus: dict[str, Path]) -> None:
    for name, path in fmus.items():
        assert companion_bytes(name) == path.read_bytes()


def test_refusals_leave_the_state(fmus: dict[str, Path]) -> None:
    """Values and steps that a master should not send: refused by the FMU itself, which goes on from there."""
    description = read_fmu(fmus["damage_growth"])
    folder = extract_fmu(description)
    slave = FMU2Slave(
        guid=description.guid, modelIdentifier=description.model_identifier, unzipDirectory=str(folder)
    )
    reference = {variable.name: variable.reference for variable in description.variables}
    try:
        slave.instantiate()
        slave.setReal([reference["rate.z1"]], [0.01])
        slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        slave.setReal([reference["load_factor"]], [3.0])
        slave.doStep(0.0, 1.0)
        for value, time, size, status in (
            (math.nan, 1.0, 1.0, 2), (99.0, 1.0, 1.0, 1), (3.0, 1.0, -1.0, 3), (3.0, 5.0, 1.0, 3),
        ):  # fmt: skip
            slave.setReal([reference["load_factor"]], [value])
            with pytest.raises(FMICallException) as caught:
                slave.doStep(time, size)
            assert caught.value.status == 2  # Discard
            assert slave.getInteger([reference["status"]]) == [status]
        slave.setReal([reference["load_factor"]], [3.0])
        slave.doStep(1.0, 1.0)
        assert slave.getReal([reference["z1"]]) == [pytest.approx(0.02)]
        assert slave.getInteger([reference["status"]]) == [0]
        slave.setReal([reference["rate.z1"]], [0.5])  # a fixed parameter, too late
        assert slave.getInteger([reference["status"]]) == [4]
        slave.terminate()
        slave.freeInstance()
    finally:
        shutil.rmtree(folder)


def test_the_gauges_take_their_parameters(fmus: dict[str, Path]) -> None:
    binding = parse_binding(
        {
            "binding": {"name": "gauges", "step_size": 1.0},
            "parameter": {"noise": {"variable": "noise", "unit": "microstrain", "value": 1.0}},
            "observation": {"r": {"variables": "reading[{1..24}]", "unit": "microstrain"}},
        }
    )
    with FmiAsset(fmus["strain_gauges"], binding, isolated=False) as asset:
        assert 0.0 < np.abs(asset.step().values).max() < 10.0
        with pytest.raises(FmuInputError, match="outside the range"):
            asset.reset({"noise": 2e5})
