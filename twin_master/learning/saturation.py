"""Soft saturation of all sensors, as static hypotheses beside the draws of the parameter.

A sensor that saturates softly shows L tanh(x / L) of a value x. The limit L follows from the
fraction s of a reading y that is lost, to first order s = (y / L)^2 / 3 (as in the catalogue of
effects, `sensor_saturation`).
"""

from collections.abc import Sequence

import numpy as np

from reporting.arrays import Float
from twin_master.errors import InvalidModelError
from twin_master.network.sensor_model import GaussianSensorModel

LOST_FRACTIONS: Float = np.array([0.0, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32])
"""Lost fractions of the largest reading before damage that are compared; 0 for sound sensors."""


def with_saturation(
    sensor_model: GaussianSensorModel,
    prior_belief: Float,
    probability: float,
    sensor_units: Sequence[str],
) -> GaussianSensorModel:
    """Return a sensor model whose sensors may all saturate, with draws for each lost fraction.

    Draw n E + e of the result is draw e of the E draws of the given model with lost fraction n.

    Parameters
    ----------
    sensor_model : GaussianSensorModel
        The sensors without saturation.
    prior_belief : (S,) array
        The belief before the first step, under which the largest reading of each unit is taken.
    probability : float
        The prior probability that the sensors saturate; all lost fractions are equally probable.
    sensor_units : sequence of str
        The unit of each of G sensors. Sensors of one unit have one limit.

    Raises
    ------
    InvalidModelError
        If the sensors show identified modes, inspections or have a likelihood of their own.
    """
    if type(sensor_model) is not GaussianSensorModel:
        raise InvalidModelError(
            "`learning.saturation` needs sensors with Gaussian noise, and got a "
            f"{type(sensor_model).__name__}: leave the key out with modes, inspections and sensor "
            "models of your own"
        )
    value = sensor_model.value_per_draw  # (E, S, U, G)
    reading = np.abs(np.tensordot(prior_belief, sensor_model.mean, axes=1)).max(axis=0)  # (G,)
    units = np.array(sensor_units)
    largest = np.array([reading[units == unit].max() for unit in sensor_units])
    values = [value]
    for fraction in LOST_FRACTIONS[1:]:
        limit = np.maximum(largest / np.sqrt(3.0 * fraction), np.finfo(np.float64).tiny)
        values.append(limit * np.tanh(value / limit))
    saturating = len(LOST_FRACTIONS) - 1
    fraction_weights = np.array([1.0 - probability, *[probability / saturating] * saturating])
    return GaussianSensorModel(
        np.concatenate(values),
        sensor_model.standard_deviation,
        draw_weight=np.outer(fraction_weights, sensor_model.draw_weight).ravel(),
        average="inside" if sensor_model.averages_inside else "outside",
        model_error=sensor_model.model_error,
        interval=sensor_model.interval,
    )
