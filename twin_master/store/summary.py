"""The figures of a mission, each beside the one that the scenario gives as its reference."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.words import parameter_title
from twin_master.assets.mismatch import Misfit
from twin_master.assets.parameter import ParameterDraws
from twin_master.mission.loop import Flight
from twin_master.mission.plant import PlantRecord
from twin_master.network.graphical_model import GraphicalModel, StateSpace
from twin_master.network.rewards import REWARD_NAMES
from twin_master.scenario.schema import FALLBACK_FIGURES, MISFIT_FIGURES, NOTICE_FIGURES, Reference
from twin_master.store.learnt import printed_learnt
from twin_master.store.mission_result import MissionResult

Float = NDArray[np.float64]
Index = NDArray[np.int64]

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
        The state factor on which alone the policy depends; None if it depends on several or none.
    switch_level : float or None
        Level of that factor from which the policy leaves the control of the first turn, SI.
    called_for_step : int or None
        First step at which the truth reaches that level.
    fallback_step : int or None
        First step from `called_for_step` on at which another control than that of the first turn is in force.
    early_step : int or None
        First step before `called_for_step` with another control.
    """

    switch_state: str | None
    switch_level: float | None
    called_for_step: int | None
    fallback_step: int | None
    early_step: int | None

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
    states : StateSpace
        S states of F factors.
    policy_index : (S,)
        Control of the policy in each state.
    first_control : int
        Control of the first turn.
    control_index : (T,)
        Controls flown.
    true_state : (T, F)
        True state, SI.
    """
    switch = policy_switch(states, policy_index, first_control)
    if switch is None:
        return Fallback(None, None, None, None, None)
    axis, level = switch
    return _fallback_of(states.factors[axis].name, level, first_control, control_index, true_state[:, axis])


def policy_switch(states: StateSpace, policy_index: Index, first_control: int) -> tuple[int, float] | None:
    """Return the factor on which alone a policy depends, and the level from which on it leaves a control.

    Parameters
    ----------
    states, policy_index, first_control
        As of `find_fallback`.

    Returns
    -------
    (int, float) or None
        None where the policy depends on several factors or none, or returns to the control. The level is SI.
    """
    table = (policy_index != first_control).reshape(states.shape)
    for axis, factor in enumerate(states.factors):
        others = tuple(index for index in range(table.ndim) if index != axis)
        any_of, all_of = table.any(axis=others), table.all(axis=others)
        switched = np.flatnonzero(all_of)
        if np.array_equal(any_of, all_of) and len(switched) and all_of[switched[0] :].all():
            return axis, float(factor.levels[switched[0]])
    return None


def _fallback_of(name: str, level: float, first_control: int, control_index: Index, truth: Float) -> Fallback:
    reached = np.flatnonzero(truth >= level - _TOLERANCE)
    other = np.flatnonzero(control_index != first_control)
    called = int(reached[0]) if len(reached) else None
    before = other[other < called] if called is not None else other
    after = other[other >= called] if called is not None else other[:0]
    return Fallback(
        switch_state=name,
        switch_level=level,
        called_for_step=called,
        fallback_step=int(after[0]) if len(after) else None,
        early_step=int(before[0]) if len(before) else None,
    )


def filtered_rms_error(model: GraphicalModel, filtered: Float, true_state: Float) -> Float:
    """Return the root mean square error of the filtered mean of each factor over the steps: (F,), SI."""
    error = model.states.mean(filtered) - true_state
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def summarise(
    result: MissionResult, draws: ParameterDraws, reward_mean: Float, misfit: Misfit | None = None
) -> tuple[Figure, ...]:
    """Return the figures of a mission; all of them are the same for the same seed.

    Parameters
    ----------
    result
        The mission.
    draws
        The calibrated parameter.
    reward_mean : (T, R)
        Mean rewards under the filtered belief.
    misfit
        Of the twin's model, where the asset is known to be another one.
    """
    scenario, flight = result.scenario, result.flight
    figures = _scored(result, flight.truth) if flight.truth is not None else _watched(result)
    for index, name in enumerate(REWARD_NAMES):
        known = reward_mean[np.isfinite(reward_mean[:, index]), index]
        mean = float(known.mean()) if len(known) else None
        figures.append(Figure(f"mean_reward_{name}", f"mean reward for {name}", mean))
    figures += _parameter_figures(result, draws)
    figures.append(
        Figure("log_evidence", "log evidence of all observations", float(flight.log_evidence.sum()))
    )
    figures += _learnt_figures(result)
    figures += _sensor_figures(flight.observed, scenario.mission.step_name)
    if misfit is not None:
        figures += _misfit_figures(misfit)
    bound = None if flight.truth is None else flight.truth.monitors.get("strain_error_bound")
    if bound is not None and set(scenario.observation.sensor_units) == {"1"}:
        figures.append(
            Figure(
                "strain_error_bound", "worst certified strain error", 1e6 * float(bound.max()), "microstrain"
            )
        )
    if flight.suspicion:
        figures += _notice_figures(flight, scenario.mission.step_name)
    references = {entry.figure: entry for entry in scenario.reference}
    return tuple(_beside(figure, references.get(figure.key)) for figure in figures)


def _parameter_figures(result: MissionResult, draws: ParameterDraws) -> list[Figure]:
    """Return what is known of the calibrated parameter before the flight, and after it where it is learnt."""
    name, label = draws.name, parameter_title(draws.name)
    own = next((quantity for quantity in result.learnt if quantity.name == name), None)
    if own is None:
        measured = result.scenario.calibration.source in ("static_test", "file")
        whose, of = "posterior " if measured else "", label if " " not in label else f"the {label}"
        mean, deviation = f"{whose}mean of {of}", f"{whose}standard deviation of {of}"
        return [
            Figure(f"{name}_mean", mean, draws.mean),
            Figure(f"{name}_standard_deviation", deviation, draws.standard_deviation),
        ]
    mean, deviation = own.course[-1, :2].tolist()
    figures = [
        Figure(f"{name}_mean", f"{label} learnt, mean", mean),
        Figure(f"{name}_standard_deviation", f"{label} learnt, standard deviation", deviation),
        Figure(f"{name}_prior_mean", f"{label} before the first turn, mean", draws.mean),
        Figure(
            f"{name}_prior_standard_deviation",
            f"{label} before the first turn, standard deviation",
            draws.standard_deviation,
        ),
    ]
    if own.truth is not None:
        figures.append(Figure(f"{name}_true", f"{label}, true", float(own.truth)))
    return figures


_LEARNT_WORDS = {
    "noise_scale": "noise factor",
    "gauge_offset": "offset",
    "gauge_gain": "gain error",
    "transition_factor": "transition factor",
}


def _learnt_figures(result: MissionResult) -> list[Figure]:
    """Return what was learnt beside the parameter; the sensor that departs most stands for all of them."""
    figures = []
    sensor_word = "gauge" if result.scenario.observation.role == "strain" else "sensor"
    for quantity in result.learnt:
        if quantity.name == result.scenario.calibration.parameter:
            continue
        factor, unit = printed_learnt(quantity.name, quantity.unit)
        word, last = f"{_LEARNT_WORDS[quantity.name]} learnt", factor * quantity.course[-1]
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
    return {"notices": [{"turn": turn} | vars(notice) for turn, notice in result.flight.notices]}


def _notice_figures(flight: Flight, step_name: str) -> list[Figure]:
    """Return when the first alarm came, and what is left of the model at the end."""
    alarm, none, gauge, decided = NOTICE_FIGURES
    last = flight.suspicion[-1]
    first = next((turn for turn, notice in flight.notices if notice.kind == "alarm"), None)
    return [
        Figure(alarm, f"{step_name} of the first alarm", first),
        Figure(none, "probability that no state explains the sensors", last.none_of_these),
        Figure(gauge, "probability that a single sensor is off", last.gauge_off),
        Figure(decided, "the last control is decided by", last.decided_by),
    ]


def _scored(result: MissionResult, truth: PlantRecord) -> list[Figure]:
    """Return the figures that need the truth: how the control fell back, and errors of the estimate."""
    scenario, flight, model = result.scenario, result.flight, result.model
    first = scenario.control_names.index(scenario.mission.first_control)
    policy = result.plan.control_index
    fallback = find_fallback(model.states, policy, first, flight.control_index, truth.state)
    units = {factor.name: factor.unit for factor in scenario.state}
    figures = _fallback_figures(fallback, units, scenario.mission.step_name)
    errors = filtered_rms_error(model, flight.filtered, truth.state)
    for factor, error in zip(scenario.state, errors, strict=True):
        name, fraction = factor.name, factor.unit == "1"
        figures.append(
            Figure(
                f"filtered_rms_error_{name}",
                f"filtered rms error of {name}",
                (100.0 if fraction else 1.0) * float(error),
                "points" if fraction else factor.unit,
            )
        )
    return figures


def _watched(result: MissionResult) -> list[Figure]:
    """Return the figures of a watched asset: what is believed of it now."""
    states, belief = result.model.states, result.flight.filtered[-1]
    figures = []
    for index, factor in enumerate(result.scenario.state):
        fraction = factor.unit == "1"
        for moment, value in (
            ("mean", states.mean(belief)[index]),
            ("standard_deviation", states.standard_deviation(belief)[index]),
        ):
            figures.append(
                Figure(
                    f"last_{moment}_{factor.name}",
                    f"last {moment.replace('_', ' ')} of {factor.name}",
                    (100.0 if fraction else 1.0) * float(value),
                    "%" if fraction else factor.unit,
                )
            )
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


def _beside(figure: Figure, reference: Reference | None) -> Figure:
    if reference is None:
        return figure
    return replace(figure, reference=reference.value, reference_source=reference.source)


def _fallback_figures(fallback: Fallback, units: Mapping[str, str], step_name: str) -> list[Figure]:
    level, name = fallback.switch_level, fallback.switch_state
    unit = units.get(name or "", "")
    if level is not None and unit == "1":
        level, unit = 100.0 * level, "%"
    switch_damage, damage_step, fallback_step, fallback_delay, early_step = FALLBACK_FIGURES
    if fallback.early_step is not None and fallback.delay == 0:  # in force since before the damage
        fallback = replace(fallback, fallback_step=None)
    one = fallback.delay == 1
    switch = Figure(
        switch_damage,
        f"policy leaves the first control from {name}" if name else "policy leaves the first control",
        level if level is not None else "nowhere, or by several states",
        unit,
    )
    if name is None:
        return [switch]
    return [
        switch,
        Figure(damage_step, f"{step_name} of the damage that calls for it", fallback.called_for_step),
        Figure(fallback_step, f"{step_name} of the fallback", fallback.fallback_step),
        Figure(
            fallback_delay, "delay of the fallback", fallback.delay, step_name if one else f"{step_name}s"
        ),
        Figure(early_step, f"{step_name} of a fallback before the damage", fallback.early_step),
    ]


def _sensor_figures(observed: Float, step_name: str) -> list[Figure]:
    received = np.isfinite(observed)
    blind = np.flatnonzero(~received.any(axis=1))
    if received.all():
        return []
    figures = [Figure("lost_observations", "observations lost", 100.0 * float(1.0 - received.mean()), "%")]
    if len(blind):
        steps = ", ".join(str(step) for step in blind)
        figures.append(
            Figure(
                "blind_steps", f"{step_name}s without any observation (belief follows the dynamics)", steps
            )
        )
    return figures


def _misfit_figures(misfit: Misfit) -> list[Figure]:
    rms, largest = MISFIT_FIGURES
    value, sensor = misfit.largest
    return [
        Figure(rms, "misfit of the twin's model, rms over sensors and states", 100 * misfit.rms, "%"),
        Figure(largest, f"largest misfit, at sensor {sensor + 1}", 100.0 * value, "%"),
    ]


def to_record(figures: Sequence[Figure], heading: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `summary.json`: the heading, and each figure beside its reference."""
    return {**heading, "figures": [asdict(figure) for figure in figures]}


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
