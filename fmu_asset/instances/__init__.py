"""One instance of an FMU in this process, for each FMI version and interface."""

from typing import TYPE_CHECKING

from .plan import Plan

if TYPE_CHECKING:
    from .base import FmuInstance


def open_instance(plan: Plan) -> "FmuInstance":
    """Return a new instance of the plan's FMI version and interface.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """
    if plan.fmu.interface == "model-exchange":
        # Its solver is a library of its own; those who do not need it shall not load it.
        from .co_simulation import ModelExchange

        return ModelExchange(plan)
    from .co_simulation import CoSimulation

    return CoSimulation(plan)
