"""The flown asset with its truth; the mission loop shows the twin its observations and nothing else."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin_master.assets.interface import Asset, AssetReading
from twin_master.errors import AssetOutputError
from twin_master.mission.truth import Truth
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]


@dataclass(frozen=True)
class PlantRecord:
    """What happened so far, for the store and the checkpoint; never for the twin.

    Attributes
    ----------
    state : (t, F)
        True state of each step, SI.
    observation : (t, G)
        Noise-free observation, SI.
    monitors : dict of str to (t,)
        Figures that the asset reported of itself.
    """

    state: Float
    observation: Float
    monitors: dict[str, Float]


def checked_values(scenario: Scenario, reading: AssetReading, step: int, control: str) -> Float:
    """Return the observation (G,) of a reading.

    Raises
    ------
    AssetOutputError
        If it holds NaN, an infinity or the wrong number of values.
    """
    values = np.asarray(reading.values, dtype=np.float64)
    if values.shape != (scenario.observation.count,):
        raise AssetOutputError(
            f"step {step}: the scenario expects {scenario.observation.count} values of "
            f"`{scenario.observation.role}` and the asset returned {values.shape}"
        )
    if not np.all(np.isfinite(values)):
        bad = ", ".join(str(index + 1) for index in np.flatnonzero(~np.isfinite(values)))
        raise AssetOutputError(
            f"step {step}: the asset returned NaN or an infinity for `{scenario.observation.role}` "
            f"{bad} under the control `{control}`; the run stops here and can be resumed"
        )
    return values


class Plant:
    """An asset, driven by its truth.

    Parameters
    ----------
    scenario : Scenario
        Controls and their inputs.
    truth : Truth
        Damage, noise and faults.
    asset : Asset
        What is flown.
    """

    def __init__(self, scenario: Scenario, truth: Truth, asset: Asset) -> None:
        self._scenario = scenario
        self._truth = truth
        self._asset = asset
        self._states: list[Float] = []
        self._observations: list[Float] = []
        self._monitors: dict[str, list[float]] = {}

    def turn(self, control_index: int, previous_control_index: int | None) -> Float:
        """Fly one turn and return what the sensors say, and behind it the readings of inspections: (G + I,).

        NaN where a sensor is lost, and where a reading was not asked for.

        Raises
        ------
        AssetOutputError
            If the asset returns NaN, an infinity or the wrong number of values.
        """
        step = len(self._states)
        control = self._scenario.control[control_index]
        if self._truth.in_asset:
            reading = self._asset.step(control.values, {})
            state = self._told(step, reading)
        else:
            previous = self._states[-1] if self._states else None
            state = self._truth.state(step, previous, previous_control_index)
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            reading = self._asset.step(control.values, health)
        values = checked_values(self._scenario, reading, step, control.name)
        self._states.append(state)
        self._observations.append(values)
        for name, value in reading.monitors.items():
            self._monitors.setdefault(name, []).append(float(value))
        sensed = self._truth.sense(step, values) if reading.inner is None else reading.inner.sensed
        return np.concatenate((sensed, self._truth.inspected(step, state, control_index)))

    def _told(self, step: int, reading: AssetReading) -> Float:
        """Return the true state that an asset with damage of its own tells."""
        if reading.inner is None:
            raise AssetOutputError(
                f"step {step}: the asset does not tell its damage, which `truth` asks of it"
            )
        return np.array([reading.inner.state[name] for name in self._scenario.state_names])

    def latest(self) -> tuple[Float, Float, dict[str, float]]:
        """Return true state (F,), noise-free observation (G,) and monitors of the last turn."""
        monitors = {name: values[-1] for name, values in self._monitors.items()}
        return self._states[-1], self._observations[-1], monitors

    def record(self) -> PlantRecord:
        """Return what happened so far."""
        return PlantRecord(
            state=np.array(self._states).reshape(-1, len(self._scenario.state)),
            observation=np.array(self._observations).reshape(-1, self._scenario.observation.count),
            monitors={name: np.array(values) for name, values in self._monitors.items()},
        )

    def save_state(self) -> bytes:
        """Return the state of the asset as bytes."""
        return self._asset.save_state()

    def restore(self, record: PlantRecord, asset_state: bytes) -> None:
        """Continue from a record and a saved state of the asset."""
        self._states = list(record.state)
        self._observations = list(record.observation)
        self._monitors = {name: values.tolist() for name, values in record.monitors.items()}
        self._asset.restore_state(asset_state)
