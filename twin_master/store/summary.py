"""The figures of a mission, each beside the one that the scenario gives as its reference."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.words import counted, parameter_title
from twin_master.network.estimator import is_state_believed
from twin_master.network.graphical_model import GraphicalModel, StateSpace
from twin_master.scenario.schema import FIGURES, REWARD_NAMES, Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import SEVERAL_UNITS, MissionResult, printed_learnt, titles_of

_CHANGES_SAID = 3

Words = Mapping[str, object]
Told = tuple[str, Words, Sequence[float | int | str | None]]
"""A group of figures, what stands in its braces, and the values."""
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
    called = _first(true_state[:, axis] >= level - states.factors[axis].slack)
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


def summarise(
    result: MissionResult, reward_mean: Float, misfit: Float | None = None, before: Iterable[Told] = ()
) -> Iterator[Figure]:
    """Yield the figures of a mission; all of them are the same for the same seed.

    Parameters
    ----------
    result
        The mission.
    reward_mean : (T, R)
        Mean rewards under the filtered belief.
    misfit
        Of the twin's model, (S, U, G), a share of what the asset shows, NaN where it shows nothing; where the
        asset is known to be another one.
    before
        What is told before them.
    """
    flight, step_word = result.flight, {"step": result.scenario.mission.step_name}
    told = [*before, *(_scored(result) if flight.simulated else _watched(result))]
    for name, rewards in zip(REWARD_NAMES, reward_mean.T, strict=True):
        known = rewards[np.isfinite(rewards)]
        told.append(("reward", {"reward": name}, [float(known.mean()) if len(known) else None]))
    told += _of_the_parameter(result)
    told.append(("evidence", {}, [float(flight.log_evidence.sum())]))
    told += _learnt(result)
    received = np.isfinite(flight.observed)
    if not received.all():
        told.append(("lost", {}, [100.0 * float(1.0 - received.mean())]))
        if blind := (flight.first_step + np.flatnonzero(~received.any(axis=1))).tolist():
            told.append(("blind", step_word, [", ".join(map(str, blind))]))
    if misfit is not None and (known := np.isfinite(misfit)).any():
        worst = np.max(np.abs(misfit), axis=(0, 1), where=known, initial=0.0)
        sensor, rms = int(np.argmax(worst)), float(np.sqrt(np.mean(misfit[known] ** 2)))
        told.append(("misfit", {"sensor": sensor + 1}, [100.0 * rms, 100.0 * float(worst[sensor])]))
    bound = flight.monitors.get("strain_error_bound")
    if bound is not None and {*result.scenario.observation.sensor_units} == {"1"}:
        told.append(("bound", {}, [1e6 * float(bound.max())]))
    if flight.suspicion:
        last = flight.suspicion[-1]
        first = next((step for step, notice in flight.notices if notice.kind == "alarm"), None)
        told.append(("notice", step_word, [first, last.none_of_these, last.gauge_off, last.decided_by]))
    references = {entry.figure: (entry.value, entry.source) for entry in result.scenario.reference}
    for group, words, values in told:
        for (key, (title, unit)), value in zip(FIGURES[group].items(), values, strict=True):
            name = key.format(**words)
            reference = references.get(name, ())
            yield Figure(name, title.format(**words), value, unit.format(**words), *reference)


def _of_the_parameter(result: MissionResult) -> Iterator[Told]:
    """Yield what is known of the calibrated parameter before the flight, and after it where it is learnt."""
    draws = result.knowledge.draws
    label, before = parameter_title(draws.name), [draws.mean, draws.standard_deviation]
    words = {"parameter": draws.name, "label": label}
    own = next((quantity for quantity in result.learnt if quantity.name == draws.name), None)
    if own is None:
        measured = result.scenario.calibration.source in ("static_test", "file")
        words |= {"whose": "posterior " * measured, "of": f"the {label}" if " " in label else label}
        yield "parameter", words, before
        return
    yield "parameter_learnt", words, [*own.course[-1, :2].tolist(), *before]
    if own.truth is not None:
        yield "parameter_true", words, [float(own.truth)]


def _learnt(result: MissionResult) -> Iterator[Told]:
    """Yield what was learnt beside the parameter; the sensor that departs most stands for all of them."""
    observation = result.scenario.observation
    for quantity in result.learnt:
        factor, unit = printed_learnt(quantity.name, quantity.unit, result.scenario)
        last, title = factor * quantity.course[-1], titles_of(quantity.name)[2]
        words = {"quantity": quantity.name, "title": title, "unit": unit, "sensor": observation.word}
        if quantity.of_sensors:
            departure = np.abs(last[:, 0] - factor * quantity.prior[:, 0]) / last[:, 1]
            most = int(np.nanargmax(departure))
            values = [float(np.nanmean(last[:, 0])), *last[most, :2].tolist()]
            if quantity.unit == SEVERAL_UNITS:  # they have no mean
                words["unit"], values[0] = observation.sensor_units[most], None
            yield "learnt_of_sensors", words | {"most": f"{most + 1}"}, values
        elif quantity.name != result.scenario.calibration.parameter:
            yield "learnt", words, last[:2].tolist()


def noticed(result: MissionResult) -> dict[str, Any]:
    """Return what the operator was told, `notices`, for the summary; nothing where nothing is watched."""
    if result.scenario.notice is None and not result.flight.notices:
        return {}
    return {"notices": [{"step": step} | notice.as_record() for step, notice in result.flight.notices]}


def _scored(result: MissionResult) -> Iterator[Told]:
    """Yield the figures that need the truth: how the control fell back, and errors of the estimate."""
    scenario, flight, known = result.scenario, result.flight, result.knowledge
    first, policy = scenario.control_names.index(scenario.mission.first_control), known.plan.control_index
    yield of_fallback(
        find_fallback(known.model.states, policy, first, flight.control_index, flight.state), scenario
    )
    errors = filtered_rms_error(known.model, flight.filtered, flight.state)
    for factor, error in zip(scenario.state, errors.tolist(), strict=True):
        scale, unit = printed_state(factor.unit, "points")
        yield "error", {"state": factor.name, "unit": unit}, [scale * error]


def _watched(result: MissionResult) -> Iterator[Told]:
    """Yield the figures of a watched asset: what is believed of it now; None where no state is."""
    states, belief = result.knowledge.model.states, result.flight.filtered[-1]
    moments = np.transpose((states.mean(belief), states.standard_deviation(belief)))
    for factor, values in zip(result.scenario.state, moments, strict=True):
        scale, unit = printed_state(factor.unit)
        believed = is_state_believed(float(result.flight.unexplained[-1]))
        figures: list[Any] = (scale * values).tolist() if believed else [None, None]
        yield "last", {"state": factor.name, "unit": unit}, figures


def control_changes(
    controls: Sequence[str], control_index: Index, step_name: str, first_step: int = 0
) -> str:
    """Return in words when which control was left for which: ``left 3g for 2g at step 31``.

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
    return ", ".join(changes) + (f", and {counted(more, 'more change')}" if more else "")


def of_fallback(fallback: Fallback, scenario: Scenario) -> Told:
    """Return the figures that say how the control fell back."""
    name, level, delay = fallback.switch_state, fallback.switch_level, fallback.delay
    if name is None or level is None:
        return "nowhere", {}, ["nowhere, or by several states"]
    scale, unit = printed_state(scenario.state[scenario.state_names.index(name)].unit)
    fell = fallback.fallback_step
    if fallback.early_step is not None and delay == 0:  # in force since before the damage
        fell = delay = None
    step = scenario.mission.step_name
    words = {"state": name, "unit": unit, "step": step, "steps": step if delay == 1 else f"{step}s"}
    return "fallback", words, [scale * level, fallback.called_for_step, fell, delay, fallback.early_step]


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
