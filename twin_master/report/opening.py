"""The sentences with which the page begins: what was decided, what is believed, whether the model holds."""

import numpy as np
from scipy.stats import binom

from reporting.words import listing, parameter_title
from twin_master.network.graphical_model import Factor, StateSpace
from twin_master.report.check import PredictiveCheck, predictive_check
from twin_master.report.data import RunRecord
from twin_master.report.view import sensor_title, state_scale
from twin_master.store.summary import Fallback, control_changes, find_fallback

_STATES_SAID = 4
_SPREAD_DIFFERS = 0.05
"""Relative departure of the spread of residuals from one below which nothing is said of it."""
_SURE = 1e-3
"""Probability of a false word about the spread, or about any sensor."""


def opening_sentences(record: RunRecord) -> tuple[str, ...]:
    """Return at most three sentences on a run; what the record does not hold is not spoken of."""
    check = predictive_check(record)
    agreement = "" if check is None else _agreement(record, check)
    decision = f"{_decision(record).removesuffix('.')}{_not_followed(record)}."
    return tuple(sentence for sentence in (decision, _belief(record), agreement) if sentence)


def _decision(record: RunRecord) -> str:
    """Return how the control went, and by how much it followed the damage that calls for another."""
    subject = "asset" if record.config.get("watched") else "twin"
    first, controls, step = int(record.control_index[0]), record.controls, record.step_word
    if len(controls) == 1:
        return f"There was one control, {controls[0]}, and nothing to decide."
    fallback = _fallback(record)
    if np.all(record.control_index == first):
        said = f"The {subject} kept {controls[first]} at every {step}"
    else:
        said = f"The {subject} {control_changes(controls, record.control_index, step, record.first_step)}"
    if fallback is None or fallback.switch_state is None or fallback.switch_level is None:
        return f"{said}."
    factor = record.state_names.index(fallback.switch_state)
    scale, unit = state_scale(record, factor)
    level = f"{scale * fallback.switch_level:.4g} {unit}".rstrip()
    what, called = _named(record.state_titles[factor]), fallback.called_for_step
    if called is None:
        return f"{said}; {what} never reached the {level} from which the policy leaves {controls[first]}."
    reached = record.first_step + called
    if fallback.early_step is not None or fallback.fallback_step is None:
        return (
            f"{said}; {what} reached the {level} from which the policy leaves {controls[first]} at "
            f"{step} {reached}."
        )
    changes = int(np.count_nonzero(np.diff(record.control_index)))
    if changes == 1:
        now = controls[int(record.control_index[fallback.fallback_step])]
        turn = record.first_step + fallback.fallback_step
        said = f"The {subject} fell back from {controls[first]} to {now} at {step} {turn}"
    when = f"{_count(fallback.delay, step)} after" if fallback.delay else "when"
    return f"{said}{',' if changes == 1 else '; the first change came'} {when} {what} had reached {level}."


def _fallback(record: RunRecord) -> Fallback | None:
    """Return how the control fell back; None where truth or policy are unknown."""
    if record.truth_state is None or record.policy is None:
        return None
    levels = zip(record.state_names, record.levels, strict=True)
    states = StateSpace(tuple(Factor(name, tuple(values.tolist())) for name, values in levels))
    if states.size != len(record.coordinates):
        return None
    return find_fallback(
        states,
        record.policy.control_index,
        int(record.control_index[0]),
        record.control_index,
        np.asarray(record.truth_state, dtype=np.float64),
    )


def _not_followed(record: RunRecord) -> str:
    """Return how often a real asset was under another control than the one that its twin had asked for."""
    if not record.config.get("watched") or record.decision_probability is None:
        return ""
    asked = np.argmax(record.decision_probability[:-1], axis=1)
    missed = int(np.count_nonzero(asked != record.control_index[1:]))
    return f"; at {_count(missed, record.step_word)} the twin had asked for another control" if missed else ""


def _belief(record: RunRecord) -> str:
    """Return the last estimate of the state, and of the parameter where it is learnt."""
    parts = [_state(record, factor) for factor in range(min(len(record.state_names), _STATES_SAID))]
    rest = len(record.state_names) - len(parts)
    if rest:
        parts.append(f"{_count(rest, 'other state')} as the figures below show")
    said = f"At the end the twin puts {listing(parts)}; in brackets two standard deviations either side"
    figures = record.summary.get("figures", ())
    decided = next((figure["value"] for figure in figures if figure["key"] == "decided_by"), "model")
    said += "" if decided == "model" else f"; what decides its control is: {decided}"
    for learnt in record.learnt:
        if learnt.name == record.parameter_name:
            mean, deviation = learnt.course[-1, :2]
            truth = "" if learnt.truth is None else f", truth {float(learnt.truth):.4g}"
            said += (
                f"; it learnt {_named(parameter_title(learnt.name))}: "
                f"{mean:.3f} ({mean - 2 * deviation:.3f} to {mean + 2 * deviation:.3f}{truth})"
            )
    return f"{said}."


def _state(record: RunRecord, factor: int) -> str:
    scale, unit = state_scale(record, factor)
    mean, deviation = record.filtered.mean[-1, factor], record.filtered.standard_deviation[-1, factor]
    ends = np.clip(mean + np.array([-2.0, 2.0]) * deviation, *record.levels[factor][[0, -1]])
    form, true = (".1f", ".0f") if unit == "%" else (".3g", ".3g")
    low, high = (f"{scale * end:{form}}" for end in ends)
    interval = f"{low} to {high}" if low != high else "no other level is believed"
    if record.truth_state is not None:
        interval += f", truth {scale * record.truth_state[-1, factor]:{true}}"
    printed = f"{scale * mean:{form}} {unit}".rstrip()
    return f"{_named(record.state_titles[factor])} at {printed} ({interval})"


def _agreement(record: RunRecord, check: PredictiveCheck) -> str:
    """Return whether the observations scatter about the model as the twin assumes."""
    spread, inside = check.standard_deviation, 100.0 * check.overall_coverage
    count = int(check.count.sum())
    if count == 0 or not np.isfinite(spread):
        return ""
    scatter = "The observations scatter about the twin's model"
    share = f"{inside:.0f} % of them lie within their 95 % intervals"
    sure = 3.3 / np.sqrt(2.0 * count)  # standard deviations of the spread that chance exceeds once in 1,000
    if spread > 1.0 + max(_SPREAD_DIFFERS, sure):
        return (
            f"{scatter} {spread:.3g} times as far as it assumes: {share}; "
            "the noise is larger, or the model is off."
        )
    if spread < 1.0 - max(_SPREAD_DIFFERS, sure):
        return (
            f"{scatter} {spread:.2g} times as far as it assumes: {share}; "
            "its intervals are wider than they need be."
        )
    hits = np.rint(np.nan_to_num(check.coverage, nan=1.0) * check.count)
    chance = np.where(check.count > 0, binom.cdf(hits, np.maximum(check.count, 1), 0.95), 1.0)
    worst = int(np.argmin(chance))
    if chance[worst] < _SURE / len(chance):
        title = sensor_title(record, worst)
        return (
            f"Of all observations {inside:.0f} % lie within their 95 % intervals, but "
            f"{100.0 * check.coverage[worst]:.0f} % of those of "
            f"{title[:1].lower()}{title[1:]}."
        )
    return f"The twin's model explains the observations within the noise that it assumes: {share}."


def _named(title: str) -> str:
    return f"the {title}" if " " in title and not title.startswith("the ") else title


def _count(count: int, word: str) -> str:
    return f"one {word}" if count == 1 else f"{count} {word}s"
