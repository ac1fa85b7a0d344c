"""The choice of the class of an instance."""

from .base import FmuInstance
from .co_simulation import CoSimulation
from .model_exchange import ModelExchange
from .plan import Plan


def open_instance(plan: Plan) -> FmuInstance:
    """Return a new instance of the plan's FMI version and interface.

    Parameters
    ----------
    plan : Plan
        The variables that each call exchanges with the FMU.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """
    if plan.fmu.interface == "model-exchange":
        return ModelExchange(plan)
    return CoSimulation(plan)
