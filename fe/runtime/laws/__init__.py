"""Laws of internal forces at ports; `fe.runtime.laws.interface` says what a law is.

Every law of a file of this folder has a number, its index in `LAWS`. So has every law of an
installed package, which has an entry point of the group `GROUP` for the law's class. `advance` and
`force_and_slope` of this module take that number first, and then call the function of the law.
`fe.compilation` compiles them.

NumPy and relative imports only: this folder is copied into the FMU.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules

from ..errors import PlugInError
from ..plug_ins import load_plug_ins
from .interface import PARAMETERS, FloatArray, PortForce

GROUP = "uav_twin.laws"
"""Group of the entry points of laws: the name is the kind of the law, the object is its class."""

_OWN_MODULES = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
_OWN_LAWS = sorted(PortForce.__subclasses__(), key=lambda law: law.kind)


def _installed_laws() -> list[type[PortForce]]:
    """Return the laws of installed packages, sorted by kind.

    Raises `PlugInError` if an entry point fails, is not a law, or has the name of another law.
    """
    laws = []
    own_kinds = [law.kind for law in _OWN_LAWS]
    for plug_in in load_plug_ins(GROUP):
        law = plug_in.value
        if not (isinstance(law, type) and issubclass(law, PortForce)):
            raise PlugInError(f"{plug_in.subject} must be a subclass of PortForce, but is {law!r}.")
        if law.kind in own_kinds:
            raise PlugInError(
                f"{plug_in.subject} is the law {law.kind!r}, which uav-twin has itself: rename the "
                "class."
            )
        if law.kind != plug_in.name:
            raise PlugInError(f"{plug_in.subject} must be named {law.kind!r}, as its law is.")
        if len(law.units) > PARAMETERS:
            raise PlugInError(
                f"{plug_in.subject} has {len(law.units)} numbers, but a law has at most "
                f"{PARAMETERS}."
            )
        laws.append(law)
    return laws


# The copy inside an FMU has another name, and knows the laws of this folder only.
INSTALLED_LAWS = tuple(_installed_laws() if __name__ == "fe.runtime.laws" else ())
"""The classes of the laws of installed packages."""
MODULES = (*_OWN_MODULES, *(sys.modules[law.__module__] for law in INSTALLED_LAWS))
"""The modules of this folder, and those of the laws of installed packages."""
LAWS = (*_OWN_LAWS, *INSTALLED_LAWS)
"""The classes of the laws, by number."""


def functions_by_law(name: str) -> tuple[Callable[..., object], ...]:
    """Return the function with a name from each law, by the number of the law."""
    return tuple(getattr(law, name) for law in LAWS)


def advance(number: int, law: FloatArray, memory: FloatArray, x: float) -> None:
    """Update the memory of a law's hysteretic elements to the position `x`, in place.

    Parameters
    ----------
    number : int
        Index of the law in `LAWS`.
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
    """Return the force of a law [N or N m], and its derivative by `x`.

    Parameters
    ----------
    number : int
        Index of the law in `LAWS`.
    law : (5 + E,) array
        Parameters of the law, then those of its hysteretic elements.
    memory : (5 + E,) array
        Memory of the law; not changed.
    x : float
        Position of the law's port [m or rad].
    duration : float
        Time since the last position [s], from which a law of speed gets the speed.
    """
    return LAWS[number].force_and_slope(law, memory, x, duration)
