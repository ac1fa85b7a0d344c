"""The workflow tried on simulated campaigns of a rig."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from discrepancy.self_calibration import (
    NOTHING,
    Simulator,
    outcome_of,
    self_calibrate,
    wilson,
    write_self_calibration,
)
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.rigs import FEW, ORIGIN, measured


@pytest.mark.parametrize(
    ("hidden", "kind", "named", "group", "outcome"),
    [
        (NOTHING, VerdictKind.NOTHING_MISSING, (), (), "right"),
        (NOTHING, VerdictKind.NAMED, ("a",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a",), (), "right"),
        ("a", VerdictKind.NAMED, ("b",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a", "b"), (), "wrong"),
        ("a", VerdictKind.GROUP, ("b", "a"), ("b", "a"), "group"),
        ("a", VerdictKind.GROUP, ("b", "c"), ("b", "c"), "wrong"),
        ("a", VerdictKind.GROUP, ("a", "b"), ("a + b",), "group"),
        ("a", VerdictKind.FAMILY, ("a",), (), "family"),
        ("a", VerdictKind.FAMILY, ("b",), (), "wrong"),
        ("a", VerdictKind.NOTHING_MISSING, (), (), "missed"),
        ("a", VerdictKind.UNEXPLAINED, (), (), "unexplained"),
    ],
)
def test_how_verdicts_count(hidden, kind, named, group, outcome):
    assert outcome_of(hidden, kind, named, group) == outcome


def test_simulated_campaigns_have_the_noise_and_the_nuisances_of_the_real_one():
    campaign, model = measured()
    simulator = Simulator(campaign, model)
    squares = []
    for seed in range(12):
        drawn = simulator.simulate(None, np.random.default_rng(seed))
        assert [trial.name for trial in drawn.trials] == [trial.name for trial in campaign.trials]
        found = investigate(drawn, model, (), thorough=False) if seed < 2 else None
        assert found is None or found.verdict.kind is VerdictKind.NOTHING_MISSING
        again = simulator.simulate(None, np.random.default_rng(seed)).trials[-1].values
        assert np.array_equal(again, drawn.trials[-1].values)
        # sixth differences of a slow motion hold noise alone: variance times the sum of squared binomials
        sixth = np.diff(drawn.trials[-1].values[:, 0], 6)
        noise = simulator.problem.noise[drawn.trials[-1].channels[0]].standard_deviation
        squares.append(float(np.mean(sixth**2)) / 924.0 / noise**2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.12)


def test_the_workflow_tried_on_its_own_geometry(tmp_path):
    campaign, model = measured(kind="static")
    steps = []
    found = self_calibrate(campaign, model, FEW, 9, seed=2, workers=1, advance=lambda: steps.append(1))
    assert len(steps) == len(found.cases) == 9
    assert [case.hidden == NOTHING for case in found.cases] == [True, False, False] * 3
    assert all(case.distance >= 25.0 for case in found.cases if case.hidden != NOTHING)
    assert sum(found.confusion()[2].ravel()) == 9
    assert found.share("right", null=True).total == 3
    none, square = wilson(0, 9), norm.ppf(0.95) ** 2  # in closed form (Wilson 1927)
    assert (none.value, none.low, none.high) == pytest.approx((0.0, 0.0, square / (9.0 + square)))
    assert wilson(0, 0).total == 0
    again = self_calibrate(campaign, model, FEW, 9, seed=2, workers=2)
    assert again == found
    path = write_self_calibration(tmp_path / "self_calibration.json", found, ORIGIN)
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["schema"] == "uav-twin self calibration 1"
    assert len(stored["cases"]) == 9
