"""The summary of a mission: its results, each with the reference value that the scenario gives."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.json_file import JsonObject
from reporting.words import counted, parameter_title
from twin_master.mission.earnings import return_reference
from twin_master.network.estimator import is_state_believed
from twin_master.network.graphical_model import StateSpace
from twin_master.scenario.schema import REWARD_NAMES, SUMMARY_TITLES, Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import (
    MEAN,
    STANDARD_DEVIATION,
    LearntQuantity,
    MissionResult,
    printed_unit_of_quantity,
    quantity_titles,
)
from twin_master.store.schema import SEVERAL_UNITS

_MOST_CHANGES = 3
"""Largest number of changes of the control that the summary names."""
TRUTH_IS_OFF = 3.0
"""Standard deviations beyond which the flown asset is not the one that was calibrated."""

EntryValue = float | int | str | None


class SummaryGroup(NamedTuple):
    """Entries of the summary that belong together.

    Attributes
    ----------
    name : str
        The name of the group in `SUMMARY_TITLES`, which contains keys, titles and units.
    fields : mapping of str to object
        The values of the fields in braces there.
    values : sequence
        The values of the entries, in the order of the group.
    """

    name: str
    fields: Mapping[str, object]
    values: Sequence[EntryValue]


@dataclass(frozen=True)
class SummaryEntry:
    """One result of a mission.

    Attributes
    ----------
    key : str
        Its name for programs.
    title : str
        Its name for people.
    value : float, int, str or None
        None if the mission gave no value.
    unit : str
        The unit of `value` and `reference`, as printed.
    reference : float, str or None
        The value that the scenario gives to compare with.
    reference_source : str
        Where the reference comes from.
    """

    key: str
    title: str
    value: EntryValue
    unit: str = ""
    reference: float | str | None = None
    reference_source: str = ""


@dataclass(frozen=True)
class Fallback:
    """The fallback of a mission from its initial control to a gentler one.

    Attributes
    ----------
    switch_factor : str or None
        The name of the one state factor that the policy depends on; None if it depends on several
        or on none.
    switch_level : float or None
        The level of this factor, SI, from which on the policy leaves the initial control, that of
        the first step.
    switch_control : int or None
        The index of the control that the policy takes there; None if it takes several.
    step_at_switch_level : int or None
        The first step in which that level, or a higher one, is the nearest to the true state: from
        then on the policy calls for another control.
    fallback_step : int or None
        The first step from then on that is flown with another control.
    early_change_step : int or None
        The first step before then that is flown with another control.
    """

    switch_factor: str | None = None
    switch_level: float | None = None
    switch_control: int | None = None
    step_at_switch_level: int | None = None
    fallback_step: int | None = None
    early_change_step: int | None = None

    @property
    def delay(self) -> int | None:
        """The number of steps from the damage that calls for the fallback to the fallback."""
        if self.fallback_step is None or self.step_at_switch_level is None:
            return None
        return self.fallback_step - self.step_at_switch_level


def find_fallback(
    states: StateSpace,
    policy_index: Index,
    first_control: int,
    control_index: Index,
    true_state: Float,
) -> Fallback:
    """Return when the policy calls for another control than the initial one, and when it is flown.

    A level of the policy stands for all true values that are nearest to it. So the true state calls
    for another control once it passes the middle between the two levels between which the policy
    changes. All steps are counted from the first step of the run.

    T is the number of steps, S the number of states, and F the number of state factors.

    Parameters
    ----------
    policy_index : (S,) array
        The index of the control that the policy takes in each state.
    first_control : int
        The index of the control of the first step.
    control_index : (T,) array
        The index of the control flown in each step.
    true_state : (T, F) array
        The true state, SI.
    """
    switch = find_policy_switch(states, policy_index, first_control)
    if switch is None:
        return Fallback()
    factor = states.factors[switch.factor_index]
    # `slack` lets a true value count as its level if it differs by rounding only
    is_called_for = true_state[:, switch.factor_index] >= switch.least_value - factor.slack
    step_at_switch_level = _first_true(is_called_for)
    has_left = control_index != first_control
    is_at_level = states.coordinates[:, switch.factor_index] >= switch.level - factor.slack
    controls_at_level = np.unique(policy_index[is_at_level]).tolist()
    steps = len(control_index)
    is_before_call = np.ones(steps, dtype=bool)  # if the level is never reached
    if step_at_switch_level is not None:
        is_before_call = np.arange(steps) < step_at_switch_level
    return Fallback(
        factor.name,
        switch.level,
        switch_control=controls_at_level[0] if len(controls_at_level) == 1 else None,
        step_at_switch_level=step_at_switch_level,
        fallback_step=_first_true(has_left & ~is_before_call),
        early_change_step=_first_true(has_left & is_before_call),
    )


def _first_true(condition: NDArray[np.bool_]) -> int | None:
    """Return the first index at which a condition holds; None if it never does."""
    return int(np.argmax(condition)) if condition.any() else None


class PolicySwitch(NamedTuple):
    """The level of a state factor at which a policy leaves a control.

    Attributes
    ----------
    factor_index : int
        The index of the one state factor that the policy depends on.
    level : float
        The level of this factor, SI, from which on the policy takes another control.
    least_value : float
        The least value of this factor, SI, to which that level is the nearest; the level itself if
        it is the lowest.
    """

    factor_index: int
    level: float
    least_value: float


def find_policy_switch(
    states: StateSpace, policy_index: Index, first_control: int
) -> PolicySwitch | None:
    """Find the level of a state factor at and above which a policy leaves its first control.

    The result is None if the policy never leaves it, depends on several factors, or returns to the
    first control at a higher level of the factor.

    Parameters
    ----------
    policy_index : (states,) array
        The index of the control that the policy takes in each state.
    first_control : int
        The index of the first control.
    """
    leaves_first_control = (policy_index != first_control).reshape(
        states.shape
    )  # an axis for each factor
    for axis, factor in enumerate(states.factors):
        # The policy depends on this factor alone if at each of its levels all states agree
        other_axes = tuple(index for index in range(leaves_first_control.ndim) if index != axis)
        leaves_somewhere = leaves_first_control.any(axis=other_axes)
        leaves_everywhere = leaves_first_control.all(axis=other_axes)
        depends_on_factor_alone = np.array_equal(leaves_somewhere, leaves_everywhere)
        level = _first_true(leaves_everywhere)
        if depends_on_factor_alone and level is not None and leaves_everywhere[level:].all():
            level_below = factor.levels[max(level - 1, 0)]
            least_value = 0.5 * (level_below + factor.levels[level])
            return PolicySwitch(axis, float(factor.levels[level]), float(least_value))
    return None


def summarise(
    result: MissionResult,
    reward_mean: Float,
    misfit: Float | None = None,
    first_groups: Iterable[SummaryGroup] = (),
) -> Iterator[SummaryEntry]:
    """Yield the results of a mission for its summary, with reference values where there are any.

    Parameters
    ----------
    reward_mean : (steps, 3) array
        The mean of each reward under the filtered belief, in the order of `REWARD_NAMES`.
    misfit : (states, controls, sensors) array, optional
        The difference of the sensor values of the twin's model to those of the asset, relative to
        the latter; NaN if these are zero. It is given if asset and model are known to differ.
    first_groups : iterable of SummaryGroup
        Groups that come before all others.
    """
    groups = [*first_groups]
    groups += _truth_groups(result) if result.flight.simulated else _watched_groups(result)
    groups += _reward_groups(result, reward_mean)
    groups += _parameter_groups(result)
    groups.append(SummaryGroup("evidence", {}, [float(result.flight.log_evidence.sum())]))
    groups += _learnt_groups(result)
    groups += _observation_groups(result)
    if misfit is not None:
        groups += _misfit_groups(misfit)
    error_bounds = result.flight.monitors.get("strain_error_bound")  # certified, of the asset
    if error_bounds is not None and {*result.scenario.observation.sensor_units} == {"1"}:
        groups.append(SummaryGroup("bound", {}, [1e6 * float(error_bounds.max())]))
    groups += _suspicion_groups(result)
    references = {reference.figure: reference for reference in result.scenario.reference}
    if result.flight.simulated:
        planned_references = return_reference(result.knowledge)
        references = {entry.figure: entry for entry in planned_references} | references
    for group in groups:
        texts = SUMMARY_TITLES[group.name]
        for (key_template, (title, unit)), value in zip(texts.items(), group.values, strict=True):
            key = key_template.format(**group.fields)
            title = title.format(**group.fields)
            unit = unit.format(**group.fields)
            reference = references.get(key)
            if reference is None:
                yield SummaryEntry(key, title, value, unit)
            else:
                yield SummaryEntry(key, title, value, unit, reference.value, reference.source)


def _reward_groups(result: MissionResult, reward_mean: Float) -> Iterator[SummaryGroup]:
    """Yield the mean of each reward over the steps, and what a simulated mission has earned.

    The mean leaves out steps in which the reward is NaN; it is None if these are all. The earnings
    are the discounted return, and the percentages of steps beyond the limit and of needless ones.
    """
    step_name = result.scenario.mission.step_name
    for name, rewards in zip(REWARD_NAMES, reward_mean.T, strict=True):
        finite = rewards[np.isfinite(rewards)]
        mean = float(finite.mean()) if len(finite) else None
        yield SummaryGroup("reward", {"reward": name, "step": step_name}, [mean])
    if result.flight.simulated:
        values = [
            result.discounted_return,
            100.0 * float(np.mean(result.earned.beyond_limit)),
            100.0 * float(np.mean(result.earned.needless)),
        ]
        yield SummaryGroup("earned", {"step": step_name}, values)


def _observation_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield the percentage of lost readings, and the steps without any reading.

    Nothing is yielded if no reading was lost.
    """
    flight = result.flight
    is_received = np.isfinite(flight.observed)
    if is_received.all():
        return
    yield SummaryGroup("lost", {}, [100.0 * float(1.0 - is_received.mean())])
    blind_steps = (flight.first_step + np.flatnonzero(~is_received.any(axis=1))).tolist()
    if blind_steps:
        fields = {"step": result.scenario.mission.step_name}
        yield SummaryGroup("blind", fields, [", ".join(str(step) for step in blind_steps)])


def _misfit_groups(misfit: Float) -> Iterator[SummaryGroup]:
    """Yield the root mean square and the largest value of a misfit, in percent.

    Parameters
    ----------
    misfit : (states, controls, sensors) array
        The relative difference of the twin's model to the asset; NaN if it is not defined.
    """
    is_known = np.isfinite(misfit)
    if not is_known.any():
        return
    largest_of_sensor = np.max(np.abs(misfit), axis=(0, 1), where=is_known, initial=0.0)
    sensor = int(np.argmax(largest_of_sensor))
    rms = float(np.sqrt(np.mean(misfit[is_known] ** 2)))
    percent = [100.0 * rms, 100.0 * float(largest_of_sensor[sensor])]
    yield SummaryGroup("misfit", {"sensor": sensor + 1}, percent)


def _suspicion_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield the step of the first alarm, and the suspicion after the last step.

    Nothing is yielded if the twin does not test its model (`notice` is off).
    """
    flight = result.flight
    if not flight.suspicion:
        return
    last_suspicion = flight.suspicion[-1]
    alarm_steps = [step for step, notice in flight.notices if notice.kind == "alarm"]
    values = [
        alarm_steps[0] if alarm_steps else None,
        last_suspicion.none_of_these,
        last_suspicion.gauge_off,
        last_suspicion.decided_by,
    ]
    yield SummaryGroup("notice", {"step": result.scenario.mission.step_name}, values)


def _parameter_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield mean and standard deviation of the calibrated parameter.

    If the parameter was learnt in flight, these are the moments after and before the flight, with
    the true value if it is known; otherwise only those before the flight.
    """
    draws = result.knowledge.draws
    title = parameter_title(draws.name)
    prior = [draws.mean, draws.standard_deviation]
    learnt_parameters = [quantity for quantity in result.learnt if quantity.name == draws.name]
    if not learnt_parameters:
        is_measured = result.scenario.calibration.source in ("static_test", "file")
        fields = {
            "parameter": draws.name,
            "whose": "posterior " if is_measured else "",
            "of": f"the {title}" if " " in title else title,
        }
        yield SummaryGroup("parameter", fields, prior)
        return
    parameter = learnt_parameters[0]
    fields = {"parameter": draws.name, "label": title}
    last_moments = parameter.posterior[-1]
    moments = [float(last_moments[MEAN]), float(last_moments[STANDARD_DEVIATION])]
    yield SummaryGroup("parameter_learnt", fields, [*moments, *prior])
    if parameter.truth is not None:
        yield SummaryGroup("parameter_true", fields, [float(parameter.truth)])


def _learnt_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield the groups of all learnt quantities other than the calibrated parameter."""
    for quantity in result.learnt:
        if quantity.is_per_sensor:
            yield _group_of_sensors(result, quantity)
        elif quantity.name != result.scenario.calibration.parameter:
            factor, unit = printed_unit_of_quantity(quantity.name, quantity.unit, result.scenario)
            fields = {
                "quantity": quantity.name,
                "title": quantity_titles(quantity.name).short,
                "unit": unit,
            }
            last_moments = factor * quantity.posterior[-1]
            values = [float(last_moments[MEAN]), float(last_moments[STANDARD_DEVIATION])]
            yield SummaryGroup("learnt", fields, values)


def _group_of_sensors(result: MissionResult, quantity: LearntQuantity) -> SummaryGroup:
    """Return the group of a learnt quantity that has a value for each sensor.

    Its entries are the mean over the sensors, and the value of the sensor whose posterior mean
    differs most from its prior mean, in posterior standard deviations.
    """
    observation = result.scenario.observation
    factor, unit = printed_unit_of_quantity(quantity.name, quantity.unit, result.scenario)
    # The moments after the last step, in printed units, with a row for each sensor
    last_moments = factor * quantity.posterior[-1]
    last_mean = last_moments[:, MEAN]
    last_deviation = last_moments[:, STANDARD_DEVIATION]
    sensor = quantity.most_departed_sensor
    mean_of_sensors: float | None = float(np.nanmean(last_mean))
    if quantity.unit == SEVERAL_UNITS:  # sensors of different units have no mean
        mean_of_sensors = None
        unit = observation.sensor_units[sensor]
    fields = {
        "quantity": quantity.name,
        "title": quantity_titles(quantity.name).short,
        "unit": unit,
        "sensor": observation.word,
        "most": f"{sensor + 1}",
    }
    values = [mean_of_sensors, float(last_mean[sensor]), float(last_deviation[sensor])]
    return SummaryGroup("learnt_of_sensors", fields, values)


def notice_record(result: MissionResult) -> JsonObject:
    """Return the entry `notices` of the summary; empty if the twin gives no notices."""
    if result.scenario.notice is None and not result.flight.notices:
        return {}
    notices = []
    for step, notice in result.flight.notices:
        notices.append({"step": step, **notice.as_record()})
    return {"notices": notices}


def _truth_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield the groups that need the true state: the fallback, and the error of each factor."""
    scenario = result.scenario
    flight = result.flight
    knowledge = result.knowledge
    fallback = find_fallback(
        knowledge.model.states,
        knowledge.plan.control_index,
        scenario.control_names.index(scenario.mission.first_control),
        flight.control_index,
        flight.state,
    )
    yield fallback_group(fallback, scenario)
    error_of_mean = knowledge.model.states.mean(flight.filtered) - flight.state  # (T, F)
    rms_error = np.sqrt(np.mean(error_of_mean**2, axis=0))
    for factor, error in zip(scenario.state, rms_error.tolist(), strict=True):
        scale, unit = printed_state(factor.unit, "percentage points")
        fields = {"state": factor.name, "title": factor.title or factor.name, "unit": unit}
        yield SummaryGroup("error", fields, [scale * error])


def _watched_groups(result: MissionResult) -> Iterator[SummaryGroup]:
    """Yield the last estimate of a watched asset; its values are None if no state is believed."""
    states = result.knowledge.model.states
    belief = result.flight.filtered[-1]
    is_believed = is_state_believed(float(result.flight.unexplained[-1]))
    means = states.mean(belief)
    deviations = states.standard_deviation(belief)
    for factor, mean, deviation in zip(result.scenario.state, means, deviations, strict=True):
        scale, unit = printed_state(factor.unit)
        values: list[EntryValue] = [None, None]
        if is_believed:
            values = [float(scale * mean), float(scale * deviation)]
        fields = {"state": factor.name, "title": factor.title or factor.name, "unit": unit}
        yield SummaryGroup("last", fields, values)


def control_changes(
    controls: Sequence[str], control_index: Index, step_name: str, first_step: int = 0
) -> str:
    """Return a description of the changes of control, such as "left 3g for 2g at step 31".

    Parameters
    ----------
    controls : sequence of str
        The names of the controls.
    control_index : (steps,) array
        The index of the control in each step.
    step_name : str
        The word for a step, such as "turn".
    first_step : int
        The number of the first step.
    """
    # The steps whose control differs from that of the step before
    steps = (np.flatnonzero(np.diff(control_index)) + 1).tolist()
    if not steps:
        return f"flew {controls[int(control_index[0])]} at every {step_name}"
    changes = []
    for step in steps[:_MOST_CHANGES]:
        previous_control = controls[int(control_index[step - 1])]
        control = controls[int(control_index[step])]
        changes.append(f"left {previous_control} for {control} at {step_name} {first_step + step}")
    sentence = ", ".join(changes)
    further_changes = len(steps) - len(changes)
    if further_changes > 0:
        sentence += f", and {counted(further_changes, 'more change')}"
    return sentence


def fallback_group(fallback: Fallback, scenario: Scenario) -> SummaryGroup:
    """Return level, steps and delay of a fallback as a group of the summary.

    If the policy does not depend on exactly one state factor, the group has a single entry that
    says so.
    """
    level = fallback.switch_level
    first_control = scenario.mission.first_control
    if fallback.switch_factor is None or level is None:
        return SummaryGroup("nowhere", {"first": first_control}, ["no single one"])
    factor = scenario.state[scenario.state_names.index(fallback.switch_factor)]
    scale, unit = printed_state(factor.unit)
    new_control = "another control"
    if fallback.switch_control is not None:
        new_control = scenario.control_names[fallback.switch_control]
    fallback_step = fallback.fallback_step
    delay = fallback.delay
    if fallback.early_change_step is not None and delay == 0:
        # The other control was in force before the damage: this is not a fallback from it.
        fallback_step = None
        delay = None
    step = scenario.mission.step_name
    steps = step if delay == 1 else f"{step}s"
    fields = {
        "title": factor.title or factor.name,
        "first": first_control,
        "new": new_control,
        "unit": unit,
        "step": step,
        "steps": steps,
    }
    values = [
        scale * level,
        fallback.step_at_switch_level,
        fallback_step,
        delay,
        fallback.early_change_step,
    ]
    return SummaryGroup("fallback", fields, values)


def truth_mismatch(
    parameter: str, truth: float, mean: float, standard_deviation: float
) -> str | None:
    """Return a warning if the true parameter contradicts the calibration of the twin, else None.

    It does if it differs from the calibrated mean by more than `TRUTH_IS_OFF` standard deviations.

    Parameters
    ----------
    parameter : str
        The name of the calibrated parameter.
    truth : float
        Its true value in the flown asset.
    mean, standard_deviation : float
        The moments of its calibration.
    """
    difference = abs(truth - mean)
    if difference <= TRUTH_IS_OFF * standard_deviation or standard_deviation <= 0.0:
        return None
    return (
        f"The true {parameter_title(parameter)} of the asset flown is {truth:.5g}, "
        f"{difference / standard_deviation:.1f} standard deviations from the {mean:.5g} ± "
        f"{standard_deviation:.2g} that the twin was calibrated with: it flies with the model of "
        "another asset."
    )
