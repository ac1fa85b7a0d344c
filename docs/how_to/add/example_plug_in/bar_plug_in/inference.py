"""A sensor model and an estimator."""

import numpy as np
from scipy.special import logsumexp
from scipy.stats import t

import uav_twin


class StudentSensorModel(uav_twin.GaussianSensorModel):
    """Errors of readings that follow a Student-t distribution with four degrees of freedom."""

    def log_likelihood_sequence(self, observations, control_index):
        """Return log p(o | D, u) of each row for each state: (T, G), (T,) -> (T, S)."""
        readings = self.check_observation(observations)[:, None]  # (rows, 1, sensors)
        # the deviations under the control of each row, (rows, states, sensors)
        deviation = self.total_standard_deviation.swapaxes(0, 1)[control_index]
        log_factor = t.logpdf(0.0, df=4) - np.log(deviation)
        log_densities = []
        for values in self.value_per_draw:  # those of a draw of the calibration
            predicted = values.swapaxes(0, 1)[control_index]
            residual = (readings - predicted) / deviation
            log_density = log_factor - 2.5 * np.log1p(residual**2 / 4)
            log_densities.append(np.nansum(log_density, axis=-1))  # a lost sensor is NaN
        return logsumexp(log_densities, b=self.draw_weight[:, None, None], axis=0)


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
