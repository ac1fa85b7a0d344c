"""The watch over the gauges: it notices faulty and stuck gauges, unexplained and absurd readings.

By the model, every gauge shows the value that belongs to the state and to a draw of the parameter,
plus noise of unknown scale. Two kinds of fault compete with the model: a gauge shows a stated
fraction too much or too little; or several gauges have unknown gains of their own, which no state
of the model explains. Each has a filter of its own, so that state and parameter are marginalised
under each. A fault may begin in any step. The mixture over the first step of the fault is exact,
because the belief of a fault that has not begun is that of the model.

The ratio of the evidence of a fault to that of the model is an e-process: its mean under the
predictions of the model is one at every step. So it ever exceeds a threshold c with a probability
of at most 1 / c, in however many steps they are compared (Ville 1939; Ramdas, Grünwald, Vovk and
Shafer 2023).

The watch takes B twins at once. A single twin is watched as one of one, so that its results are the
same to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from twin_master.errors import InvalidModelError
from twin_master.gauges import hypothesis_weights
from twin_master.gauges.discriminating_control import discriminating_controls, gauge_hypotheses
from twin_master.gauges.fault_filter import FaultFilter
from twin_master.gauges.fault_kernels import Observations
from twin_master.gauges.hypothesis_weights import log_of_sum, log_of_sums
from twin_master.gauges.notices import NoticeWriter
from twin_master.gauges.stuck_gauges import StandstillTest, StuckGauges
from twin_master.gauges.watch_state import MODEL_KEY, PREFIX, StoredBelief, WatchState
from twin_master.network.estimator import (
    Carried,
    Estimate,
    Estimator,
    Hypothesis,
    Notice,
    NoticeWording,
    Suspicion,
)
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import smooth
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import Noticing


@dataclass(frozen=True)
class CheckedReadings:
    """The observations of B twins in a step, with absurd and stuck readings marked and excluded.

    Attributes
    ----------
    rows : (B, G + I) array
        All observed values, SI; NaN where nothing was received or a reading is left out.
    readings : (B, G) array
        The values of the gauges as they were received.
    is_absurd : (B, G) array of bool
        Whether no state can show a reading.
    stuck_gauges : StuckGauges
        Which gauges stand still, after this step.
    observations : Observations
        The observations without the excluded readings.
    """

    rows: Float
    readings: Float
    is_absurd: NDArray[np.bool_]
    stuck_gauges: StuckGauges
    observations: Observations

    @property
    def is_left_out(self) -> NDArray[np.bool_]:
        """Whether a reading (B, G) was received and is not used."""
        is_stuck = (self.stuck_gauges.is_stuck > 0.0) & ~np.isnan(self.readings)
        return self.is_absurd | is_stuck


class AlarmEvidence(NamedTuple):
    """The log evidence of the kinds of fault over the model, for B twins.

    Attributes
    ----------
    free_gains, any_gauge : (B,) array
        The evidence that several gauges have unknown gains, and that a single one is faulty.
    each_gauge : (B, G) array
        The evidence that a certain gauge is faulty.
    """

    free_gains: Float
    any_gauge: Float
    each_gauge: Float


class GaugeWatch:
    """The watch over the gauges of B twins with the same model.

    Parameters
    ----------
    model : GraphicalModel
        S states, and their transitions.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,) array
        The value of the parameter in each draw.
    settings : Noticing
        When alarms are raised.
    wording : NoticeWording
        How notices speak of steps and sensors.

    Attributes
    ----------
    faults : FaultFilter
        The filters of the hypotheses.

    Raises
    ------
    InvalidModelError
        If there are too many states.
    """

    def __init__(
        self,
        model: GraphicalModel,
        sensor_model: GaussianSensorModel,
        draws: Float,
        settings: Noticing,
        wording: NoticeWording,
    ) -> None:
        self._sensor_model = sensor_model
        self._controls = model.controls
        self._free_gain_deviation = settings.all_gain
        self.faults = FaultFilter(model, sensor_model, draws, settings)
        self._notices = self._notice_writer(wording, settings)
        self._standstill = StandstillTest.of(sensor_model.standard_deviation, settings)

    def _notice_writer(self, wording: NoticeWording, settings: Noticing) -> NoticeWriter:
        """Return the writer of notices, with the range of plausible readings of each gauge.

        A reading is plausible if it lies within a margin of the prediction in some state with some
        draw of the parameter.
        """
        value = self._sensor_model.value_per_draw
        deviation = self._sensor_model.total_standard_deviation
        margin = settings.absurd_deviations * deviation  # (S, U, G)
        sensors = range(self._sensor_model.sensor_count)
        return NoticeWriter(
            wording=wording,
            threshold=settings.threshold,
            gains=self.faults.gains,
            log_gauge_prior=self.faults.log_gauge_prior,
            lowest_plausible=(value.min(axis=0) - margin).min(axis=0),
            highest_plausible=(value.max(axis=0) + margin).max(axis=0),
            noise=self._sensor_model.standard_deviation,
            hypothesis_names=tuple(f"{wording.name_sensors([g])} off" for g in sensors),
        )

    def exclude_useless_readings(
        self, state: WatchState | None, rows: Float, control_index: Index
    ) -> CheckedReadings:
        """Exclude absurd and stuck readings from the observations of B twins.

        Parameters
        ----------
        state : WatchState or None
            The state of the watch after the previous step; None if this is the first one.
        rows : (B, G + I) array
            The values of G sensors and the readings of I inspections, SI; NaN where nothing was
            received.
        control_index : (B,) array
            The controls in force.

        Returns
        -------
        CheckedReadings
            The sensor values with and without the excluded ones; readings of inspections are kept.
        """
        values, inspections_log_density = self._sensor_model.split_observation(rows)
        is_absurd = self._notices.is_absurd(values, control_index)
        if state is None:
            step_count = np.zeros(len(values))
            before = StuckGauges.initial(*values.shape)
        else:
            step_count = state.step_count
            before = state.stuck_gauges
        begins_now = self.faults.probability_to_begin_now(step_count)
        stuck_gauges = self._standstill.update(before, values, step_count, begins_now)
        is_useless = is_absurd | (stuck_gauges.is_stuck > 0.0)
        used_values = np.where(is_useless, np.nan, values)
        inspections = rows[:, values.shape[1] :]
        used_rows = np.concatenate([used_values, inspections], axis=1)
        inspections_log_density = np.broadcast_to(
            inspections_log_density, (len(rows), self._sensor_model.state_count)
        )
        observations = Observations(
            used_values,
            # A copy, as numba would compile the loops once more for an array that is read only.
            inspections_log_density.copy(),
            control_index.astype(np.int64),
        )
        return CheckedReadings(used_rows, values, is_absurd, stuck_gauges, observations)

    def step(
        self,
        state: WatchState | None,
        checked: CheckedReadings,
        forecast: Float,
        model_belief: Float,
        previous_control: Index,
        step: int,
    ) -> tuple[WatchState, list[list[Notice]]]:
        """Advance the hypotheses of B twins to a step, correct them, and mix their beliefs.

        Parameters
        ----------
        state : WatchState or None
            The state of the watch after the previous step, updated in place; None if this is the
            first step of the model.
        forecast, model_belief : (B, S) array
            The beliefs under the model before and after the observations.
        previous_control : (B,) array
            The controls of the previous step; not used in the first step of the model.

        Returns
        -------
        notices : list of list of Notice
            The notices of each twin.
        """
        if state is None:
            state = self.faults.start(forecast, checked.observations.control)
        else:
            self.faults.advance(state, previous_control, checked.observations.control)
        self.faults.assimilate(state, checked.observations)
        notices = self._report_useless_readings(state, checked, step)
        if step == 0:
            own_likelihood = self._notices.report_own_likelihood(self._sensor_model)
            notices = [own_likelihood + twin_notices for twin_notices in notices]
        self._raise_alarms(state, notices, step)
        self._report_followed_hypothesis(state, notices, step)
        self._advise_controls(state, notices, model_belief, step)
        state.mixed = hypothesis_weights.mix_beliefs(state.weights, model_belief, state.beliefs)
        return state, notices

    def _report_useless_readings(
        self, state: WatchState, checked: CheckedReadings, step: int
    ) -> list[list[Notice]]:
        """Return the notices of each twin about gauges that are now excluded, or used again."""
        is_left_out = checked.is_left_out
        is_missing = np.isnan(checked.readings)
        was_left_out = state.left_out
        # A gauge that was left out and sends no reading now counts as left out still.
        state.left_out = is_left_out | (was_left_out & is_missing)
        state.stuck_gauges = checked.stuck_gauges
        notices: list[list[Notice]] = [[] for _ in is_left_out]
        for twin in np.flatnonzero(np.any(state.left_out != was_left_out, axis=1)).tolist():
            # The step counts from the first one of this model, which may have replaced another.
            first_step = step + 1 - round(float(state.step_count[twin]))
            readings = checked.readings[twin]
            begins = is_left_out[twin] & ~was_left_out[twin]
            is_absurd = checked.is_absurd[twin]
            still_since = first_step + state.stuck_gauges.still_since[twin]
            notices[twin] = [
                *self._notices.report_absurd_readings(
                    begins & is_absurd, readings, int(checked.observations.control[twin]), step
                ),
                *self._notices.report_stuck_gauges(
                    begins & ~is_absurd, readings, still_since, step
                ),
                *self._notices.report_gauges_back(
                    was_left_out[twin] & ~state.left_out[twin], readings, step
                ),
            ]
        return notices

    def _raise_alarms(self, state: WatchState, notices: Sequence[list[Notice]], step: int) -> None:
        """Append the alarms of a step to the notices of each twin."""
        evidence = self.alarm_evidence(state)
        may_alarm = self._notices.may_raise_alarm(state, evidence.any_gauge, evidence.free_gains)
        for twin in np.flatnonzero(may_alarm).tolist():
            notices[twin] += self._notices.raise_alarms(
                state,
                twin,
                float(evidence.any_gauge[twin]),
                float(evidence.free_gains[twin]),
                step,
            )

    def _report_followed_hypothesis(
        self, state: WatchState, notices: Sequence[list[Notice]], step: int
    ) -> None:
        """Append a notice for each twin whose belief follows another hypothesis than before."""
        hypothesis, probability = hypothesis_weights.most_probable_hypothesis(
            state.weights, gauge_count=state.left_out.shape[1]
        )
        has_changed = (probability > 0.5) & (hypothesis != state.followed_hypothesis)
        for twin in np.flatnonzero(has_changed).tolist():
            state.followed_hypothesis[twin] = hypothesis[twin]
            notices[twin] += self._notices.report_followed_hypothesis(
                int(hypothesis[twin]), float(probability[twin]), step
            )

    def _advise_controls(
        self,
        state: WatchState,
        notices: Sequence[list[Notice]],
        model_belief: Float,
        step: int,
    ) -> None:
        """Append to each ambiguous alarm the control that best separates its hypotheses."""
        for twin, notices_of_twin in enumerate(notices):
            if not any(notice.kind == "alarm" for notice in notices_of_twin):
                continue
            hypotheses = gauge_hypotheses(
                state,
                twin,
                model_belief[twin],
                self.faults.gains,
                self._free_gain_deviation,
                self._notices.hypothesis_names,
            )
            comparison = discriminating_controls(hypotheses, self._sensor_model)
            if comparison is not None:
                notices_of_twin.append(
                    self._notices.advise_control(comparison, self._controls, step)
                )

    def alarm_evidence(self, state: WatchState) -> AlarmEvidence:
        """Return the evidence for each kind of fault, relative to that for the model.

        It is summed over the steps in which the fault may begin. A fault that begins in the future
        predicts what the model predicts so far; its term is the prior probability of that case.
        """
        log_begins_later = np.log(self.faults.probability_to_begin_after(state.step_count - 1.0))
        twins, gauges = state.left_out.shape
        by_gauge = state.log_gauge_evidence.reshape(twins, gauges, -1)
        log_fault_has_begun = log_of_sums(by_gauge)
        each_gauge = log_of_sum(log_fault_has_begun, log_begins_later[:, None])
        return AlarmEvidence(
            free_gains=log_of_sum(state.log_free_gains_evidence, log_begins_later),
            any_gauge=log_of_sums(each_gauge + self.faults.log_gauge_prior),
            each_gauge=each_gauge,
        )

    def suspicion(self, state: WatchState) -> Suspicion:
        """Return how well the model explains the sensors of one twin so far."""
        evidence = self.alarm_evidence(state)
        return Suspicion(
            none_of_these=float(state.weights.free_gains_probability[0]),
            gauge_off=float(state.weights.gauge_fault_probability.sum()),
            log_evidence_none=float(evidence.free_gains[0]),
            log_evidence_any_gauge=float(evidence.any_gauge[0]),
            log_evidence_gauge=evidence.each_gauge[0],
            left_out=state.left_out[0],
        )

    def hypotheses(self, state: WatchState, model_belief: Float) -> tuple[Hypothesis, ...]:
        """Return the hypotheses of one twin that are not very improbable.

        Parameters
        ----------
        model_belief : (1, S) array
            Its filtered belief under the model.
        """
        return hypothesis_weights.list_hypotheses(
            state.weights, model_belief, state.beliefs, self._notices.hypothesis_names
        )


class WatchfulEstimator:
    """An estimator with a watch over the gauges: it excludes useless readings and notices faults.

    The belief is that of a mixture of hypotheses: the inner estimator, each faulty gauge, and
    gauges that are right again after a fault (see `hypothesis_weights`). Beside the arrays of the
    inner estimator it carries those of a `WatchState`, whose names begin with `notice/`.

    Parameters
    ----------
    inner_estimator : Estimator
        The estimator of the belief under the model.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,) array
        The value of the parameter in each draw.
    settings : Noticing, optional
        When alarms are raised.

    Attributes
    ----------
    watch : GaugeWatch
        The watch over the gauges.

    Raises
    ------
    InvalidModelError
        If the average over the draws stands inside the product over the sensors, or if there are
        too many states.
    """

    def __init__(
        self,
        inner_estimator: Estimator,
        sensor_model: GaussianSensorModel,
        draws: Float,
        settings: Noticing | None = None,
        words: NoticeWording | None = None,
    ) -> None:
        if sensor_model.averages_inside:
            raise InvalidModelError(
                "notices need the average over the draws outside the product over the sensors: "
                "inside, each sensor has a parameter of its own"
            )
        self._inner = inner_estimator
        self.model = inner_estimator.model
        self.watch = GaugeWatch(
            inner_estimator.model,
            sensor_model,
            draws,
            settings or Noticing(),
            words or NoticeWording(),
        )

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) over S states for n consecutive steps k, up to step t: (n, S).

        It is the average of the smoothed beliefs under the model and under the competing
        hypotheses, weighted by the probability of the model in step t, and one minus it. Under the
        model the inner estimator smooths. For the competing hypotheses, a backward pass from their
        belief in step t smooths the mixed beliefs of the steps before, which is approximate.

        Parameters
        ----------
        carried : sequence of Carried
            The arrays that the estimator carried on from each of the n steps.
        """
        smoothed_by_model = self._inner.smoothed(carried)
        if not carried:
            return smoothed_by_model
        stored_beliefs = [StoredBelief.from_arrays(step.arrays) for step in carried]
        last_step = stored_beliefs[-1]
        with np.errstate(divide="ignore"):
            log_beliefs = np.log([stored_belief.belief for stored_belief in stored_beliefs])
            log_beliefs[-1] = np.log(last_step.competing_belief)
        controls = [step.control_index for step in carried]
        smoothed_by_competitors = smooth(self.model, controls, log_beliefs)
        model_weight = last_step.model_weight
        return np.asarray(
            model_weight * smoothed_by_model + (1.0 - model_weight) * smoothed_by_competitors
        )

    def for_smoothing(self, carried: Carried) -> Carried:
        """Return the arrays of a step that smoothing needs: the beliefs of the faults are not."""
        arrays = {
            name: array
            for name, array in carried.arrays.items()
            if name in StoredBelief.NAMES or not name.startswith(PREFIX)
        }
        return Carried(carried.control_index, arrays)

    def step(
        self, before: Carried | None, observation: Float, control_index: int, step: int
    ) -> Estimate:
        """Advance the belief to step t and correct it by an observation, see `Estimator.step`."""
        controls = np.array([control_index])
        faults = self.watch.faults
        state = None
        # The state of the watch holds for the predictions of one model only.
        if before is not None and before.arrays.get(MODEL_KEY) == faults.model_key:
            state = faults.restore(before)
        checked = self.watch.exclude_useless_readings(
            state, np.asarray(observation)[None], controls
        )
        estimate = self._inner.step(before, checked.rows[0], control_index, step)

        # Advance and correct the hypotheses about the gauges.
        model_belief = estimate.filtered[None]
        previous_control = controls if before is None else np.array([before.control_index])
        state, (notices,) = self.watch.step(
            state, checked, estimate.forecast[None], model_belief, previous_control, step
        )

        hypotheses = self.watch.hypotheses(state, model_belief)
        probabilities = {hypothesis.name: hypothesis.probability for hypothesis in hypotheses}
        suspicion = self.watch.suspicion(state)
        arrays = {**estimate.carried.arrays, **state.as_arrays(faults.model_key)}
        return replace(
            estimate,
            filtered=state.mixed.belief[0],
            carried=Carried(control_index, arrays),
            notices=(*estimate.notices, *notices),
            suspicion=replace(suspicion, hypotheses=probabilities),
            hypotheses=hypotheses,
        )


def gauge_watch_of(estimator: Estimator) -> GaugeWatch | None:
    """Return the watch over the gauges of an estimator; None if it has none."""
    return estimator.watch if isinstance(estimator, WatchfulEstimator) else None
