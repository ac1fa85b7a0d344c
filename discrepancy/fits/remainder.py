"""What is left beside the noise, as a record: its size, and how many samples of it are independent."""

from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Remainder:
    """What is left in each channel of trials in motion.

    Attributes
    ----------
    size : (channels,) ndarray
        Standard deviation beside the noise, over that of the noise; nought where noise alone is left.
    factor : (channels,) ndarray
        Deviation of the noise that counts as many samples as are independent, over the recorded one.
    time : (channels,) ndarray
        Over which it forgets [s].
    frequency : (channels,) ndarray
        At which it swings [Hz]; nought if it does not.
    of_noise : (channels,) ndarray of bool
        Where it is the colour of the noise itself, as its record admits.
    """

    size: FloatArray
    factor: FloatArray
    time: FloatArray
    frequency: FloatArray
    of_noise: BoolArray

    @property
    def acts(self) -> bool:
        """Whether anything but white noise is left."""
        return bool(np.any(self.factor != 1.0))

    @property
    def is_noise(self) -> bool:
        """Whether all that is left is the colour of the noise, as its records have it."""
        return bool(np.all(self.of_noise | (self.factor == 1.0)))
