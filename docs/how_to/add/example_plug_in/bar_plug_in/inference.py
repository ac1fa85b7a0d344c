"""A sensor model and an estimator."""

import numpy as np
from scipy.special import logsumexp
from scipy.stats import t

import uav_twin


class StudentSensorModel(uav_twin.GaussianSensorModel):
    """Errors of readings that follow a Student-t distribution with four degrees of freedom."""

    def log_likelihood(self, observation, control_index):
        """Return log p(o | D, u) for each state (S,)."""
        readings = self.check_observation(observation)
        seen = ~np.isnan(readings)
        predicted = self.value_per_draw[:, :, control_index, seen]
        deviation = self.total_standard_deviation[:, control_index, seen]
        log_densities = t.logpdf(readings[seen], df=4, loc=predicted, scale=deviation)
        weights = np.log(self.draw_weight)[:, None]
        return logsumexp(log_densities.sum(axis=-1) + weights, axis=0)


def make_student(twin):
    """Return the sensor model for what the twin knows."""
    plain = twin.sensor_model
    return StudentSensorModel(
        plain.value_per_draw,
        plain.standard_deviation,
        draw_weight=plain.draw_weight,
        interval=plain.interval,
    )


class WaryFilter(uav_twin.ExactFilter):
    """An exact filter that takes in every second observation."""

    def step(self, before, observation, control_index, step):
        """Return the belief after a step."""
        taken = observation if step % 2 == 0 else np.full_like(observation, np.nan)
        return super().step(before, taken, control_index, step)


def make_wary(twin):
    """Return the estimator for what the twin knows."""
    return WaryFilter(twin.model, twin.sensor_model, "wary")
