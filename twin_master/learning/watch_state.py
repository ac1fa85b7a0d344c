"""The state of the watch over the gauges, which is carried from step to step, and its storage."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Single, Unsigned
from twin_master.learning.faults import FreeGainStatistics
from twin_master.learning.hypothesis_weights import HypothesisWeights
from twin_master.network.estimator import CarriedArrays

PREFIX = "notice/"
"""Prefix of the names of its arrays; those of the inner estimator are stored without it."""
MODEL_KEY = f"{PREFIX}model_key"
"""Name of the array that identifies the predictions for which the state holds."""
FROM_THE_START = 0.5
"""Prior probability that a fault, if there is one, begins in the first step, not a later one."""
FREE_GAIN_PROBABILITY = 0.5
"""Prior probability that a certain gauge has a gain of its own, under the fault free gains."""


@dataclass
class WatchState:
    """Beliefs and sums of the model and of the faults, for G gauges, K gains, E draws, S states.

    A fault may begin in any step. Its belief, evidence and sums are averages over the first steps.

    Attributes
    ----------
    model_belief, recovered_belief : (E, S) array
        The belief under the model, and after a fault has ended.
    gauge_belief : (G, K, E, S) array
        The belief if gauge g is off by gain k; most entries are zero.
    free_gains_belief : (1, E, S) array
        The belief if several gauges have unknown gains.
    weights : HypothesisWeights
        The weights with which the hypotheses are mixed.
    log_gauge_evidence, gauge_onset : (G, K) array
        The log evidence of a gauge fault over the model for alarms, and its expected first step.
    log_free_gains_evidence, free_gains_onset : (1,) array
        The same of free gains.
    model_squares, recovered_squares : (G,) array
        Sums of squared residuals in units of the assumed noise.
    gauge_squares, gauge_sum_cc, gauge_sum_cx : (G, K) array
        The sums of the gauge that is off, see `update_gauge_faults`.
    free_gain_statistics : FreeGainStatistics
        The sums of each gauge if several have unknown gains.
    observation_count : (G,) array
        The number of observations of each gauge.
    step_count : float
        The number of steps since the start of this model.
    gauge_alarm_raised, free_gains_alarm_raised : bool
        Whether the alarm of a kind of fault has been raised.
    left_out : (G,) array of bool
        Whether the last reading of a gauge was absurd.
    followed_hypothesis : int
        The hypothesis that belief and decision follow: 0 is the model, -1 free gains, and g > 0 is
        gauge g, counted from 1.
    belief, competing_belief : (S,) array
        The belief about the state over all hypotheses, and over the competitors of the model.
    model_weight : float
        The weight of the model among the hypotheses under which a state is believed.
    """

    model_belief: Float
    recovered_belief: Float
    gauge_belief: Single
    free_gains_belief: Single
    weights: HypothesisWeights
    log_gauge_evidence: Float
    gauge_onset: Float
    log_free_gains_evidence: Float
    free_gains_onset: Float
    model_squares: Float
    recovered_squares: Float
    gauge_squares: Float
    gauge_sum_cc: Float
    gauge_sum_cx: Float
    free_gain_statistics: FreeGainStatistics
    observation_count: Float
    step_count: float
    gauge_alarm_raised: bool
    free_gains_alarm_raised: bool
    left_out: NDArray[np.bool_]
    followed_hypothesis: int
    belief: Float = field(default_factory=lambda: np.empty(0))
    competing_belief: Float = field(default_factory=lambda: np.empty(0))
    model_weight: float = 1.0

    @classmethod
    def initial(
        cls, model_belief: Float, sensors: int, gains: int, weights: HypothesisWeights
    ) -> "WatchState":
        """Return the state before the first observation.

        Parameters
        ----------
        model_belief : (E, S) array
            The prior over draws and states, the same under all hypotheses.
        sensors, gains : int
            The numbers G of gauges and K of gain errors.
        weights : HypothesisWeights
            The prior weights of the hypotheses.
        """
        # The evidence for a fault starts as the prior probability that it is there from the first
        # step; each gain of a gauge is equally probable.
        log_prior = np.log(FROM_THE_START)
        gauge_shape = (sensors, gains)
        gauge_belief = np.broadcast_to(model_belief, (*gauge_shape, *model_belief.shape))
        return cls(
            model_belief=model_belief,
            recovered_belief=model_belief.copy(),
            gauge_belief=gauge_belief.astype(np.float32, order="C"),
            free_gains_belief=model_belief[None].astype(np.float32),
            weights=weights,
            log_gauge_evidence=np.full(gauge_shape, log_prior - np.log(gains)),
            gauge_onset=np.zeros(gauge_shape),
            log_free_gains_evidence=np.full(1, log_prior),
            free_gains_onset=np.zeros(1),
            model_squares=np.zeros(sensors),
            recovered_squares=np.zeros(sensors),
            gauge_squares=np.zeros(gauge_shape),
            gauge_sum_cc=np.zeros(gauge_shape),
            gauge_sum_cx=np.zeros(gauge_shape),
            free_gain_statistics=FreeGainStatistics(
                free_probability=np.full(sensors, FREE_GAIN_PROBABILITY),
                fixed_squares=np.zeros(sensors),
                sum_cc=np.zeros(sensors),
                sum_cx=np.zeros(sensors),
                free_squares=np.zeros(sensors),
            ),
            observation_count=np.zeros(sensors),
            step_count=0.0,
            gauge_alarm_raised=False,
            free_gains_alarm_raised=False,
            left_out=np.zeros(sensors, dtype=bool),
            followed_hypothesis=0,
        )

    def as_arrays(self, model_key: Unsigned) -> CarriedArrays:
        """Return the state as arrays by name; zeros of `gauge_belief` are left out.

        Names and layout are those of earlier versions, so that their saved states can be read.

        Parameters
        ----------
        model_key : (1,) array
            The number that identifies the predictions for which the state holds.
        """
        # The comparison first makes `flatnonzero` ten times as fast.
        nonzero_indices = np.flatnonzero(self.gauge_belief != 0.0)
        arrays: CarriedArrays = {
            "model": self.model_belief,
            "mended": self.recovered_belief,
            "gauge": self.gauge_belief.ravel()[nonzero_indices],
            "gauge_place": nonzero_indices.astype(np.int32),
            "none": self.free_gains_belief,
            "share": self.weights.current,
            "hidden": self.weights.hidden,
            "shows": self.weights.showing,
            "log_gauge": self.log_gauge_evidence,
            "gauge_onset": self.gauge_onset,
            "log_none": self.log_free_gains_evidence,
            "none_onset": self.free_gains_onset,
            "model_squares": self.model_squares,
            "mended_squares": self.recovered_squares,
            "gauge_squares": self.gauge_squares,
            "gauge_sums": np.stack([self.gauge_sum_cc, self.gauge_sum_cx], axis=-1),
            "none_statistics": self.free_gain_statistics.as_array(),
            "count": self.observation_count,
            "steps": np.array([self.step_count]),
            "alarmed": np.array(
                [float(self.gauge_alarm_raised), float(self.free_gains_alarm_raised)]
            ),
            "left_out": self.left_out.astype(np.float64),
            "leading": np.array([float(self.followed_hypothesis)]),
            "belief": self.belief,
            "rivals": self.competing_belief,
            "right": np.array([self.model_weight]),
        }
        return {f"{PREFIX}{name}": array for name, array in arrays.items()} | {MODEL_KEY: model_key}

    @classmethod
    def from_arrays(cls, arrays: CarriedArrays, gauge_shape: tuple[int, ...]) -> "WatchState":
        """Return the state from the arrays that `as_arrays` returned; they are copied.

        Parameters
        ----------
        arrays : dict of str to array
            All arrays that an estimator carried on; those of the state begin with `PREFIX`.
        gauge_shape : tuple of int
            The shape (G, K, E, S) of `gauge_belief`.
        """
        stored_arrays = {
            name.removeprefix(PREFIX): array.copy()
            for name, array in arrays.items()
            if name.startswith(PREFIX)
        }
        gauge_belief = np.zeros(gauge_shape, dtype=np.float32)
        gauge_belief.ravel()[stored_arrays["gauge_place"]] = stored_arrays["gauge"]
        gauge_alarm_raised, free_gains_alarm_raised = stored_arrays["alarmed"].tolist()
        gauge_sum_cc, gauge_sum_cx = np.moveaxis(stored_arrays["gauge_sums"], -1, 0)
        return cls(
            model_belief=stored_arrays["model"],
            recovered_belief=stored_arrays["mended"],
            gauge_belief=gauge_belief,
            free_gains_belief=stored_arrays["none"],
            weights=HypothesisWeights(
                stored_arrays["share"], stored_arrays["hidden"], stored_arrays["shows"]
            ),
            log_gauge_evidence=stored_arrays["log_gauge"],
            gauge_onset=stored_arrays["gauge_onset"],
            log_free_gains_evidence=stored_arrays["log_none"],
            free_gains_onset=stored_arrays["none_onset"],
            model_squares=stored_arrays["model_squares"],
            recovered_squares=stored_arrays["mended_squares"],
            gauge_squares=stored_arrays["gauge_squares"],
            gauge_sum_cc=np.ascontiguousarray(gauge_sum_cc),
            gauge_sum_cx=np.ascontiguousarray(gauge_sum_cx),
            free_gain_statistics=FreeGainStatistics.from_array(stored_arrays["none_statistics"]),
            observation_count=stored_arrays["count"],
            step_count=float(stored_arrays["steps"][0]),
            gauge_alarm_raised=bool(gauge_alarm_raised),
            free_gains_alarm_raised=bool(free_gains_alarm_raised),
            left_out=stored_arrays["left_out"] > 0.0,
            followed_hypothesis=int(stored_arrays["leading"][0]),
            belief=stored_arrays["belief"],
            competing_belief=stored_arrays["rivals"],
            model_weight=float(stored_arrays["right"][0]),
        )


@dataclass(frozen=True)
class StoredBelief:
    """The mixed beliefs about the state that were stored in a step, for smoothing.

    Attributes
    ----------
    belief, competing_belief : (S,) array
        The belief over all hypotheses, and over the competitors of the model.
    model_weight : float
        The weight of the model.
    """

    belief: Float
    competing_belief: Float
    model_weight: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "StoredBelief":
        """Return the beliefs among the arrays that an estimator carried on."""
        return cls(
            np.asarray(arrays[f"{PREFIX}belief"], dtype=np.float64),
            np.asarray(arrays[f"{PREFIX}rivals"], dtype=np.float64),
            float(np.asarray(arrays[f"{PREFIX}right"])[0]),
        )
