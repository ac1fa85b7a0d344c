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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reporting.arrays import Float
from twin_master.errors import InvalidModelError
from twin_master.gauges.gauge_watch import GaugeWatch
from twin_master.gauges.watch_state import MODEL_KEY, StoredBelief
from twin_master.network.estimator import Carried, Estimate, Estimator, NoticeWording
from twin_master.network.inference import smooth
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import Noticing


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
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S).

        Under the model, the inner estimator smooths. Under the competing hypotheses, the mixed
        beliefs of the steps are smoothed, starting from the belief of the competing hypotheses in
        the last step, which is approximate. The result is their average, weighted by the
        probability of the model in the last step.
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
