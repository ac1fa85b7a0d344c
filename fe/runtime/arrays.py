"""Types of arrays, and columns of one.

NumPy only: this file is copied into the FMU.
"""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

HELD, PLACE, LAGGED, FADING, FORCE, HEAD = range(6)
"""Columns of a law's memory, see `laws.interface`; from `HEAD` on its hysteretic elements."""
