"""The flown asset with its truth, as a source: the twin is shown its observations and nothing else."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmu_asset.errors import FmuEndedError
from twin_master.assets.interface import Asset, AssetReading
from twin_master.errors import AssetOutputError, TwinMasterError
from twin_master.mission.truth import Truth
from twin_master.mission.turns import Happened, Reading
from twin_master.network.twin import Twin
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]


def checked_values(scenario: Scenario, reading: AssetReading, step: int, control: str) -> Float:
    """Return the observation (G,) of a reading.

    Raises
    ------
    AssetOutputError
        It has another number of values, or one that is not finite.
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


def decided_to_end(scenario: Scenario, control_index: int) -> str:
    """Return that an action has ended a mission."""
    return f"the twin decided on `{scenario.control_names[control_index]}`."


class Plant:
    """An asset, driven by its truth, and flown under the controls that a twin proposes.

    Parameters
    ----------
    scenario : Scenario
    truth : Truth
    asset : Asset
        At its start.

    Attributes
    ----------
    step : int
        Turns flown.
    ended : str
        How the asset ended the mission before its last turn; empty where it did not.
    """

    def __init__(self, scenario: Scenario, truth: Truth, asset: Asset) -> None:
        self._scenario, self._truth, self._asset = scenario, truth, asset
        self._state: Float | None = None
        self.step, self.ended = 0, ""

    def read(self, twin: Twin) -> Reading | None:
        """Return what comes of the next turn, see `Source`; None at the end of the mission."""
        if twin.turns == self._scenario.mission.steps:
            return None
        before = twin.control_of(twin.turns - 1) if twin.turns else None
        if before is not None and self._scenario.ends(before):
            self.ended = decided_to_end(self._scenario, before)
            return None
        try:
            return self.turn(twin.proposed_control, before)
        except FmuEndedError as error:
            if not twin.turns:
                raise
            self.ended = error.sentence
            return None

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Refuse to go on: what is simulated was observed, whatever the twin believes."""
        raise error

    def turn(self, control_index: int, previous_control_index: int | None) -> Reading:
        """Fly one turn.

        Parameters
        ----------
        control_index
            Control in force.
        previous_control_index
            Control of the turn before; None in the first one.

        Raises
        ------
        AssetOutputError
            The asset returned something that is no observation.
        """
        control = self._scenario.control[control_index]
        if self._truth.in_asset:
            reading = self._asset.step(control.values, {})
            state = self._told(reading)
        else:
            state = self._truth.state(self.step, self._state, previous_control_index)
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            reading = self._asset.step(control.values, health)
        values = checked_values(self._scenario, reading, self.step, control.name)
        sensed = self._truth.sense(self.step, values) if reading.inner is None else reading.inner.sensed
        inspected = self._truth.inspected(self.step, state, control_index)
        self._state, self.step = state, self.step + 1
        monitors = {name: float(value) for name, value in reading.monitors.items()}
        happened = Happened(state, values, monitors)
        return Reading(np.concatenate((sensed, inspected)), control_index, happened=happened)

    def _told(self, reading: AssetReading) -> Float:
        """Return the true state that an asset with damage of its own tells."""
        if reading.inner is None:
            raise AssetOutputError(
                f"step {self.step}: the asset does not tell its damage, which `truth` asks of it"
            )
        return np.array([reading.inner.state[name] for name in self._scenario.state_names])

    def save_state(self) -> bytes:
        """Return the state of the asset as bytes."""
        return self._asset.save_state()

    def restore(self, readings: Sequence[Reading], asset_state: bytes) -> None:
        """Continue behind turns that were flown, and from a saved state of the asset."""
        happened = readings[-1].happened
        self.step, self._state = len(readings), None if happened is None else happened.state
        self._asset.restore_state(asset_state)
