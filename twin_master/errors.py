"""What can go wrong in the twin, by cause, and why it refuses what it is given: a file of sentences."""

from collections.abc import Collection, Iterable, Mapping

from reporting.errors import StandsForOthersError
from reporting.sentences import Sentences

said = Sentences(__file__).said


class TwinMasterError(StandsForOthersError):
    """Any failure of `twin_master` that has a cause which the user can act upon."""


class InvalidModelError(TwinMasterError, ValueError):
    """State space, controls, sensors or rewards do not fit together, or a distribution is none."""


class InvalidObservationError(TwinMasterError, ValueError):
    """An observation has the wrong shape or holds an infinite value."""


class PlanningError(TwinMasterError, RuntimeError):
    """Value iteration was given no solvable problem, or did not converge."""


class ImpossibleObservation(TwinMasterError, RuntimeError):  # noqa: N818 - the name says it all
    """The observation has probability zero in every state that the belief still allows.

    Attributes
    ----------
    twin : str
        Name of the twin.
    step : int
        Step of the observation.
    worst_residuals : dict of str to float
        The sensors that fit worst, with their standardised residuals; empty if unknown.
    """

    def __init__(self, twin: str, step: int, worst_residuals: Mapping[str, float] | None = None) -> None:
        self.twin = twin
        self.step = step
        self.worst_residuals = dict(worst_residuals or {})
        worst = ", ".join(f"{name}: {value:+.3g} sd" for name, value in self.worst_residuals.items())
        super().__init__(
            f"twin {twin!r}, step {step}: the observation has probability zero in every state that the "
            f"belief still allows{f' (worst residuals {worst})' if worst else ''}; "
            "check these sensors, or the transitions and the prior that rule out the true state"
        )

    def __reduce__(self) -> "tuple[type[ImpossibleObservation], tuple[str, int, dict[str, float]]]":
        return type(self), (self.twin, self.step, self.worst_residuals)


class ScenarioError(TwinMasterError, ValueError):
    """A scenario file cannot be read or does not keep to the schema."""


class RunFolderError(TwinMasterError, RuntimeError):
    """A run folder cannot be used as asked, such as one that exists already."""


class NotResumableError(RunFolderError):
    """A run cannot be continued from the folder."""


class MissionInputError(TwinMasterError, ValueError):
    """Something that a mission was told to use, or what flies, is not there or does not fit."""


class FleetError(TwinMasterError, RuntimeError):
    """A fleet cannot be flown, read or learnt from as asked."""


class ViewError(TwinMasterError, RuntimeError):
    """A flight cannot be shown on this machine."""


def check_names(
    whose: str,
    where: str,
    rows: Iterable[tuple[str, Iterable[str], Collection[str]]],
    advice: str = "",
) -> None:
    """Check names of several sorts against those that are known.

    Parameters
    ----------
    whose : str
        What has the names: "the scenario has the".
    where : str
        What knows names: "the binding uav_wing".
    rows : iterable of (str, names, known names)
        What the names are of, in the singular.
    advice : str
        What to do, behind a colon.
    """
    for what, names, known in rows:
        unknown = sorted({*names} - {*known})
        if unknown:
            raise MissionInputError(
                f"{whose} {what} {', '.join(unknown)}, which {where} does not know; it knows "
                f"{', '.join(known) or 'none'}{f': {advice}' if advice else ''}."
            )
