"""SUNDIALS CVODE through fmpy, with the failures and the memory that fmpy's wrapper lets slip."""

import ctypes
from collections.abc import Callable
from typing import Any

from fmpy.fmi1 import FMICallException
from fmpy.sundials import CVodeSolver
from fmpy.sundials.libraries import sundials_core
from fmpy.sundials.nvector_serial import N_VDestroy_Serial

from fmu_asset.errors import FmuError

from .base import DISCARD
from .plan import Plan

_MOST_INTERNAL_STEPS = 100_000

for _name in ("SUNLinSolFree", "SUNMatDestroy", "SUNContext_Free"):
    getattr(sundials_core, _name).argtypes = [ctypes.c_void_p]


class Solver(CVodeSolver):  # type: ignore[misc]
    """Backward differentiation with root finding for one model-exchange instance.

    Parameters
    ----------
    fmu : fmpy model
        The FMU, with the methods of FMI 2.0.
    plan : Plan
        Its numbers of states and event indicators, and the relative tolerance; absolute ones are this times
        the nominal values.
    inputs : ModelExchange
        Whose `apply` sets the inputs of a moment; asked before each evaluation.
    start_time : float
        Where to begin [s].
    largest_step : float
        Limit of internal steps [s], so that an event indicator that changes sign twice is not missed for
        long.
    """

    def __init__(self, fmu: Any, plan: Plan, inputs: Any, start_time: float, largest_step: float) -> None:
        self._failure: Exception | None = None
        self._open = True

        def get_nominals(values: Any, count: int) -> None:
            fmu.getNominalsOfContinuousStates(values, count)
            for index in range(count):
                # Zero says nothing of a size, and CVODE takes no tolerance of zero for a state that is zero.
                values[index] = abs(values[index]) or 1.0

        super().__init__(
            nx=plan.states,
            nz=plan.event_indicators,
            get_x=fmu.getContinuousStates,
            set_x=fmu.setContinuousStates,
            get_dx=fmu.getDerivatives,
            get_z=fmu.getEventIndicators,
            get_nominals=get_nominals,
            set_time=fmu.setTime,
            input=inputs,
            startTime=start_time,
            maxStep=largest_step,
            relativeTolerance=plan.solver_tolerance,
            maxNumSteps=_MOST_INTERNAL_STEPS,
        )

    # An exception that leaves a ctypes callback is printed and forgotten, and CVODE goes on with rubbish.

    def f(self, t: float, y: Any, ydot: Any, user_data: Any) -> int:
        """Return the right-hand side; 1 asks CVODE for a smaller step, -1 ends the integration."""
        return self._guarded(self._right_hand_side, t, y, ydot, user_data)

    def _right_hand_side(self, t: float, *rest: Any) -> int:
        self.input.apply(t)
        return int(super().f(t, *rest))

    def g(self, t: float, y: Any, gout: Any, user_data: Any) -> int:
        """Return the event indicators."""
        return self._guarded(super().g, t, y, gout, user_data)

    def _guarded(self, function: Callable[..., int], *arguments: Any) -> int:
        try:
            return function(*arguments)
        except (FMICallException, FmuError) as error:
            self._failure = error
            return 1 if getattr(error, "status", None) == DISCARD else -1

    def advance(self, begin: float, end: float) -> tuple[bool, float]:
        """Integrate until `end` or an event; return whether there was one, and the time reached.

        Raises
        ------
        FMICallException, FmuCallError
            If the FMU failed.
        RuntimeError
            If CVODE failed.
        """
        self._failure = None
        try:
            event, _, reached = self.step(begin, end)
        except Exception as error:
            if self._failure is not None:
                raise self._failure from error
            raise RuntimeError(self.error_info[3] if self.error_info else str(error)) from error
        return event, reached

    def close(self) -> None:
        """Free what fmpy's wrapper does not: the vectors, the matrix, the linear solver and the context."""
        if not self._open:
            return
        super().__del__()
        sundials_core.SUNLinSolFree(self.LS)
        sundials_core.SUNMatDestroy(self.A)
        N_VDestroy_Serial(self.x)
        N_VDestroy_Serial(self.abstol)
        sundials_core.SUNContext_Free(ctypes.byref(self.sunctx))
        self._open = False

    def __del__(self) -> None:
        """Leave it to `close`."""
