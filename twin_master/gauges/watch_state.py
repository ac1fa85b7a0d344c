"""The state of the watch over the gauges, which is carried from step to step, and its storage."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index, Unsigned
from twin_master.gauges.fault_kernels import Beliefs, FreeGainStatistics
from twin_master.gauges.hypothesis_weights import HypothesisWeights, MixedBelief
from twin_master.gauges.stuck_gauges import FROM_THE_START, StuckGauges
from twin_master.network.estimator import CarriedArrays

_Number = TypeVar("_Number", bound=np.floating[Any])
PREFIX = "notice/"
"""Prefix of the names of its arrays; those of the inner estimator are stored without it."""
MODEL_KEY = f"{PREFIX}model_key"
"""Name of the array that identifies the predictions for which the state holds."""
FREE_GAIN_PROBABILITY = 0.5
"""Prior probability that a certain gauge has a gain of its own, under the fault free gains."""


@dataclass
class WatchState:
    """Beliefs and sums of the model and of the faults of B twins.

    G is the number of gauges, K of gain errors, S of states, E of draws. A fault may begin in any
    step: its belief, evidence and sums are averages over its possible first steps.

    Attributes
    ----------
    beliefs : Beliefs
        The belief and the sums of squares of each hypothesis.
    free_gain_statistics : FreeGainStatistics
        The sums of each gauge if several have unknown gains.
    weights : HypothesisWeights
        The weights with which the hypotheses are mixed.
    log_gauge_evidence, gauge_onset : (B, G K) array
        The log evidence of a gauge fault over the model for alarms, and its expected first step.
    log_free_gains_evidence, free_gains_onset : (B,) array
        The same of free gains.
    observation_count : (B, G) array
        The number of observations of each gauge.
    step_count : (B,) array
        The number of steps since the start of this model.
    gauge_alarm_raised, free_gains_alarm_raised : (B,) array of bool
        Whether the alarm of a kind of fault has been raised.
    left_out : (B, G) array of bool
        Whether the last reading of a gauge was left out: absurd, or stuck.
    stuck_gauges : StuckGauges
        Which gauges stand still.
    followed_hypothesis : (B,) array
        The hypothesis that belief and decision follow: 0 is the model, -1 free gains, and g > 0 is
        gauge g, counted from 1.
    mixed : MixedBelief
        The belief about the state over all hypotheses, and over the competitors of the model.
    """

    beliefs: Beliefs
    free_gain_statistics: FreeGainStatistics
    weights: HypothesisWeights
    log_gauge_evidence: Float
    gauge_onset: Float
    log_free_gains_evidence: Float
    free_gains_onset: Float
    observation_count: Float
    step_count: Float
    gauge_alarm_raised: NDArray[np.bool_]
    free_gains_alarm_raised: NDArray[np.bool_]
    left_out: NDArray[np.bool_]
    stuck_gauges: StuckGauges
    followed_hypothesis: Index
    mixed: MixedBelief

    @classmethod
    def initial(
        cls, model_belief: Float, sensors: int, gains: int, weights: HypothesisWeights
    ) -> "WatchState":
        """Return the state before the first observation.

        Parameters
        ----------
        model_belief : (B, S E) array
            The prior over states and draws, the same under all hypotheses.
        sensors, gains : int
            The numbers G of gauges and K of gain errors.
        weights : HypothesisWeights
            The prior weights of the hypotheses of B twins.
        """
        # The evidence for a fault starts as the prior probability that it is there from the first
        # step; each gain of a gauge is equally probable.
        log_prior = np.log(FROM_THE_START)
        twins, pairs = model_belief.shape
        faults = sensors * gains
        gauge_belief = np.broadcast_to(model_belief[:, :, None], (twins, pairs, faults))
        by_gauge = (twins, sensors)
        by_fault = (twins, faults)
        return cls(
            beliefs=Beliefs(
                model=model_belief,
                recovered=model_belief.copy(),
                gauge=gauge_belief.astype(np.float32, order="C"),
                gauge_is_nonzero=model_belief > 0.0,
                free_gains=model_belief.astype(np.float32),
                model_squares=np.zeros(by_gauge),
                recovered_squares=np.zeros(by_gauge),
                gauge_squares=np.zeros(by_fault),
                gauge_sum_cc=np.zeros(by_fault),
                gauge_sum_cx=np.zeros(by_fault),
            ),
            free_gain_statistics=FreeGainStatistics(
                free_probability=np.full(by_gauge, FREE_GAIN_PROBABILITY),
                fixed_squares=np.zeros(by_gauge),
                sum_cc=np.zeros(by_gauge),
                sum_cx=np.zeros(by_gauge),
                free_squares=np.zeros(by_gauge),
            ),
            weights=weights,
            log_gauge_evidence=np.full(by_fault, log_prior - np.log(gains)),
            gauge_onset=np.zeros(by_fault),
            log_free_gains_evidence=np.full(twins, log_prior),
            free_gains_onset=np.zeros(twins),
            observation_count=np.zeros(by_gauge),
            step_count=np.zeros(twins),
            gauge_alarm_raised=np.zeros(twins, dtype=bool),
            free_gains_alarm_raised=np.zeros(twins, dtype=bool),
            left_out=np.zeros(by_gauge, dtype=bool),
            stuck_gauges=StuckGauges.initial(*by_gauge),
            followed_hypothesis=np.zeros(twins, dtype=np.int64),
            mixed=MixedBelief(np.empty((twins, 0)), np.empty((twins, 0)), np.ones(twins)),
        )

    def is_finite(self, largest: float) -> NDArray[np.bool_]:
        """Return for each of B twins whether all numbers except beliefs are below a bound."""
        numbers = (
            self.mixed.belief,
            self.weights.current,
            self.weights.hidden,
            self.log_gauge_evidence,
            self.log_free_gains_evidence[:, None],
            self.beliefs.model_squares,
            self.beliefs.recovered_squares,
            self.beliefs.gauge_squares,
            self.beliefs.gauge_sum_cc,
            self.beliefs.gauge_sum_cx,
            *self.free_gain_statistics,
        )
        # False for NaN as well.
        are_small = [np.all(values < largest, axis=1) for values in numbers]
        return np.asarray(np.all(are_small, axis=0))

    def as_arrays(self, model_key: Unsigned) -> CarriedArrays:
        """Return the state of a single twin as arrays by name; zeros of `gauge` are left out.

        Names and layout are those of earlier versions, so that their saved states can be read:
        beliefs have the order of the draws.

        Parameters
        ----------
        model_key : (1,) array
            The number that identifies the predictions for which the state holds.
        """
        beliefs = self.beliefs
        states = self.mixed.belief.shape[1]
        gauge_belief = np.moveaxis(_by_draw(beliefs.gauge, states), -1, 0)  # (G K, E, S)
        gauge_belief = np.ascontiguousarray(gauge_belief)
        # The comparison first makes `flatnonzero` ten times as fast.
        nonzero_indices = np.flatnonzero(gauge_belief != 0.0)
        smallest_type = np.min_scalar_type(gauge_belief.size)
        sensors = beliefs.model_squares.shape[1]
        by_fault = (sensors, -1)
        sums = np.stack([beliefs.gauge_sum_cc[0], beliefs.gauge_sum_cx[0]], axis=-1)
        alarms = [self.gauge_alarm_raised[0], self.free_gains_alarm_raised[0]]
        arrays: CarriedArrays = {
            "model": _by_draw(beliefs.model, states),
            "mended": _by_draw(beliefs.recovered, states),
            "gauge": gauge_belief.ravel()[nonzero_indices],
            "gauge_place": nonzero_indices.astype(smallest_type),
            "none": _by_draw(beliefs.free_gains, states)[None],
            "share": self.weights.current[0],
            "hidden": self.weights.hidden[0],
            "shows": self.weights.showing[0],
            "log_gauge": self.log_gauge_evidence.reshape(by_fault),
            "gauge_onset": self.gauge_onset.reshape(by_fault),
            "log_none": self.log_free_gains_evidence,
            "none_onset": self.free_gains_onset,
            "model_squares": beliefs.model_squares[0],
            "mended_squares": beliefs.recovered_squares[0],
            "gauge_squares": beliefs.gauge_squares.reshape(by_fault),
            "gauge_sums": sums.reshape(sensors, -1, 2),
            "none_statistics": np.concatenate(self.free_gain_statistics).T,
            "count": self.observation_count[0],
            "steps": self.step_count,
            "alarmed": np.array(alarms, dtype=np.float64),
            "left_out": self.left_out[0].astype(np.float64),
            "stuck": np.concatenate(self.stuck_gauges),
            "leading": self.followed_hypothesis.astype(np.float64),
            "belief": self.mixed.belief[0],
            "rivals": self.mixed.competing[0],
            "right": self.mixed.model_weight,
        }
        return {
            f"{PREFIX}{name}": np.ascontiguousarray(array) for name, array in arrays.items()
        } | {MODEL_KEY: model_key}

    @classmethod
    def from_arrays(cls, arrays: CarriedArrays, gauge_shape: tuple[int, ...]) -> "WatchState":
        """Return the state of a single twin from the arrays of `as_arrays`; they are copied.

        Parameters
        ----------
        arrays : dict of str to array
            All arrays that an estimator carried on; those of the state begin with `PREFIX`.
        gauge_shape : tuple of int
            The numbers (G, K, E, S) of gauges, gain errors, draws and states.
        """
        sensors, gains, draws, states = gauge_shape
        stored_arrays = {
            name.removeprefix(PREFIX): array.copy()
            for name, array in arrays.items()
            if name.startswith(PREFIX)
        }
        gauge_belief = np.zeros((sensors * gains, draws, states), dtype=np.float32)
        gauge_belief.ravel()[stored_arrays["gauge_place"]] = stored_arrays["gauge"]
        gauge = _by_state(np.moveaxis(gauge_belief, 0, -1))
        # Contiguous as in a new state: for strided arrays the loops would be compiled once more,
        # which takes five seconds.
        gauge_sum_cc, gauge_sum_cx = np.ascontiguousarray(
            np.moveaxis(stored_arrays["gauge_sums"], -1, 0)
        )
        gauge_alarm_raised, free_gains_alarm_raised = stored_arrays["alarmed"].tolist()
        statistics = [row[None] for row in np.ascontiguousarray(stored_arrays["none_statistics"].T)]
        return cls(
            beliefs=Beliefs(
                model=_by_state(stored_arrays["model"]),
                recovered=_by_state(stored_arrays["mended"]),
                gauge=gauge,
                gauge_is_nonzero=np.any(gauge > 0.0, axis=2),
                free_gains=_by_state(stored_arrays["none"][0]),
                model_squares=stored_arrays["model_squares"][None],
                recovered_squares=stored_arrays["mended_squares"][None],
                gauge_squares=stored_arrays["gauge_squares"].reshape(1, -1),
                gauge_sum_cc=gauge_sum_cc.reshape(1, -1),
                gauge_sum_cx=gauge_sum_cx.reshape(1, -1),
            ),
            free_gain_statistics=FreeGainStatistics._make(statistics),
            weights=HypothesisWeights(
                stored_arrays["share"][None],
                stored_arrays["hidden"][None],
                stored_arrays["shows"][None],
            ),
            log_gauge_evidence=stored_arrays["log_gauge"].reshape(1, -1),
            gauge_onset=stored_arrays["gauge_onset"].reshape(1, -1),
            log_free_gains_evidence=stored_arrays["log_none"],
            free_gains_onset=stored_arrays["none_onset"],
            observation_count=stored_arrays["count"][None],
            step_count=stored_arrays["steps"],
            gauge_alarm_raised=np.array([gauge_alarm_raised > 0.0]),
            free_gains_alarm_raised=np.array([free_gains_alarm_raised > 0.0]),
            left_out=stored_arrays["left_out"][None] > 0.0,
            stuck_gauges=StuckGauges._make(row[None] for row in stored_arrays["stuck"]),
            followed_hypothesis=stored_arrays["leading"].astype(np.int64),
            mixed=MixedBelief(
                stored_arrays["belief"][None],
                stored_arrays["rivals"][None],
                stored_arrays["right"],
            ),
        )


def _by_draw(belief: NDArray[_Number], states: int) -> NDArray[_Number]:
    """Return the belief (1, S E, ...) of one twin by draw and state: (E, S, ...)."""
    return belief.reshape(states, -1, *belief.shape[2:]).swapaxes(0, 1)


def _by_state(belief: NDArray[_Number]) -> NDArray[_Number]:
    """Return one twin's belief by draw and state (E, S, ...) in the order of states.

    The result has the shape (1, S E, ...).
    """
    draws, states, *faults = belief.shape
    by_state = np.ascontiguousarray(belief.swapaxes(0, 1))
    return by_state.reshape(1, states * draws, *faults)


@dataclass(frozen=True)
class StoredBelief:
    """The beliefs about the state that were stored in a step, for smoothing.

    Attributes
    ----------
    belief, competing_belief : (S,) array
        The belief over all hypotheses, and over the competitors of the model.
    model_weight : float
        The weight of the model.
    """

    NAMES: ClassVar = (f"{PREFIX}belief", f"{PREFIX}rivals", f"{PREFIX}right")
    """The names of the arrays from which the beliefs are read."""

    belief: Float
    competing_belief: Float
    model_weight: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "StoredBelief":
        """Return the beliefs among the arrays that an estimator carried on."""
        belief, competing_belief, model_weight = (np.asarray(arrays[name]) for name in cls.NAMES)
        return cls(
            belief.astype(np.float64), competing_belief.astype(np.float64), float(model_weight[0])
        )
