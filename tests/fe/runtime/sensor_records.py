"""Records of three channels with smooth readings, and what sensors of a patch show of them."""

from dataclasses import replace

import numpy as np

from fe.high_pass import filtered_record
from fe.runtime.arrays import FloatArray
from fe.runtime.patch import ModelPatch, Primitive
from fe.runtime.sensors import SensorRecord, apply_sensors

CHANNELS = (("tip", "displacement"), ("g0", "strain"), ("g1", "strain"))
TIME = np.arange(200) * 0.01
RINGDOWN = SensorRecord(CHANNELS, "ringdown", TIME, 100.0, np.full(200, 5.0), "A", 0.05)
STATIC = replace(RINGDOWN, kind="static")
FORCED = replace(RINGDOWN, kind="forced")
FLIGHT = replace(RINGDOWN, kind="flight")
VALUES = np.stack([np.cos(3 * TIME), 1e-3 * np.cos(5 * TIME), 2e-3 * np.sin(4 * TIME)], axis=1)
"""True values (200, 3) of the channels."""
RATES = np.stack([-3 * np.sin(3 * TIME), -5e-3 * np.sin(5 * TIME), 8e-3 * np.cos(4 * TIME)], axis=1)
"""Their derivatives by time."""


def reading_of(name: str, readings: FloatArray) -> FloatArray:
    """Return the column of one channel by its name."""
    names = [channel for channel, _ in CHANNELS]
    return readings[:, names.index(name)]


def show(
    *primitives: Primitive,
    record: SensorRecord = RINGDOWN,
    values: FloatArray = VALUES,
    rates: FloatArray = RATES,
    **components: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return values and rates that sensors show.

    Parameters
    ----------
    *primitives
        The patch.
    record, values, rates
        The record with the true values (N, 3) and their rates.
    **components
        `transverse` and `shear` (N, 3) of gauges that are rotated.
    """
    return apply_sensors(
        ModelPatch(primitives), record, values, rates, high_pass=filtered_record, **components
    )
