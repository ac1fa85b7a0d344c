"""The watch over the gauges: it notices faulty gauges, unexplained readings and absurd readings.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reporting.arrays import Float
from twin_master.errors import InvalidModelError
from twin_master.learning import hypothesis_weights
from twin_master.learning.fault_filter import FaultFilter
from twin_master.learning.hypothesis_weights import HypothesisBeliefs
from twin_master.learning.notices import NoticeWriter
from twin_master.learning.watch_state import (
    MODEL_KEY,
    StoredBelief,
    WatchState,
)
from twin_master.network.estimator import (
    Carried,
    Estimate,
    Estimator,
    NoticeWording,
    Suspicion,
)
from twin_master.network.inference import smooth
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import Noticing


class WatchfulEstimator:
    """An estimator that is watched: absurd readings are left out, and faults of gauges are noticed.

    The belief is that of a mixture of hypotheses: the inner estimator, each gauge that is off, and
    gauges that are right again after a fault (see `hypothesis_weights`). Beside the arrays of the
    inner estimator it carries those of a `WatchState`, whose names begin with `notice/`.

    Parameters
    ----------
    inner : Estimator
        The estimator that holds the belief under the model.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,) array
        The value of the parameter in each draw.
    settings : Noticing, optional
        When alarms are raised.
    words : NoticeWording, optional
        How notices speak of steps and sensors.

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
        self._sensor_model = sensor_model
        self.model = inner_estimator.model
        settings = settings or Noticing()
        self._faults = FaultFilter(inner_estimator.model, sensor_model, draws, settings)
        self._notices = self._notice_writer(words or NoticeWording(), settings)

    def _notice_writer(self, wording: NoticeWording, settings: Noticing) -> NoticeWriter:
        """Return the writer of notices.

        A reading is plausible if it is within a margin of the prediction of some draw and state.
        """
        value = self._sensor_model.value_per_draw
        deviation = self._sensor_model.total_standard_deviation
        margin = settings.absurd_deviations * deviation  # (S, U, G)
        sensors = range(self._sensor_model.sensor_count)
        return NoticeWriter(
            wording=wording,
            threshold=settings.threshold,
            gains=self._faults.gains,
            log_gauge_prior=self._faults.log_gauge_prior,
            lowest_plausible=(value.min(axis=0) - margin).min(axis=0),
            highest_plausible=(value.max(axis=0) + margin).max(axis=0),
            hypothesis_names=tuple(f"{wording.name_sensors([g])} off" for g in sensors),
        )

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S).

        Under the model, the inner estimator smooths. Under the competing hypotheses, the mixed
        beliefs of the steps are smoothed, which is approximate: the last step has the belief of the
        competing hypotheses alone. The result is the average, with the last weight of the model.
        """
        under_model = self._inner.smoothed(carried)
        if not carried:
            return under_model
        stored_beliefs = [StoredBelief.from_arrays(step.arrays) for step in carried]
        last_step = stored_beliefs[-1]
        with np.errstate(divide="ignore"):
            log_beliefs = np.log([stored_belief.belief for stored_belief in stored_beliefs])
            log_beliefs[-1] = np.log(last_step.competing_belief)
        controls = [step.control_index for step in carried]
        competing = smooth(self.model, controls, log_beliefs)
        return np.asarray(
            last_step.model_weight * under_model + (1.0 - last_step.model_weight) * competing
        )

    def step(
        self, before: Carried | None, observation: Float, control_index: int, step: int
    ) -> Estimate:
        """Advance the belief to step t and correct it by an observation, see `Estimator.step`."""
        # Leave out absurd readings.
        readings, other_log_density = self._sensor_model.split_observation(observation)
        is_absurd = self._notices.is_absurd(readings, control_index)
        used_readings = np.where(is_absurd, np.nan, readings)
        # The rest of the observation, such as readings of inspections, is kept.
        used_observation = np.append(used_readings, observation[len(used_readings) :])
        estimate = self._inner.step(before, used_observation, control_index, step)

        # Advance and correct the hypotheses about the gauges.
        if before is not None and self._continues(before):
            state = self._faults.advance(before, control_index)
        else:
            state = self._faults.start(estimate.forecast, control_index)
        self._faults.assimilate(state, used_readings, other_log_density, control_index)

        # Write the notices of this step.
        notices = self._notices.report_absurd_readings(
            state.left_out, is_absurd, readings, control_index, step
        )
        if before is None:
            notices += self._notices.report_own_likelihood(self._sensor_model)
        # A gauge that was left out and sends no reading now counts as left out still.
        state.left_out = is_absurd | (state.left_out & np.isnan(readings))
        suspicion = self._suspicion(state)
        notices += self._notices.raise_alarms(state, suspicion, step)
        beliefs = HypothesisBeliefs(estimate.filtered, state.recovered_belief, state.gauge_belief)
        hypotheses = hypothesis_weights.list_hypotheses(
            state.weights, beliefs, self._notices.hypothesis_names
        )
        notices += self._notices.report_followed_hypothesis(state, hypotheses, step)

        # Mix the beliefs of the hypotheses by their weights.
        mixed_belief = hypothesis_weights.mix_beliefs(state.weights, beliefs)
        state.belief = mixed_belief.belief
        state.competing_belief = mixed_belief.competing
        state.model_weight = mixed_belief.model_weight
        arrays = {**estimate.carried.arrays, **state.as_arrays(self._faults.model_key)}
        probabilities = {hypothesis.name: hypothesis.probability for hypothesis in hypotheses}
        return replace(
            estimate,
            filtered=mixed_belief.belief,
            carried=Carried(control_index, arrays),
            notices=(*estimate.notices, *notices),
            suspicion=replace(suspicion, hypotheses=probabilities),
            hypotheses=hypotheses,
        )

    def _continues(self, before: Carried) -> bool:
        """Return whether the state of the previous step holds for the predictions of this model."""
        return bool(before.arrays.get(MODEL_KEY) == self._faults.model_key)

    def _suspicion(self, state: WatchState) -> Suspicion:
        """Return how well the model explains the sensors so far.

        The evidence for a fault, relative to that for the model, is a sum over the steps in which
        it may begin. If it begins later, it predicts so far what the model predicts: this term is
        the prior probability that it begins later, times one.
        """
        log_begins_later = np.log(self._faults.probability_to_begin_after(state.step_count - 1.0))
        log_fault_has_begun = np.logaddexp.reduce(state.log_gauge_evidence, axis=1)
        log_each_gauge = np.logaddexp(log_fault_has_begun, log_begins_later)
        log_free_gains = float(state.log_free_gains_evidence[0])
        log_any_gauge = np.logaddexp.reduce(log_each_gauge + self._faults.log_gauge_prior)
        return Suspicion(
            none_of_these=state.weights.free_gains_probability,
            gauge_off=float(state.weights.gauge_fault_probability.sum()),
            log_evidence_none=float(np.logaddexp(log_free_gains, log_begins_later)),
            log_evidence_any_gauge=float(log_any_gauge),
            log_evidence_gauge=log_each_gauge,
            left_out=state.left_out,
        )
