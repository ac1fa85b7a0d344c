"""What the sensors are expected to show, and the rewards, under the belief of a learning filter.

The belief is that over states and static hypotheses together, so that what the data tell of a parameter and
of the damage in common stays in it. Moments are exact; quantiles take what a sensor shows for normal given
the state.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reporting.arrays import Float
from twin_master.learning.learning_filter import Hypotheses, LearningFilter, quantiles_of
from twin_master.network.estimator import Carried, Learnt
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel

_LEVELS = np.array([0.025, 0.975])
_NEGLIGIBLE = 1e-9
"""Share of a belief below which a state tells nothing of the quantiles."""


@dataclass(frozen=True)
class Expected:
    """What beliefs say of the G sensors and of the rewards; the leading axes are those of the beliefs.

    Attributes
    ----------
    mean, standard_deviation, lower, upper : (..., G)
        Of what is shown without noise, SI; the last two are the quantiles of 2.5 and 97.5 %.
    noise : (..., G)
        Standard deviation of noise and model error, SI.
    reward_mean, reward_standard_deviation : (..., 3)
        In the order of `REWARD_NAMES`.
    """

    mean: Float
    standard_deviation: Float
    lower: Float
    upper: Float
    noise: Float
    reward_mean: Float
    reward_standard_deviation: Float


def expected_of(
    sensor_model: GaussianSensorModel, rewards: RewardModel, joint: Float, rows: Float | None,
    *, quantiles: bool = True,
) -> Expected:  # fmt: skip
    """Return what beliefs (..., S, U) say where nothing is learnt; without quantiles those are NaN.

    Rows that were observed are (..., G + I); None where they are predicted.
    """
    mean, deviation = sensor_model.moments(joint)
    lower = upper = np.full_like(mean, np.nan)
    if quantiles:
        lower, upper = np.moveaxis(sensor_model.quantiles(joint, _LEVELS), -2, 0)
    observed = None if rows is None else rows[..., : sensor_model.sensor_count]
    noise = sensor_model.noise(joint, rows)
    return Expected(mean, deviation, lower, upper, noise, *rewards.expectation(joint, observed))


@dataclass(frozen=True)
class LearntExpectation:
    """Expectations of a learning filter.

    Attributes
    ----------
    learning : LearningFilter
    rewards : RewardModel
    policy : (S, U)
        p(U | D), which is predicted through.
    """

    learning: LearningFilter
    rewards: RewardModel
    policy: Float

    def filtered(self, carried: Sequence[Carried], beliefs: Float, observed: Float) -> Expected:
        """Return what is expected of T steps given the observations up to each.

        Parameters
        ----------
        carried : sequence of Carried
            Of each step.
        beliefs : (T, S)
            About the state, which may be those of more than the model alone.
        observed : (T, G)
            What the sensors say, SI.
        """
        rows = zip(carried, beliefs, observed, strict=True)
        known = (self._known(self.learning.hypotheses(step), step, *row) for step, *row in rows)
        return joined(known, np.array)

    def smoothed(self, carried: Sequence[Carried], beliefs: Float, observed: Float) -> Expected:
        """Return what is expected of T steps given all observations, see `filtered`."""
        rows, own = zip(carried, beliefs, observed, strict=True), self.learning.smoothed_hypotheses(carried)
        last = (self.learning.hypotheses(carried[-1], weight) for weight in own)
        return joined((self._known(found, *row) for found, row in zip(last, rows, strict=True)), np.array)

    def predicted(self, carried: Sequence[Carried], beliefs: Float, asked: Float, horizon: int) -> Expected:
        """Return what is expected after each of T steps of given filtered beliefs, of the H to come.

        Controls are asked for with the probabilities p(U | D) (T, S, U).
        """
        rows = zip(carried, beliefs, asked, strict=True)
        return joined((self._ahead(*row, horizon) for row in rows), np.array)

    def of_marginals(
        self, learnt: Mapping[str, Learnt], joint: Float, controls: slice, seen: Float | None
    ) -> Expected:
        """Return what is expected under B beliefs (B, S, U') where no more is known than what was learnt.

        Each quantity is taken for independent of the others and of the state; the parameter stands a standard
        deviation to either side of its mean, between the draws around it.

        Parameters
        ----------
        learnt : dict of str to Learnt
            Posterior of each quantity, as a step tells it.
        joint : (B, S, U')
            Belief over states and controls.
        controls : slice
            Which of the controls the U' are.
        seen : (G,) or None
            What the sensors say, SI.
        """
        model, (name, values) = self.learning.sensor_model, self.learning.draws or ("", ())
        share = model.draw_weight
        if (parameter := learnt.get(name)) is not None:
            draws = np.asarray(values, dtype=np.float64)
            order = np.argsort(draws)
            at = parameter.mean + np.array([-1.0, 1.0]) * parameter.standard_deviation
            near = np.eye(len(draws))[:, order]
            share = np.array([np.interp(at, draws[order], own).mean() for own in near])
        draw = np.flatnonzero(share)

        def of_sensors(name: str, otherwise: float) -> Float:
            plain = Learnt(otherwise, 0.0, otherwise, otherwise)
            known = [learnt.get(f"{name}[{number}]", plain) for number in range(1, model.sensor_count + 1)]
            return np.array([own.figures[:2] for own in known]).T

        (gain, gain_spread), (offset, offset_spread), (scale, scale_spread) = (
            of_sensors(name, otherwise)
            for name, otherwise in (("gauge_gain", 0.0), ("gauge_offset", 0.0), ("noise_scale", 1.0))
        )
        spread = np.stack([offset_spread**2, np.zeros(model.sensor_count), gain_spread**2], axis=-1)
        scale2 = scale**2 + scale_spread**2
        alike = (part[None] for part in (offset, gain, spread, scale2))  # for all draws
        hypotheses = Hypotheses(np.empty(0), draw, *alike)
        weight = share[draw][None, :, None, None] * joint[:, None]
        return self._of(hypotheses, np.ascontiguousarray(weight), controls, seen)

    @cached_property
    def _closed_loop(self) -> Float:
        """p(D' | D) under the policy: (S, S)."""
        matrix = self.learning.model.transition.matrix
        return np.asarray(np.einsum("su,usn->sn", self.policy, matrix))

    def _known(self, hypotheses: Hypotheses, step: Carried, belief: Float, seen: Float) -> Expected:
        u = slice(step.control_index, step.control_index + 1)
        found = self._of(hypotheses, _believing(hypotheses.weight, belief)[None, :, :, None], u, seen)
        return Expected(**{name: values[0] for name, values in vars(found).items()})

    def _ahead(self, step: Carried, belief: Float, asked: Float, horizon: int) -> Expected:
        hypotheses = self.learning.hypotheses(step)
        rows, coming = _believing(hypotheses.weight, belief), np.empty((horizon, *hypotheses.weight.shape))
        transition = self.learning.model.transition.matrix[step.control_index]
        for h in range(horizon):
            rows, transition = rows @ transition, self._closed_loop
            coming[h] = rows
        return self._of(hypotheses, coming[..., None] * asked, slice(None), None)

    def _of(self, hypotheses: Hypotheses, weight: Float, controls: slice, seen: Float | None) -> Expected:
        """Return what is expected under B beliefs (B, K, S, U') over hypotheses, states and controls."""
        weight = weight / weight.sum(axis=(1, 2, 3), keepdims=True)
        model = self.learning.sensor_model
        own = model.value_per_draw[:, :, controls][hypotheses.draw]
        gain, offset, wide, scale2 = (
            part[:, None, None]
            for part in (hypotheses.gain, hypotheses.offset, hypotheses.covariance, hypotheses.scale2)
        )
        shown = own * (1.0 + gain) + offset  # (K, S, U', G), normally distributed
        shown_variance = wide[..., 0] + own * (2.0 * wide[..., 1] + own * wide[..., 2])
        noise2 = np.broadcast_to(scale2 * model.total_standard_deviation[:, controls] ** 2, shown.shape)
        beliefs, count = len(weight), shown.shape[-1]
        flat = weight.reshape(beliefs, -1)
        center = shown[0].mean(axis=(0, 1))  # near enough that squares do not cancel
        first = shown - center
        second = shown_variance + first**2
        by_state = weight.sum(axis=1).reshape(beliefs, -1)
        means = np.einsum("bksu,ksug->bsug", weight, first).reshape(beliefs, -1, count)
        squares = np.einsum("bksu,ksug->bsug", weight, second).reshape(beliefs, -1, count)
        mean = means.sum(axis=1)
        deviation = np.sqrt(np.maximum(squares.sum(axis=1) - mean**2, 0.0))
        noise = np.sqrt(flat @ noise2.reshape(-1, count))
        quantiles = np.empty((beliefs, 2, count))
        for b in range(beliefs):
            kept = np.flatnonzero(by_state[b] > _NEGLIGIBLE)
            share = by_state[b, kept]
            own = means[b, kept] / share[:, None]
            wide = np.sqrt(np.maximum(squares[b, kept] / share[:, None] - own**2, 0.0))
            quantiles[b] = quantiles_of(share / share.sum(), own, wide, _LEVELS)
        rewards = self.rewards.expectation_of(weight, hypotheses.draw, controls, shown, shown_variance, seen)
        return Expected(
            mean + center, deviation, quantiles[:, 0] + center, quantiles[:, 1] + center, noise,
            *rewards,
        )  # fmt: skip


def _believing(weight: Float, belief: Float) -> Float:
    """Return p(k | D) of a joint belief (K, S) under another belief about the state (S,): (K, S)."""
    own, apart = weight.sum(axis=0), np.tile(weight.sum(axis=1, keepdims=True), len(belief))
    return np.asarray(belief * np.divide(weight, own, out=apart, where=own > 0.0))


def joined(parts: Iterable[Expected], by: Callable[[list[Float]], Float] = np.concatenate) -> Expected:
    """Return what is expected of steps one after the other; by `np.array` each is a row of a leading axis."""
    found = [vars(part) for part in parts]
    return Expected(**{name: by([part[name] for part in found]) for name in found[0]})
