"""Expected sensor values and rewards, under the belief of a learning filter.

The belief is that over states and static hypotheses together. So the correlation of the parameter
and the damage, which the data cause, stays in it. Means and standard deviations are exact.
Quantiles take a sensor value to be normally distributed given the state.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from twin_master.learning.learning_filter import LearningFilter, StaticHypotheses
from twin_master.learning.saturation import LOST_FRACTIONS
from twin_master.network.estimator import Carried, Learnt
from twin_master.network.graphical_model import interpolation_weights
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel

_LEVELS = np.array([0.025, 0.975])
"""Levels of the reported quantiles: the bounds of a central 95 % interval."""
_NEGLIGIBLE_PROBABILITY = 1e-9
"""A state of smaller probability does not change the quantiles."""
_HALVINGS = 18
"""Bisections: the interval of 13 standard deviations shrinks to 5e-5 of one."""
_SEARCH_DEVIATIONS = 6.5
"""Standard deviations from the mean within which the 2.5 and 97.5 % quantiles lie.

By Cantelli's inequality a quantile of probability p lies within sqrt((1 - p) / p) = 6.2 of them.
"""


@dataclass(frozen=True)
class Expectation:
    """Expected values of G sensors and of the rewards, under beliefs along the leading axes.

    Attributes
    ----------
    mean, standard_deviation, lower, upper : (..., G) array
        Moments of the values without noise, and their quantiles of 2.5 and 97.5 %, SI.
    noise_standard_deviation : (..., G) array
        The standard deviation of noise and model error, SI.
    reward_mean, reward_standard_deviation : (..., 3) array
        Moments of the rewards, in the order of `REWARD_NAMES`.
    """

    mean: Float
    standard_deviation: Float
    lower: Float
    upper: Float
    noise_standard_deviation: Float
    reward_mean: Float
    reward_standard_deviation: Float


def expectation_of_draws(
    sensor_model: GaussianSensorModel,
    rewards: RewardModel,
    joint: Float,
    rows: Float | None,
    *,
    quantiles: bool = True,
) -> Expectation:
    """Return what a twin that learns nothing expects of sensors and rewards under its beliefs.

    The draws of the calibrated parameter keep their weights.

    Parameters
    ----------
    sensor_model : GaussianSensorModel
        S states, U controls, G sensors.
    joint : (..., S, U) array
        The joint belief over states and controls.
    rows : (..., G + I) array or None
        What was observed: the sensors, and further readings; None for a prediction.
    quantiles : bool
        Whether quantiles are computed; else they are NaN.
    """
    mean, standard_deviation = sensor_model.moments(joint)
    lower = upper = np.full_like(mean, np.nan)
    if quantiles:
        lower, upper = np.moveaxis(sensor_model.quantiles(joint, _LEVELS), -2, 0)
    observation = None if rows is None else rows[..., : sensor_model.sensor_count]
    reward_mean, reward_standard_deviation = rewards.expectation(joint, observation)
    return Expectation(
        mean=mean,
        standard_deviation=standard_deviation,
        lower=lower,
        upper=upper,
        noise_standard_deviation=sensor_model.noise(joint, rows),
        reward_mean=reward_mean,
        reward_standard_deviation=reward_standard_deviation,
    )


@dataclass(frozen=True)
class LearntExpectation:
    """Computes expectations under the beliefs of a learning filter.

    Attributes
    ----------
    learning : LearningFilter
        The filter whose beliefs are used.
    rewards : RewardModel
        The rewards of the asset.
    policy : (S, U) array
        The policy p(U | D) that predicts the controls.
    """

    learning: LearningFilter
    rewards: RewardModel
    policy: Float

    def filtered(
        self, carried: Sequence[Carried], beliefs: Float, observations: Float
    ) -> Expectation:
        """Return the expected sensor values and rewards in T steps, given the observations so far.

        Parameters
        ----------
        carried : sequence of Carried
            What the filter carried on from each step.
        beliefs : (T, S) array
            The beliefs about the state. They differ from those of the filter if competing
            hypotheses, such as a gauge fault, are mixed into them.
        observations : (T, G) array
            The observed sensor values, SI.
        """
        hypotheses = (self.learning.hypotheses(step) for step in carried)
        return self._expect_steps(hypotheses, carried, beliefs, observations)

    def smoothed(
        self, carried: Sequence[Carried], beliefs: Float, observations: Float
    ) -> Expectation:
        """Return the expectation in T steps given all observations; see `filtered`."""
        hypotheses = (
            self.learning.hypotheses(carried[-1], joint_belief)
            for joint_belief in self.learning.smoothed_hypotheses(carried)
        )
        return self._expect_steps(hypotheses, carried, beliefs, observations)

    def predicted(
        self, carried: Sequence[Carried], beliefs: Float, policies: Float, horizon: int
    ) -> Expectation:
        """Return the predicted sensor values and rewards in the H steps after each of T steps.

        S is the number of states, U that of controls.

        Parameters
        ----------
        carried : sequence of Carried
            The arrays that the filter carried on from each of the T steps.
        beliefs : (T, S) array
            The filtered belief about the state in each of the T steps.
        policies : (T, S, U) array
            For each of the T steps the policy p(control | state) in all H steps after it.
        horizon : int
            The number H of predicted steps.

        Returns
        -------
        Expectation
            The predicted values; their leading axes are (T, H).
        """
        steps = zip(carried, beliefs, policies, strict=True)
        predictions = [
            self._expect_ahead(step, belief, policy, horizon) for step, belief, policy in steps
        ]
        return stack_expectations(predictions)

    def from_marginals(
        self,
        learnt: Mapping[str, Learnt],
        joint: Float,
        controls: slice,
        observation: Float | None,
    ) -> Expectation:
        """Return the expectation under B beliefs if only the marginals of a filter are known.

        The learnt quantities are taken to be independent of each other and of the state. The
        calibrated parameter is represented by two values, one standard deviation on either side of
        its mean; each is interpolated between two draws.

        Parameters
        ----------
        learnt : dict of str to Learnt
            The posterior of each quantity by name, as `Estimate.learnt` has it.
        joint : (B, S, U') array
            The joint belief over states and controls.
        controls : slice
            The U' controls among all.
        observation : (G,) array or None
            The observed sensor values, SI; None for a prediction.
        """
        draw_weight = self._draw_weight(learnt)
        draw = np.flatnonzero(draw_weight)
        gain, gain_deviation = self._gauge_moments(learnt, "gauge_gain", 0.0)
        offset, offset_deviation = self._gauge_moments(learnt, "gauge_offset", 0.0)
        scale, scale_deviation = self._gauge_moments(learnt, "noise_scale", 1.0)
        hypotheses = StaticHypotheses(  # a first axis of length 1 stands for all draws
            weight=np.empty(0),
            draw=draw,
            offset=offset[None],
            gain=gain[None],
            offset_variance=offset_deviation[None] ** 2,
            covariance=np.zeros_like(gain)[None],
            gain_variance=gain_deviation[None] ** 2,
            squared_noise_scale=(scale**2 + scale_deviation**2)[None],
        )
        weight = draw_weight[draw][None, :, None, None] * joint[:, None]
        return self._expect(hypotheses, np.ascontiguousarray(weight), controls, observation)

    def _draw_weight(self, learnt: Mapping[str, Learnt]) -> Float:
        """Return draw weights that give the parameter its learnt mean and standard deviation.

        If saturation is learnt, its lost fraction gets its learnt moments in the same way; see
        `with_saturation`.
        """
        parameter = self.learning.parameter
        weight = self.learning.parameter_weight
        if parameter is not None and parameter.name in learnt:
            weight = _interpolating_weights(parameter.values, learnt[parameter.name])
        fraction_weights = np.ones(1)
        if "saturation" in learnt:
            fraction_weights = _interpolating_weights(LOST_FRACTIONS, learnt["saturation"])
        return np.outer(fraction_weights, weight).ravel()

    def _gauge_moments(
        self, learnt: Mapping[str, Learnt], name: str, default: float
    ) -> tuple[Float, Float]:
        """Return mean and standard deviation (G,) of a quantity that gauges may have learnt.

        A gauge that has not learnt it has the default value and no uncertainty.
        """
        certain = Learnt(default, 0.0, default, default)
        numbers = range(1, self.learning.sensor_model.sensor_count + 1)
        posteriors = [learnt.get(f"{name}[{number}]", certain) for number in numbers]
        means = np.array([posterior.mean for posterior in posteriors])
        deviations = np.array([posterior.standard_deviation for posterior in posteriors])
        return means, deviations

    @cached_property
    def _closed_loop(self) -> Float:
        """The transitions p(D' | D) of the S states under the policy: (S, S)."""
        matrix = self.learning.model.transition.matrix
        return np.asarray(np.einsum("su,usn->sn", self.policy, matrix))

    def _expect_steps(
        self,
        hypotheses_of_steps: Iterable[StaticHypotheses],
        carried: Sequence[Carried],
        beliefs: Float,
        observations: Float,
    ) -> Expectation:
        """Return the expectation in T steps, each under its hypotheses and the control in force.

        Parameters
        ----------
        beliefs : (T, S) array
            The beliefs about the state, which take the place of those of the hypotheses.
        observations : (T, G) array
            The observed sensor values, SI.
        """
        expectations = []
        steps = zip(hypotheses_of_steps, carried, beliefs, observations, strict=True)
        for hypotheses, step, belief, observation in steps:
            controls = slice(step.control_index, step.control_index + 1)
            weight = _joint_with_marginal(hypotheses.weight, belief)[None, :, :, None]
            expectations.append(self._expect(hypotheses, weight, controls, observation))
        return concatenate_expectations(expectations)

    def _expect_ahead(
        self, step: Carried, belief: Float, policy: Float, horizon: int
    ) -> Expectation:
        """Predict sensor values and rewards in the H steps after one step.

        Parameters
        ----------
        belief : (S,) array
            The filtered belief about the state in the step.
        policy : (S, U) array
            The policy p(control | state) in the H steps.
        """
        hypotheses = self.learning.hypotheses(step)
        joint = _joint_with_marginal(hypotheses.weight, belief)
        predicted_joint = np.empty((horizon, *hypotheses.weight.shape))  # (H, K, S)
        # The first transition is under the control in force, later ones are under the policy.
        transition = self.learning.model.transition.matrix[step.control_index]
        for h in range(horizon):
            joint = joint @ transition
            predicted_joint[h] = joint
            transition = self._closed_loop
        return self._expect(hypotheses, predicted_joint[..., None] * policy, slice(None), None)

    def _expect(
        self,
        hypotheses: StaticHypotheses,
        weight: Float,
        controls: slice,
        observation: Float | None,
    ) -> Expectation:
        """Return the expectation under B beliefs over hypotheses, states and controls.

        Parameters
        ----------
        hypotheses : StaticHypotheses
            K hypotheses; their own weights are not used.
        weight : (B, K, S, U') array
            The beliefs, up to a factor of each.
        observation : (G,) array or None
            The observed sensor values, SI; None for a prediction.
        """
        weight = weight / weight.sum(axis=(1, 2, 3), keepdims=True)
        value, value_variance = self._sensor_moments(hypotheses, controls)
        sensors = value.shape[-1]
        belief_count = len(weight)

        # Moments about a point near the mean: the variance is a small difference of large squares
        # if they are taken about zero.
        center = value[0].mean(axis=(0, 1))
        first_moment = value - center
        second_moment = value_variance + first_moment**2
        state_weight = weight.sum(axis=1).reshape(belief_count, -1)
        first_moment_by_state = np.einsum("bksu,ksug->bsug", weight, first_moment).reshape(
            belief_count, -1, sensors
        )
        second_moment_by_state = np.einsum("bksu,ksug->bsug", weight, second_moment).reshape(
            belief_count, -1, sensors
        )
        mean = first_moment_by_state.sum(axis=1)
        variance = np.maximum(second_moment_by_state.sum(axis=1) - mean**2, 0.0)
        quantiles = _quantiles_by_state(state_weight, first_moment_by_state, second_moment_by_state)
        lower, upper = np.moveaxis(quantiles, 1, 0)

        # What sensors lose by saturation does not change the structure: see `with_saturation`.
        draw_of_structure = hypotheses.draw % self.rewards.quantity.draw_count
        reward_mean, reward_standard_deviation = self.rewards.expectation_of(
            weight, draw_of_structure, controls, value, value_variance, observation
        )
        return Expectation(
            mean=mean + center,
            standard_deviation=np.sqrt(variance),
            lower=lower + center,
            upper=upper + center,
            noise_standard_deviation=self._expected_noise(hypotheses, weight, controls),
            reward_mean=reward_mean,
            reward_standard_deviation=reward_standard_deviation,
        )

    def _sensor_moments(self, hypotheses: StaticHypotheses, controls: slice) -> tuple[Float, Float]:
        """Return mean and variance of each sensor's value without noise: (K, S, U', G), SI."""
        sensor_model = self.learning.sensor_model
        predicted_values = sensor_model.value_per_draw[:, :, controls][hypotheses.draw]
        gain = _insert_state_and_control(hypotheses.gain)
        offset = _insert_state_and_control(hypotheses.offset)
        offset_variance = _insert_state_and_control(hypotheses.offset_variance)
        covariance = _insert_state_and_control(hypotheses.covariance)
        gain_variance = _insert_state_and_control(hypotheses.gain_variance)
        value = predicted_values * (1.0 + gain) + offset
        variance = offset_variance + predicted_values * (
            2.0 * covariance + predicted_values * gain_variance
        )
        return value, variance

    def _expected_noise(
        self, hypotheses: StaticHypotheses, weight: Float, controls: slice
    ) -> Float:
        """Return the standard deviation (B, G) of noise and model error, SI."""
        squared_noise_scale = _insert_state_and_control(hypotheses.squared_noise_scale)
        deviation = self.learning.sensor_model.total_standard_deviation[:, controls]
        belief_count, hypothesis_count, states, control_count = weight.shape
        sensors = deviation.shape[-1]
        variance = np.broadcast_to(
            squared_noise_scale * deviation**2, (hypothesis_count, states, control_count, sensors)
        )
        return np.asarray(np.sqrt(weight.reshape(belief_count, -1) @ variance.reshape(-1, sensors)))


def _interpolating_weights(points: ArrayLike, posterior: Learnt) -> Float:
    """Return weights of points (n,) with the mean and standard deviation of a posterior.

    Two values, one standard deviation on either side of the mean and each with the probability one
    half, are interpolated between the points.
    """
    values = np.asarray(points, dtype=np.float64)
    order = np.argsort(values)
    two_values = posterior.mean + np.array([-1.0, 1.0]) * posterior.standard_deviation
    weights = np.empty(len(values))
    weights[order] = interpolation_weights(values[order], two_values).mean(axis=1)
    return weights


def _insert_state_and_control(values: Float) -> Float:
    """Return values (K, G) of hypotheses and gauges with axes for state and control inserted."""
    return values[:, None, None]


def _quantiles_by_state(probability: Float, first_moment: Float, second_moment: Float) -> Float:
    """Return the lower and upper quantiles (B, 2, G) of G sensors under B beliefs.

    Each sensor value is a mixture with a normal component for each of N states and controls.

    Parameters
    ----------
    probability : (B, N) array
        The probability of each pair of a state and a control.
    first_moment, second_moment : (B, N, G) array
        The moments of each component, times its probability.
    """
    quantiles = np.empty((len(probability), len(_LEVELS), first_moment.shape[-1]))
    for b in range(len(probability)):
        relevant = np.flatnonzero(probability[b] > _NEGLIGIBLE_PROBABILITY)
        weight = probability[b, relevant]
        mean = first_moment[b, relevant] / weight[:, None]
        variance = np.maximum(second_moment[b, relevant] / weight[:, None] - mean**2, 0.0)
        quantiles[b] = mixture_quantiles(weight / weight.sum(), mean, np.sqrt(variance), _LEVELS)
    return quantiles


def _joint_with_marginal(joint: Float, belief: Float) -> Float:
    """Return a joint belief (K, S) with its p(k | D) kept and the marginal p(D) replaced (S,).

    Where the first belief rules out a state, p(k | D) is not defined, and p(k) takes its place.
    """
    marginal = joint.sum(axis=0)
    hypothesis_given_state = np.tile(joint.sum(axis=1, keepdims=True), len(belief))
    np.divide(joint, marginal, out=hypothesis_given_state, where=marginal > 0.0)
    return np.asarray(belief * hypothesis_given_state)


def concatenate_expectations(expectations: Iterable[Expectation]) -> Expectation:
    """Return the expectations of successive spans of a mission as one, along their leading axis."""
    return _join_expectations(expectations, np.concatenate)


def stack_expectations(expectations: Iterable[Expectation]) -> Expectation:
    """Return expectations stacked along a new leading axis."""
    return _join_expectations(expectations, np.array)


def _join_expectations(
    expectations: Iterable[Expectation], join: Callable[[list[Float]], Float]
) -> Expectation:
    """Return one expectation by joining each array of several."""
    expectations = list(expectations)
    arrays = {
        field.name: join([getattr(expectation, field.name) for expectation in expectations])
        for field in fields(Expectation)
    }
    return Expectation(**arrays)


def mixture_quantiles(weight: Float, mean: Float, deviation: Float, levels: Float) -> Float:
    """Return P quantiles of G mixtures of N normal distributions, a (P, G) array, by bisection.

    Parameters
    ----------
    weight : (N,) array
        The weights of the components, which sum to one; the same for all mixtures.
    mean, deviation : (N, G) array
        Mean and standard deviation of the components; a deviation of zero is a point.
    levels : (P,) array
        Levels of the quantiles, between 2.5 and 97.5 %.
    """
    from scipy.special import ndtr  # slow to import; only a twin that learns needs it

    center = weight @ mean
    total_deviation = np.sqrt(weight @ (deviation**2 + (mean - center) ** 2))
    lower_bound = np.tile(center - _SEARCH_DEVIATIONS * total_deviation, (len(levels), 1))
    upper_bound = np.tile(center + _SEARCH_DEVIATIONS * total_deviation, (len(levels), 1))
    for _ in range(_HALVINGS):
        middle = 0.5 * (lower_bound + upper_bound)
        distance = middle[:, None] - mean  # (P, N, G)
        # A component with a deviation of zero is a point: it lies wholly below or above.
        standardized = np.copysign(np.inf, distance)
        np.divide(distance, deviation, out=standardized, where=deviation > 0.0)
        probability_below = np.einsum("n,png->pg", weight, ndtr(standardized))
        is_above_quantile = probability_below >= levels[:, None]
        lower_bound = np.where(is_above_quantile, lower_bound, middle)
        upper_bound = np.where(is_above_quantile, middle, upper_bound)
    return upper_bound
