"""Misfit between the model of a twin and the asset that flies, for the study `level_turns`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin_master.assets.asset_source import Asset, noise_free_observations
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Misfit:
    """Predictions of the twin's model less what the asset would show without noise.

    Attributes
    ----------
    difference : (S, U, G)
        Mean prediction less observation, SI.
    observation : (S, U, G)
        What the asset shows without noise, SI.
    gain : (S, U, F, G)
        How much an error of one in a sensor moves the weighted least-squares estimate of each
        factor of the state, linearised about each state, with the spread of the parameter draws as
        correlated noise.
    """

    difference: Float
    observation: Float
    gain: Float

    @property
    def relative(self) -> Float:
        """Difference as a share of the observation: (S, U, G); NaN where that is zero."""
        shape = self.observation.shape
        nonzero = self.observation != 0.0
        return np.asarray(
            np.divide(self.difference, self.observation, out=np.full(shape, np.nan), where=nonzero)
        )

    @property
    def rms(self) -> float:
        """Root mean square of the relative difference over states, controls and sensors."""
        return float(np.sqrt(np.nanmean(self.relative**2)))

    @property
    def per_sensor(self) -> Float:
        """Rms relative difference of each sensor over states and controls: (G,)."""
        return np.asarray(np.sqrt(np.nanmean(self.relative**2, axis=(0, 1))))

    @property
    def largest(self) -> tuple[float, int]:
        """The largest relative difference, without sign, and the index of its sensor."""
        worst = np.nanmax(np.abs(self.relative), axis=(0, 1))
        sensor = int(np.nanargmax(worst))
        return float(worst[sensor]), sensor

    @property
    def bias_per_sensor(self) -> Float:
        """What the misfit of each sensor adds to the estimate of one step: (S, U, F, G), SI.

        An asset that shows less than predicted looks less damaged, hence the sign.
        """
        return -self.gain * self.difference[:, :, None, :]

    @property
    def bias(self) -> Float:
        """What the misfit adds to the estimate of one step, linearised: (S, U, F), SI."""
        return np.asarray(self.bias_per_sensor.sum(axis=-1))


def find_misfit(
    scenario: Scenario, model: GraphicalModel, sensor_model: GaussianSensorModel, asset: Asset
) -> Misfit:
    """Compare predictions with the asset for every state and control; NaN where the asset refuses.

    Parameters
    ----------
    scenario : Scenario
        States and controls.
    model : GraphicalModel
        S states of F factors.
    sensor_model : GaussianSensorModel
        What the twin predicts, and the noise that it assumes.
    asset : Asset
        What is flown.
    """
    observation = noise_free_observations(scenario, model.states.coordinates, asset)
    return Misfit(sensor_model.mean - observation, observation, _gain(model, sensor_model))


def _gain(model: GraphicalModel, sensor_model: GaussianSensorModel) -> Float:
    """Return (J' C^-1 J)^-1 J' C^-1 of each state and control: (S, U, F, G)."""
    levels = [factor.levels for factor in model.states.factors]
    mean = sensor_model.mean
    grid = mean.reshape(*model.states.shape, *mean.shape[1:])
    slopes = [
        np.gradient(grid, np.asarray(level), axis=axis).reshape(mean.shape)
        for axis, level in enumerate(levels)
        if len(level) > 1
    ]
    jacobian = np.stack(slopes, axis=-1)  # (S, U, G, F)
    spread = sensor_model.value_per_draw - mean
    covariance = np.einsum("e,esug,esuh->sugh", sensor_model.draw_weight, spread, spread)
    index = np.arange(sensor_model.sensor_count)
    covariance[..., index, index] += sensor_model.total_standard_deviation**2
    weighted = np.linalg.solve(covariance, jacobian).swapaxes(-1, -2)  # J' C^-1
    return np.asarray(np.linalg.solve(weighted @ jacobian, weighted))
