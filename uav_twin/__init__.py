"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name comes from the package that holds it, and is imported when it is used. `__init__.pyi`
beside this file lists them; `docs/python.md` shows all of them at work; the command line is `uav-twin`.
"""

from uav_twin.lazy import handed_on

_HOMES, __getattr__ = handed_on(__file__)
"""Module of each name, and what imports it."""

__all__ = sorted(_HOMES)  # noqa: PLE0605 - the names stand in `__init__.pyi` alone


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
