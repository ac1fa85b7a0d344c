"""What the mission can fly: one protocol, and the assets that need no FMU.

An asset is told the control and its true health, and returns the noise-free observation; or it carries damage
and sensors of its own, and tells of them beside. It is driven by the `Plant`; the twin never meets it.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class InnerTruth:
    """What an asset with damage and sensors of its own tells for scoring; never for the twin.

    Attributes
    ----------
    state : dict of str to float
        True value of each state factor, SI.
    sensed : (G,)
        What its sensors say, SI; NaN where one is lost.
    """

    state: Mapping[str, float]
    sensed: Float


@dataclass(frozen=True)
class AssetReading:
    """What an asset returns for one step.

    Attributes
    ----------
    values : (G,)
        Noise-free observation in its SI unit.
    monitors : dict of str to float
        Further figures that the asset reports of itself, such as a certified error bound.
    inner : InnerTruth or None
        What the asset tells of its own damage and sensors, where it carries them.
    """

    values: Float
    monitors: Mapping[str, float] = field(default_factory=dict)
    inner: InnerTruth | None = None


class Asset(Protocol):
    """An asset under control; one that inherits from this has no state unless it says so."""

    @property
    def units(self) -> Mapping[str, str]:
        """Units of control inputs and monitors by name; those that are missing are dimensionless."""
        return {}

    @abstractmethod
    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Fly one step with the given control inputs and true health (SI)."""

    def save_state(self) -> bytes:
        """Return the state as bytes; empty if the asset has none."""
        return b""

    def restore_state(self, state: bytes) -> None:
        """Continue from a saved state, also in another process."""

    def close(self) -> None:
        """Let go of what the asset holds."""


Told = Callable[[Mapping[str, float], Mapping[str, float]], Float]
"""Returns what is shown (G,) under control inputs in a state, both by name."""
ObservationFunction = Callable[[Mapping[str, float], Mapping[str, float]], AssetReading]


class StatelessAsset(Asset):
    """An asset whose observation depends on nothing but the control and the health of the step.

    Parameters
    ----------
    observe
        Returns the reading for control inputs and health.
    """

    def __init__(self, observe: ObservationFunction) -> None:
        self._observe = observe

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Return the observation under the given control inputs and health."""
        return self._observe(control, health)

    def restore_state(self, state: bytes) -> None:
        """Accept that there is no state."""

    def close(self) -> None:
        """Hold nothing."""


def asked_table(
    names: Sequence[str], states: Float, controls: Iterable[Mapping[str, float]], ask: Told
) -> Float:
    """Ask what is shown in every state (S, F) of named factors under every control: (S, U, G)."""
    settings = list(controls)
    rows = (dict(zip(names, levels, strict=True)) for levels in states.tolist())
    return np.array([[ask(values, health) for values in settings] for health in rows])
