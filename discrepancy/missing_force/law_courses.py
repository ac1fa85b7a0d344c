"""Forces of laws along a motion that is known: what they would have been, had the port moved so."""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from discrepancy.models.compiled_motion import law_functions
from fe.compilation import compiled
from fe.runtime.laws import LAWS, advance, pull, steady
from fe.runtime.laws.interface import HEAD, PARAMETERS, PortForce
from fe.runtime.motion_arrays import FIRST_PARTS

FloatArray = NDArray[np.float64]

WIDER = 10.0
"""By which a deviation of the speed is too small: that of the process does not know of steps."""
SLOW = 0.02
"""Share of the usual speed below which a body creeps before it slides, and no law of the speed holds."""


def along(
    number: int, of_speed: bool, law: FloatArray, elements: FloatArray, x: FloatArray, v: FloatArray,
    memory: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    """Fill `found` (F,) with the force of a law at positions and speeds (F,) that follow one another."""
    for k in range(len(x)):
        if of_speed:
            found[k] = steady(number, law, x[k], v[k])
        else:
            advance(number, law, elements, memory, x[k], FIRST_PARTS if k == 0 else 1)
            memory[1] = x[k]
            found[k] = pull(number, law, elements, memory, x[k], 1.0, 1)[0]


@cache
def _compiled_along() -> Callable[..., None]:
    return compiled(along, law_functions())


def law_course(
    law: PortForce,
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    doubt: float = 0.0,
    holding: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the force (F,) of a law along a motion (F,) of its port; zero outside of its windows.

    Where a speed may be zero by its deviation `doubt`, a law of the speed that is a force at rest, too, is
    what holds the port, `holding` (F,), up to its own largest.
    """
    elements = np.asarray(law.elements(), dtype=np.float64)
    elements = elements if len(elements) else np.zeros(1)
    values = np.pad(np.array(law.row, dtype=np.float64), (0, PARAMETERS - len(law.row)))
    found = np.zeros(len(position))
    memory = np.zeros(HEAD + len(elements))
    motion = (np.ascontiguousarray(position), np.ascontiguousarray(speed))
    _compiled_along()(LAWS.index(type(law)), type(law).of_speed, values, elements, *motion, memory, found)
    if type(law).of_speed and doubt > 0.0:
        slow = max(WIDER * doubt, SLOW * float(np.sqrt(np.mean(speed**2))))
        moves = erf(np.abs(speed) / (np.sqrt(2.0) * slow))
        found = moves * found + (1.0 - moves) * np.clip(holding, -np.abs(found), np.abs(found))
    if law.windows:
        inside = np.zeros(len(found), dtype=bool)
        for window in law.windows:
            begin, end = window.span
            inside |= (time >= begin) & (time < end)
        found *= inside
    return found
