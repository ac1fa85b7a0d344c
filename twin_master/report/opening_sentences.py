"""The opening sentences of a report: on the decisions, on the estimates, and on the model."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from reporting.words import counted, listing, parameter_title
from twin_master.network.estimator import is_state_believed
from twin_master.report.check import PredictiveCheck, predictive_check
from twin_master.report.reading import Run, moments_of
from twin_master.store.mission_result import LearntQuantity
from twin_master.store.summary import Fallback, control_changes, find_fallback

_MOST_FACTORS = 4
"""Largest number of state factors whose estimates are named."""
_LEAST_DEPARTURE = 0.05
"""Difference of the residuals' standard deviation from 1 below which it is not mentioned."""
_DEVIATIONS_OF_CHANCE = 3.3
"""Standard deviations that chance exceeds once in 1,000 times."""
_FALSE_ALARM = 1e-3
"""Probability of a false sentence about the coverage of any sensor."""


def opening_sentences(run: Run) -> tuple[str, ...]:
    """Return the sentences that sum up a run: on decisions, estimates and agreement with the data.

    A subject without data has no sentence.
    """
    sentences = (
        _decision_sentence(run),
        _belief_sentence(run),
        _agreement_sentence(run, predictive_check(run)),
    )
    return tuple(sentence for sentence in sentences if sentence)


@dataclass(frozen=True)
class _SwitchInWords:
    """The level of a state factor from which on the policy leaves the initial control, in words.

    Attributes
    ----------
    factor : str
        The title of the factor, with its article.
    level : str
        The level with its unit, and whether the true value that is nearest to it is smaller.
    is_always_reached : bool
        Whether the level is the lowest, so that every state calls for another control.
    """

    factor: str
    level: str
    is_always_reached: bool


def _decision_sentence(run: Run) -> str:
    """Return the sentence on the flown controls, and on the delay from the damage to the fallback.

    A fallback is the change from the initial control, that of the first step, after the true state
    has reached the level at which the policy leaves it.
    """
    initial_control = run.controls[int(run.control_index[0])]
    if len(run.controls) == 1:
        return f"There was one control, {initial_control}, and nothing to decide."
    fallback = Fallback()  # empty if the true state is not known
    if run.true_state is not None:
        fallback = find_fallback(
            run.model.states,
            run["policy/control_index"].astype(np.int64),
            int(run.control_index[0]),
            run.control_index,
            run.true_state,
        )
    switch = _switch_in_words(run, fallback)
    fell_back = fallback.fallback_step is not None and fallback.early_change_step is None
    if fell_back and switch is not None and not switch.is_always_reached:
        sentence = _fallback_clause(run, fallback, switch)
    else:
        sentence = f"{_subject(run)} kept {initial_control} at every {run.step_word}"
        if np.any(np.diff(run.control_index)):
            sentence = f"{_subject(run)} {_changes_of_control(run)}"
        sentence += _switch_clause(run, fallback, switch)
    if run.is_watched:  # a real asset may have another control than its twin has asked for
        requested_control = np.argmax(run["filtered/decision_probability"][:-1], axis=1)
        unheeded_requests = int(np.count_nonzero(requested_control != run.control_index[1:]))
        if unheeded_requests:
            count = _one_or_count(unheeded_requests, run.step_word)
            sentence += f"; at {count} the twin had asked for another control"
    return f"{sentence}."


def _switch_in_words(run: Run, fallback: Fallback) -> _SwitchInWords | None:
    """Return the level at which the policy leaves the initial control; None if there is none."""
    if fallback.switch_factor is None or fallback.switch_level is None:
        return None
    factor_index = run.scenario.state_names.index(fallback.switch_factor)
    factor = run.factors[factor_index]
    level = factor.scale * fallback.switch_level
    level_text = f"{level:.4g} {factor.unit}".rstrip()
    step = fallback.step_at_switch_level
    if step is not None and run.true_state is not None:
        true_value = run.true_state[step, factor_index]
        slack = run.model.states.factors[factor_index].slack
        if true_value < fallback.switch_level - slack:
            level_text += " (to the nearest level)"
    return _SwitchInWords(
        factor=_with_article(factor.title),
        level=level_text,
        is_always_reached=level <= factor.levels[0],
    )


def _subject(run: Run) -> str:
    """Return the subject of sentences on controls; the operator of a real asset decides on them."""
    return "The asset" if run.is_watched else "The twin"


def _changes_of_control(run: Run) -> str:
    """Return the changes of control in words, with their steps."""
    return control_changes(run.controls, run.control_index, run.step_word, run.first_step)


def _fallback_clause(run: Run, fallback: Fallback, switch: _SwitchInWords) -> str:
    """Return the clause on the step of the fallback and on the delay from the damage to it."""
    row = fallback.fallback_step
    assert row is not None
    if np.count_nonzero(np.diff(run.control_index)) == 1:
        initial_control = run.controls[int(run.control_index[0])]
        new_control = run.controls[int(run.control_index[row])]
        fell_back = (
            f"{_subject(run)} fell back from {initial_control} to {new_control} "
            f"at {run.step_word} {run.first_step + row},"
        )
    else:
        fell_back = f"{_subject(run)} {_changes_of_control(run)}; the first change came"
    delay = fallback.delay
    time_text = f"{_one_or_count(delay, run.step_word)} after" if delay else "when"
    return f"{fell_back} {time_text} {switch.factor} had reached {switch.level}"


def _switch_clause(run: Run, fallback: Fallback, switch: _SwitchInWords | None) -> str:
    """Return the clause on the step in which the damage reached the level of another control.

    The clause depends on the policy, where 2g is the initial control:

    - It has no level at which it leaves 2g: the clause is empty.
    - It leaves 2g at every level: "; the policy leaves 2g in every state".
    - The true state stays below the level: "; the stiffness loss of region 1 never reached the 60 %
      from which the policy leaves 2g".
    - The true state reaches it: "; the stiffness loss of region 1 reached the 60 % from which the
      policy leaves 2g at step 30".
    """
    if switch is None:
        return ""
    initial_control = run.controls[int(run.control_index[0])]
    if switch.is_always_reached:
        return f"; the policy leaves {initial_control} in every state"
    level = f"the {switch.level} from which the policy leaves {initial_control}"
    if fallback.step_at_switch_level is None:
        return f"; {switch.factor} never reached {level}"
    # The steps of a fallback count from the first step of the run, those of the report from 0.
    step_number = run.first_step + fallback.step_at_switch_level
    return f"; {switch.factor} reached {level} at {run.step_word} {step_number}"


def _belief_sentence(run: Run) -> str:
    """Return the sentence on the last estimate of the state, and of a learnt calibrated parameter.

    If no state of the model explains the observations, the sentence says so instead.
    """
    probability_of_none = run.get("notice/none_of_these")
    if probability_of_none is not None and not is_state_believed(probability_of_none[-1]):
        return (
            f"At the end no state is believed: no state of the model explains the "
            f"{run.sensors.word}s (probability {probability_of_none[-1]:.3g})."
        )
    estimates = [_state_estimate(run, index) for index in range(len(run.factors))]
    if len(estimates) > _MOST_FACTORS:
        other_count = len(estimates) - _MOST_FACTORS
        estimates = estimates[:_MOST_FACTORS]
        estimates.append(f"{counted(other_count, 'other state')} as the figures below show")
    sentence = (
        f"At the end the twin puts {listing(estimates)}; "
        "in brackets two standard deviations either side"
    )
    decided_by = _decided_by(run)
    if decided_by != "model":
        sentence += f"; what decides its control is: {decided_by}"
    for quantity in run.learnt_quantities:
        if quantity.name == run.scenario.calibration.parameter:
            sentence += f"; {_parameter_clause(quantity)}"
    return f"{sentence}."


def _decided_by(run: Run) -> str:
    """Return the hypothesis that decided on the last control, from the run's summary.

    This is "model" unless an alarm overrides the model.
    """
    for figure in run.summary.get("figures", ()):
        if figure["key"] == "decided_by":
            return figure["value"] or "model"
    return "model"


def _state_estimate(run: Run, index: int) -> str:
    """Return the last estimate of one factor of the state, with its interval and the truth."""
    factor = run.factors[index]
    mean = factor.scale * run["filtered/mean"][-1, index]
    deviation = factor.scale * run["filtered/standard_deviation"][-1, index]
    ends = np.clip(mean + np.array([-2.0, 2.0]) * deviation, factor.levels[0], factor.levels[-1])
    is_percentage = factor.unit == "%"
    number_format = ".1f" if is_percentage else ".3g"
    truth_format = ".0f" if is_percentage else ".3g"
    low, high = (f"{end:{number_format}}" for end in ends)
    interval = f"{low} to {high}" if low != high else "no other level is believed"
    if run.true_state is not None:
        truth = factor.scale * run.true_state[-1, index]
        interval += f", truth {truth:{truth_format}}"
    estimate = f"{mean:{number_format}} {factor.unit}".rstrip()
    return f"{_with_article(factor.title)} at {estimate} ({interval})"


def _parameter_clause(quantity: LearntQuantity) -> str:
    """Return the clause on the learnt parameter: mean, two standard deviations, and true value."""
    last_moments = moments_of(quantity.posterior[-1])
    mean = float(last_moments.mean)
    two_deviations = 2 * float(last_moments.standard_deviation)
    values = f"{mean:.3f} ({mean - two_deviations:.3f} to {mean + two_deviations:.3f}"
    if quantity.truth is not None:
        values += f", truth {float(quantity.truth):.4g}"
    return f"it learnt {_with_article(parameter_title(quantity.name))}: {values})"


def _agreement_sentence(run: Run, check: PredictiveCheck) -> str:
    """Return the sentence on the residuals: whether they are as large as the twin assumes.

    If they are, it names a sensor with too few observations within their intervals, if there is
    one. It is empty if nothing was observed.
    """
    count = int(check.count.sum())
    if count == 0:
        return ""
    deviation = check.standard_deviation
    # The sample standard deviation of n standard normal residuals has a standard error of about
    # 1 / sqrt(2 n).
    threshold = max(_LEAST_DEPARTURE, _DEVIATIONS_OF_CHANCE / np.sqrt(2.0 * count))
    coverage = f"{100.0 * check.overall_coverage:.0f} %"
    scatter = "The observations scatter about the twin's model"
    within_clause = f"{coverage} of them lie within their 95 % intervals"
    if deviation > 1.0 + threshold:
        return (
            f"{scatter} {deviation:.3g} times as far as it assumes: {within_clause}; "
            "the noise is larger, or the model is off."
        )
    if deviation < 1.0 - threshold:
        return (
            f"{scatter} {deviation:.2g} times as far as it assumes: {within_clause}; "
            "its intervals are wider than they need be."
        )
    sensor = _sensor_with_low_coverage(check)
    if sensor is not None:
        return (
            f"Of all observations {coverage} lie within their 95 % intervals, "
            f"but {100.0 * check.coverage[sensor]:.0f} % of those of {run.sensors.titles[sensor]}."
        )
    return (
        "The twin's model explains the observations within the noise that it assumes: "
        f"{within_clause}."
    )


def _sensor_with_low_coverage(check: PredictiveCheck) -> int | None:
    """Return the index of the sensor whose coverage is too low to be chance; None if there is none.

    If the model is right, the number of a sensor's observations within their 95 % intervals is
    binomial. The limit `_FALSE_ALARM` of its probability is divided by the number of
    sensors, because all sensors are tested (Bonferroni correction).
    """
    count_within = np.rint(np.nan_to_num(check.coverage, nan=1.0) * check.count)
    p_values = binom.cdf(count_within, np.maximum(check.count, 1), 0.95)
    p_values = np.where(check.count > 0, p_values, 1.0)
    sensor = int(np.argmin(p_values))
    return sensor if p_values[sensor] < _FALSE_ALARM / len(p_values) else None


def _with_article(title: str) -> str:
    """Return a title with its article; a symbol stays as it is."""
    return f"the {title}" if " " in title and not title.startswith("the ") else title


def _one_or_count(count: int, noun: str) -> str:
    """Return a count with its noun; one is written as a word."""
    return f"one {noun}" if count == 1 else counted(count, noun)
