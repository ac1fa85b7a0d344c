"""What comes out of one communication step."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Observation(NamedTuple):
    """What came out of one communication step.

    Attributes
    ----------
    values : (n_obs,) ndarray
        The observations of the binding in their order and units.
    time : float
        Time at the end of the step [s]: start + i * interval.
    extra : dict of str to float
        Monitors, recorded variables and outputs of ports.
    """

    values: npt.NDArray[np.float64]
    time: float
    extra: dict[str, float]
