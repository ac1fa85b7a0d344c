"""Opens a new instance of an FMU, and removes the Python modules that it leaves behind."""

import os
import sys

from .base import FmuInstance
from .co_simulation import CoSimulation
from .model_exchange import ModelExchange
from .plan import Plan


def open_instance(plan: Plan) -> FmuInstance:
    """Return a new instance for the plan's FMI version and interface.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """
    if plan.fmu.interface == "model-exchange":
        return ModelExchange(plan)
    return CoSimulation(plan)


def forget_modules(folder: str) -> None:
    """Remove the modules that an FMU in Python has imported from its folder.

    Otherwise the next FMU with a module of the same name would get that module, and the folder is
    about to be removed. Instances that still run keep their modules.
    """
    prefix = folder.rstrip(os.sep) + os.sep
    sys.path[:] = [entry for entry in sys.path if not (entry + os.sep).startswith(prefix)]
    # a copy is one step, unlike a list of items: other threads import too
    for name, module in sys.modules.copy().items():
        file = getattr(module, "__file__", None) or ""
        if str(file).startswith(prefix):
            sys.modules.pop(name, None)
