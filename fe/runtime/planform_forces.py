"""Internal forces that are spread over the planform: by station, each by its share of the area.

A law at the port `PLANFORM` acts at every place of the wing on the motion of that place, with a force that is
the place's share of the area times that of the law: air resists where the wing moves, not its mean.
The integral over the area is taken at the stations of Gauss and Legendre along the span.

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from .arrays import FloatArray
from .laws.interface import PortForce
from .patch import ModelPatch
from .primitive import Primitive

PLANFORM = "planform"
"""The place of a force that is spread over the planform."""
STATION_COUNT = 6
"""Stations of the integral: ring-downs under quadratic drag are within 1e-3 microstrain of those with 24."""
STATION_PORTS = tuple(f"{PLANFORM}[{number}]" for number in range(1, STATION_COUNT + 1))
"""Ports of the stations, from the root to the tip."""


def place_of(port: str) -> str:
    """Return the place that a patch names for a port: `PLANFORM` for those of its stations."""
    return PLANFORM if port in STATION_PORTS else port


class PlanformStations(NamedTuple):
    """Stations of the integral over the planform.

    Attributes
    ----------
    distance : (S,) ndarray
        From the root [m].
    share : (S,) ndarray
        Share of the area; sums to one.
    """

    distance: FloatArray
    share: FloatArray


def planform_stations(semi_span: float, root_chord: float, tip_chord: float) -> PlanformStations:
    """Return the stations of a wing whose chord is linear along the span, lengths in m."""
    place, weight = np.polynomial.legendre.leggauss(STATION_COUNT)
    eta = 0.5 * (1.0 + place)
    area = weight * (root_chord + (tip_chord - root_chord) * eta)
    return PlanformStations(semi_span * eta, area / area.sum())


def at_stations(patch: ModelPatch, share: FloatArray) -> ModelPatch:
    """Return a patch with each force at `PLANFORM` replaced by one at every port of `STATION_PORTS`.

    Parameters
    ----------
    patch : ModelPatch
        Any; what acts elsewhere stays, in its order.
    share : (S,) ndarray
        Of the stations.
    """
    spread: list[Primitive] = []
    for item in patch:
        if not isinstance(item, PortForce) or item.port != PLANFORM:
            spread.append(item)
            continue
        for port, part in zip(STATION_PORTS, share.tolist(), strict=True):
            changes: dict[str, Any] = {name: part * getattr(item, name) for name in item.proportional}
            spread.append(replace(item, **changes, port=port))
    return ModelPatch(tuple(spread))
