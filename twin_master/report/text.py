"""Captions and phrases of the report."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin_master.report.check import PredictiveCheck, assumed_model_error, assumed_noise
from twin_master.report.data import RunRecord
from twin_master.report.view import observation_scale, sensor_title, sensor_word, state_scale, symbol


def number(value: Any) -> str:
    """Return a figure as printed: text as it is, five significant digits, a dash for none."""
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.5g}".replace("-", "−")
    return str(value)


def turn_ranges(turns: ArrayLike, step_word: str = "turn") -> str:
    """Return increasing turns in words: ``turns 3–4, 12–18``."""
    values = np.asarray(turns, dtype=int)
    if not len(values):
        return f"no {step_word}"
    parts = np.split(values, np.flatnonzero(np.diff(values) > 1) + 1)
    words = [f"{part[0]}" if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts]
    return f"{step_word} {words[0]}" if len(values) == 1 else f"{step_word}s {', '.join(words)}"


def lost_ranges(record: RunRecord) -> str:
    """Return which sensors were lost when, those lost together in one phrase."""
    if record.observation is None:
        return ""
    lost = np.isnan(record.observation)
    blind = lost.all(axis=1)
    together: dict[tuple[int, ...], list[str]] = {}
    for sensor, label in enumerate(record.sensors):
        turns = tuple(int(turn) for turn in np.flatnonzero(lost[:, sensor] & ~blind))
        if turns:
            together.setdefault(turns, []).append(str(label))
    word, step = sensor_word(record).lower(), record.step_word
    phrases = [
        f"{word}{'s' if len(labels) > 1 else ''} {', '.join(labels)} at {turn_ranges(turns, step)}"
        for turns, labels in together.items()
    ]
    if blind.any():
        phrases.append(f"all {word}s at {turn_ranges(np.flatnonzero(blind), step)}")
    return "; ".join(phrases)


def mission_caption(record: RunRecord, now: int) -> str:
    """Return the caption of the mission seen from turn `now`."""
    names = ", ".join(symbol(name) for name in record.state_names)
    _, unit = observation_scale(record)
    step, units = record.step_word, _state_units(record)
    last = now == record.step_count - 1
    given = "all observations" if last else f"the observations up to {step} {now}"
    past = "in hindsight" if last else "as seen at the time"
    hollow = "" if last else f"hollow: not yet made at {step} {now}; "
    sentences = [
        f"{names}: mean and two standard deviations (within the range of levels) in {units}; the past given "
        f"{given} (blue), as seen at the time (thin green), and at the present {step} {now} (diamond)."
    ]
    if record.horizon:
        sentences.append(
            f"The {record.horizon} {step}s to come are predicted through the policy, eqs. (37)–(39) "
            "(vermilion, dashed)."
        )
    shown, name = unit or "each in its unit", record.observation_name
    sentences.append(
        f"{sensor_word(record)}s: {name} without noise at the control flown ({shown}) with "
        f"95 % intervals, {past}, and observations (dots; {hollow}crosses: lost)."
    )
    later = "" if last else "; triangles: flown later"
    asked = (
        f" and, for each {step} to come, the probability that the policy asks for it in the state predicted "
        f"(height of the bars{later})"
        if record.horizon
        else ""
    )
    sentences.append(f"Control: flown (full bars){asked}.{decision_sentence(record, now)}")
    if record.filtered.reward is not None:
        sentences.append(f"Rewards: eqs. (9)–(11), dimensionless, with 95 % intervals, {past}.")
    if record.truth_state is not None:
        sentences.append("The black line is the truth, which the twin never sees.")
    return " ".join(sentences)


def _state_units(record: RunRecord) -> str:
    """Return the printed units of the state factors in words."""
    units = dict.fromkeys(state_scale(record, factor)[1] for factor in range(len(record.state_names)))
    return ", ".join("percent" if unit == "%" else unit for unit in units)


def decision_sentence(record: RunRecord, turn: int) -> str:
    """Return what the twin decided at the end of a turn, and by which belief; empty if it was not stored."""
    if record.decision_probability is None:
        return ""
    probability = record.decision_probability[turn]
    chosen, step = int(np.argmax(probability)), record.step_word
    return (
        f" At the end of {step} {turn} the twin decided on {record.controls[chosen]} for the next one: "
        f"the policy asks for it with probability {probability[chosen]:.2f} in the state "
        f"{f'predicted for that {step}' if record.decides_on_prediction else 'as just observed'}."
    )


def belief_caption(record: RunRecord) -> str:
    """Return the caption of the belief."""
    if len(record.state_names) != 2:
        line = " Black line: truth." if record.truth_state is not None else ""
        return (
            f"Marginal belief about each factor ({_state_units(record)}) given the observations up to each "
            f"{record.step_word}.{line}"
        )
    first, second = (symbol(name) for name in record.state_names)
    ring = "; ring: truth" if record.truth_state is not None else ""
    return (
        f"Joint probability of {first} and {second} ({_state_units(record)}) given the observations up to "
        f"the {record.step_word} named; diamond: mean{ring}. Source: filtered/probability in run.nc."
    )


def policy_caption(record: RunRecord) -> str:
    """Return the caption of the policy."""
    text = (
        "a: control that value iteration, eq. (36), chooses in each state, and the way of the estimated mean "
        "through the states during the mission, beginning at the white dot"
    )
    text += " (black: truth)." if record.truth_state is not None else "."
    if len(record.controls) == 2:
        worse, better = record.controls
        text += f" b: how much more {better} is worth than {worse} (action values, dimensionless)."
    else:
        text += " b: how much more the chosen control is worth than the next best (dimensionless)."
    return text


def check_caption(record: RunRecord, check: PredictiveCheck) -> str:
    """Return the caption of the predictive check."""
    noise = assumed_noise(record)
    word = sensor_word(record).lower()
    sentences = [
        f"a: observation less its expectation at the same {record.step_word}, in standard deviations of what "
        "the twin expects (noise and uncertainty of the state); grey: lost.",
        f"b: share of each {word}'s observations within the 95 % interval.",
        f"c: probability integral transform of all {len(check.transform)} observations.",
        "Grey bands: where 95 % of such figures lie if the twin is right.",
        f"The root mean square of the residuals is {check.standard_deviation:.2f}, and "
        f"{100.0 * check.overall_coverage:.1f} % of all observations lie within their intervals.",
        "A root mean square above 1 means that the noise is larger than assumed, or the model is off.",
    ]
    if np.isfinite(check.coverage).any():
        lowest = int(np.nanargmin(check.coverage))
        title = _small(sensor_title(record, lowest))
        sentences.append(f"Lowest coverage: {title}, {100.0 * check.coverage[lowest]:.0f} %.")
    if noise is not None:
        learnt = "" if record.learnt_noise is None else ", and stands here by what it has learnt of it"
        sentences.append(
            f"The twin assumes a noise of {_noise(record, noise)}{_model_error(record)}{learnt}."
        )
    return " ".join(sentences)


def _small(text: str) -> str:
    return text[:1].lower() + text[1:]


def _noise(record: RunRecord, noise: NDArray[np.floating[Any]]) -> str:
    """Return the assumed standard deviations with their units."""
    if noise.ndim == 0 and not record.sensor_units:
        scale, unit = observation_scale(record)
        return f"{scale * float(noise):.4g} {unit}"
    parts = []
    for sensor, value in enumerate(np.broadcast_to(noise, len(record.sensors)).tolist()):
        scale, unit = observation_scale(record, sensor)
        parts.append(f"{scale * value:.4g} {unit} ({_small(sensor_title(record, sensor))})")
    return ", ".join(parts)


def _model_error(record: RunRecord) -> str:
    error = assumed_model_error(record)
    if error is None:
        return ""
    low, high = 100.0 * float(error.min()), 100.0 * float(error.max())
    share = f"{low:.3g} %" if low == high else f"{low:.3g} to {high:.3g} %"
    return f" and an error of its model of {share} of the predicted value"


def network_caption(record: RunRecord) -> str:
    """Return the caption of the network."""
    decided_from = (
        "the belief predicted from its observation"
        if record.decides_on_prediction
        else "the belief that its observation updated"
    )
    return (
        "Circles are random variables, squares controls, diamonds rewards; grey ones are known at the "
        f"present {record.step_word}. A digital state D follows the one before under the control U in force, "
        "eqs. (28)–(29), and is updated by the observation O, eq. (30); it gives the quantities of interest "
        "Q, and these the rewards R, eqs. (9)–(11). In the prediction, controls follow the policy; in the "
        f"mission, a control is decided at the end of the {record.step_word} before, from {decided_from}. "
        "The physical state S is never seen. Arrows show how information flows; the joint distribution is "
        "that of eqs. (1)–(4)."
    )
