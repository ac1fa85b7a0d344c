"""Gaussian sensors: the likelihood of what they show, residuals, and classes of what they may show.

Kapteyn et al. 2021, eqs. (30) and (32).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import rel_entr

from reporting.arrays import Float, Index
from reporting.choices import require_one_of
from reporting.words import brief
from twin_master.errors import InvalidModelError, InvalidObservationError, said
from twin_master.network.kernels import LOG_ROOT_TWO_PI, log_densities, separated
from twin_master.network.quantity import QuantityModel
from twin_master.network.transition import expect_controls, expect_shape

Averaging = Literal["outside", "inside"]
"""Whether draws are averaged over their likelihoods, or their predictions before it."""
_WORST_SHOWN = 3
LARGEST = 1e140
"""Its square is still a number."""
LEAST_LEFT = 1e-12
"""What rounding leaves of the share of a sensor that alone tells where in the interval the truth is."""


@dataclass(frozen=True)
class Nearest:
    """Predictions where in the interval of each state they fit an observation best.

    Attributes
    ----------
    value, alone : (E, S, G)
        At the most probable place by all sensors, and for each sensor at that by all the others, SI.
    left : (S, G) dimensionless
        Variance of a sensor's noise over that of its observation, given all the others.
    log_density : (E, S)
        Of the place, with all that it might have been: what is to be added to the log density of independent
        sensors at `value`.
    """

    value: Float
    alone: Float
    left: Float
    log_density: Float


class GaussianSensorModel(QuantityModel):
    """Sensors that show a value plus independent Gaussian noise.

    Where the twin doubts its model, an error of the model is added to the noise in quadrature for each
    state, control and sensor: sqrt(standard_deviation² + (model_error * mean)²), the mean over the draws. It
    is an error that is drawn anew for each sensor and step; a real one stays the same from step to step, so
    that the term is a safeguard and no description of it.

    A state may stand for an interval of each factor. Where the truth is inside it moves all sensors together,
    so that it adds to the covariance of a state and control one term for each factor, of rank one.

    Parameters
    ----------
    strain_per_draw : (E, S, U, G)
        Noise-free value for each draw e of the uncertain parameters, state, control and sensor, SI.
    standard_deviation : float or (G,)
        Of the noise that the twin assumes, SI, positive.
    draw_weight : (E,), optional
        Probability of each draw; equal by default.
    average : {"outside", "inside"}
        Where the average over the draws stands. "outside", the default, is the integral (30):
        mean over e of the product over sensors. "inside" is eq. (32) as printed: the product over sensors of
        the mean over e, as if each sensor had parameters of its own.
    model_error : float or (G,) dimensionless
        Standard deviation of the predicted value as a share of it; none by default.
    interval : (S, U, G, F), optional
        What each sensor changes by, SI, when a factor moves by one standard deviation inside the interval
        that the state stands for (`StateSpace.within_interval`); without it the truth is at the levels.

    Raises
    ------
    InvalidModelError
        If shapes do not fit, a value is not finite, a standard deviation not positive or an error negative.
    InvalidChoiceError
        If `average` is another word.
    """

    interval: Float
    """What each sensor changes by within the interval of a state (S, U, G, F), SI."""
    independent_standard_deviation: Float
    """Noise and model error of each state, control and sensor (S, U, G), SI, independent; read-only."""
    total_standard_deviation: Float
    """The same with what a sensor changes by within the interval of a state (S, U, G), SI; read-only."""

    def __repr__(self) -> str:
        draws, states, controls, sensors = self.value_per_draw.shape
        return brief(self, draws=draws, states=states, controls=controls, sensors=sensors)

    def __init__(
        self,
        strain_per_draw: ArrayLike,
        standard_deviation: ArrayLike,
        draw_weight: ArrayLike | None = None,
        average: Averaging = "outside",
        model_error: ArrayLike = 0.0,
        interval: ArrayLike | None = None,
    ) -> None:
        require_one_of(average, get_args(Averaging), "average")
        super().__init__(strain_per_draw, draw_weight)
        for what, given, positive in (
            ("positive noise standard deviation", standard_deviation, True),
            ("relative model error that is not negative", model_error, False),
        ):
            value = np.array(given, dtype=np.float64)
            enough = value > 0.0 if positive else value >= 0.0
            if value.shape not in ((), (self.sensor_count,)) or not np.all(np.isfinite(value) & enough):
                count = self.sensor_count
                raise InvalidModelError(said("network.one_or_each", what=what, sensors=count, value=value))
        self.standard_deviation: Float = np.full(self.sensor_count, standard_deviation, np.float64)
        self.model_error: Float = np.full(self.sensor_count, model_error, np.float64)
        independent = np.hypot(
            self.standard_deviation, self.model_error * self.mean
        )  # a root of a square rounds
        shape = independent.shape
        self.interval = np.zeros((*shape, 0)) if interval is None else np.array(interval, dtype=np.float64)
        expect_shape("changes within intervals", self.interval.shape, *shape, "factors")
        if not np.all(np.isfinite(self.interval)):
            raise InvalidModelError("expected finite changes within intervals")
        self.independent_standard_deviation = independent
        self.total_standard_deviation = np.hypot(independent, np.linalg.norm(self.interval, axis=-1))
        for array in (independent, self.total_standard_deviation, self.interval):
            array.setflags(write=False)
        self.averages_inside = average == "inside"
        with np.errstate(divide="ignore"):
            self._log_weight: Float = np.log(self.draw_weight)
        beside = (self.value_per_draw - self.mean) / independent
        size = float(np.max(np.abs(self.value_per_draw) / independent))
        part, self._function = separated(np.moveaxis(beside, 0, -1).reshape(-1, self.draw_count), size)
        self._part = part.reshape(*shape, len(self._function))
        self._shared = dict[int, tuple[Any, ...]]()  # by control, of the sensors that were there last

    @property
    def beside(self) -> dict[str, Any]:
        """Keywords that a kind of sensors has beside those of all."""
        return {}

    def checked(self, observation: ArrayLike) -> Float:
        """Return observations (..., G) in which NaN stands for a lost sensor.

        Raises
        ------
        InvalidObservationError
            The shape is another one, or a value is infinite.
        """
        observation = np.array(observation, dtype=np.float64, order="C")
        shape = observation.shape
        expect_shape("sensor values", shape, *shape[:-1], self.sensor_count, error=InvalidObservationError)
        if np.any(np.isinf(observation)):
            where = tuple(int(i) for i in np.argwhere(np.isinf(observation))[0])
            raise InvalidObservationError(said("network.infinite", where=where))
        return observation

    def apart(self, observation: ArrayLike) -> tuple[Float, Float]:
        """Return of an observation the values of the sensors (G,), and the rest of its log density (S,).

        The rest is that of what does not pass through the sensors, in each state; zero here.
        """
        return self.checked(observation), np.zeros(self.state_count)

    def sampled(self, state: Index, control_index: int, generator: np.random.Generator) -> Float:
        """Return one observation drawn in each of N states (N,) under a control: (N, G), SI."""
        size = len(state), self.sensor_count
        draw = generator.choice(
            self.draw_count, size if self.averages_inside else (size[0], 1), p=self.draw_weight
        )
        values = self.value_per_draw[draw, state[:, None], control_index, np.arange(self.sensor_count)]
        within = generator.standard_normal((size[0], self.interval.shape[-1]))
        noise = self.independent_standard_deviation[state, control_index] * generator.standard_normal(size)
        moved = np.einsum("ngf,nf->ng", self.interval[state, control_index], within)
        return np.asarray(values + noise + moved)

    def log_likelihood(self, observation: ArrayLike, control_index: int) -> Float:
        """Return log p(o | D, u) for each state, eq. (30) or (32).

        Parameters
        ----------
        observation : (G,)
            SI; NaN where the sensor is lost. If all are lost the result is zero.
        control_index : int
            Control in force.

        Returns
        -------
        (S,)
            Density in SI.

        Raises
        ------
        InvalidObservationError, InvalidModelError
            If the shape is another one or a value is infinite; if there is no such control.
        """
        values, told = self.apart(observation)
        return np.asarray(self._densities(values[None], [control_index], 1)[0, :, 0] + told)

    def log_likelihood_sequence(self, observations: ArrayLike, control_index: ArrayLike) -> Float:
        """Return log p(o_t | D_t, u_t) for a sequence: (T, G) and (T,) -> (T, S).

        Raises
        ------
        InvalidObservationError, InvalidModelError
            As `log_likelihood`.
        """
        values, told = self.apart(observations)
        return np.asarray(self._densities(values, control_index, 1)[..., 0] + told)

    def log_density_of_draws(self, observations: ArrayLike, control_index: ArrayLike) -> Float:
        """Return log p(o_t | D_t, u_t, e) of a sequence for each draw e: (T, G) and (T,) -> (T, S, E).

        Raises
        ------
        InvalidObservationError, InvalidModelError
            As `log_likelihood`.
        """
        values, told = self.apart(observations)
        return self._densities(values, control_index, self.draw_count) + told[..., None]

    def _densities(self, observations: ArrayLike, control_index: ArrayLike, draws: int) -> Float:
        """Return log densities (T, S, E) of each draw, or of their average where `draws` is one."""
        observations = self.checked(observations)
        control = np.array(control_index, dtype=np.int64)
        expect_shape("controls", control.shape, control.size)
        expect_shape("observations", observations.shape, control.size, self.sensor_count)
        expect_controls(control, self.control_count)
        inside = self.averages_inside and draws == 1
        result = np.zeros((len(observations), self.state_count, draws))
        for sensors in np.eye(self.sensor_count, dtype=bool) if inside else [np.array([True])]:
            seen = sensors & ~np.isnan(observations)
            alike: dict[tuple[int, bytes], list[int]] = {}
            there = seen.view(f"V{self.sensor_count}")[:, 0].tolist()  # as bytes
            for row, kind in enumerate(zip(control.tolist(), there, strict=True)):
                alike.setdefault(kind, []).append(row)
            for kind, rows in alike.items():
                result[rows] += self._alike(observations[rows], *kind, draws)
        return result

    def _alike(self, observations: Float, control: int, seen: bytes, draws: int) -> Float:
        """Return log densities (T, S, E) or (T, S, 1) of what the same sensors show under a control."""
        there = np.frombuffer(seen, dtype=bool)
        if self._shared.get(control, (b"",))[0] != seen:
            self._shared[control] = seen, *self._shared_by(control, there)
        _, scale, offset, mean, inverse, outward, part = self._shared[control]
        offset = offset - self._log_weight if draws == 1 else offset
        result = np.empty((len(observations), self.state_count, draws))
        shown = np.ascontiguousarray(np.where(there, observations, 0.0).T)
        log_densities(shown, mean, inverse, outward, part, self._function, offset, scale, result)
        return result

    def _shared_by(self, control: int, there: NDArray[np.bool_]) -> tuple[Float, ...]:
        """Return what all observations by the same sensors share, as `log_densities` takes it.

        First are the log of their scale (S,) and half the squares of what each draw adds (S, E). The
        covariance is the unit matrix plus interval times its transpose, inverted by Woodbury's identity: with
        the Cholesky factor L of 1 + interval' interval, outward (F, G) is L^-1 interval'. With d what is
        observed beside the mean, -|d - A b_e|² / 2 of a draw e is -|d|² / 2 + (A'd) b_e - |A b_e|² / 2.
        """
        inverse = np.where(there, 1.0 / self.independent_standard_deviation[:, control], 0.0)
        interval = self.interval[:, control] * inverse[..., None]
        part = np.where(there[:, None], self._part[:, control], 0.0)
        root = np.linalg.cholesky(np.eye(interval.shape[-1]) + interval.swapaxes(1, 2) @ interval)
        outward = np.linalg.solve(root, interval.swapaxes(1, 2))
        whole = part - outward.swapaxes(1, 2) @ (outward @ part)
        offset = 0.5 * np.sum((whole.swapaxes(1, 2) @ part @ self._function) * self._function, axis=1)
        scale = np.log(inverse[:, there]).sum(axis=1) - LOG_ROOT_TWO_PI * there.sum()
        scale -= np.log(np.einsum("sff->sf", root)).sum(axis=1)
        return scale, offset, np.ascontiguousarray(self.mean[:, control]), inverse, outward, whole

    def nearest(
        self, observation: Float, control_index: int, value: Float, precision: ArrayLike = 1.0
    ) -> Nearest:
        """Return what the sensors show where in the interval of each state they fit an observation best.

        Parameters
        ----------
        observation : (G,)
            SI; NaN where the sensor is lost.
        control_index : int
        value : (E, S, G)
            Predictions at the levels, of any draws, SI.
        precision : float or (G,) dimensionless
            Of the sensors over the assumed one, where more is known: a sensor that is off tells no place.
        """
        seen, root = ~np.isnan(observation), np.sqrt(precision)
        inverse_deviation = 1.0 / self.independent_standard_deviation[:, control_index]
        scaled = (np.where(seen, root, 0.0) * inverse_deviation)[..., None] * self.interval[:, control_index]
        distance = np.where(seen, observation - value, 0.0).clip(-LARGEST, LARGEST)
        residual = distance * inverse_deviation * root
        inverse = np.linalg.inv(np.eye(scaled.shape[-1]) + scaled.swapaxes(1, 2) @ scaled)
        weight = inverse @ scaled.swapaxes(1, 2)  # (S, F, G)
        place = (weight @ residual[..., None])[..., 0]
        moved = (self.interval[:, control_index] @ place[..., None])[..., 0]
        left = (1.0 - np.einsum("sgf,sfg->sg", scaled, weight)).clip(LEAST_LEFT)
        return Nearest(
            value=value + moved,
            alone=value + (distance - (distance - moved) / left),
            left=left,
            log_density=0.5 * (np.linalg.slogdet(inverse)[1] - np.sum(place**2, axis=-1)),
        )

    def worst_residuals(self, observation: ArrayLike, control_index: int) -> dict[str, float]:
        """Return the sensors that fit worst in the state that fits best, in standard deviations."""
        observation = np.asarray(observation)[: self.sensor_count]
        predicted = self.mean[:, control_index]
        deviation = self.total_standard_deviation[:, control_index]
        with np.errstate(over="ignore"):  # an absurd observation is what this is for
            residual = (observation - predicted) / deviation
            distance = np.nan_to_num(np.abs(residual), nan=0.0)
            best = int(np.argmin(distance.sum(axis=1)))
        order = np.argsort(-distance[best])[:_WORST_SHOWN]
        return {f"sensor {index + 1}": float(residual[best, index]) for index in order}

    def noise(self, joint: ArrayLike, _rows: Float | None = None) -> Float:
        """Return the standard deviation (..., G) of what beliefs (..., S, U) leave unsaid of a sensor, SI.

        It is noise, model error, what a sensor changes by within the interval of a state, and what rows that
        were observed (..., G + I) say of their own.
        """
        return np.asarray(
            np.sqrt(np.tensordot(self.weights(joint), self.total_standard_deviation**2, axes=2))
        )


def check_noise(key: str, deviation: ArrayLike, predicted: Float, units: Sequence[str]) -> None:
    """Check that the noise of no sensor hides all that the sensors of its unit can show.

    Such a noise is a unit that was forgotten. The sensors of a unit are taken together, because a single one
    may well be insensitive to everything.

    Parameters
    ----------
    key : str
        Where the noise stands in the scenario.
    deviation : float or (G,)
        Its standard deviation, SI.
    predicted : (E, S, U, G)
        What the sensors show without noise, SI.
    units : (G,)
        Unit of each sensor.

    Raises
    ------
    InvalidModelError
        It does; the sentence names the sensor, what it can show, and the likely unit.
    """
    noise = np.broadcast_to(np.asarray(deviation, dtype=np.float64), len(units))
    low, high = predicted.min(axis=(0, 1, 2)), predicted.max(axis=(0, 1, 2))
    for sensor, (unit, given) in enumerate(zip(units, noise.tolist(), strict=True)):
        alike = [index for index, other in enumerate(units) if other == unit]
        least, largest = float(low[alike].min()), float(high[alike].max())
        reach = max(largest - least, abs(least), abs(largest))
        if given <= reach:
            continue
        advice = f"give it in {unit}, the unit of the sensor"
        if unit == "1":
            advice = "give it as a strain, without unit"
            if given * 1e-6 <= reach:
                advice = f"it is likely meant in microstrain: write `{key}_microstrain = {given:g}`"
        which, ends = f"{given:g} for sensor {sensor + 1}", (least, largest)
        raise InvalidModelError(
            said("network.noise", key=key, which=which, unit=unit, ends=ends, advice=advice)
        )


SAMPLES = 1500
"""Observations that are drawn for each control, the same number in each state."""
CLASSES = 64
"""Classes that they are joined to at most."""
_LOST = 0.005
"""Bits that may be lost where fewer classes do."""


def observation_classes(
    sensor_model: GaussianSensorModel, generator: np.random.Generator, classes: int = CLASSES
) -> tuple[Float, ...]:
    """Return for each control the probability of each class of observations in each state: (K, S).

    Observations are drawn in each state, and those are joined that tell the same of the state: whose
    posterior beliefs, from all states alike, are close in the distance of Hellinger. The probability of a
    class is that of its members, weighed by their likelihood in each state. There are as few as tell of the
    state what all observations do, by doubling their number.
    """
    from scipy.cluster.vq import kmeans2  # reads a second of modules that a flight does not need

    states = sensor_model.state_count
    drawn = np.repeat(np.arange(states), -(-SAMPLES // states))
    result = []
    for control in range(sensor_model.control_count):
        rows = sensor_model.sampled(drawn, control, generator)
        log_likelihood = sensor_model.log_likelihood_sequence(rows, np.full(len(rows), control))
        told = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
        told /= told.sum(axis=1, keepdims=True)
        number, every, joined = 1, _information(told), told.sum(axis=0, keepdims=True)
        while number < min(classes, len(rows)) and _information(joined) < every - _LOST:
            number *= 2
            _, label = kmeans2(np.sqrt(told), min(number, classes), minit="++", rng=generator)
            joined = np.array([told[label == place].sum(axis=0) for place in np.unique(label)])
        result.append(joined / joined.sum(axis=0))
    return tuple(result)


def _information(joint: Float) -> float:
    """Return what observations (K, S) tell of the state, in proportion to their joint probability [bit]."""
    seen, state = joint.sum(axis=1, keepdims=True), joint.sum(axis=0)
    return float(rel_entr(joint, seen * state / joint.sum()).sum() / joint.sum() / np.log(2.0))
