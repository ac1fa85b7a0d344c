"""What sensors make of a response: gain, saturation, drift, rotation, thermal strain, high-pass, lines, zero.

Pure functions on arrays for the primitives of `fe.runtime.patch.SENSORS`; clocks are not here, because they
say when the response is taken and so belong to whoever computes it. Without sensors the input comes back
untouched. A high-pass needs the whole record, or of one that is read row after row what it remembers
(`FilterMemory`).

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Callable, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray
from .errors import InvalidPatchError
from .modal_system import exponential
from .patch import EVERY_CHANNEL, Clock, HighPass, LoggerClock, ModelPatch, Sensor, SensorRotation
from .patch import SensorRecord as SensorRecord
from .primitive import Primitive

Filter = Callable[[HighPass, "SensorRecord", FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

STRAIN = "strain"
"""Quantity of a strain gauge."""


def needs_structure(patch: ModelPatch) -> bool:
    """Return whether a patch needs more than what its sensors make of the readings of the plain structure."""
    return any(isinstance(item, SensorRotation) or not isinstance(item, Sensor) for item in patch)


def clock_of(patch: ModelPatch) -> tuple[float, float]:
    """Return rate [1] and zero [s] of the clock primitives of a patch, added up."""
    clocks = [item for item in patch if isinstance(item, Clock)]
    return sum(item.rate for item in clocks), sum(item.zero for item in clocks)


def check_channels(patch: ModelPatch, channels: Sequence[tuple[str, str]]) -> None:
    """Check that the channels which sensor primitives name exist and are of the right quantity.

    Raises
    ------
    InvalidPatchError
        If one does not; the sentence names it and what there is.
    """
    quantities = dict(channels)
    for item in patch:
        name = getattr(item, "channel", EVERY_CHANNEL)
        if name == EVERY_CHANNEL:
            continue
        if name not in quantities:
            raise InvalidPatchError(
                f"The primitive {item.kind!r} names the channel {name!r}, which does not exist; there are "
                f"{', '.join(quantities)}."
            )
        if getattr(item, "of_strain", False) and quantities[name] != STRAIN:
            raise InvalidPatchError(
                f"The primitive {item.kind!r} is for strain gauges, but the channel {name!r} measures "
                f"{quantities[name]}."
            )


def apply_sensors(
    patch: ModelPatch,
    record: SensorRecord,
    values: FloatArray,
    rates: FloatArray | None = None,
    transverse: FloatArray | None = None,
    shear: FloatArray | None = None,
    *,
    filtered: Filter,
) -> tuple[FloatArray, FloatArray | None]:
    """Return what the channels show and its time derivative.

    Rotations come first, because a gauge sees the strain of the skin before anything is made of it (several
    rotations of one gauge add up); the other primitives follow in the order of the patch. A primitive whose
    channel is not among `record.channels` changes nothing (`check_channels` finds names that exist nowhere).
    High-pass and lines touch dynamic trials only: static and flight rows are settled readings.

    Parameters
    ----------
    patch : ModelPatch
        Other primitives than those of sensors are ignored, the clock too.
    record : SensorRecord
        The record.
    values : (N, C) ndarray
        What perfect sensors show, in the channels' units.
    rates : (N, C) ndarray, optional
        Its time derivative, for dynamic trials.
    transverse, shear : (N, C) ndarray, optional
        Strain across each gauge's direction and engineering shear strain; needed for rotations.
    filtered : callable
        How columns (N, C) of a dynamic record and their rates pass a high-pass:
        `fe.high_pass.filtered_record`, or `FilterMemory.filtered` of one row of a longer one,
        which has no rates.

    Raises
    ------
    InvalidPatchError
        If a gauge is turned and the components are missing, or a time constant, an order, a drift's time or
        a limit is not positive.
    """
    active = [
        item for item in patch if isinstance(item, Sensor) and not isinstance(item, Clock | LoggerClock)
    ]
    if not active:
        return values, rates
    shown = np.array(values, dtype=np.float64)
    slopes = np.zeros_like(shown) if rates is None else np.array(rates, dtype=np.float64)
    angles = np.zeros(len(record.channels))
    for item in active:
        if isinstance(item, SensorRotation):
            angles[columns_of(item, record.channels)] += item.angle
    turned = np.flatnonzero(angles)
    if turned.size:  # eps' = eps cos^2 + eps_t sin^2 + gamma sin cos (strain in a plane)
        if transverse is None or shear is None:
            raise InvalidPatchError(
                "A gauge is turned, but the model gives no transverse and shear strain to turn it in."
            )
        cosine, sine = np.cos(angles[turned]), np.sin(angles[turned])
        across = transverse[:, turned] * sine**2 + shear[:, turned] * (sine * cosine)
        shown[:, turned] = shown[:, turned] * cosine**2 + across
        if len(across) > 1 and record.is_dynamic:
            # A response has no rates of the components; a central difference of this small share will do.
            slopes[:, turned] = slopes[:, turned] * cosine**2 + np.gradient(across, record.time, axis=0)
    for item in active:
        columns = columns_of(item, record.channels)
        if not columns.size or isinstance(item, SensorRotation):
            continue
        signal, slope = shown[:, columns], slopes[:, columns]
        if not isinstance(item, HighPass):
            read = item.reading(record, signal, slope)
        elif record.is_dynamic:
            read = filtered(item, record, signal, slope)
        else:
            continue
        acting = item.acts(record.time)[:, np.newaxis]
        shown[:, columns], slopes[:, columns] = (
            np.where(acting, after, before) for after, before in zip(read, (signal, slope), strict=True)
        )
    return shown, None if rates is None else slopes


def columns_of(item: Primitive, channels: Sequence[tuple[str, str]]) -> NDArray[np.intp]:
    """Return the columns that a primitive acts on; a named channel is meant whatever its quantity."""
    name = getattr(item, "channel", EVERY_CHANNEL)
    if name != EVERY_CHANNEL:
        chosen = [index for index, (channel, _) in enumerate(channels) if channel == name]
    else:
        quantity = STRAIN if getattr(item, "of_strain", False) else str(getattr(item, "quantity", ""))
        chosen = [index for index, (_, own) in enumerate(channels) if quantity in ("", own)]
    return np.array(chosen, dtype=np.intp)


RATES = frozenset({"velocity", "acceleration", "angular_velocity", "angular_acceleration"})
"""Quantities that are zero at rest."""


def held_before(item: HighPass, record: SensorRecord, first: FloatArray) -> FloatArray:
    """Return what the columns (C,) of a filter had been for ever before the `first` row of a record.

    They were at rest there; what moved already had done so about zero.
    """
    rates = [record.channels[column][1] in RATES for column in columns_of(item, record.channels)]
    return np.where(rates, 0.0, first) if record.settled else np.zeros_like(first)


LARGEST_ORDER = 4
"""Most stages of a high-pass."""


class FilterMemory:
    """What filters remember from one row of a record to the next; the signal is linear between the two.

    Parameters
    ----------
    before : sequence of float or None
        `after` of the row before; None: the signals had settled for ever, see `held_before`.
    duration : float
        Time since the row before [s].

    Attributes
    ----------
    after : list of float
        What is remembered of this row: signal and stages, column after column and filter after filter.
    """

    def __init__(self, before: Sequence[float] | None, duration: float) -> None:
        self._before, self._duration = None if before is None else iter(before), duration
        self.after: list[float] = []

    def filtered(
        self, item: HighPass, record: SensorRecord, row: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what columns (1, C) show, and no rates; raises `InvalidPatchError`."""
        if not (item.time_constant > 0.0 and item.order in range(1, LARGEST_ORDER + 1)):
            raise InvalidPatchError(
                f"A high-pass that is read sample by sample needs a positive time constant and 1 to "
                f"{LARGEST_ORDER} stages, but {item} was given."
            )
        shown, order = [], int(item.order)
        for signal, held in zip(row[0].tolist(), held_before(item, record, row[0]).tolist(), strict=True):
            states = np.full(order, signal - held)
            if self._before is not None:
                last, *kept = islice(self._before, 1 + order)
                states = high_pass_step(np.array(kept), signal - last, self._duration / item.time_constant)
            shown.append(states[-1])
            self.after += [signal, *states.tolist()]
        return np.array([shown]), np.zeros_like(row)


def high_pass_step(states: FloatArray, increment: float, ratio: float) -> FloatArray:
    """Return the outputs of a chain of equal first-order high-pass stages after a linear change of its input.

    The outputs obey y_i' = x' - (y_1 + ... + y_i) / tau.

    Parameters
    ----------
    states : (n,) ndarray
        Outputs of the stages before.
    increment : float
        Change of the input.
    ratio : float
        Duration of the change over tau.
    """
    count = len(states)
    matrix = np.zeros((count + 1, count + 1))  # of the outputs, and the increment as one more that stays
    matrix[:count, :count] = -ratio * np.tri(count)
    matrix[:count, count] = increment
    return np.asarray(exponential(matrix)[:count] @ np.append(states, 1.0))
