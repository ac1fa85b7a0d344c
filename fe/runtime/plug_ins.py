"""Plug-ins: objects that installed packages provide by entry points.

This is the only module that loads them. Standard library only: this file is copied into the FMU.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points

from .errors import PlugInError


@dataclass(frozen=True)
class PlugIn:
    """An object that an installed package provides.

    Attributes
    ----------
    name : str
        The name of the entry point.
    subject : str
        The entry point, its group and its package, as the beginning of a message.
    value : object
        The loaded object.
    """

    name: str
    subject: str
    value: object


def plug_in_names(group: str) -> list[str]:
    """Return the sorted names of the entry points of a group, without loading them."""
    return sorted({point.name for point in entry_points(group=group)})


def load_plug_ins(group: str) -> tuple[PlugIn, ...]:
    """Load all plug-ins of a group such as "uav_twin.effects", sorted by name.

    Raises
    ------
    PlugInError
        If two entry points have the same name, or one cannot be loaded.
    """
    return _loaded(entry_points(group=group), group)


def find_plug_in(group: str, name: str) -> PlugIn | None:
    """Load the plug-in with a name in a group; None if there is none.

    Raises
    ------
    PlugInError
        If two entry points have this name, or it cannot be loaded.
    """
    plug_ins = _loaded(entry_points(group=group, name=name), group)
    return plug_ins[0] if plug_ins else None


def _loaded(points: Iterable[EntryPoint], group: str) -> tuple[PlugIn, ...]:
    """Load entry points of a group, sorted by name."""
    sorted_points = sorted(points, key=lambda point: (point.name, _package_of(point)))
    counts = Counter(point.name for point in sorted_points)
    plug_ins = []
    for point in sorted_points:
        if counts[point.name] > 1:
            packages = [_package_of(other) for other in sorted_points if other.name == point.name]
            raise PlugInError(
                f"The packages {' and '.join(packages)} both have an entry point {point.name!r} of "
                f"the group {group!r}: uninstall one of them."
            )
        subject = (
            f"The entry point {point.name!r} of the group {group!r} in the package "
            f"{_package_of(point)}"
        )
        try:
            value = point.load()
        except Exception as cause:  # a module may fail with any error while it is imported
            raise PlugInError(
                f"{subject} failed: {type(cause).__name__}: {cause}. Mend the package, or "
                "uninstall it."
            ) from cause
        plug_ins.append(PlugIn(name=point.name, subject=subject, value=value))
    return tuple(plug_ins)


def _package_of(point: EntryPoint) -> str:
    """Return the name and version of the distribution that provides an entry point."""
    return "(unknown)" if point.dist is None else f"{point.dist.name} {point.dist.version}"
