"""The sentences with which the page begins: what was decided, what is believed, whether the model holds."""

import numpy as np
from scipy.stats import binom

from reporting.page import Words
from reporting.words import counted, listing, parameter_title
from twin_master.report.check import PredictiveCheck, predictive_check
from twin_master.report.reading import Run
from twin_master.store.summary import Fallback, control_changes, find_fallback

WORDS = Words("twin_master.report")

_STATES_SAID = 4
_SPREAD_DIFFERS = 0.05
"""Relative departure of the spread of residuals from one below which nothing is said of it."""
_SURE = 1e-3
"""Probability of a false word about the spread, or about any sensor."""


def opening_sentences(run: Run) -> tuple[str, ...]:
    """Return at most three sentences on a run; what the run does not hold is not spoken of."""
    sentences = (_decision(run), _belief(run), _agreement(run, predictive_check(run)))
    return tuple(sentence for sentence in sentences if sentence)


def _decision(run: Run) -> str:
    """Return how the control went, and by how much it followed the damage that calls for another."""
    first, controls, index = int(run.control_index[0]), run.controls, run.control_index
    changes, fallback = int(np.count_nonzero(np.diff(index))), _fallback(run)
    fell = None if fallback is None or fallback.early_step is not None else fallback.fallback_step
    switch: dict[str, object] = {"what": "", "level": "", "everywhere": False}
    if fallback is not None and fallback.switch_state is not None and fallback.switch_level is not None:
        factor = run.factors[run.scenario.state_names.index(fallback.switch_state)]
        level = factor.scale * fallback.switch_level
        switch = {
            "what": _named(factor.title), "level": f"{level:.4g} {factor.unit}".rstrip(),
            "everywhere": level <= factor.levels[0],
        }  # fmt: skip
    missed = 0
    if run.watched:  # a real asset may be under another control than the one that its twin asked for
        asked = np.argmax(run["filtered/decision_probability"][:-1], axis=1)
        missed = int(np.count_nonzero(asked != index[1:]))
    return WORDS.say(
        "decision", run=run, first=controls[first], **switch, missed=missed and _count(missed, run.step),
        asset="asset" if run.watched else "twin", changes=changes,
        changed=control_changes(controls, index, run.step, run.first_step),
        called=None if fallback is None or fallback.called_for_step is None
        else run.first_step + fallback.called_for_step,
        fell=None if fell is None else run.first_step + fell,
        now=controls[int(index[fell or 0])],
        delay=fallback and fallback.delay and _count(fallback.delay, run.step),
    )  # fmt: skip


def _fallback(run: Run) -> Fallback | None:
    """Return how the control fell back; None where the truth is unknown."""
    if run.truth is None:
        return None
    policy = run["policy/control_index"].astype(np.int64)
    return find_fallback(run.model.states, policy, int(run.control_index[0]), run.control_index, run.truth)


def _belief(run: Run) -> str:
    """Return the last estimate of the state, and of the parameter where it is learnt."""
    parts = [_state(run, index) for index in range(min(len(run.factors), _STATES_SAID))]
    rest = len(run.factors) - len(parts)
    if rest:
        parts.append(f"{counted(rest, 'other state')} as the figures below show")
    figures = {figure["key"]: figure["value"] for figure in run.summary.get("figures", ())}
    learnt = next((one for one in run.learnt if one.name == run.scenario.calibration.parameter), None)
    told = None
    if learnt is not None:
        mean, deviation = learnt.course[-1, :2]
        told = {
            "name": _named(parameter_title(learnt.name)), "mean": mean, "low": mean - 2 * deviation,
            "high": mean + 2 * deviation, "truth": None if learnt.truth is None else float(learnt.truth),
        }  # fmt: skip
    decided = figures.get("decided_by") or "model"
    return WORDS.say("belief", states=listing(parts), decided=decided, learnt=told)


def _state(run: Run, index: int) -> str:
    factor = run.factors[index]
    mean, deviation = (
        factor.scale * run[f"filtered/{moment}"][-1, index] for moment in ("mean", "standard_deviation")
    )
    ends = np.clip(mean + np.array([-2.0, 2.0]) * deviation, factor.levels[0], factor.levels[-1])
    form, true = (".1f", ".0f") if factor.unit == "%" else (".3g", ".3g")
    low, high = (f"{end:{form}}" for end in ends)
    interval = f"{low} to {high}" if low != high else "no other level is believed"
    if run.truth is not None:
        interval += f", truth {factor.scale * run.truth[-1, index]:{true}}"
    return f"{_named(factor.title)} at {f'{mean:{form}} {factor.unit}'.rstrip()} ({interval})"


def _agreement(run: Run, check: PredictiveCheck) -> str:
    """Return whether the observations scatter about the model as the twin assumes."""
    count, spread = int(check.count.sum()), check.standard_deviation
    if count == 0:
        return ""
    # standard deviations of the spread that chance exceeds once in 1,000
    differs = max(_SPREAD_DIFFERS, 3.3 / np.sqrt(2.0 * count))
    hits = np.rint(np.nan_to_num(check.coverage, nan=1.0) * check.count)
    chance = np.where(check.count > 0, binom.cdf(hits, np.maximum(check.count, 1), 0.95), 1.0)
    worst = int(np.argmin(chance))
    return WORDS.say(
        "agreement", spread=spread, wide=spread > 1.0 + differs, narrow=spread < 1.0 - differs,
        inside=100.0 * check.overall_coverage, off=chance[worst] < _SURE / len(chance),
        worst=run.sensors.titles[worst], share=100.0 * check.coverage[worst],
    )  # fmt: skip


def _named(title: str) -> str:
    return f"the {title}" if " " in title and not title.startswith("the ") else title


def _count(count: int, word: str) -> str:
    return f"one {word}" if count == 1 else counted(count, word)
