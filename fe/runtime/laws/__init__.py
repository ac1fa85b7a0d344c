"""Laws of internal forces at ports; `fe.runtime.laws.interface` says what a law is.

Every law of a file of this folder has a number, its index in `LAWS`. `advance` and
`force_and_slope` of this module take that number first, and then call the function of the law.
`fe.compilation` compiles them.

NumPy and relative imports only: this folder is copied into the FMU.
"""

from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules

from .interface import FloatArray, PortForce

MODULES = tuple(import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
"""The modules of this folder."""
LAWS = tuple(sorted(PortForce.__subclasses__(), key=lambda law: law.kind))
"""The classes of the laws, by number."""


def functions_by_law(name: str) -> tuple[Callable[..., object], ...]:
    """Return one function of the interface for each law, by the number of the law."""
    return tuple(getattr(law, name) for law in LAWS)


def advance(number: int, law: FloatArray, memory: FloatArray, x: float) -> None:
    """Carry the memory of a law's hysteretic elements to the position `x`, in place.

    Parameters
    ----------
    number : int
        Number of the law in `LAWS`.
    law : (5 + E,) array
        Parameters of the law, then those of its hysteretic elements.
    memory : (5 + E,) array
        Memory of the law; changed in place.
    x : float
        Position of the law's port [m or rad].
    """
    LAWS[number].advance(law, memory, x)


def force_and_slope(
    number: int, law: FloatArray, memory: FloatArray, x: float, duration: float
) -> tuple[float, float]:
    """Return the force of a law at a position or speed, and its derivative by that.

    Parameters
    ----------
    number : int
        Number of the law in `LAWS`.
    law : (5 + E,) array
        Parameters of the law, then those of its hysteretic elements.
    memory : (5 + E,) array
        Memory of the law; it is not changed.
    x : float
        Position [m or rad] of the law's port, or its speed for a law of speed.
    duration : float
        Time since the last position [s].

    Returns
    -------
    force, slope : float
        The force [N or N m] and its derivative.
    """
    return LAWS[number].force_and_slope(law, memory, x, duration)
