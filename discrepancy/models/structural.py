"""A wing or a structure as a model: under one force at a place, or lift, with natural scales of its own."""

from abc import abstractmethod
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.models.acting import Acting, Course
from discrepancy.models.interface import (
    NO_PATCH,
    Place,
    Scales,
)
from discrepancy.models.natural_scales import natural_scales
from discrepancy.models.questions import LoadChange, check_no_inputs, check_plain, release_of
from discrepancy.models.second_order import SecondOrderSystem
from discrepancy.models.system_model import Case, State, SystemModel
from fe.runtime.patch import LOADS, ModelPatch, PointMass


class StructuralModel(SystemModel):
    """A structure that springs hold, under a force or lift.

    Attributes
    ----------
    reference : str
        Place whose stiffness and modal mass are the natural ones.
    """

    reference: str

    # ------------------------------------------------------------ what each structure says

    @abstractmethod
    def force_row(self, place: Place, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the load (n,) of 1 N at a place, as load primitives have it."""

    @abstractmethod
    def lift(self, trial: Trial, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the loads (2, n) of a load factor and of its square in a flight, as load primitives do."""

    @abstractmethod
    def moving(self, state: State, place: Place, ports: tuple[str, ...] = ()) -> SecondOrderSystem:
        """Return the structure as it moves when let go, or pushed, at a place, with forces at `ports`."""

    # ------------------------------------------------------------ what it is

    def check(self, trial: Trial) -> None:
        """Refuse a trial that is driven, begins otherwise than settled, or holds other inputs at rest."""
        check_plain(trial, self.name)
        check_no_inputs(trial, self.name)

    def base(self, state: State, *, closed: bool = True) -> SecondOrderSystem:
        """Return the structure as it moves from the natural place."""
        return self.moving(state, self.reference)

    def reference_load(self, parameters: FloatArray, campaign: Campaign) -> FloatArray:
        """Return the load (n,) at whose place stiffness and modal mass are the natural ones."""
        return self.force_row(self.reference, parameters, NO_PATCH)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, by the structure without a patch."""
        return natural_scales(self, campaign)

    # ------------------------------------------------------------ loads

    def loads(self, case: Case) -> tuple[FloatArray, FloatArray]:
        """Return the loads (k, n) of a trial at rest, and how much of each (L, k) acts in each row."""
        trial, _, patch, state = case
        if trial.kind is TrialKind.FLIGHT:
            # where a mass has weight; other zeros are read with it in place
            units = self.lift(trial, state.parameters, patch.of(*LOADS, PointMass))
            return units, np.column_stack((trial.load_factor, trial.load_factor**2))
        row = self.force_row(trial.load_place, state.parameters, patch.of(*LOADS))
        return row[None], LoadChange.of(patch).changed(trial.force, trial.force)[:, None]

    def acting(self, case: Case) -> Acting:
        """Return what acts in a dynamic trial."""
        trial, conditions, patch, state = case
        loads = patch.of(*LOADS) if trial.kind is TrialKind.FORCED else NO_PATCH
        row = self.force_row(trial.load_place, state.parameters, loads)
        acting = Acting(trial.time, np.zeros(len(row)), clock=conditions.clock)
        if trial.kind is TrialKind.RINGDOWN:
            return replace(acting, release=(row, release_of(trial)), initial=conditions.initial)
        force = LoadChange.of(loads).changed(trial.force, trial.force)
        return replace(acting, loads=[(row, Course.of(trial.time, force, trial.hold))])

    def system(self, case: Case, acting: Acting, ports: tuple[str, ...]) -> SecondOrderSystem:
        """Return what moves in a dynamic trial under forces at ports."""
        return self.moving(case.state, case.trial.load_place, ports)
