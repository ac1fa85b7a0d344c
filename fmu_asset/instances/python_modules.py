"""Python modules that an FMU written in Python has imported into this process."""

import os
import sys


def forget_modules(folder: str) -> None:
    """Remove the modules that an FMU in Python has imported from its folder.

    Otherwise the next FMU with a module of the same name, or the caller, would be given that
    module, and the folder is about to be removed. Instances that still run keep their modules.
    """
    prefix = folder.rstrip(os.sep) + os.sep
    sys.path[:] = [entry for entry in sys.path if not (entry + os.sep).startswith(prefix)]
    # a copy is one step, unlike a list of items: other threads import too
    for name, module in sys.modules.copy().items():
        file = getattr(module, "__file__", None) or ""
        if str(file).startswith(prefix):
            sys.modules.pop(name, None)
