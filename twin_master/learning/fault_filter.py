"""The filters of the model and of each gauge fault, all corrected by the same observations."""

from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from twin_master.errors import InvalidModelError
from twin_master.learning import faults, hypothesis_weights
from twin_master.learning.faults import StandardizedObservation
from twin_master.learning.hypothesis_weights import HypothesisWeights
from twin_master.learning.watch_state import FREE_GAIN_PROBABILITY, FROM_THE_START, WatchState
from twin_master.network.estimator import Carried
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import MOST_DRAWS, Noticing

_GAINS = (-2.5, -1.0, 1.0, 2.5)
"""Gain errors that are compared, in `Noticing.gauge_gain`; the largest also find larger ones."""
_GAIN_DEVIATIONS = (1.0, 0.5, 0.5, 1.0)
"""Prior standard deviation of each: half of a gain error that is to be found is none."""
_MOST_BELIEF_NUMBERS = 20_000_000
"""Numbers that the beliefs of the gauge faults may take: each kept step holds them."""
_LEAST_INFORMATION = 1e-3
"""Least information about a gain in a step, so that a gauge without load has a finite prior."""
_STATE_FORMAT = b"3"
"""Changes with the layout of the carried arrays: a state of another layout is not continued."""


class FaultFilter:
    """Advances the beliefs of the model and of the faults, and corrects them by observations.

    Parameters
    ----------
    model : GraphicalModel
        S states, and their transitions.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,) array
        The value of the parameter in each draw.
    settings : Noticing
        The priors of the faults.

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

        # Predictions of the chosen draws (E', S, G) and inverse noise (S, G) for each control.
        values = sensor_model.value_per_draw[chosen_draws]
        noise = sensor_model.independent_standard_deviation
        controls = range(sensor_model.control_count)
        self._value = [np.ascontiguousarray(values[:, :, u]) for u in controls]
        self._inverse_deviation = [1.0 / noise[:, u] for u in controls]
        # A model that takes the place of another, such as one that was taught, begins without
        # suspicion: the key of its predictions differs.
        digest = sha256(_STATE_FORMAT + np.ascontiguousarray(values).tobytes()).digest()
        self.model_key = np.frombuffer(digest[:8], dtype=np.uint64)

        self.gains: Float = settings.gauge_gain * np.array(_GAINS)
        self._gain_deviations = settings.gauge_gain * np.array(_GAIN_DEVIATIONS)
        self.log_gauge_prior = self._log_gauge_prior()
        # Given that a fault begins, it is free gains or a gauge with equal probability.
        log_gauge_and_gain = np.repeat(self.log_gauge_prior - np.log(len(_GAINS)), len(_GAINS))
        no_beginning = [-np.inf, -np.inf]  # of the model and of "recovered"
        self._log_begin: Float = np.log(0.5) + np.concatenate(
            [no_beginning, [0.0], log_gauge_and_gain]
        )

    def _log_gauge_prior(self) -> Float:
        """Return the log prior probability (G,) that the fault is in each gauge.

        The probability is proportional to the expected number of steps until a fault of the gauge
        is found. Otherwise a gauge with a weak signal would have no chance beside gauges whose
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

    def start(self, forecast: Float, control_index: int) -> WatchState:
        """Return the state of the watch before the first observation of this model.

        Parameters
        ----------
        forecast : (S,) array
            The belief about the state before the observation.
        control_index : int
            The control in force.
        """
        # `prior` is the probability of each of the two kinds of fault: free gains and one gauge.
        weights = HypothesisWeights.initial(
            fault_probability=2.0 * self._settings.prior * FROM_THE_START,
            log_begin=self._log_begin,
            control_index=control_index,
            control_count=len(self._value),
        )
        model_belief = self._draw_weight[:, None] * forecast
        return WatchState.initial(
            model_belief, self._sensor_model.sensor_count, len(_GAINS), weights
        )

    def advance(self, before: Carried, control_index: int) -> WatchState:
        """Return the state of the watch in the next step, before its observation.

        The beliefs pass one transition. In the weights, faults may begin, end or become hidden.

        Parameters
        ----------
        before : Carried
            The arrays that were carried on from the previous step; they are copied, not changed.
        control_index : int
            The control in force in the next step.
        """
        state = WatchState.from_arrays(before.arrays, self._gauge_belief_shape)
        # The state follows that of the previous step through the control of the previous step.
        for belief in (
            state.model_belief,
            state.gauge_belief,
            state.free_gains_belief,
            state.recovered_belief,
        ):
            self._advance_belief(belief, before.control_index)
        # The prior probability to begin in exactly this step. It is positive: the probability to
        # begin after a step decreases strictly with the step.
        begins_later = self.probability_to_begin_after(state.step_count)
        begins_now = self.probability_to_begin_after(state.step_count - 1.0) - begins_later
        log_begins_now = np.log(begins_now)
        self._begin_gauge_faults(state, log_begins_now)
        self._begin_free_gains(state, log_begins_now)
        self._switch_hypotheses(state, log_begins_now, before.control_index, control_index)
        return state

    def _advance_belief(self, belief: NDArray[Any], control_index: int) -> None:
        """Advance beliefs (..., S) by one transition under a control, in place.

        A row of zeros stays zero. Such rows are skipped; most rows of faults of gauges are zero.
        """
        rows = belief.reshape(-1, belief.shape[-1])
        is_nonzero = rows.any(axis=1)
        rows[is_nonzero] = self._model.transition.forward(control_index, rows[is_nonzero])

    def _begin_gauge_faults(self, state: WatchState, log_begins_now: float) -> None:
        """Let faults of single gauges begin in this step, and let the sums about their gains fade.

        A fault that begins now has the belief and the sums of squares of the model so far.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : float
            The log prior probability that a fault begins in this step.
        """
        sensors, gains, draws, states = self._gauge_belief_shape
        earlier_weight = faults.mix_in_beginning_faults(
            state.model_belief,
            state.gauge_belief.reshape(-1, draws, states),
            state.log_gauge_evidence.reshape(-1),
            state.gauge_onset.reshape(-1),
            log_begins_now - np.log(gains),  # each gain with equal probability
            state.step_count,
        ).reshape(sensors, gains)
        # A fault that begins now has learnt no gain yet: its sums are zero.
        fading = self._fading_per_step()
        state.gauge_sum_cc *= fading * earlier_weight
        state.gauge_sum_cx *= fading * earlier_weight
        earlier_squares = earlier_weight * state.gauge_squares
        state.gauge_squares = (
            earlier_squares + (1.0 - earlier_weight) * state.model_squares[:, None]
        )

    def _begin_free_gains(self, state: WatchState, log_begins_now: float) -> None:
        """Let the fault of free gains begin in this step, and let its sums about the gains fade.

        Free gains are the fault that several gauges have unknown gains.

        A fault that begins now has the belief and the sums of squares of the model so far.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : float
            The log prior probability that the fault begins in this step.
        """
        (earlier_weight,) = faults.mix_in_beginning_faults(
            state.model_belief,
            state.free_gains_belief,
            state.log_free_gains_evidence,
            state.free_gains_onset,
            log_begins_now,
            state.step_count,
        )
        statistics = state.free_gain_statistics
        new_weight = 1.0 - earlier_weight
        statistics.free_probability += new_weight * (
            FREE_GAIN_PROBABILITY - statistics.free_probability
        )
        statistics.fixed_squares += new_weight * (state.model_squares - statistics.fixed_squares)
        statistics.free_squares += new_weight * (state.model_squares - statistics.free_squares)
        fading = self._fading_per_step()
        statistics.sum_cc *= fading * earlier_weight
        statistics.sum_cx *= fading * earlier_weight

    def _fading_per_step(self) -> float:
        """Return the factor by which the sums about gains fade in a step, as gains may change."""
        return float(np.exp(-1.0 / self._settings.memory_steps))

    def probability_to_begin_after(self, step: float) -> float:
        """Return the prior probability that a fault begins after a step, counted from 0.

        It decreases slowly, as 1 / step, so that a fault may still begin after years.
        """
        return (1.0 - FROM_THE_START) / (1.0 + step / self._settings.onset_steps)

    def _switch_hypotheses(
        self, state: WatchState, log_begins_now: float, previous_control: int, control: int
    ) -> None:
        """Update the weights of the hypotheses for faults that begin, end or become hidden.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        log_begins_now : float
            The log prior probability that a fault begins in this step.
        previous_control, control : int
            The controls of the step before and of this one.
        """
        # Hazard: probability to begin now, given that no fault of either kind has begun before.
        fault_probability = 2.0 * self._settings.prior
        begins_now_or_later = self.probability_to_begin_after(state.step_count - 1.0)
        log_no_fault_so_far = np.log1p(fault_probability * (begins_now_or_later - 1.0))
        log_hazard = np.log(fault_probability) + log_begins_now - log_no_fault_so_far

        ended_or_hidden = np.zeros_like(state.weights.hidden)
        if previous_control != control:
            ended_or_hidden += state.weights.change_control(previous_control, control)
        ended_or_hidden += state.weights.advance(log_hazard, self._log_begin)
        if ended_or_hidden.sum() > 0.0:
            self._move_to_recovered(state, ended_or_hidden)

    def _move_to_recovered(self, state: WatchState, right_again: Float) -> None:
        """Mix the beliefs and sums of ended and hidden faults into the hypothesis "recovered".

        "Recovered" is the hypothesis that the gauges are right again after a fault.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        right_again : (1 + G K,) array
            The probability of each fault that it ended or was hidden in this step.
        """
        probability_of_all = right_again.sum()
        # The fraction of the probability of "recovered" that was added in this step.
        fraction_new = min(probability_of_all * np.exp(-state.weights.log_right_after_fault), 1.0)
        fault_weight = right_again / probability_of_all
        free_gains_weight = fault_weight[hypothesis_weights.FREE_GAINS_OF_FAULTS]
        gauge_weight = fault_weight[hypothesis_weights.GAUGES_OF_FAULTS]

        gauge_rows = state.gauge_belief.reshape(len(gauge_weight), -1)
        gauge_belief = gauge_weight.astype(np.float32) @ gauge_rows
        new_belief = (
            gauge_belief.reshape(state.recovered_belief.shape)
            + free_gains_weight * state.free_gains_belief[0]
        )
        state.recovered_belief += fraction_new * (
            new_belief / new_belief.sum() - state.recovered_belief
        )

        # Sums of squares: those of the model for a sound gauge and those of the fault for a faulty
        # one, averaged over the faults by their weights.
        new_squares = state.model_squares.copy()
        gauge_weight = gauge_weight.reshape(state.gauge_squares.shape)
        new_squares += np.sum(gauge_weight * (state.gauge_squares - new_squares[:, None]), axis=1)
        statistics = state.free_gain_statistics
        free_probability = statistics.free_probability
        free_gains_squares = (
            free_probability * statistics.free_squares
            + (1.0 - free_probability) * statistics.fixed_squares
        )
        new_squares += free_gains_weight * (free_gains_squares - state.model_squares)
        state.recovered_squares += fraction_new * (new_squares - state.recovered_squares)

    def assimilate(
        self, state: WatchState, readings: Float, log_density_beside: Float, control_index: int
    ) -> None:
        """Correct the beliefs and weights of all hypotheses by an observation.

        Parameters
        ----------
        state : WatchState
            The state of the watch; updated in place.
        readings : (G,) array
            The sensor values, SI; NaN where a sensor is lost or left out.
        log_density_beside : (S,) array
            The log density of the rest of the observation, such as readings of inspections.
        control_index : int
            The control in force.
        """
        observation, log_density_without_residuals = self._standardize(
            state, readings, log_density_beside, control_index
        )
        log_recovered = self._update_recovered(state, observation, log_density_without_residuals)

        model_squares_before = state.model_squares.copy()
        log_likelihood = log_density_without_residuals.copy()
        log_model, kernel = faults.update_model(
            observation, state.model_squares, state.model_belief.reshape(-1), log_likelihood
        )
        model = faults.ModelLikelihood(model_squares_before, kernel, log_likelihood)
        with np.errstate(divide="ignore"):  # what is ruled out has the logarithm minus infinity
            log_gauges = faults.update_gauge_faults(
                observation,
                model,
                self.gains,
                self._gain_deviations,
                state.gauge_belief.reshape(-1, len(log_likelihood)),
                state.gauge_squares,
                state.gauge_sum_cc,
                state.gauge_sum_cx,
            )
            log_free_gains = faults.update_free_gains(
                observation,
                model,
                self._settings.all_gain,
                state.free_gains_belief.reshape(-1),
                state.free_gain_statistics,
            )

        # Log evidence of each hypothesis minus that of the model: for alarms, which sum it over all
        # steps, and for the weights of the mixture.
        state.log_gauge_evidence += log_gauges - log_model
        state.log_free_gains_evidence += log_free_gains - log_model
        log_evidence_ratio = np.zeros_like(state.weights.current)
        log_evidence_ratio[hypothesis_weights.RECOVERED] = log_recovered - log_model
        log_evidence_ratio[hypothesis_weights.FREE_GAINS] = log_free_gains - log_model
        log_evidence_ratio[hypothesis_weights.GAUGE_FAULTS] = (log_gauges - log_model).ravel()
        state.weights.update(log_evidence_ratio)
        state.observation_count += observation.present
        state.step_count += 1.0

    def _update_recovered(
        self,
        state: WatchState,
        observation: StandardizedObservation,
        log_density_without_residuals: Float,
    ) -> float:
        """Correct the belief of "recovered" by an observation, and return its log evidence.

        "Recovered" is the hypothesis that the gauges are right again after a fault.

        Parameters
        ----------
        state : WatchState
            The state of the watch; belief and squares of "recovered" are updated in place. The
            squares of the model are still those before the observation.
        observation : StandardizedObservation
            The observation, for N pairs of a draw and a state.
        log_density_without_residuals : (N,) array
            The log density of the observation but for its standardised residuals.
        """
        recovered_squares_before = state.recovered_squares.copy()
        log_evidence, _ = faults.update_model(
            observation,
            state.recovered_squares,
            state.recovered_belief.reshape(-1),
            log_density_without_residuals.copy(),
        )
        # Each hypothesis has learnt noise scales of its own. They enter the constant of Student's
        # density: 1 / sqrt(degrees + squares) for each gauge.
        log_scale_ratio = np.log(
            (observation.degrees + state.model_squares)
            / (observation.degrees + recovered_squares_before)
        )
        return log_evidence + 0.5 * float(np.sum(log_scale_ratio, where=observation.present))

    def _standardize(
        self, state: WatchState, readings: Float, log_density_beside: Float, control_index: int
    ) -> tuple[StandardizedObservation, Float]:
        """Return an observation in units of the noise, and the first part of its log density.

        This part (N,), for each pair of a draw and a state, is the same under all hypotheses. It
        lacks the densities of the standardised residuals, which depend on the hypothesis. The
        parameters are those of `assimilate`.
        """
        degrees = self._settings.noise_degrees
        count = state.observation_count
        # A gauge is weighted by the noise that is learnt. Otherwise a gauge that is off would shift
        # the best fit within the interval of a state, and so the residuals of all other gauges.
        precision = np.minimum((degrees + count) / (degrees + state.model_squares), 1.0)
        best_fit = self._sensor_model.fit_within_interval(
            readings, control_index, self._value[control_index], precision
        )
        is_present = ~np.isnan(readings)
        inverse_deviation = np.where(is_present, self._inverse_deviation[control_index], 0.0)
        prediction = (best_fit.value * inverse_deviation).reshape(-1, len(readings))
        difference = np.where(is_present, readings - best_fit.value, 0.0)
        observation = StandardizedObservation(
            present=is_present,
            residual=(difference * inverse_deviation).reshape(prediction.shape),
            prediction=prediction,
            power=0.5 * (degrees + count + 1.0),
            degrees=degrees,
        )
        log_scale = np.log(inverse_deviation[:, is_present]).sum(axis=1)
        log_prior_density = best_fit.log_density + log_density_beside + log_scale
        return observation, log_prior_density.ravel()


def _choose_even_draws(draws: Float, weight: Float) -> tuple[NDArray[np.int64], Float]:
    """Choose draws evenly over the whole range, each with the probability of the draws around it.

    The chosen draws are evenly spaced: a true value in a wide gap between two of them would look
    like a fault.

    Parameters
    ----------
    draws, weight : (E,) array
        The value and the probability of each draw.

    Returns
    -------
    chosen_draws : (E',) array
        The indices of the chosen draws.
    chosen_weight : (E',) array
        For each chosen draw, the total probability of the draws that are nearest to it.
    """
    order = np.argsort(draws, kind="stable")
    grid = np.linspace(draws[order[0]], draws[order[-1]], MOST_DRAWS)
    nearest_to_grid = [order[np.argmin(np.abs(draws[order] - value))] for value in grid]
    chosen_draws = np.unique(nearest_to_grid)
    nearest_chosen = np.argmin(np.abs(draws[:, None] - draws[chosen_draws]), axis=1)
    chosen_weight = np.bincount(nearest_chosen, weight, minlength=len(chosen_draws))
    return chosen_draws, np.asarray(chosen_weight / chosen_weight.sum(), dtype=np.float64)
