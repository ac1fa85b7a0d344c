"""The errors of `twin_master`, by cause."""

from collections.abc import Collection, Iterable, Mapping

from reporting.errors import StandsForOthersError


class TwinMasterError(StandsForOthersError):
    """Any failure of `twin_master` that has a cause which the user can act upon."""


class InvalidModelError(TwinMasterError, ValueError):
    """States, controls, sensors or rewards do not fit, or probabilities do not sum to one."""


class InvalidObservationError(TwinMasterError, ValueError):
    """An observation has the wrong shape or holds an infinite value."""


class PlanningError(TwinMasterError, RuntimeError):
    """There is no plan: no policy solves the problem, or the file of a policy is wrong."""


class ImpossibleObservation(TwinMasterError, RuntimeError):  # noqa: N818 - the name says it all
    """The observation has probability zero in every state that the belief still allows.

    Attributes
    ----------
    twin : str
        The name of the twin.
    step : int
        The step of the observation.
    worst_residuals : dict of str to float
        The residuals of the sensors that fit worst, in standard deviations; empty if unknown.
    """

    def __init__(
        self, twin: str, step: int, worst_residuals: Mapping[str, float] | None = None
    ) -> None:
        self.twin = twin
        self.step = step
        self.worst_residuals = dict(worst_residuals or {})
        sensors = ""
        if self.worst_residuals:
            residuals = [f"{name}: {value:+.3g} sd" for name, value in self.worst_residuals.items()]
            sensors = f" (worst residuals {', '.join(residuals)})"
        super().__init__(
            f"twin {twin!r}, step {step}: the observation has probability zero in every state that "
            f"the belief still allows{sensors}; check these sensors, or the transitions and the "
            "prior that rule out the true state"
        )

    def __reduce__(
        self,
    ) -> "tuple[type[ImpossibleObservation], tuple[str, int, dict[str, float]]]":
        # Workers of a fleet send the error to another process: it is made anew of its arguments.
        return type(self), (self.twin, self.step, self.worst_residuals)


class ScenarioError(TwinMasterError, ValueError):
    """A scenario file cannot be read, or violates the schema."""


class RunFolderError(TwinMasterError, RuntimeError):
    """A run folder cannot be used as asked, for example because it already exists."""


class NotResumableError(RunFolderError):
    """A run cannot be continued from the folder."""


class MissionInputError(TwinMasterError, ValueError):
    """An input of a mission, or the asset that flies, is missing or does not fit."""


class FleetError(TwinMasterError, RuntimeError):
    """A fleet cannot be flown, read or learnt from as asked."""


class ViewError(TwinMasterError, RuntimeError):
    """A flight cannot be shown on this machine."""


def check_names(
    owner: str,
    reference: str,
    rows: Iterable[tuple[str, Iterable[str], Collection[str]]],
    advice: str = "",
) -> None:
    """Check that all names are known to a binding, a model or a scenario.

    Parameters
    ----------
    owner : str
        The owner of the names, as the beginning of the sentence: "the scenario has the".
    reference : str
        The place where names are known: "the binding uav_wing".
    rows : iterable of (str, iterable of str, collection of str)
        For each kind of name: the noun of the kind in the singular, the names, and the known names.
    advice : str
        The advice to the user, which ends the message.

    Raises
    ------
    MissionInputError
        If a name is not known; the sentence lists the known ones.
    """
    for kind, names, known_names in rows:
        unknown_names = sorted({*names} - {*known_names})
        if unknown_names:
            what_to_do = f": {advice}" if advice else ""
            raise MissionInputError(
                f"{owner} {kind} {', '.join(unknown_names)}, which {reference} does not know; it "
                f"knows {', '.join(known_names) or 'none'}{what_to_do}."
            )
