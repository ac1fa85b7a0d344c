"""The loops of `fe.motion_kernel`, compiled: what the FMU runs as plain Python, from the same file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from typing import Any

import numba

from fe import motion_kernel

MODULE = "discrepancy._motion_kernel_compiled"


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
    except RuntimeError:  # numba's way to say that it found no writable folder
        return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


@cache
def compiled_kernel() -> dict[str, Callable[..., Any]]:
    """Return the compiled functions, for `kernel` of `fe.motion.simulate` and `static_solution`.

    The file is loaded a second time under a name of its own, and its functions are replaced there by compiled
    ones, so that they call each other compiled and `fe.motion_kernel` stays as it is. Machine code is kept
    beside `fe` (or in the user's cache folder); the first use compiles it.
    """
    specification = spec_from_file_location(MODULE, motion_kernel.__file__)
    assert specification is not None
    assert specification.loader is not None
    module = module_from_spec(specification)
    sys.modules[MODULE] = module
    specification.loader.exec_module(module)
    for name in module.COMPILED:
        setattr(module, name, _compiled(getattr(module, name)))
    return dict(module.kernel())
