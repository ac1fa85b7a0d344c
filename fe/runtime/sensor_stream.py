"""Sensors read one sample after the other: `fe.runtime.sensors` for a record whose end is not known.

What needs no memory is `apply_sensors` on one row. A high-pass remembers the states of its stages; between
two samples the signal is linear, as there.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import exp, expm1, factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidPatchError
from .patch import SENSORS, Clock, HighPass, LoggerClock, ModelPatch, SensorRotation
from .sensors import SensorRecord, apply_sensors, columns_of

FloatArray = NDArray[np.float64]

LARGEST_ORDER = 4
"""Most stages of a high-pass."""


class Sample(NamedTuple):
    """One sample of what perfect sensors show.

    Attributes
    ----------
    values : (C,) ndarray
        In the channels' units.
    time : float
        Since time zero of drifts [s].
    temperature : float
        Less the reference temperature [K].
    transverse, shear : (C,) ndarray or None
        As in `apply_sensors`.
    """

    values: FloatArray
    time: float
    temperature: float
    transverse: FloatArray | None = None
    shear: FloatArray | None = None


def needs_structure(patch: ModelPatch) -> bool:
    """Return whether a patch needs more than what its sensors make of the readings of the plain structure."""
    return any(not isinstance(item, SENSORS) or isinstance(item, SensorRotation) for item in patch)


@dataclass(frozen=True)
class SensorStream:
    """Sensors of a patch, sample by sample; what they remember is handed in and out.

    Attributes
    ----------
    patch : ModelPatch
        Its sensor primitives act, in their order; rotations first.
    channels : tuple of (str, str)
        Name and quantity of each channel.
    dynamic : bool
        Whether the samples are those of a motion; else high-pass and lines do nothing.
    start : float
        Time of the first sample [s]: lines count from it.
    release : float
        Amplitude of the release at the start [m]; zero: none, and decaying lines do nothing.
    """

    patch: ModelPatch
    channels: tuple[tuple[str, str], ...]
    dynamic: bool
    start: float
    release: float

    def __post_init__(self) -> None:
        for item in self.patch.of(HighPass):
            if not (
                isinstance(item, HighPass)
                and item.time_constant > 0.0
                and item.order in range(1, LARGEST_ORDER + 1)
            ):
                raise InvalidPatchError(
                    f"A high-pass that is read sample by sample needs a positive time constant and 1 to "
                    f"{LARGEST_ORDER} stages, but {item} was given."
                )

    def read(
        self, sample: Sample, memory: Sequence[float] | None, duration: float
    ) -> tuple[FloatArray, list[float]]:
        """Return what the channels show, and what is remembered after it.

        Parameters
        ----------
        sample : Sample
            What perfect sensors show.
        memory : sequence of float or None
            From the sample before; None: the signals had settled at this sample's values for ever.
        duration : float
            Time since the sample before [s].

        Raises
        ------
        InvalidPatchError
            If a primitive cannot be applied.
        """
        values = sample.values
        after: list[float] = []
        pending = [] if memory is None else list(memory)
        active = [
            item
            for item in self.patch
            if isinstance(item, SENSORS) and not isinstance(item, Clock | LoggerClock)
        ]
        active.sort(key=lambda item: not isinstance(item, SensorRotation))
        for filtered, group in groupby(active, lambda item: isinstance(item, HighPass)):
            if not filtered:
                values = self._apply(tuple(group), values, sample)
                continue
            for item in group:
                if isinstance(item, HighPass) and self.dynamic:
                    values = self._filter(
                        item, values, pending if memory is not None else None, after, duration
                    )
        return values, after

    def _apply(self, items: tuple, values: FloatArray, sample: Sample) -> FloatArray:  # type: ignore[type-arg]
        kind = "flight" if not self.dynamic else "ringdown" if self.release != 0.0 else "forced"
        record = SensorRecord(
            channels=self.channels,
            kind=kind,
            time=np.array([sample.time - self.start if self.dynamic else sample.time]),
            start=self.start,
            temperature=np.array([sample.temperature]),
            release=self.release,
        )
        across = (None if part is None else part[np.newaxis] for part in (sample.transverse, sample.shear))
        shown, _ = apply_sensors(ModelPatch(items), record, values[np.newaxis], None, *across)
        return np.asarray(shown[0])

    def _filter(
        self,
        item: HighPass,
        values: FloatArray,
        pending: list[float] | None,
        after: list[float],
        duration: float,
    ) -> FloatArray:
        """Filter the columns of one primitive; take their memory from `pending` and append it to `after`."""
        order, shown = int(item.order), values.copy()
        for column in columns_of(item, self.channels):
            signal = float(values[column])
            states = np.zeros(order)
            if pending is not None:
                before, *kept = pending[: 1 + order]
                del pending[: 1 + order]
                states = high_pass_step(np.array(kept), signal - before, duration / item.time_constant)
            shown[column] = states[-1]
            after += [signal, *states.tolist()]
        return shown


def high_pass_step(states: FloatArray, increment: float, ratio: float) -> FloatArray:
    """Return the outputs of a chain of equal first-order high-pass stages after a linear change of its input.

    The outputs obey y_i' = x' - (y_1 + ... + y_i) / tau, whose matrix -L / tau has the single eigenvalue
    -1 / tau: its exponential is a finite sum.

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
    lower = np.tril(np.ones((count, count)), -1)
    decay, power = exp(-ratio), np.eye(count)
    transition = decay * power
    rest = np.zeros(count)  # exp(-ratio L) e_1 without the term of the unit matrix
    for k in range(1, count):
        power = power @ lower
        term = decay * (-ratio) ** k / factorial(k) * power
        transition += term
        rest += term[:, 0]
    # (e_1 - exp(-ratio L) e_1) / ratio is the mean of the response over the change
    gain = -rest / ratio
    gain[0] += -expm1(-ratio) / ratio
    return np.asarray(transition @ states + gain * increment)
