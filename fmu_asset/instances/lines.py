"""Inputs that move in straight lines between two communication points."""

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from .plan import Plan

_ROUNDING = 1e-12
"""Of the step: what the moment of its end may lack."""


class Lines:
    """What the FMU is given within a step, of a request that says where each line begins and ends.

    Parameters
    ----------
    request : ctypes array of double
        The request block: time, step size, the inputs at the end of the step (those that move first), and
        where they begin.
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    values : ctypes array of double
        Time, step size, and the inputs of the moment.
    slopes : ctypes array of double
        Derivatives in time of the inputs that move.
    """

    def __init__(self, request: Any, plan: Plan) -> None:
        count = plan.linear_count
        self.values = (ctypes.c_double * (len(request) - count))()
        self.slopes = (ctypes.c_double * count)()
        self._request, self._all = _array(request), _array(self.values)
        self._moving, self._slopes = self._all[2 : 2 + count], _array(self.slopes)
        self._end, self._begin = self._request[2 : 2 + count], self._request[-count:]
        self._substeps, self._start, self._span = plan.substeps, 0.0, 1.0

    def stand(self) -> None:
        """Give the inputs of the request as they are, as in an initialisation."""
        self._all[:] = self._request[: len(self._all)]

    def aim(self) -> None:
        """Take the lines of a new request, and give the inputs of its begin."""
        self._start, self._span = self._request[0], self._request[1] * self._substeps
        self._slopes[:] = (self._end - self._begin) / self._span
        self.stand()
        self._moving[:] = self._begin

    def move(self, time: float) -> None:
        """Give the inputs of a moment [s]; one that stays keeps its value to the bit, and so does the end."""
        share = (time - self._start) / self._span
        there = share >= 1.0 - _ROUNDING
        self._moving[:] = self._end if there else self._begin + share * (self._end - self._begin)


def _array(block: Any) -> npt.NDArray[np.float64]:
    return np.frombuffer(memoryview(block).cast("B"))
