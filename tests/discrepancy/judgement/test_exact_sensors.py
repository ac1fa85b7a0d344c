"""A verdict says which zero or gain the campaign calls exact, where that is what the model misses."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.verdict import VerdictKind
from discrepancy.workflow import Investigation, investigate
from tests.discrepancy.rigs import chosen, measured

DRAG = chosen("quadratic_damping")


def found(drag: float = 0.0, zero: float = 0.0, gain: float = 1.0, **stated: float) -> Investigation:
    """Return the verdict on a simulated campaign whose displacement reads otherwise than it states."""
    campaign, model = measured(drag)
    name = next(name for name, item in campaign.channels.items() if item.output == "displacement")
    channel = replace(campaign.channels[name], **stated)
    trials = []
    for trial in campaign.trials:
        values = trial.values.copy()
        if name in trial.channels:
            column = trial.channels.index(name)
            values[:, column] = gain * values[:, column] + zero
        trials.append(replace(trial, values=values))
    changed = replace(campaign, channels={**campaign.channels, name: channel}, trials=tuple(trials))
    return investigate(changed, model, DRAG, seed=3, thorough=False)


def told(investigation: Investigation) -> list[str]:
    return [remark for remark in investigation.verdict.remarks if "is exact in the campaign" in remark]


WRONG_SENSORS = pytest.mark.parametrize(
    ("wrong", "noun", "key"),
    [({"zero": 5e-4}, "zero", "offset_deviation"), ({"gain": 1.05}, "gain", "gain_deviation")],
)


@WRONG_SENSORS
def test_what_the_campaign_calls_exact_and_the_data_do_not_is_named_with_the_key(wrong, noun, key):
    """Also how much of the misfit falls away if it is fitted."""
    investigation = found(**wrong, **{key: 0.0})
    (remark,) = told(investigation)
    start = f"The {noun} of the channel 'displacement' is exact in the campaign; give `{key}`: if it is "
    start += "fitted, the misfit of the model without any effect falls by "
    assert investigation.verdict.kind is not VerdictKind.NOTHING_MISSING
    assert remark.startswith(start)
    percent = float(remark.removeprefix(start).split()[0])
    assert 90.0 <= percent <= 100.0


@WRONG_SENSORS
def test_nothing_is_missing_once_the_campaign_does_not_call_it_exact(wrong, noun, key):
    verdict = found(**wrong, **{key: np.inf if noun == "zero" else 0.1}).verdict
    assert verdict.kind is VerdictKind.NOTHING_MISSING


def test_an_effect_is_not_taken_for_a_zero_or_a_gain():
    investigation = found(drag=0.01, offset_deviation=0.0, gain_deviation=0.0)
    assert investigation.verdict.kind is not VerdictKind.NOTHING_MISSING
    assert told(investigation) == []
