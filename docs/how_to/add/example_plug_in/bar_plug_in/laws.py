"""A law of force."""

from typing import Annotated

import numpy as np

from fe.runtime.laws.interface import POSITIVE, PortForce


class SaturatingSpring(PortForce):
    """A spring whose force approaches a limit: F = F0 tanh(x / h)."""

    limit: Annotated[float, "N or N m"]
    transition: Annotated[float, "m or rad", POSITIVE]

    @staticmethod
    def force_and_slope(law, memory, x, duration):
        """Return the force at `x` and its derivative by `x`."""
        limit = law[0]
        transition = law[1]
        ratio = np.tanh(x / transition)
        return limit * ratio, limit * (1.0 - ratio * ratio) / transition
