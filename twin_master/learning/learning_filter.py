"""The filter that learns: static hypotheses as an axis of the belief, gauges by conjugate regression.

A static hypothesis k is a draw of the calibrated parameter and a factor on the transition probabilities; both
stay what they are. Each has a filter of its own over the states, and its weight is its evidence:

    p(D_t, k | o_0..o_t) ~ p(o_t | D_t, k, o_0..o_t-1) sum over i of T_k[i, D_t] p(D_t-1 = i, k | o_0..o_t-1),

which is exact. What a gauge has of its own, given the hypothesis, is a `GaugeRegression`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv, gammaln, logsumexp, ndtr

from reporting.arrays import Float, Index
from twin_master.errors import ImpossibleObservation
from twin_master.learning.regression import GaugeRegression
from twin_master.network.estimator import Carried, Estimate, Learnt
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import log_forecast, smooth_many
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import TransitionModel
from twin_master.scenario.tables import Learning

INTERVAL = (0.05, 0.95)
_POINTS = 801
_REACH = 60.0
"""Draws whose evidence lies this many nats below the best tell the spline nothing that counts."""


def posterior_of_draws(values: ArrayLike, prior: ArrayLike, weight: ArrayLike) -> Learnt:
    """Return the posterior of a parameter whose draws have weights.

    The evidence of a draw is a smooth function of the parameter, and its logarithm nearly a parabola. When it
    is narrower than the distance of the draws, their weights alone would give a point; so the log evidence is
    interpolated between them by a cubic spline, and the prior by the straight lines of its distribution
    function.

    Parameters
    ----------
    values : (E,)
        Draws.
    prior, weight : (E,)
        Their probabilities before and after the observations.
    """
    distinct, place = np.unique(np.asarray(values, dtype=np.float64), return_inverse=True)
    before, after = (np.bincount(place, np.asarray(given, dtype=np.float64)) for given in (prior, weight))
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = np.log(after) - np.log(before)
    near = np.flatnonzero(evidence >= np.max(evidence[np.isfinite(evidence)]) - _REACH)
    count = len(distinct)
    if count < 4 or len(near) < 2:
        mean, reached = float(after @ distinct), np.cumsum(after)
        lower, upper = (float(distinct[np.searchsorted(reached, level * (1 - 1e-12))]) for level in INTERVAL)
        return Learnt(mean, float(np.sqrt(after @ (distinct - mean) ** 2)), lower, upper)
    first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, count)
    from scipy.interpolate import CubicSpline  # takes a while to load; only a twin that learns needs it

    floor = np.min(evidence[near]) - _REACH
    edges = np.concatenate([[distinct[0]], 0.5 * (distinct[1:] + distinct[:-1]), [distinct[-1]]])
    edges[0] -= edges[1] - distinct[0]
    edges[-1] += distinct[-1] - edges[-2]
    grid = np.linspace(edges[first], edges[end], _POINTS)
    middle = 0.5 * (grid[1:] + grid[:-1])
    mass = np.diff(np.interp(grid, edges, np.concatenate([[0.0], np.cumsum(before)])))
    # With fewer than four draws that count it is one polynomial.
    log_evidence = CubicSpline(distinct[first:end], np.maximum(evidence[first:end], floor))(middle)
    share = mass * np.exp(log_evidence - log_evidence.max())
    share /= share.sum()
    mean = float(share @ middle)
    lower, upper = np.interp(INTERVAL, np.concatenate([[0.0], np.cumsum(share)]), grid)
    deviation = float(np.sqrt(share @ (middle - mean) ** 2))
    return Learnt(mean, deviation, float(lower), float(upper))


_NEGLIGIBLE = 1e-9
"""Share of a belief below which a hypothesis tells nothing."""
HALVINGS = 18
REACH = 6.5
"""Standard deviations from the mean within which a quantile between 2.5 and 97.5 % lies, by Cantelli."""


@dataclass(frozen=True)
class Hypotheses:
    """Belief over state and static hypotheses, and what each hypothesis says of the G sensors.

    Attributes
    ----------
    weight : (K, S)
        p(D, k | observations).
    draw : (K,)
        Draw of the parameter of each hypothesis.
    offset, gain : (K, G)
        Posterior mean of offset [SI] and gain error [1] given the hypothesis.
    covariance : (K, G, 3)
        Variance of the offset, covariance, and variance of the gain error, the noise scale averaged.
    scale2 : (K, G)
        Posterior mean of the squared noise scale.
    """

    weight: Float
    draw: Index
    offset: Float
    gain: Float
    covariance: Float
    scale2: Float


def quantiles_of(weight: Float, mean: Float, deviation: Float, levels: Float) -> Float:
    """Return quantiles (P, G) of mixtures of N normal distributions.

    weight is (N,), mean and deviation (N, G). Levels lie between 2.5 and 97.5 %.
    """
    center = weight @ mean
    spread = np.sqrt(weight @ (deviation**2 + (mean - center) ** 2))
    low, high = (np.tile(center + side * REACH * spread, (len(levels), 1)) for side in (-1.0, 1.0))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        distance = middle[:, None] - mean
        below = ndtr(np.divide(distance, deviation, out=np.copysign(np.inf, distance), where=deviation > 0.0))
        over = np.einsum("n,png->pg", weight, below) >= levels[:, None]
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    return high


_NORMAL = 1.6448536269514722
"""Half-width of the central 90 % of a normal distribution, in standard deviations."""


class LearningFilter:
    """Exact filter over states and static hypotheses, with a conjugate regression for each gauge.

    It carries `log_belief` (K, S), the log of p(D_t, k | o_0..o_t), `statistics` (K, G, 6), the sums of the
    regressions in units of the assumed noise, and `count` (G,), the observations of each sensor.

    Parameters
    ----------
    model : GraphicalModel
        S states, U controls; its transitions are what the twin predicts and plans with.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G), weights of the draws, and the noise that is assumed.
    settings : Learning
        The priors; of the transitions it is what is given here.
    draws : (str, (E,)), optional
        Name of the parameter of the draws, and its values in the order of the sensor model; without it the
        draws are averaged anew in each step.
    transitions : mapping of float to TransitionModel, optional
        Those of each factor on the probabilities to leave a state, equally probable at first; those of the
        model if left out.
    name : str
        Name of the twin, for messages.
    sensor_units : sequence of str, optional
        Of each sensor; "1" if left out.
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
    ) -> None:
        moves = transitions or {1.0: model.transition}
        self.model, self.sensor_model, self._name = model, sensor_model, name
        self.draws, self._factors = draws, np.array([*moves])
        count, factors, sensors = sensor_model.draw_count, len(moves), sensor_model.sensor_count
        self._units = sensor_units or ("1",) * sensors
        blocks = zip(*(move.blocks for move in moves.values()), strict=True)
        self._transition = TransitionModel(tuple(map(np.concatenate, blocks)))  # one factor after the other
        self._draw: Index = np.tile(np.arange(count), factors)
        self._first_control: Index = np.repeat(np.arange(factors), count) * len(model.controls)
        with np.errstate(divide="ignore"):
            self._log_weight: Float = np.log(np.tile(sensor_model.draw_weight / factors, factors))
        self._inverse = 1.0 / sensor_model.independent_standard_deviation
        offset, gain = (
            np.broadcast_to(np.asarray(prior, np.float64), (sensors,)).copy()
            for prior in (settings.gauge_offset, settings.gauge_gain)
        )
        self._gauges = GaugeRegression(offset, gain, settings.noise_degrees if settings.noise else 0.0)

    @property
    def prior(self) -> Mapping[str, Learnt]:
        """What is believed of all that is learnt before the first observation, by name."""
        sensors = self.sensor_model.sensor_count
        weight = np.exp(self._log_weight)[:, None]
        return self._learnt(weight, np.zeros((len(weight), sensors, 6)), np.zeros(sensors))

    def step(self, before: Carried | None, observation: Float, control_index: int, step: int) -> Estimate:
        """Advance belief and what is learnt to step t, and correct them by an observation.

        See `Estimator.step`; `learnt` of the estimate holds by name the parameter, `transition_factor`,
        and `noise_scale[g]`, `gauge_gain[g]`, `gauge_offset[g]` for the sensors g from 1.
        """
        seen, told = self.sensor_model.apart(observation)
        forecast, statistics, count = self._forecast(before)
        value = self.sensor_model.value_per_draw[:, :, control_index]
        inverse = self._inverse[:, control_index]
        near = self.sensor_model.nearest(seen, control_index, value)
        log_belief = forecast + told + near.log_density[self._draw]
        log_belief += self._gauges.log_density(seen, self._draw, near.value, inverse, statistics, count)
        best = float(log_belief.max())
        if best == -np.inf:
            worst = self.sensor_model.worst_residuals(seen, control_index)
            raise ImpossibleObservation(self._name, step, worst)
        filtered = np.exp(log_belief - best)
        evidence = best + float(np.log(filtered.sum()))
        filtered /= filtered.sum()
        log_belief -= evidence
        if self._gauges.learns:
            scale = inverse * np.sqrt(near.left)
            statistics = statistics + self._gauges.told(seen, self._draw, near.alone, scale, log_belief)
        count = count + ~np.isnan(seen)
        arrays = {"log_belief": log_belief, "statistics": statistics, "count": count}
        return Estimate(
            forecast=np.exp(forecast).sum(axis=0),
            filtered=filtered.sum(axis=0),
            log_evidence=evidence,
            carried=Carried(control_index, arrays),
            learnt=self._learnt(filtered, statistics, count),
        )

    def _forecast(self, before: Carried | None) -> tuple[Float, Float, Float]:
        """Return log p(D_t, k | o_0..o_t-1) (K, S), and statistics (K, G, 6) and counts (G,) until then."""
        hypotheses, sensors = len(self._draw), self.sensor_model.sensor_count
        if before is None:
            forecast = self._log_weight[:, None] + self.model.log_prior
            return forecast, np.zeros((hypotheses, sensors, 6)), np.zeros(sensors)
        log_before = before.arrays["log_belief"]
        forecast = log_forecast(self._transition, self._first_control + before.control_index, log_before)
        if self.draws is None:
            forecast = self._averaged_anew(forecast)
        return forecast, before.arrays["statistics"], before.arrays["count"]

    def hypotheses(self, carried: Carried, weight: Float | None = None) -> Hypotheses:
        """Return what is believed after a step of each hypothesis that tells something.

        Of other beliefs the weight (K, S) is given.
        """
        weight = np.exp(carried.arrays["log_belief"]) if weight is None else weight
        share = weight.sum(axis=1)
        kept = np.flatnonzero(share > _NEGLIGIBLE * share.sum())
        fitted = self._gauges.fitted(carried.arrays["statistics"][kept])
        offset, gain = self._gauges.offset, self._gauges.gain
        scale2 = self._gauges.scale2(fitted, carried.arrays["count"])
        covariance = np.stack(
            [offset**2 * fitted[..., 2], offset * gain * fitted[..., 3], gain**2 * fitted[..., 4]], axis=-1
        )
        return Hypotheses(
            weight[kept], self._draw[kept], offset * fitted[..., 0], gain * fitted[..., 1],
            scale2[..., None] * covariance, scale2,
        )  # fmt: skip

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S)."""
        return np.asarray(self.smoothed_hypotheses(carried).sum(axis=1))

    def smoothed_hypotheses(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_i, k | o_0..o_t) for the steps i of `carried`, which end at t: (n, K, S)."""
        result = np.zeros((len(carried), len(self._draw), self.model.states.size))
        if not len(carried):
            return result
        rows = np.array([step.arrays["log_belief"] for step in carried])  # (n, K, S)
        if self.draws is None and len(self._draw) > 1:
            rows = np.stack([self._averaged_anew(row) for row in rows])
        weight = np.exp(rows[-1]).sum(axis=1)
        held = np.flatnonzero(weight > 0.0)
        own = rows[:, held] - logsumexp(rows[:, held], axis=2, keepdims=True)
        control = self._first_control[held, None] + np.array([step.control_index for step in carried])
        own = np.ascontiguousarray(own.swapaxes(0, 1))
        parts = smooth_many(self._transition, control, np.exp(own), own)
        result[:, held] = weight[held, None] * parts.swapaxes(0, 1)
        return result

    def _averaged_anew(self, log_belief: Float) -> Float:
        """Return a belief (K, S) in which the draws have their first weights again, whatever the state."""
        factors = len(self._factors)
        by_factor = log_belief.reshape(factors, -1, log_belief.shape[1])
        merged = np.repeat(np.logaddexp.reduce(by_factor, axis=1), by_factor.shape[1], axis=0)
        return np.asarray(merged + self._log_weight[:, None] + np.log(factors))

    def _learnt(self, filtered: Float, statistics: Float, count: Float) -> Mapping[str, Learnt]:
        """Return the posterior of everything that is learnt."""
        weight = filtered.sum(axis=1)  # of each hypothesis
        result: dict[str, Learnt] = {}
        factors = self._factors
        if self.draws is not None:
            name, values = self.draws
            own, prior = weight.reshape(len(factors), -1).sum(axis=0), self.sensor_model.draw_weight
            result[name] = posterior_of_draws(values, prior, own)
        if len(factors) > 1:
            own = weight.reshape(len(factors), -1).sum(axis=1)
            prior = np.full(len(factors), 1.0 / len(factors))
            result["transition_factor"] = posterior_of_draws(factors, prior, own)
        if self._gauges.learns:
            result |= self._learnt_of_gauges(weight, statistics, count)
        return result

    def _learnt_of_gauges(self, weight: Float, statistics: Float, count: Float) -> dict[str, Learnt]:
        fitted, degrees = self._gauges.fitted(statistics), self._gauges.degrees
        result: dict[str, Learnt] = {}
        scale2 = self._gauges.scale2(fitted, count)
        if degrees > 0.0:
            shape, left = 0.5 * (degrees + count), 0.5 * (degrees + fitted[..., 5])
            # The square is inverse gamma (shape, left) given a hypothesis: the moments of its root over all
            # of them, and its quantiles as if they were one.
            low, high = (np.sqrt(weight @ left / gammaincinv(shape, level)) for level in INTERVAL[::-1])
            mean = weight @ np.sqrt(left) * np.exp(gammaln(shape - 0.5) - gammaln(shape))
            deviation = np.sqrt(np.maximum(weight @ left / (shape - 1.0) - mean**2, 0.0))
            for g, figures in enumerate(np.column_stack([mean, deviation, low, high]).tolist(), 1):
                result[f"noise_scale[{g}]"] = Learnt(*figures)
        for column, prior, name, units in (
            (0, self._gauges.offset, "gauge_offset", self._units),
            (1, self._gauges.gain, "gauge_gain", ("1",) * len(self._units)),
        ):
            mean = weight @ fitted[..., column]
            spread = weight @ (fitted[..., column] ** 2 + scale2 * fitted[..., 2 + 2 * column]) - mean**2
            deviation = np.sqrt(np.maximum(spread, 0.0))
            for g in np.flatnonzero(prior > 0.0).tolist():
                own, wide = float(mean[g] * prior[g]), float(deviation[g] * prior[g])
                low, high = own - _NORMAL * wide, own + _NORMAL * wide
                result[f"{name}[{g + 1}]"] = Learnt(own, wide, low, high, units[g])
        return result
