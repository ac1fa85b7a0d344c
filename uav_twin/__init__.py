"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name comes from the package that holds it, and is imported when it is used. `__init__.pyi`
beside this file lists them; `docs/python.md` shows all of them at work; the command line is `uav-twin`.
"""

from typing import Any

from uav_twin.shadowing import refuse_shadowing


def __getattr__(name: str) -> Any:
    if name.startswith("__") and name != "__all__":  # asked for by Python itself
        raise AttributeError(name)
    refuse_shadowing()
    from reporting.lazy import lazy_getattr, reexported_names

    homes = reexported_names(__file__)
    known: dict[str, Any] = {"_HOMES": homes, "__all__": sorted(homes)}
    return known[name] if name in known else lazy_getattr(__name__, __file__)(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
