"""Types of arrays, by the names that signatures use."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Unsigned = NDArray[np.uint64]
