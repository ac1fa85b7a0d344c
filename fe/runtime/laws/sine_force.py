"""A force that is a sine of position: weight of a pendulum, cogging of a motor, F = c sin(k x + p).

Parameters: c, k, p. No memory. NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from .interface import FloatArray, PortForce


class SineForce(PortForce):
    """F = coefficient sin(wave_number x + phase), against x; m g l sin x brings a pendulum back to x = 0."""

    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    coefficient: Annotated[float, "N or N m"]
    wave_number: Annotated[float, "rad/m or 1"]
    phase: Annotated[float, "rad"]


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`."""
    angle = law[1] * x + law[2]
    return law[0] * np.sin(angle), law[0] * law[1] * np.cos(angle)
