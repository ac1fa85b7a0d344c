"""The mission of the pump against brute force: every path of the state, physics and likelihood anew."""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import norm

from reporting.progress import SilentProgress
from twin_master.assets.resolution import Overrides
from twin_master.library.request import grid_of_scenario
from twin_master.library.sampling import sample_library
from twin_master.store.writing import read_run
from twin_master.workflow import fly as new_run

sys.path.insert(0, str(Path(__file__).parent))
from pump_mission import small_pump

Float = NDArray[np.float64]

WEAR, CLOGGING = (0.0, 0.3, 0.6), (0.0, 0.6)
STATES = list(itertools.product(WEAR, CLOGGING))
CONTROLS = {"eco": (1000.0, 100.0), "normal": (1500.0, 140.0), "boost": (1800.0, 180.0)}
WORSENING = {"eco": (0.02, 0.04), "normal": (0.04, 0.06), "boost": (0.08, 0.08)}
NOISE = np.array([0.4, 0.5, 0.6, 0.15])


def show(control: str, wear: float, clogging: float, viscosity: float) -> Float:
    """Flow, torque, temperature and filter pressure drop, from the equations of docs/another_asset.md."""
    displacement = 16e-6 / (2 * math.pi)
    speed, load = 2 * math.pi * CONTROLS[control][0] / 60, 1e5 * CONTROLS[control][1]

    def at(temperature: float) -> tuple[float, float, float]:
        mu = viscosity * 870 * 46e-6 * (6.8 / 46) ** ((temperature - 40) / 60)
        conductance = 1.52e-8 * displacement * (1 + wear) ** 3 / mu

        def balance(flow: float) -> float:
            drop = mu * 9e9 * flow / (1 - clogging)
            return displacement * speed - conductance * (load + drop) - flow

        flow = brentq(balance, -1e-1, 1e-1, xtol=1e-18)
        drop = mu * 9e9 * flow / (1 - clogging)
        return flow, drop, displacement * ((load + drop) * 1.05 + 1e5 * mu * speed)

    def surplus(temperature: float) -> float:
        flow, _, torque = at(temperature)
        return torque * speed - load * flow - 250 * (temperature - 40)

    temperature = brentq(surplus, 40, 120, xtol=1e-12)
    flow, drop, torque = at(temperature)
    return np.array([6e4 * flow, torque, temperature, 1e-5 * drop])


def move(control: str, before: int, after: int) -> float:
    """Probability that each factor stays or worsens by one level; the last level is kept."""
    result = 1.0
    for axis, levels in enumerate((WEAR, CLOGGING)):
        a, b = levels.index(STATES[before][axis]), levels.index(STATES[after][axis])
        up = WORSENING[control][axis] if a < len(levels) - 1 else 0.0
        result *= {0: 1.0 - up, 1: up}.get(b - a, 0.0)
    return result


@pytest.fixture(scope="module", params=["asset", "library"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("pump")
    library = sample(folder) if request.param == "library" else None
    return read_run(new_run(small_pump(), folder / "run", Overrides(library=library), report=False).folder)


def sample(folder: Path) -> Path:
    grid = grid_of_scenario(small_pump(), folder / "made", progress=SilentProgress())
    return sample_library(grid, folder / "pump.nc", workers=1).path


def test_filter_smoother_and_prediction_equal_enumeration(run: Any) -> None:
    observed = run["observed"]["operation"].values
    controls = [str(name) for name in run["policy"]["control"].values]
    flown = [controls[index] for index in run["observed"]["control_index"].values]
    draws = run["calibration"]["draw_value"].values
    steps = len(flown)
    assert np.isnan(observed).sum() == 5  # one sensor once, and all of them once
    assert len(set(flown)) > 1

    table = {
        control: np.array([[show(control, *state, e) for e in draws] for state in STATES])
        for control in set(flown)
    }
    likelihood = np.ones((steps, len(STATES)))
    for t in range(steps):
        for s in range(len(STATES)):
            density = norm.pdf(observed[t], table[flown[t]][s], NOISE)  # (E, 4)
            likelihood[t, s] = np.nanprod(density, axis=1).mean()  # a lost sensor says nothing

    start = STATES.index((0.0, 0.0))
    filtered = np.zeros((steps, len(STATES)))
    smoothed = np.zeros((steps, len(STATES)))
    evidence = np.zeros(steps)
    for path in itertools.product(range(len(STATES)), repeat=steps):
        weight = float(path[0] == start)
        for t, state in enumerate(path):
            if t:
                weight *= move(flown[t - 1], path[t - 1], state)
            if weight == 0.0:
                break
            weight *= likelihood[t, state]
            # A prefix is met once for each of its continuations; count it with the first of them.
            if not any(path[t + 1 :]):
                filtered[t, state] += weight
                evidence[t] += weight
        else:
            smoothed[np.arange(steps), path] += weight
    filtered /= filtered.sum(axis=1, keepdims=True)
    smoothed /= smoothed.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(run["filtered"]["probability"].values, filtered, rtol=1e-7, atol=1e-13)
    np.testing.assert_allclose(run["smoothed"]["probability"].values, smoothed, rtol=1e-7, atol=1e-13)
    ratios = np.log(evidence) - np.log(np.concatenate([[1.0], evidence[:-1]]))
    np.testing.assert_allclose(run["filtered"]["log_evidence"].values, ratios, rtol=1e-8, atol=1e-9)

    chosen = [controls[index] for index in run["policy"]["control_index"].values]
    horizon = run["predicted"].sizes["horizon"]
    predicted = np.zeros((horizon, len(STATES)))
    for path in itertools.product(range(len(STATES)), repeat=horizon + 1):
        weight = filtered[-1, path[0]]
        for h in range(1, horizon + 1):
            weight *= move(flown[-1] if h == 1 else chosen[path[h - 1]], path[h - 1], path[h])
            if weight == 0.0:
                break
            if not any(path[h + 1 :]):
                predicted[h - 1, path[h]] += weight
    np.testing.assert_allclose(run["predicted"]["probability"].values[-1], predicted, rtol=1e-7, atol=1e-13)
    for control, name in enumerate(controls):
        asked = predicted @ np.array([float(choice == name) for choice in chosen])
        np.testing.assert_allclose(
            run["predicted"]["control_probability"].values[-1, :, control], asked, atol=1e-12
        )


def test_rewards_are_those_of_the_sensors_that_have_a_limit(run: Any) -> None:
    controls = [str(name) for name in run["policy"]["control"].values]
    draws, probability = run["calibration"]["draw_value"].values, run["filtered"]["probability"].values
    for t, index in enumerate(run["observed"]["control_index"].values):
        values = np.array([[show(controls[index], *state, e) for e in draws] for state in STATES])
        health = 1.0 - np.maximum(values[..., 2] / 50.0, values[..., 3] / 5.0)
        seen = run["observed"]["operation"].values[t]
        error = -np.abs(seen - values) / NOISE
        reward = run["filtered"]["reward_mean"].values[t]
        assert reward[0] == pytest.approx(probability[t] @ health.mean(axis=1), rel=1e-8)
        if np.isnan(seen).all():
            assert np.isnan(reward[2])
        else:
            assert reward[2] == pytest.approx(
                probability[t] @ np.nanmean(error, axis=2).mean(axis=1), rel=1e-7
            )
