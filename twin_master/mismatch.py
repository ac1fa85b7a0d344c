"""A twin that believes another model than the one that flies: an honest model mismatch.

The asset comes from one source and the twin's predicted observations from another; by how much the two
differ is a `Misfit`, which says what the difference does to an estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmu_asset.errors import FmuCallError
from reporting.progress import Progress
from twin_master.asset_source import AssetSource, Origin
from twin_master.assets import Asset
from twin_master.errors import MissingObservationModelError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws
from twin_master.scenario import Scenario
from twin_master.sensor_model import GaussianSensorModel

__all__ = ["Misfit", "MismatchedSource", "check_load_factors", "find_misfit"]

Float = NDArray[np.float64]

_TOLERANCE = 1e-9


class MismatchedSource:
    """The asset of one source; everything that the twin knows from another.

    Parameters
    ----------
    asset : AssetSource
        What is flown.
    model : AssetSource
        Parameter draws, predicted observations and field.
    """

    def __init__(self, asset: AssetSource, model: AssetSource) -> None:
        self._asset = asset
        self._model = model

    @property
    def origin(self) -> Origin:
        """Asset of the one, model of the other."""
        return Origin(self._asset.origin.asset, self._model.origin.model, differ=True)

    def check(self) -> None:
        """Check both."""
        self._asset.check()
        self._model.check()

    def files(self) -> dict[str, bytes]:
        """Return the files of both."""
        return {**self._asset.files(), **self._model.files()}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Prepare both; return the hashes of both."""
        return {**self._asset.prepare(folder, progress), **self._model.prepare(folder, progress)}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter of the twin's model."""
        return self._model.draws(seed)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predictions (E, S, U, G) of the twin's model."""
        return self._model.observation_table(draws, model)

    def open(self) -> Asset:
        """Return the asset at its start."""
        return self._asset.open()

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field of the twin's model."""
        return self._model.write_field(path, state, control)


def check_load_factors(scenario: Scenario) -> None:
    """Check that a control named as in the library, such as `3g`, is a turn at that load factor.

    Raises
    ------
    MissingObservationModelError
        It is another one: asset and model would fly different turns.
    """
    for control in scenario.control:
        named, given = control.name.removesuffix("g"), control.values.get("load_factor")
        try:
            expected = float(named)
        except ValueError:
            continue
        if given is not None and abs(given - expected) > _TOLERANCE:
            raise MissingObservationModelError(
                f"the strain library flies the control {control.name} at load factor {expected:g}, and the "
                f"scenario gives the model of the design {given:g}: set `load_factor` to {expected:g}."
            )


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
        How much an error of one in a sensor moves the weighted least-squares estimate of each factor of the
        state, linearised about each state, with the spread of the parameter draws as correlated noise.
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
        """Root mean square of the relative difference of each sensor over states and controls: (G,)."""
        return np.asarray(np.sqrt(np.nanmean(self.relative**2, axis=(0, 1))))

    @property
    def largest(self) -> tuple[float, int]:
        """The largest relative difference, without sign, and the index of its sensor."""
        worst = np.nanmax(np.abs(self.relative), axis=(0, 1))
        sensor = int(np.nanargmax(worst))
        return float(worst[sensor]), sensor

    @property
    def bias_per_sensor(self) -> Float:
        """What the misfit of each sensor adds to the estimate of one turn: (S, U, F, G), SI.

        An asset that shows less than predicted looks less damaged, hence the sign.
        """
        return -self.gain * self.difference[:, :, None, :]

    @property
    def bias(self) -> Float:
        """What the misfit adds to the estimate of one turn, linearised: (S, U, F), SI."""
        return np.asarray(self.bias_per_sensor.sum(axis=-1))


def find_misfit(
    scenario: Scenario, model: GraphicalModel, sensor_model: GaussianSensorModel, asset: Asset
) -> Misfit:
    """Ask an asset for every state and control from where it stands, and compare; NaN where it refuses.

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
    names = scenario.state_names
    observation = np.full(sensor_model.mean.shape, np.nan)
    start = asset.save_state()
    for state, levels in enumerate(model.states.coordinates):
        health = dict(zip(names, levels.tolist(), strict=True))
        for index, control in enumerate(scenario.control):
            asset.restore_state(start)  # an asset with hidden effects may remember
            with suppress(FmuCallError):
                observation[state, index] = asset.step(control.values, health).values
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
