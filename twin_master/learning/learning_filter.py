"""The filter that learns: static hypotheses as an axis of the belief, gauges by regression.

A static hypothesis k is a draw of the calibrated parameter, the fraction that the sensors lose to
soft saturation, and a factor on the transition probabilities; none of them changes in time. Each
hypothesis has a filter of its own over the states, and its weight is its evidence:

    p(D_t, k | o_0..o_t) ~
        p(o_t | D_t, k, o_0..o_t-1) sum over i of T_k[i, D_t] p(D_t-1 = i, k | o_0..o_t-1),

which is exact: D_t is the state in step t, o_t the observation, and T_k the transitions. The
offset, gain and noise scale of a gauge, given the hypothesis, are learnt by a `GaugeRegression`.

The axes of arrays are n or T steps, K hypotheses, E draws of the parameter, N lost fractions, S
states, U controls and G gauges.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from twin_master.errors import ImpossibleObservation
from twin_master.learning.draw_posterior import (
    INTERVAL,
    posterior_of_draws,
    posterior_of_points,
)
from twin_master.learning.regression import SUM_COUNT, GaugeFit, GaugeReadings, GaugeRegression
from twin_master.learning.saturation import LOST_FRACTIONS, with_saturation
from twin_master.network.estimator import (
    BELIEVED,
    Carried,
    Estimate,
    Learnt,
    Notice,
    NoticeWording,
)
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import log_forecast, smooth_many
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import TransitionModel
from twin_master.scenario.tables import Learning

_NEGLIGIBLE_WEIGHT = 1e-9
"""A hypothesis with a smaller part of the belief is left out of predictions."""
_NORMAL_HALF_WIDTH = 1.6448536269514722
"""Half-width of the central 90 % of a normal distribution, in standard deviations."""


class LearntParameter(NamedTuple):
    """The calibrated parameter, if it is learnt: its name, and the value of each draw (E,)."""

    name: str
    values: ArrayLike


@dataclass(frozen=True)
class StaticHypotheses:
    """Joint belief over S states and K static hypotheses, and the gauge coefficients given each.

    Attributes
    ----------
    weight : (K, S) array
        The belief p(D, k | observations).
    draw : (K,) array
        The index of the draw of each hypothesis, n E + e for lost fraction n and draw e of
        the parameter.
    offset : (K, G) array
        The posterior mean of each offset given the hypothesis, SI.
    gain : (K, G) array
        The posterior mean of each gain error given the hypothesis, dimensionless.
    offset_variance, covariance, gain_variance : (K, G) array
        The posterior covariance of offset and gain error, averaged over the noise scale.
    squared_noise_scale : (K, G) array
        The posterior mean of the squared noise scale.
    """

    weight: Float
    draw: Index
    offset: Float
    gain: Float
    offset_variance: Float
    covariance: Float
    gain_variance: Float
    squared_noise_scale: Float


class LearningFilter:
    """Exact filter over states and static hypotheses, with a conjugate regression for each gauge.

    It carries `log_belief` (K, S), the log of p(D_t, k | o_0..o_t); `statistics` (K, G, 6), the
    sums of the regressions (`RegressionSums`); and `count` (G,), the number of observations of each
    sensor.

    Parameters
    ----------
    model : GraphicalModel
        S states, U controls; the twin predicts and plans with its transitions.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G), weights of the draws, and the assumed noise. If saturation is
        learnt, the attribute of that name has N E draws, see `with_saturation`.
    settings : Learning
        The priors of the gauges; the factors on transitions are those of `transitions`.
    draws : (str, (E,) array), optional
        The name of the calibrated parameter, and its values in the order of the sensor model. If
        left out, the draws are averaged anew in each step.
    transitions : mapping of float to TransitionModel, optional
        For each factor on the probabilities to leave a state its transitions, equally probable at
        first; only those of the model if left out.
    name : str
        The name of the twin, for messages.
    sensor_units : sequence of str, optional
        The unit of each sensor; "1" if left out.

    Attributes
    ----------
    parameter_weight : (E,) array
        The prior probability of each draw of the parameter.

    Raises
    ------
    InvalidModelError
        If saturation is to be learnt of sensors whose noise is not Gaussian.
    """

    def __init__(
        self,
        model: GraphicalModel,
        sensor_model: GaussianSensorModel,
        settings: Learning,
        draws: tuple[str, ArrayLike] | None = None,
        transitions: Mapping[float, TransitionModel] | None = None,
        name: str = "twin",
        sensor_units: Sequence[str] = (),
        words: NoticeWording | None = None,
    ) -> None:
        transitions = transitions or {1.0: model.transition}
        self._units = sensor_units or ("1",) * sensor_model.sensor_count
        self.parameter_weight = sensor_model.draw_weight  # (E,)
        self._lost_fractions = LOST_FRACTIONS[:1]
        if settings.saturation > 0.0:
            self._lost_fractions = LOST_FRACTIONS
            sensor_model = with_saturation(
                sensor_model, model.prior, settings.saturation, self._units
            )
        self.model = model
        self.sensor_model = sensor_model
        self._words = words or NoticeWording()
        self.parameter = None if draws is None else LearntParameter(*draws)
        self._name = name
        self._transition_factors = np.array(list(transitions))

        # Hypothesis k is draw k % (N E) with factor k // (N E). The transitions of all factors
        # stand one after the other as further controls, so that one loop advances all hypotheses:
        # control u of a hypothesis is the row u + `_control_offset` of the stacked tables.
        factor_count = len(transitions)
        blocks_by_factor = [transition.blocks for transition in transitions.values()]
        stacked_blocks = tuple(
            np.concatenate(blocks) for blocks in zip(*blocks_by_factor, strict=True)
        )
        self._transition = TransitionModel(stacked_blocks)
        self._draw_of_hypothesis: Index = np.tile(np.arange(sensor_model.draw_count), factor_count)
        factor_index: Index = np.repeat(np.arange(factor_count), sensor_model.draw_count)
        self._control_offset: Index = factor_index * len(model.controls)  # (K,)

        prior_weight = np.tile(sensor_model.draw_weight / factor_count, factor_count)
        with np.errstate(divide="ignore"):
            self._log_prior_weight: Float = np.log(prior_weight)
        self._inverse_deviation = 1.0 / sensor_model.independent_standard_deviation
        self._gauges = GaugeRegression(
            offset_deviation=np.full(sensor_model.sensor_count, settings.gauge_offset, np.float64),
            gain_deviation=np.full(sensor_model.sensor_count, settings.gauge_gain, np.float64),
            degrees_of_freedom=settings.noise_degrees if settings.noise else 0.0,
        )

    @property
    def prior(self) -> Mapping[str, Learnt]:
        """The prior of each learnt quantity, by name."""
        sensors = self.sensor_model.sensor_count
        weight = np.exp(self._log_prior_weight)
        regression_sums = np.zeros((len(weight), sensors, SUM_COUNT))
        return self._learnt_quantities(weight, regression_sums, np.zeros(sensors))

    def step(
        self, before: Carried | None, observation: Float, control_index: int, step: int
    ) -> Estimate:
        """Advance the joint belief to step t, and correct it by an observation.

        Parameters and errors are those of `Estimator.step`. `learnt` of the estimate holds by name
        the parameter, `saturation`, `transition_factor`, and `noise_scale[g]`, `gauge_gain[g]` and
        `gauge_offset[g]` for the sensors g from 1.
        """
        sensor_values, other_log_density = self.sensor_model.split_observation(observation)
        forecast, regression_sums, count = self._forecast(before)

        # Correct the belief by the sensors, and by the other parts of the observation.
        inverse_deviation = self._inverse_deviation[:, control_index]
        best_fit = self.sensor_model.fit_within_interval(
            sensor_values,
            control_index,
            self.sensor_model.value_per_draw[:, :, control_index],
        )
        readings = GaugeReadings(
            sensor_values, self._draw_of_hypothesis, best_fit.value, inverse_deviation
        )
        log_belief = forecast + other_log_density + best_fit.log_density[self._draw_of_hypothesis]
        log_belief += self._gauges.log_density(readings, regression_sums, count)

        # Normalise it.
        largest = float(log_belief.max())
        if largest == -np.inf:
            worst_residuals = self.sensor_model.worst_residuals(sensor_values, control_index)
            raise ImpossibleObservation(self._name, step, worst_residuals)
        joint_belief = np.exp(log_belief - largest)
        log_evidence = largest + float(np.log(joint_belief.sum()))
        joint_belief /= joint_belief.sum()
        log_belief -= log_evidence

        # Update the regressions. Each gauge is compared with the fit by all other gauges: a fit
        # that contains the gauge follows its noise, which would seem smaller than it is.
        if self._gauges.learns:
            predictive_scale = inverse_deviation * np.sqrt(best_fit.one_minus_leverage)
            readings = GaugeReadings(
                sensor_values, self._draw_of_hypothesis, best_fit.value_by_others, predictive_scale
            )
            regression_sums = regression_sums + self._gauges.expected_products(readings, log_belief)
        count = count + ~np.isnan(sensor_values)
        arrays = {"log_belief": log_belief, "statistics": regression_sums, "count": count}
        return Estimate(
            forecast=np.exp(forecast).sum(axis=0),
            filtered=joint_belief.sum(axis=0),
            log_evidence=log_evidence,
            carried=Carried(control_index, arrays),
            learnt=self._learnt_quantities(joint_belief.sum(axis=1), regression_sums, count),
            notices=self._saturation_notices(np.exp(forecast), joint_belief, step),
        )

    def _saturation_notices(
        self, forecast: Float, joint_belief: Float, step: int
    ) -> tuple[Notice, ...]:
        """Return a notice if the probability of saturation crosses one half in this step.

        Parameters
        ----------
        forecast, joint_belief : (K, S) array
            The belief before and after the observation of the step.
        """
        before, after = (
            float(self._weight_of_fractions(belief.sum(axis=1))[1:].sum())
            for belief in (forecast, joint_belief)
        )
        if (before > BELIEVED) == (after > BELIEVED):
            return ()
        if after > BELIEVED:
            finding = (
                f"large readings of all {self._words.sensor}s are too small, as if they saturated "
                f"softly (probability {after:.3g}): the belief corrects them"
            )
        else:
            finding = f"the {self._words.sensor}s do not saturate (probability {1.0 - after:.3g})"
        return (Notice("hypothesis", f"{self._words.name_step(step)}: {finding}."),)

    def _weight_of_fractions(self, weight: Float) -> Float:
        """Return the probability of each lost fraction (N,) from the hypotheses' weights (K,)."""
        by_fraction = weight.reshape(len(self._transition_factors), len(self._lost_fractions), -1)
        return np.asarray(by_fraction.sum(axis=(0, 2)))

    def _forecast(self, before: Carried | None) -> tuple[Float, Float, Float]:
        """Return the belief, the regression sums and the counts before the observation of a step.

        Returns
        -------
        log_forecast : (K, S) array
            The log of p(D_t, k | o_0..o_t-1), for K static hypotheses and S states.
        regression_sums : (K, G, 6) array
            The sums over earlier steps from which the gauge coefficients are fitted.
        count : (G,) array
            The number of earlier observations of each sensor.
        """
        if before is None:
            sensors = self.sensor_model.sensor_count
            regression_sums = np.zeros((len(self._draw_of_hypothesis), sensors, SUM_COUNT))
            log_joint_prior = self._log_prior_weight[:, None] + self.model.log_prior
            return log_joint_prior, regression_sums, np.zeros(sensors)
        stacked_control = self._control_offset + before.control_index
        forecast = log_forecast(self._transition, stacked_control, before.arrays["log_belief"])
        if self.parameter is None:  # the parameter is not learnt
            forecast = self._with_prior_draw_weights(forecast)
        return forecast, before.arrays["statistics"], before.arrays["count"]

    def hypotheses(self, carried: Carried, weight: Float | None = None) -> StaticHypotheses:
        """Return the joint belief after a step and the gauge coefficients given each hypothesis.

        Hypotheses of negligible weight are left out.

        Parameters
        ----------
        carried : Carried
            The arrays that the filter carried on from the step.
        weight : (K, S) array, optional
            Another joint belief over hypotheses and states, such as a smoothed one, that takes the
            place of the filtered one.
        """
        if weight is None:
            weight = np.exp(carried.arrays["log_belief"])
        hypothesis_weight = weight.sum(axis=1)
        is_relevant = hypothesis_weight > _NEGLIGIBLE_WEIGHT * hypothesis_weight.sum()
        relevant = np.flatnonzero(is_relevant)

        # Regression of offset and gain error, in units of their prior standard deviations.
        fit = self._gauges.fit(carried.arrays["statistics"][relevant])
        offset_deviation = self._gauges.offset_deviation
        gain_deviation = self._gauges.gain_deviation
        squared_noise_scale = self._gauges.squared_noise_scale(fit, carried.arrays["count"])
        # Convert the posterior covariance to SI: a coefficient is in units of its prior standard
        # deviation. It holds for a noise scale of one, and is proportional to the squared scale.
        offset_variance = offset_deviation**2 * fit.offset_variance
        covariance = offset_deviation * gain_deviation * fit.covariance
        gain_variance = gain_deviation**2 * fit.gain_variance
        return StaticHypotheses(
            weight=weight[relevant],
            draw=self._draw_of_hypothesis[relevant],
            offset=offset_deviation * fit.offset,
            gain=gain_deviation * fit.gain,
            offset_variance=squared_noise_scale * offset_variance,
            covariance=squared_noise_scale * covariance,
            gain_variance=squared_noise_scale * gain_variance,
            squared_noise_scale=squared_noise_scale,
        )

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return the smoothed beliefs p(D_i | o_0..o_t) of n steps i, the last being t: (n, S)."""
        return np.asarray(self.smoothed_hypotheses(carried).sum(axis=1))

    def smoothed_hypotheses(self, carried: Sequence[Carried]) -> Float:
        """Return the smoothed joint belief over hypotheses on constant unknowns and over states.

        Parameters
        ----------
        carried : sequence of Carried
            The arrays that the filter carried on from n steps, the last of which is step t.

        Returns
        -------
        (n, K, S) array
            p(D_i, k | o_0..o_t) for each step i, hypothesis k and state D_i.
        """
        from scipy.special import logsumexp  # slow to import; only a twin that learns needs it

        step_count = len(carried)
        hypothesis_count = len(self._draw_of_hypothesis)
        smoothed_joint = np.zeros((step_count, hypothesis_count, self.model.states.size))
        if step_count == 0:
            return smoothed_joint
        log_belief = np.array([step.arrays["log_belief"] for step in carried])  # (n, K, S)
        if self.parameter is None and hypothesis_count > 1:
            # The parameter is not learnt: its draws are averaged anew in each step, so that what a
            # step says about the draws must not weigh in other steps.
            log_belief = np.stack(
                [self._with_prior_draw_weights(belief_of_step) for belief_of_step in log_belief]
            )

        # Hypotheses do not change in time, so their smoothed weights are those after the last step.
        # The belief over states is smoothed separately under each hypothesis that is possible.
        weight = np.exp(log_belief[-1]).sum(axis=1)  # (K,)
        possible = np.flatnonzero(weight > 0.0)
        log_joint = log_belief[:, possible]
        log_given_hypothesis = log_joint - logsumexp(log_joint, axis=2, keepdims=True)

        # `smooth_many` takes a row for each hypothesis, not for each step: beliefs (K, n, S).
        log_by_hypothesis = np.ascontiguousarray(log_given_hypothesis.swapaxes(0, 1))
        control_of_step = np.array([step.control_index for step in carried])  # (n,)
        stacked_control = self._control_offset[possible, None] + control_of_step  # (K, n)
        smoothed_by_hypothesis = smooth_many(
            self._transition, stacked_control, np.exp(log_by_hypothesis), log_by_hypothesis
        )
        smoothed_joint[:, possible] = weight[possible, None] * smoothed_by_hypothesis.swapaxes(0, 1)
        return smoothed_joint

    def _with_prior_draw_weights(self, log_belief: Float) -> Float:
        """Return a log belief (K, S) in which the draws have their prior weights again.

        All draws of the parameter get the same belief over states, given a transition factor and a
        lost fraction; the weights of the transition factors and of the lost fractions stay as they
        are.
        """
        draw_count = len(self.parameter_weight)
        by_draw = log_belief.reshape(-1, draw_count, log_belief.shape[1])
        log_belief_of_others = np.logaddexp.reduce(by_draw, axis=1)
        with np.errstate(divide="ignore"):
            log_weight = np.log(self.parameter_weight)
        averaged = log_belief_of_others[:, None] + log_weight[:, None]
        return np.asarray(averaged.reshape(log_belief.shape))

    def _learnt_quantities(
        self, weight: Float, regression_sums: Float, count: Float
    ) -> Mapping[str, Learnt]:
        """Return the posterior of each learnt quantity by name.

        Parameters
        ----------
        weight : (K,) array
            The probability of each hypothesis.
        regression_sums : (K, G, 6) array
            The sums over all steps from which the gauge coefficients are fitted.
        count : (G,) array
            The number of observations of each sensor.
        """
        factor_count = len(self._transition_factors)
        fraction_count = len(self._lost_fractions)
        by_hypothesis = weight.reshape(factor_count, fraction_count, -1)  # (factors, N, E)
        result: dict[str, Learnt] = {}
        if self.parameter is not None:
            result[self.parameter.name] = posterior_of_draws(
                self.parameter.values, self.parameter_weight, by_hypothesis.sum(axis=(0, 1))
            )
        if fraction_count > 1:
            fraction_weights = self._weight_of_fractions(weight)
            result["saturation"] = posterior_of_points(self._lost_fractions, fraction_weights)
        if factor_count > 1:
            prior = np.full(factor_count, 1.0 / factor_count)
            result["transition_factor"] = posterior_of_draws(
                self._transition_factors, prior, by_hypothesis.sum(axis=(1, 2))
            )
        if self._gauges.learns:
            fit = self._gauges.fit(regression_sums)
            if self._gauges.learns_noise:
                result |= self._learnt_noise_scales(weight, fit, count)
            result |= self._learnt_offsets_and_gains(weight, fit, count)
        return result

    def _learnt_noise_scales(self, weight: Float, fit: GaugeFit, count: Float) -> dict[str, Learnt]:
        """Return the posterior of each gauge's noise scale: true over assumed standard deviation.

        Given a hypothesis, the square of a noise scale has an inverse gamma distribution. Mean and
        variance are averaged over the hypotheses. The quantiles are approximate: those of the
        inverse gamma distribution whose rate is the mean over the hypotheses.

        Parameters
        ----------
        weight : (K,) array
            The probability of each hypothesis.
        count : (G,) array
            The number of observations of each gauge.

        Returns
        -------
        dict of str to Learnt
            The posteriors by `noise_scale[g]`, with the gauges g counted from 1.
        """
        from scipy.special import gammaincinv, gammaln  # slow to import, as above

        degrees_of_freedom = self._gauges.degrees_of_freedom
        shape = 0.5 * (degrees_of_freedom + count)  # (G,)
        rate = 0.5 * (degrees_of_freedom + fit.sum_of_squares)  # (K, G)
        mean_rate = weight @ rate
        low_level, high_level = INTERVAL
        # The squared scale is the rate over a gamma variate. So the lower bound of the scale
        # belongs to the upper quantile of the variate.
        lower = np.sqrt(mean_rate / gammaincinv(shape, high_level))
        upper = np.sqrt(mean_rate / gammaincinv(shape, low_level))
        # For a gamma variate x: E(1 / sqrt(x)) = Gamma(shape - 1/2) / Gamma(shape), and
        # E(1 / x) = 1 / (shape - 1).
        mean = weight @ np.sqrt(rate) * np.exp(gammaln(shape - 0.5) - gammaln(shape))
        mean_square = mean_rate / (shape - 1.0)
        deviation = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
        return {
            f"noise_scale[{g + 1}]": Learnt(
                float(mean[g]), float(deviation[g]), float(lower[g]), float(upper[g])
            )
            for g in range(len(mean))
        }

    def _learnt_offsets_and_gains(
        self, weight: Float, fit: GaugeFit, count: Float
    ) -> dict[str, Learnt]:
        """Return the posterior of each offset and gain error by name.

        Parameters
        ----------
        weight : (K,) array
            The probability of each hypothesis.
        count : (G,) array
            The number of observations of each sensor.
        """
        squared_noise_scale = self._gauges.squared_noise_scale(fit, count)
        offsets = _learnt_coefficients(
            "gauge_offset",
            self._units,
            self._gauges.offset_deviation,
            mean=weight @ fit.offset,
            mean_square=weight @ (fit.offset**2 + squared_noise_scale * fit.offset_variance),
        )
        gains = _learnt_coefficients(
            "gauge_gain",
            ("1",) * len(self._units),
            self._gauges.gain_deviation,
            mean=weight @ fit.gain,
            mean_square=weight @ (fit.gain**2 + squared_noise_scale * fit.gain_variance),
        )
        return offsets | gains


def _learnt_coefficients(
    name: str, units: Sequence[str], prior_deviation: Float, mean: Float, mean_square: Float
) -> dict[str, Learnt]:
    """Return the posterior of a coefficient of each gauge, by `name[g]` with g from 1.

    Parameters
    ----------
    units : sequence of str
        The unit of the coefficient for each gauge.
    prior_deviation : (G,) array
        The prior standard deviation, in that unit; a gauge with 0 does not learn the coefficient.
    mean, mean_square : (G,) array
        Posterior moments of the coefficient in prior standard deviations.
    """
    deviation = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
    result = {}
    for g in np.flatnonzero(prior_deviation > 0.0).tolist():
        posterior_mean = float(mean[g] * prior_deviation[g])
        standard_deviation = float(deviation[g] * prior_deviation[g])
        half_width = _NORMAL_HALF_WIDTH * standard_deviation
        result[f"{name}[{g + 1}]"] = Learnt(
            posterior_mean,
            standard_deviation,
            posterior_mean - half_width,
            posterior_mean + half_width,
            units[g],
        )
    return result
