"""States on which the matrices of a system depend, and records of a trial and its loads."""

from typing import NamedTuple

from discrepancy.campaign.records import Trial
from discrepancy.system.excitation import Excitation, Load
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.response import Conditions
from discrepancy.system.time_history import RecordedHistory
from fe.runtime.patch import ModelPatch
from fe.runtime.state import Losses


class SystemState(NamedTuple):
    """All values on which the matrices of a system depend.

    Attributes
    ----------
    parameters : tuple of float
        Values (P,) of the model's parameters.
    losses : tuple of float
        The stiffness losses of the damage regions.
    structure : ModelPatch
        The primitives of a patch that change the structure.
    temperature_rise : float
        The temperature above the reference [K], zero if the structure does not depend on it.
    drives : tuple of str
        Inputs whose motion is prescribed.
    controlled : bool
        Whether the controllers of the rig act.
    """

    parameters: tuple[float, ...]
    losses: Losses = ()
    structure: ModelPatch = NO_PATCH
    temperature_rise: float = 0.0
    drives: tuple[str, ...] = ()
    controlled: bool = True


class PatchedTrial(NamedTuple):
    """A trial under a patch and in conditions, and the state of the matrices at its start."""

    trial: Trial
    conditions: Conditions
    patch: ModelPatch
    state: SystemState


class LoadsAndMotions(NamedTuple):
    """Loads, and prescribed motions by the names of their inputs."""

    loads: list[Load]
    prescribed_motions: dict[str, RecordedHistory]


class ExcitedSystem(NamedTuple):
    """The linear system of a dynamic trial, and its excitation."""

    system: LinearSystem
    excitation: Excitation


class RowsAtRest(NamedTuple):
    """Consecutive rows of a trial at rest, in which the structure is the same."""

    rows: slice
    state: SystemState
