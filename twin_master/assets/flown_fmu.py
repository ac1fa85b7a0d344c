"""An FMU, or several coupled ones, as the mission flies them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from twin_master.assets.interface import AssetReading, InnerTruth

if TYPE_CHECKING:
    from fmu_asset.coupling.asset import CoupledAsset
    from fmu_asset.door.session import FmiAsset

    Session = FmiAsset | CoupledAsset
    """One FMU, or several as one, with the same face."""


@dataclass(frozen=True)
class InnerRoles:
    """Where an asset with damage and sensors of its own tells the truth; see `[truth]` of a scenario.

    Attributes
    ----------
    state : dict of str to str
        Monitor by state factor.
    observation : slice
        The noise-free observation among those of the binding.
    received : slice or None
        Where the binding observes whether each sensor is received.
    """

    state: Mapping[str, str]
    observation: slice
    received: slice | None


_TAKEN = ("state", "sensor_status", "step", "region", "sensor")
"""What the truth of a run holds already."""


class FmuAsset:
    """An FMU, or several coupled ones, as the mission flies them.

    Parameters
    ----------
    session : FmiAsset or CoupledAsset
        The door, at its start.
    observation : slice
        Where the observed quantity stands among the observations of the binding.
    load : mapping of str to float
        Load inputs, the same in every step.
    inner : InnerRoles, optional
        Given where damage and sensors are the asset's own.
    """

    def __init__(
        self,
        session: "Session",
        observation: slice,
        load: Mapping[str, float],
        inner: InnerRoles | None = None,
    ) -> None:
        self._session, self._observation, self._load, self._inner = session, observation, dict(load), inner
        binding, recorded = session.binding, session.recorded_units
        taken = {*binding.control, *binding.observation, *_TAKEN}
        self._names = {name: _plain_name(name, taken) for name in recorded}
        self._units = {
            name: scalar.unit
            for table in (binding.parameter, binding.control)
            for name, scalar in table.items()
        }
        self._units |= {self._names[name]: unit for name, unit in recorded.items()}

    @property
    def units(self) -> Mapping[str, str]:
        """Units of parameters, control inputs and of what is recorded beside the observations."""
        return self._units

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make one communication step."""
        observation = self._session.step(control, health, self._load)
        sensed = observation.values[self._observation]
        extra = {self._names[name]: value for name, value in observation.extra.items()}
        if self._inner is None:
            return AssetReading(sensed, extra)
        state = {name: observation.extra[monitor] for name, monitor in self._inner.state.items()}
        if self._inner.received is not None:
            sensed = np.where(observation.values[self._inner.received] == 0.0, np.nan, sensed)
        free = observation.values[self._inner.observation]
        return AssetReading(free, extra, InnerTruth(state, sensed))

    def save_state(self) -> bytes:
        """Return the state of the FMU."""
        return self._session.save_state()

    def restore_state(self, state: bytes) -> None:
        """Bring the FMU to a saved state."""
        self._session.restore_state(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()


def _plain_name(name: str, taken: set[str]) -> str:
    """Return a name under which a variable of an FMU can be stored: without `/`, and not taken."""
    plain = "".join("_" if letter == "/" or not letter.isprintable() else letter for letter in name).strip()
    while plain in taken or not plain:
        plain += "_"
    taken.add(plain)
    return plain
