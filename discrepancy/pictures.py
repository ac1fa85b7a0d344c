"""The picture of an investigation for a notebook: the missing force over time."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from discrepancy.missing_force.port_force import MissingForce
from reporting.pages.notebook import new_panels

if TYPE_CHECKING:  # it takes long to import
    from matplotlib.axes import Axes

MOST_TRIALS = 6
"""Most trials that are drawn, each in a panel."""


class HasMissingForce(Protocol):
    """A result with a missing force, such as what `investigate` returns."""

    @property
    def missing(self) -> MissingForce | None:
        """The force that the model lacks at a port; None if there is none."""


def plot_missing_force(
    result: HasMissingForce, axes: "Axes | Sequence[Axes] | None" = None
) -> "list[Axes]":
    """Draw the force that the model lacks over time, with the law of the verdict if it has one.

    Each of the first trials has a panel with the smoothed force and two standard deviations.

    Parameters
    ----------
    result : Investigation
        What `investigate` returns.
    axes : Axes or sequence of Axes, optional
        A panel for each drawn trial, of which there are at most 6; new ones of pyplot by default.

    Returns
    -------
    list of Axes
        The panels.

    Raises
    ------
    ValueError
        If no force is missing, or none can be determined; or if another number of panels was given.
    """
    from reporting.pages import figures as style

    missing = result.missing
    if missing is None:
        raise ValueError(
            "This investigation has no missing force: nothing is missing, or the trials do not "
            "move. See `verdict.sentence` of the investigation."
        )
    courses = missing.courses[:MOST_TRIALS]
    panels = new_panels(len(courses), axes)
    for panel, course in zip(panels, courses, strict=True):
        low = course.force - 2.0 * course.deviation
        high = course.force + 2.0 * course.deviation
        style.band(panel, course.time, low, high, style.PAST)
        panel.plot(course.time, course.force, color=style.PAST, label="missing force")
        if course.law is not None:
            panel.plot(
                course.time, course.law, color=style.PREDICTION, linestyle="--", label=missing.law
            )
        panel.set_title(course.trial, loc="left")
        panel.set_ylabel(f"force at {missing.at_port.port} ({missing.at_port.unit})")
    panels[0].legend(frameon=False)
    panels[-1].set_xlabel("time (s)")
    return panels
