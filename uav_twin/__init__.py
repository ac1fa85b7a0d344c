"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name comes from the package that holds it, and is imported when it is used. `__init__.pyi`
beside this file lists them; `docs/python.md` shows all of them at work; the command line is
`uav-twin`.
"""

from typing import Any

from uav_twin.shadowing import refuse_shadowing


def __getattr__(name: str) -> Any:
    """Return a public name, imported now; `__all__` and `_HOMES` list them and their modules."""
    if name.startswith("__") and name != "__all__":  # Python itself looks for such names
        raise AttributeError(name)
    refuse_shadowing()
    from reporting.lazy import lazy_getattr, reexported_names

    modules_of_names = reexported_names(__file__)
    if name == "__all__":
        return sorted(modules_of_names)
    if name == "_HOMES":
        return modules_of_names
    return lazy_getattr(__name__, __file__)(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
