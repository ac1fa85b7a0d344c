"""The filters of the model and of each gauge fault, all corrected by the same observations."""

from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from twin_master.errors import InvalidModelError
from twin_master.gauges import hypothesis_weights
from twin_master.gauges.belief_transitions import Onsets, Recoveries, advance_beliefs
from twin_master.gauges.fault_evidence import correct_beliefs
from twin_master.gauges.fault_kernels import FaultPriors, LogEvidence, Observations, Predictions
from twin_master.gauges.hypothesis_weights import HypothesisWeights, log_of_sum
from twin_master.gauges.stuck_gauges import FROM_THE_START
from twin_master.gauges.watch_state import FREE_GAIN_PROBABILITY, WatchState
from twin_master.network.estimator import Carried
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import MOST_DRAWS, Noticing

_GAINS = (-2.5, -1.0, 1.0, 2.5)
"""Gain errors that are compared, in `Noticing.gauge_gain`; the largest also find larger ones."""
_GAIN_DEVIATIONS = (1.0, 0.5, 0.5, 1.0)
"""Prior standard deviation of each, in the same unit."""
_MOST_BELIEF_NUMBERS = 20_000_000
"""Largest number of entries in the beliefs of the gauge faults, which each kept step contains."""
_LEAST_INFORMATION = 1e-3
"""Least information about a gain in a step, so that a gauge without load has a finite prior."""
_STATE_FORMAT = b"4"
"""Changes with the layout of the carried arrays: a state of another layout is not continued."""


class FaultFilter:
    """The filters of the model and of the faults: they advance all beliefs, and correct them.

    Parameters
    ----------
    model : GraphicalModel
        S states, and their transitions.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,) array
        The value of the parameter in each draw.

    Attributes
    ----------
    gains : (K,) array
        The gain errors of single gauges that are compared.
    log_gauge_prior : (G,) array
        The log prior probability of each gauge to be the one that is off.
    model_key : (1,) array
        Identifies the predictions: a state of the watch holds for the same ones only.

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
    ) -> None:
        self._model = model
        self._sensor_model = sensor_model
        self._settings = settings
        chosen_draws, self._draw_weight = _choose_even_draws(
            np.asarray(draws, np.float64), sensor_model.draw_weight
        )
        sensors = sensor_model.sensor_count
        states = model.states.size
        self._gauge_belief_shape = (sensors, len(_GAINS), len(chosen_draws), states)
        if np.prod(self._gauge_belief_shape, dtype=float) > _MOST_BELIEF_NUMBERS:
            raise InvalidModelError(
                f"notices need a belief over {states} states and {len(chosen_draws)} draws for "
                f"each of {sensors * len(_GAINS)} faults of gauges, which are more than "
                f"{_MOST_BELIEF_NUMBERS} numbers: take fewer levels or state factors, or leave out "
                "`notice`"
            )

        values = sensor_model.value_per_draw[chosen_draws]
        self.predictions = self._predictions_of_pairs(values)
        # A model that takes the place of another, such as one that was taught, begins without
        # suspicion: the key of its predictions differs.
        digest = sha256(_STATE_FORMAT + np.ascontiguousarray(values).tobytes()).digest()
        self.model_key = np.frombuffer(digest[:8], dtype=np.uint64)

        self.gains: Float = settings.gauge_gain * np.array(_GAINS)
        self._priors = FaultPriors(
            gains=self.gains,
            gain_deviations=settings.gauge_gain * np.array(_GAIN_DEVIATIONS),
            free_gain_deviation=settings.all_gain,
            degrees_of_freedom=settings.noise_degrees,
        )
        self.log_gauge_prior = self._log_gauge_prior()
        # Given that a fault begins, it is free gains or a gauge with equal probability.
        log_gauge_and_gain = np.repeat(self.log_gauge_prior - np.log(len(_GAINS)), len(_GAINS))
        no_beginning = [-np.inf, -np.inf]  # of the model and of "recovered"
        self._log_begin: Float = np.log(0.5) + np.concatenate(
            [no_beginning, [0.0], log_gauge_and_gain]
        )

    def _predictions_of_pairs(self, values: Float) -> Predictions:
        """Return the predictions for all pairs of a state and a chosen draw.

        `values` (E', S, U, G) are the predicted values by draw, state, control and sensor.
        """
        draws, states, controls, sensors = values.shape
        shape = (controls, states, draws, sensors)
        shape_of_pairs = (controls, states * draws, sensors)
        deviation = self._sensor_model.independent_standard_deviation.swapaxes(0, 1)  # (U, S, G)
        inverse_deviation = np.broadcast_to(1.0 / deviation[:, :, None], shape)
        interval = self._sensor_model.interval.transpose(1, 3, 0, 2)  # (U, F, S, G)
        scaled_interval = interval[:, :, :, None] * inverse_deviation[:, None]
        factors = interval.shape[1]
        return Predictions(
            value=(values.transpose(2, 1, 0, 3) * inverse_deviation).reshape(shape_of_pairs),
            inverse_deviation=inverse_deviation.reshape(shape_of_pairs),
            log_inverse_deviation=np.ascontiguousarray(-np.log(deviation)),
            interval=scaled_interval.reshape(controls, factors, *shape_of_pairs[1:]),
        )

    def _log_gauge_prior(self) -> Float:
        """Return the log prior probability (G,) that the fault is in each gauge.

        The probability is proportional to the expected number of steps until a fault of the gauge
        is found. Otherwise a gauge with a weak signal would stand no chance against gauges whose
        faults are found in one step.
        """
        sensor_model = self._sensor_model
        gain_signal = self._settings.gauge_gain * sensor_model.mean
        information_per_step = np.mean(
            (gain_signal / sensor_model.total_standard_deviation) ** 2, axis=(0, 1)
        )
        # The information about a gain is its squared signal-to-noise ratio, and steps add up. So
        # about one over the information per step is needed until the ratio is one.
        steps_to_detection = 1.0 + 1.0 / np.maximum(information_per_step, _LEAST_INFORMATION)
        return np.asarray(np.log(steps_to_detection / steps_to_detection.sum()))

    def start(self, forecast: Float, control_index: Index) -> WatchState:
        """Return the state of the watch of B twins before the first observation of this model.

        Parameters
        ----------
        forecast : (B, S) array
            The beliefs about the state before the observation.
        control_index : (B,) array
            The controls in force.
        """
        # `prior` is the probability of each of the two kinds of fault: free gains and one gauge.
        weights = [
            HypothesisWeights.initial(
                fault_probability=2.0 * self._settings.prior * FROM_THE_START,
                log_begin=self._log_begin,
                control_index=control,
                control_count=len(self.predictions.value),
            )
            for control in control_index.tolist()
        ]
        return WatchState.initial(
            model_belief=(forecast[:, :, None] * self._draw_weight).reshape(len(forecast), -1),
            sensors=self._sensor_model.sensor_count,
            gains=len(_GAINS),
            weights=HypothesisWeights.stack(weights),
        )

    @property
    def belief_size(self) -> int:
        """The number of entries in the beliefs of the gauge faults of a twin."""
        return int(np.prod(self._gauge_belief_shape))

    def restore(self, before: Carried) -> WatchState:
        """Return the state of the watch of one twin from the arrays that it carried on."""
        return WatchState.from_arrays(before.arrays, self._gauge_belief_shape)

    def advance(self, state: WatchState, previous_control: Index, control_index: Index) -> None:
        """Advance the state of the watch of B twins to the next step, before its observation.

        The beliefs make one transition. In the weights, faults may begin, end or become hidden.

        Parameters
        ----------
        state : WatchState
            The state after the previous step; updated in place.
        previous_control : (B,) array
            The controls of the previous step, through which the states of this one follow.
        control_index : (B,) array
            The controls in force in this step.
        """
        log_begins_now = np.log(self.probability_to_begin_now(state.step_count))
        onsets = Onsets(
            self._begin_gauge_faults(state, log_begins_now),
            self._begin_free_gains(state, log_begins_now),
        )
        ended_or_hidden = self._advance_weights(
            state, log_begins_now, previous_control, control_index
        )
        recoveries = self._recoveries(state, ended_or_hidden)
        self._mix_squares(state, recoveries)
        advance_beliefs(
            self._model.transition.forward_lists,
            previous_control,
            len(self._draw_weight),
            onsets,
            recoveries,
            state.beliefs,
        )

    def _begin_gauge_faults(self, state: WatchState, log_begins_now: Float) -> Float:
        """Let faults of single gauges begin in this step; return the probability of older ones.

        This is the probability (B, G K) that each fault began before this step, given that it is
        there; beliefs are mixed with this weight. A fault that begins now has the sums of squares
        of the model so far. In the sums for the gains, old terms are forgotten, as gains may
        change.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : (B,) array
            The log prior probability that a fault begins in this step.
        """
        beliefs = state.beliefs
        gain_count = len(_GAINS)
        log_begin = log_begins_now[:, None] - np.log(gain_count)  # each gain with equal probability
        log_total = log_of_sum(state.log_gauge_evidence, log_begin)
        earlier_weight = np.exp(state.log_gauge_evidence - log_total)
        state.log_gauge_evidence = log_total
        state.gauge_onset += (1.0 - earlier_weight) * (
            state.step_count[:, None] - state.gauge_onset
        )
        # A fault that begins now has learnt no gain yet: its sums are zero.
        forgetting = self._forgetting_factor()
        np.multiply(beliefs.gauge_sum_cc, forgetting * earlier_weight, out=beliefs.gauge_sum_cc)
        np.multiply(beliefs.gauge_sum_cx, forgetting * earlier_weight, out=beliefs.gauge_sum_cx)
        model_squares = np.repeat(beliefs.model_squares, gain_count, axis=1)
        beliefs.gauge_squares[:] = (
            earlier_weight * beliefs.gauge_squares + (1.0 - earlier_weight) * model_squares
        )
        return np.asarray(earlier_weight)

    def _begin_free_gains(self, state: WatchState, log_begins_now: Float) -> Float:
        """Let free gains begin in this step; return the probability (B,) that they began before.

        Free gains are the fault that several gauges have unknown gains. It is treated as the faults
        of single gauges are in `_begin_gauge_faults`.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : (B,) array
            The log prior probability that the fault begins in this step.
        """
        beliefs = state.beliefs
        log_total = log_of_sum(state.log_free_gains_evidence, log_begins_now)
        earlier_weight = np.exp(state.log_free_gains_evidence - log_total)[:, None]
        state.log_free_gains_evidence = log_total
        new_weight = 1.0 - earlier_weight
        state.free_gains_onset += new_weight[:, 0] * (state.step_count - state.free_gains_onset)
        # The regression of each gauge is an average over the two cases. In the new one it begins
        # anew: prior probability, the squares of the model, and no sums.
        statistics = state.free_gain_statistics
        statistics.free_probability[:] += new_weight * (
            FREE_GAIN_PROBABILITY - statistics.free_probability
        )
        for squares in (statistics.fixed_squares, statistics.free_squares):
            squares += new_weight * (beliefs.model_squares - squares)
        forgetting = self._forgetting_factor()
        for sums in (statistics.sum_cc, statistics.sum_cx):
            sums *= forgetting * earlier_weight
        return np.ascontiguousarray(earlier_weight[:, 0])

    def _forgetting_factor(self) -> float:
        """Return the factor on the sums about gains in each step: gains may change slowly."""
        return float(np.exp(-1.0 / self._settings.memory_steps))

    def probability_to_begin_after(self, step: Float) -> Float:
        """Return the prior probability that a fault begins after a step (B,), counted from 0.

        It decreases slowly, as 1 / step, so that a fault may still begin after years.
        """
        return (1.0 - FROM_THE_START) / (1.0 + step / self._settings.onset_steps)

    def probability_to_begin_now(self, step: Float) -> Float:
        """Return the prior probability that a fault begins in exactly a step (B,), from 1.

        It is positive, because the probability to begin after a step decreases strictly with it.
        """
        begins_later = self.probability_to_begin_after(step)
        return self.probability_to_begin_after(step - 1.0) - begins_later

    def _advance_weights(
        self,
        state: WatchState,
        log_begins_now: Float,
        previous_control: Index,
        control: Index,
    ) -> Float:
        """Update the weights of the hypotheses for faults that begin, end or become hidden.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : (B,) array
            The log prior probability that a fault begins in this step.
        previous_control, control : (B,) array
            The controls of the step before and of this one.

        Returns
        -------
        (B, 1 + G K) array
            The probability of each fault that it ended or was hidden in this step.
        """
        # Hazard: probability to begin now, given that no fault of either kind has begun before.
        fault_probability = 2.0 * self._settings.prior  # faults of one gauge, and free gains
        begins_now_or_later = self.probability_to_begin_after(state.step_count - 1.0)
        log_no_fault_so_far = np.log1p(fault_probability * (begins_now_or_later - 1.0))
        log_hazard = np.log(fault_probability) + log_begins_now - log_no_fault_so_far

        ended_or_hidden = state.weights.change_controls(previous_control, control)
        ended_or_hidden += state.weights.advance(log_hazard, self._log_begin)
        return ended_or_hidden

    def _recoveries(self, state: WatchState, ended_or_hidden: Float) -> Recoveries:
        """Return how much probability each fault passes to the hypothesis "recovered" in this step.

        "Recovered" is the hypothesis that the gauges are right again after a fault.

        Parameters
        ----------
        ended_or_hidden : (B, 1 + G K) array
            The probability of each fault that it ended or was hidden in this step.
        """
        probability_of_all = ended_or_hidden.sum(axis=1)
        has_ended = probability_of_all > 0.0
        # The fraction of the probability of "recovered" that was added in this step.
        probability_recovered = state.weights.right_after_fault
        new_fraction = np.zeros_like(probability_of_all)
        np.divide(
            probability_of_all,
            probability_recovered,
            out=new_fraction,
            where=probability_recovered > 0.0,
        )
        new_fraction = np.where(has_ended, np.minimum(new_fraction, 1.0), 0.0)
        fault_weight = ended_or_hidden / np.where(has_ended, probability_of_all, 1.0)[:, None]
        return Recoveries(
            new_fraction,
            np.ascontiguousarray(fault_weight[:, hypothesis_weights.GAUGES_OF_FAULTS]),
            np.ascontiguousarray(fault_weight[:, hypothesis_weights.FREE_GAINS_OF_FAULTS]),
        )

    def _mix_squares(self, state: WatchState, recoveries: Recoveries) -> None:
        """Mix the sums of squares of ended and hidden faults into "recovered".

        Under a fault its own gauge has the sum of the fault, and each other gauge that of the
        model. These sums are averaged over the faults by their weights, and the average enters
        "recovered" in proportion to the probability that is new there.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        """
        beliefs = state.beliefs
        model_squares = beliefs.model_squares
        gain_count = len(_GAINS)
        difference = beliefs.gauge_squares - np.repeat(model_squares, gain_count, axis=1)
        # average over the faults of gauges: only the faulty gauge differs from the model
        by_gauge = (recoveries.gauge_weight * difference).reshape(len(difference), -1, gain_count)
        new_squares = model_squares + by_gauge.sum(axis=2)
        # the fault of free gains: each gauge is a mixture of one with and one without a gain
        statistics = state.free_gain_statistics
        free_probability = statistics.free_probability
        free_gains_squares = (
            free_probability * statistics.free_squares
            + (1.0 - free_probability) * statistics.fixed_squares
        )
        new_squares += recoveries.free_gains_weight[:, None] * (free_gains_squares - model_squares)
        beliefs.recovered_squares[:] += recoveries.new_fraction[:, None] * (
            new_squares - beliefs.recovered_squares
        )

    def assimilate(self, state: WatchState, observations: Observations) -> None:
        """Correct the beliefs and weights of all hypotheses of B twins by an observation of each.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        """
        twins, faults = state.log_gauge_evidence.shape
        log_evidence = LogEvidence(
            np.empty(twins), np.empty(twins), np.empty(twins), np.empty((twins, faults))
        )
        with np.errstate(divide="ignore"):  # what is ruled out has the logarithm minus infinity
            correct_beliefs(
                self.predictions,
                observations,
                self._priors,
                state.observation_count,
                state.beliefs,
                state.free_gain_statistics,
                log_evidence,
            )

        # Log evidence of each hypothesis minus that of the model: for alarms, which sum it over all
        # steps, and for the weights of the mixture.
        log_gauges = log_evidence.gauge - log_evidence.model[:, None]
        log_free_gains = log_evidence.free_gains - log_evidence.model
        state.log_gauge_evidence = state.log_gauge_evidence + log_gauges
        state.log_free_gains_evidence = state.log_free_gains_evidence + log_free_gains
        log_evidence_ratio = np.zeros_like(state.weights.current)
        log_evidence_ratio[:, hypothesis_weights.RECOVERED] = (
            log_evidence.recovered - log_evidence.model
        )
        log_evidence_ratio[:, hypothesis_weights.FREE_GAINS] = log_free_gains
        log_evidence_ratio[:, hypothesis_weights.GAUGE_FAULTS] = log_gauges
        state.weights.update(log_evidence_ratio)
        state.observation_count = state.observation_count + ~np.isnan(observations.readings)
        state.step_count = state.step_count + 1.0


def _choose_even_draws(draws: Float, weight: Float) -> tuple[NDArray[np.int64], Float]:
    """Choose at most `MOST_DRAWS` draws of the parameter, evenly over the range of their values.

    They are not chosen by probability, which would leave wide gaps: a true value in a gap would
    look like a fault.

    Parameters
    ----------
    draws, weight : (E,) array
        The value of the parameter in each of E draws, and the probability of the draw.

    Returns
    -------
    chosen_draws : (C,) array
        The indices of the chosen draws.
    chosen_weight : (C,) array
        For each chosen draw, the total probability of the draws that are nearest to it.
    """
    rising_order = np.argsort(draws, kind="stable")  # stable: the first of equal draws
    rising_values = draws[rising_order]
    even_values = np.linspace(rising_values[0], rising_values[-1], MOST_DRAWS)
    nearest_draws = []
    for even_value in even_values:
        nearest = np.argmin(np.abs(rising_values - even_value))
        nearest_draws.append(rising_order[nearest])
    chosen_draws = np.unique(nearest_draws)  # a draw may be the nearest to several even values

    distance = np.abs(draws[:, None] - draws[chosen_draws])  # (E, C)
    nearest_chosen = np.argmin(distance, axis=1)  # (E,)
    chosen_weight = np.bincount(nearest_chosen, weight, minlength=len(chosen_draws))
    return chosen_draws, np.asarray(chosen_weight / chosen_weight.sum(), dtype=np.float64)
