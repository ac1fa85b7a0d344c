"""The figures of a mission, each beside the one that the scenario gives as its reference."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.words import parameter_title
from twin_master.network.graphical_model import GraphicalModel, StateSpace
from twin_master.scenario.schema import (
    FALLBACK_FIGURES,
    MISFIT_FIGURES,
    NOTICE_FIGURES,
    REWARD_NAMES,
    Scenario,
)
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import MissionResult, printed_learnt, titles_of

_TOLERANCE = 1e-9
_CHANGES_SAID = 3

TRUTH_IS_OFF = 3.0
"""Standard deviations beyond which the asset flown is not the one that was calibrated."""


@dataclass(frozen=True)
class Figure:
    """One figure of a mission.

    Attributes
    ----------
    key : str
        Name for programs.
    title : str
        Name for people.
    value : float, int, str or None
        The figure; None where the mission gave none.
    unit : str
        Unit of `value` and `reference`, as printed.
    reference : float, str or None
        What the scenario gives to compare it with.
    reference_source : str
        Where that comes from.
    """

    key: str
    title: str
    value: float | int | str | None
    unit: str = ""
    reference: float | str | None = None
    reference_source: str = ""


@dataclass(frozen=True)
class Fallback:
    """How the control fell back to the gentler one.

    Attributes
    ----------
    switch_state : str or None
        The state factor on which the policy alone depends; None if it depends on several or on none.
    switch_level : float or None
        Its level, SI, from which on the policy leaves the first control.
    called_for_step : int or None
        First step in which the true state reaches that level.
    fallback_step : int or None
        First step from then on that is flown with another control.
    early_step : int or None
        First step before that, if any, that is flown with another control.
    """

    switch_state: str | None = None
    switch_level: float | None = None
    called_for_step: int | None = None
    fallback_step: int | None = None
    early_step: int | None = None

    @property
    def delay(self) -> int | None:
        """Steps from the damage that calls for it to the fallback."""
        if self.fallback_step is None or self.called_for_step is None:
            return None
        return self.fallback_step - self.called_for_step


def find_fallback(
    states: StateSpace, policy_index: Index, first_control: int, control_index: Index, true_state: Float
) -> Fallback:
    """Return how the control fell back.

    Parameters
    ----------
    states
        The state space.
    policy_index : (S,)
        Control of the policy in each state.
    first_control
        Index of the control of the first step.
    control_index : (T,)
        Controls flown.
    true_state : (T, F)
        True state, SI.
    """
    switch = policy_switch(states, policy_index, first_control)
    if switch is None:
        return Fallback()
    axis, level = switch
    called = _first(true_state[:, axis] >= level - _TOLERANCE)
    left = control_index != first_control
    before = np.arange(len(left)) < (len(left) if called is None else called)
    return Fallback(states.factors[axis].name, level, called, _first(left & ~before), _first(left & before))


def _first(where: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(where)) if where.any() else None


def policy_switch(states: StateSpace, policy_index: Index, first_control: int) -> tuple[int, float] | None:
    """Return the factor on which alone a policy depends, and the level from which on it leaves a control.

    None where it depends on several factors or on none, or comes back to that control at a higher level.
    """
    table = (policy_index != first_control).reshape(states.shape)
    for axis, factor in enumerate(states.factors):
        others = tuple(index for index in range(table.ndim) if index != axis)
        any_of, all_of = table.any(axis=others), table.all(axis=others)
        first = _first(all_of)
        if np.array_equal(any_of, all_of) and first is not None and all_of[first:].all():
            return axis, float(factor.levels[first])
    return None


def filtered_rms_error(model: GraphicalModel, filtered: Float, true_state: Float) -> Float:
    """Return the root mean square error of the filtered mean of each factor over the steps: (F,), SI."""
    error = model.states.mean(filtered) - true_state
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def summarise(result: MissionResult, reward_mean: Float, misfit: Float | None = None) -> tuple[Figure, ...]:
    """Return the figures of a mission; all of them are the same for the same seed.

    Parameters
    ----------
    result
        The mission.
    reward_mean : (T, R)
        Mean rewards under the filtered belief.
    misfit
        Of the twin's model, (S, U, G), a share of what the asset shows, NaN where it shows nothing; where the
        asset is known to be another one.
    """
    scenario, flight = result.scenario, result.flight
    step = scenario.mission.step_name
    figures = _scored(result) if flight.simulated else _watched(result)
    for name, rewards in zip(REWARD_NAMES, reward_mean.T, strict=True):
        known = rewards[np.isfinite(rewards)]
        mean = float(known.mean()) if len(known) else None
        figures.append(Figure(f"mean_reward_{name}", f"mean reward for {name}", mean))
    figures += _parameter_figures(result)
    evidence = float(flight.log_evidence.sum())
    figures.append(Figure("log_evidence", "log evidence of all observations", evidence))
    figures += _learnt_figures(result)
    figures += _sensor_figures(flight.observed, step)
    if misfit is not None:
        worst = np.nanmax(np.abs(misfit), axis=(0, 1))
        sensor = int(np.nanargmax(worst))
        told_rms = (
            "misfit of the twin's model, rms over sensors and states",
            float(np.sqrt(np.nanmean(misfit**2))),
        )
        shares = told_rms, (f"largest misfit, at sensor {sensor + 1}", float(worst[sensor]))
        for key, (title, share) in zip(MISFIT_FIGURES, shares, strict=True):
            figures.append(Figure(key, title, 100.0 * share, "%"))
    bound = flight.monitors.get("strain_error_bound")
    if bound is not None and set(scenario.observation.sensor_units) == {"1"}:
        worst = 1e6 * float(bound.max())
        figures.append(Figure("strain_error_bound", "worst certified strain error", worst, "microstrain"))
    if flight.suspicion:
        last = flight.suspicion[-1]
        first = next((turn for turn, notice in flight.notices if notice.kind == "alarm"), None)
        told: tuple[tuple[str, float | str | None], ...] = (
            (f"{step} of the first alarm", first),
            ("probability that no state explains the sensors", last.none_of_these),
            ("probability that a single sensor is off", last.gauge_off),
            ("the last control is decided by", last.decided_by),
        )
        figures += [Figure(key, *one) for key, one in zip(NOTICE_FIGURES, told, strict=True)]
    references = {entry.figure: entry for entry in scenario.reference}
    return tuple(
        replace(figure, reference=found.value, reference_source=found.source)
        if (found := references.get(figure.key))
        else figure
        for figure in figures
    )


def _parameter_figures(result: MissionResult) -> list[Figure]:
    """Return what is known of the calibrated parameter before the flight, and after it where it is learnt."""
    draws = result.knowledge.draws
    name, label = draws.name, parameter_title(draws.name)
    before = {"mean": draws.mean, "standard_deviation": draws.standard_deviation}
    own = next((quantity for quantity in result.learnt if quantity.name == name), None)
    if own is None:
        measured = result.scenario.calibration.source in ("static_test", "file")
        whose, of = "posterior " if measured else "", label if " " not in label else f"the {label}"
        return [
            Figure(f"{name}_{moment}", f"{whose}{moment.replace('_', ' ')} of {of}", value)
            for moment, value in before.items()
        ]
    after = dict(zip(before, own.course[-1, :2].tolist(), strict=True))
    figures = [
        Figure(f"{name}_{key}{moment}", f"{label} {when}, {moment.replace('_', ' ')}", value)
        for key, when, moments in (("", "learnt", after), ("prior_", "before the first turn", before))
        for moment, value in moments.items()
    ]
    if own.truth is not None:
        figures.append(Figure(f"{name}_true", f"{label}, true", float(own.truth)))
    return figures


def _learnt_figures(result: MissionResult) -> list[Figure]:
    """Return what was learnt beside the parameter; the sensor that departs most stands for all of them."""
    figures = []
    sensor_word = "gauge" if result.scenario.observation.role == "strain" else "sensor"
    for quantity in result.learnt:
        if quantity.name == result.scenario.calibration.parameter:
            continue
        factor, unit = printed_learnt(quantity.name, quantity.unit)
        word, last = f"{titles_of(quantity.name)[2]} learnt", factor * quantity.course[-1]
        if quantity.of_sensors:
            departure = np.abs(last[:, 0] - factor * quantity.prior[:, 0]) / last[:, 1]
            most = int(np.nanargmax(departure))
            mean = f"{word}, mean of the {sensor_word}s"
            figures.append(Figure(f"{quantity.name}_mean", mean, float(np.nanmean(last[:, 0])), unit))
            key, of, shown = f"{quantity.name}_most", f"{sensor_word} {most + 1}", last[most]
            figures.append(Figure(key, f"{word}, {of} (departs most)", float(shown[0]), unit))
        else:
            key, of, shown = quantity.name, "", last
            figures.append(Figure(f"{key}_mean", f"{word}, mean", float(shown[0]), unit))
        deviation = ", ".join(part for part in (word, of, "standard deviation") if part)
        figures.append(Figure(f"{key}_standard_deviation", deviation, float(shown[1]), unit))
    return figures


def noticed(result: MissionResult) -> dict[str, Any]:
    """Return what the operator was told, `notices`, for the summary; nothing where nothing is watched."""
    if result.scenario.notice is None and not result.flight.notices:
        return {}
    return {"notices": [{"turn": turn} | notice.as_record() for turn, notice in result.flight.notices]}


def _scored(result: MissionResult) -> list[Figure]:
    """Return the figures that need the truth: how the control fell back, and errors of the estimate."""
    scenario, flight, known = result.scenario, result.flight, result.knowledge
    first, step = scenario.control_names.index(scenario.mission.first_control), scenario.mission.step_name
    policy, states = known.plan.control_index, known.model.states
    figures = _fallback_figures(
        find_fallback(states, policy, first, flight.control_index, flight.state), scenario, step
    )
    errors = filtered_rms_error(known.model, flight.filtered, flight.state)
    for factor, error in zip(scenario.state, errors.tolist(), strict=True):
        scale, unit = printed_state(factor.unit, "points")
        key, title = f"filtered_rms_error_{factor.name}", f"filtered rms error of {factor.name}"
        figures.append(Figure(key, title, scale * error, unit))
    return figures


def _watched(result: MissionResult) -> list[Figure]:
    """Return the figures of a watched asset: what is believed of it now."""
    states, belief = result.knowledge.model.states, result.flight.filtered[-1]
    moments = {"mean": states.mean(belief), "standard_deviation": states.standard_deviation(belief)}
    figures = []
    for index, factor in enumerate(result.scenario.state):
        scale, unit = printed_state(factor.unit)
        for moment, values in moments.items():
            title = f"last {moment.replace('_', ' ')} of {factor.name}"
            key = f"last_{moment}_{factor.name}"
            figures.append(Figure(key, title, scale * float(values[index]), unit))
    return figures


def control_changes(
    controls: Sequence[str], control_index: Index, step_name: str, first_step: int = 0
) -> str:
    """Return in words when which control was left for which: ``left 3g for 2g at turn 31``.

    Parameters
    ----------
    controls : (U,)
        Names of the controls.
    control_index : (T,)
        Controls flown.
    step_name : str
        What a step is called.
    first_step : int
        Number of the first one.
    """
    steps = (np.flatnonzero(np.diff(control_index)) + 1).tolist()
    if not steps:
        return f"flew {controls[int(control_index[0])]} at every {step_name}"
    changes = [
        f"left {controls[int(control_index[step - 1])]} for {controls[int(control_index[step])]} "
        f"at {step_name} {first_step + step}"
        for step in steps[:_CHANGES_SAID]
    ]
    more = len(steps) - len(changes)
    return ", ".join(changes) + (f", and {more} more change{'s' if more > 1 else ''}" if more else "")


def _fallback_figures(fallback: Fallback, scenario: Scenario, step: str) -> list[Figure]:
    name, level = fallback.switch_state, fallback.switch_level
    if name is None or level is None:
        title = "policy leaves the first control"
        return [Figure(FALLBACK_FIGURES[0], title, "nowhere, or by several states")]
    scale, unit = printed_state(scenario.state[scenario.state_names.index(name)].unit)
    if fallback.early_step is not None and fallback.delay == 0:  # in force since before the damage
        fallback = replace(fallback, fallback_step=None)
    delay = fallback.delay
    told: tuple[tuple[str, float | None, str], ...] = (
        (f"policy leaves the first control from {name}", scale * level, unit),
        (f"{step} of the damage that calls for it", fallback.called_for_step, ""),
        (f"{step} of the fallback", fallback.fallback_step, ""),
        ("delay of the fallback", delay, step if delay == 1 else f"{step}s"),
        (f"{step} of a fallback before the damage", fallback.early_step, ""),
    )
    return [Figure(key, *one) for key, one in zip(FALLBACK_FIGURES, told, strict=True)]


def _sensor_figures(observed: Float, step_name: str) -> list[Figure]:
    received = np.isfinite(observed)
    if received.all():
        return []
    figures = [Figure("lost_observations", "observations lost", 100.0 * float(1.0 - received.mean()), "%")]
    if blind := np.flatnonzero(~received.any(axis=1)).tolist():
        title = f"{step_name}s without any observation (belief follows the dynamics)"
        figures.append(Figure("blind_steps", title, ", ".join(map(str, blind))))
    return figures


def another_truth(parameter: str, truth: float, mean: float, deviation: float) -> str | None:
    """Return what to say of an asset whose truth is far off what its twin was calibrated with, or None."""
    off = abs(truth - mean)
    if off <= TRUTH_IS_OFF * deviation or deviation <= 0.0:
        return None
    return (
        f"The true {parameter_title(parameter)} of the asset flown is {truth:.5g}, {off / deviation:.1f} "
        f"standard deviations from the {mean:.5g} ± {deviation:.2g} that the twin was calibrated with: it "
        "flies with the model of another asset."
    )
