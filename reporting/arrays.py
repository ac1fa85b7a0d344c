"""Types of arrays, by the names that signatures use, and the least divisor of their quotients."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Unsigned = NDArray[np.uint64]
AnyArray = NDArray[Any]

LEAST_DIVISOR = 1e-300
"""Stands for a divisor of zero, so that a quotient is large and not infinite or undefined."""
