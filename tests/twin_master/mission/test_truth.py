"""Truth: the scripted history of the paper, random growth as the twin believes, faults of sensors."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

from scenarios import scenario_files
from twin_master.mission.truth import SensorStatus, Truth
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.seeds import PURPOSES, generator


def changed(name: str, **truth: Any) -> Scenario:
    table = tomllib.loads(scenario_files()[name].read_text(encoding="utf-8"))
    table["truth"] |= truth
    return parse_scenario(table, name)


def make(scenario: Scenario, seed: int = 1) -> Truth:
    return Truth(scenario, build_graphical_model(scenario), seed)


def test_the_papers_history() -> None:
    truth = make(load_scenario("level_turns").scenario)
    history = np.array([truth.state(step, None, None) for step in range(50)])
    # Written out from the text: z1 gains 2 at 10..19 and 20 at 20 and 30, z2 2 at 5..14 and 20 at 5 and 25.
    z1 = [0] * 10 + list(range(2, 21, 2)) + [40] * 10 + [60] * 20
    z2 = [0] * 5 + list(range(22, 41, 2)) + [40] * 10 + [60] * 25
    np.testing.assert_array_equal(history, np.array([z1, z2]).T / 100.0)


def test_random_growth_follows_the_transitions_of_the_control() -> None:
    scenario = load_scenario("growing_damage").scenario
    model = build_graphical_model(scenario)
    worse = np.zeros((2, 2))
    for seed in range(60):
        truth = Truth(scenario, model, seed)
        for control in (0, 1):
            state = None
            for step in range(50):
                new = truth.state(step, state, None if state is None else control)
                if state is not None:
                    assert np.all((new == state) | np.isclose(new, state + 0.2))
                    worse[control] += [np.sum((new > state)[state < 0.79]), np.sum(state < 0.79)]
                state = new
    rate = worse[:, 0] / worse[:, 1]
    error = np.sqrt(rate * (1 - rate) / worse[:, 1])
    assert np.all(np.abs(rate - [0.05, 0.10]) < 4 * error)


def test_the_same_seed_meets_the_same_noise_whatever_else_is_drawn() -> None:
    noise = make(load_scenario("level_turns").scenario, seed=7).noise
    np.testing.assert_array_equal(noise, make(load_scenario("growing_damage").scenario, seed=7).noise)
    assert not np.array_equal(noise, make(load_scenario("level_turns").scenario, seed=8).noise)
    assert noise.std() == pytest.approx(150e-6, rel=0.05)


def test_purposes_have_streams_of_their_own() -> None:
    first = {purpose: generator(3, purpose).random() for purpose in PURPOSES}
    assert len(set(first.values())) == len(PURPOSES)


def test_faults() -> None:
    scenario = load_scenario("failing_gauges").scenario
    truth = make(scenario)
    assert np.all(truth.status[36:38] == SensorStatus.LOST)
    assert np.all(truth.status[12:19, 16:20] == SensorStatus.LOST)
    assert np.all(truth.status[28:, 0] == SensorStatus.LOST)
    assert np.all(truth.status[:12, 16] == SensorStatus.HEALTHY)
    assert truth.status[8, 11] == SensorStatus.DRIFTING
    assert truth.status[36, 11] == SensorStatus.LOST
    np.testing.assert_allclose(truth.drift[:10, 11], [0] * 8 + [6e-6, 12e-6])
    quiet = changed("failing_gauges", noise={"standard_deviation_microstrain": 0})
    truth = make(quiet)
    value = np.full(24, 1e-3)
    sensed = truth.sense(13, value)
    assert np.isnan(sensed[16:20]).all()
    assert sensed[11] == pytest.approx(1e-3 + 36e-6)
    assert np.all(value == 1e-3)
    assert np.isnan(truth.sense(36, value)).all()
