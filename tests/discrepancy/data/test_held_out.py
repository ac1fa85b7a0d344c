"""Which trials are held out: whole ones or load levels, inside what is fitted, by a rule that repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.campaign.held_out import choose_held_out, level
from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind


def trial(name: str, kind: TrialKind, top: float, count: int = 4, run: str = "A", channels=("x",)) -> Trial:
    rows = np.linspace(0.0, top, count)
    drive = {
        TrialKind.RINGDOWN: {"release": Release(top)},
        TrialKind.STATIC: {"force": rows},
        TrialKind.FLIGHT: {"load_factor": rows},
    }.get(kind, {})
    values = np.arange(float(count * len(channels))).reshape(count, len(channels))
    return Trial.plain(name, kind, tuple(channels), rows, values=values, load_place="x", run=run, **drive)


def campaign(*trials: Trial) -> Campaign:
    channels = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("x", "y")}
    return Campaign("", channels, trials, None, {}, "")


def held(*trials: Trial) -> list[str]:
    return [item.name for item in choose_held_out(campaign(*trials)).held_out]


def releases(*levels: float) -> list[Trial]:
    return [trial(f"r{n}", TrialKind.RINGDOWN, value) for n, value in enumerate(levels)]


def test_amplitudes_inside_come_first() -> None:
    assert held(*releases(1.0, 0.5, 0.2)) == ["r1"]
    assert held(*releases(0.2, 1.0, 0.3, 0.6)) == ["r3"]
    assert held(*releases(1.0, 0.9, 0.6, 0.5, 0.3, 0.2)) == ["r2", "r3"]
    # The extremes stay: with three trials at two levels the one that repeats can go.
    assert held(*releases(1.0, 1.0, 0.2)) == ["r1"]
    assert held(*releases(1.0, 1.0, 1.0, 1.0, 1.0)) == ["r4"]


def test_marked_trials_are_respected() -> None:
    trials = releases(1.0, 0.5, 0.2)
    given_campaign = campaign(
        trials[0], replace(trials[1], held_out=False), replace(trials[2], held_out=True)
    )
    assert choose_held_out(given_campaign) is given_campaign


def test_what_only_one_trial_has_stays() -> None:
    trials = releases(1.0, 0.5, 0.2)
    assert held(trials[0], replace(trials[1], run="B"), trials[2]) == []
    two = trial("r1", TrialKind.RINGDOWN, 0.5, channels=("x", "y"))
    assert held(trials[0], two, trials[2]) == []


def test_too_few_trials_are_said() -> None:
    chosen = choose_held_out(campaign(*releases(1.0, 0.5)))
    assert not chosen.held_out
    assert "Nothing is held out" in chosen.remarks[-1]
    assert [item.name for item in chosen.trials] == ["r0", "r1"]


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT])
def test_load_levels_of_a_single_trial(kind: TrialKind) -> None:
    single = trial("s", kind, 8.0, count=9)
    chosen = choose_held_out(campaign(single))
    fitted, proof = chosen.fitted[0], chosen.held_out[0]
    load = "force" if kind is TrialKind.STATIC else "load_factor"
    assert getattr(proof, load).tolist() == [2.0, 5.0]
    assert getattr(fitted, load).tolist() == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0]
    assert proof.values.tolist() == [[2.0], [5.0]]
    assert proof.name == "s, levels held out"
    assert held(trial("s", kind, 8.0, count=5)) == []
    path = np.concatenate([np.arange(5.0), np.arange(3.0, -1.0, -1.0)])
    assert held(replace(single, force=path, load_factor=0 * path)) == []  # a path that turns stays whole


@given(
    st.lists(
        st.tuples(st.sampled_from(TrialKind), st.sampled_from([0.1, 0.2, 0.5, 1.0]), st.sampled_from("AB")),
        min_size=1,
        max_size=9,
    )
)
@settings(max_examples=100, deadline=None)
def test_what_is_left_covers_what_is_held_out(rows: list[tuple[TrialKind, float, str]]) -> None:
    trials = [trial(str(n), kind, top, 8, run) for n, (kind, top, run) in enumerate(rows)]
    before = campaign(*trials)
    chosen = choose_held_out(before)
    assert [item.name for item in choose_held_out(before).held_out] == [item.name for item in chosen.held_out]
    assert sum(len(item.time) for item in chosen.trials) == sum(len(item.time) for item in trials)
    for item in chosen.held_out:
        left = [other for other in chosen.fitted if other.kind is item.kind]
        assert left
        lowest = 0.0 if "levels held out" in item.name else min(map(level, left))
        assert lowest <= level(item) <= max(map(level, left))
        assert any(other.run == item.run for other in chosen.fitted)
