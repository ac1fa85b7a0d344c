"""What a missing force would do to the readings of a lumped model."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.models.interface import Conditions, Model, ModelParameter
from discrepancy.models.lumped_file import LumpedDescription
from discrepancy.models.lumped_rig import LumpedRig
from discrepancy.models.patch_parts import sorted_lumped
from discrepancy.models.ported import NO_PATCH, OutputRows, PortedSystem, modal_system
from discrepancy.models.rig import Rig
from discrepancy.models.rig_records import Shown
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.motion import NO_LAWS
from fe.runtime.patch import ModelPatch, Primitive

FloatArray = NDArray[np.float64]


class PortedLumped(ABC):
    """The part of a lumped model that tells how its ports move; what it needs of the model is below."""

    description: LumpedDescription

    @property
    @abstractmethod
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""

    @abstractmethod
    def _system(
        self, parameters: FloatArray, structure: tuple[Primitive, ...], temperature: float
    ) -> SecondOrderSystem: ...

    @abstractmethod
    def _rig(
        self, parameters: FloatArray, structure: tuple[Primitive, ...], temperature: float
    ) -> LumpedRig: ...

    @abstractmethod
    def _input_row(self, place: str | tuple[float, float]) -> FloatArray: ...

    @abstractmethod
    def _factors(self, parameters: FloatArray) -> dict[str, float]: ...

    @property
    def _mean(self) -> FloatArray:
        return np.array([item.mean for item in self.parameters])

    @abstractmethod
    def _moved_place(
        self, lumped: LumpedRig, trial: Trial, along_span: float, along_chord: float
    ) -> FloatArray | None: ...

    def ported(
        self,
        trial: Trial,
        outputs: tuple[tuple[str, Quantity], ...],
        parameters: FloatArray,
        patch: ModelPatch = NO_PATCH,
    ) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        warm, structure = float(trial.temperature[0]), sorted_lumped(patch, cast(Model, self)).structure
        if trial.kind is TrialKind.RINGDOWN:
            vectors = {item.name: np.array(item.vector or ()) for item in self.description.output}
            rows = np.array([vectors[output] for output, _ in outputs]).reshape(len(outputs), -1)
            base = self._system(self._mean, structure, warm)
            quantities = [quantity for _, quantity in outputs]
            return self._system(parameters, structure, warm).ported(rows, quantities, base.shapes)
        lumped = self._rig(parameters, structure, warm)
        drives = lumped.acting(trial, Conditions(parameters), 0.0, 0.0, None)[2]
        base_rig = self._rig(self._mean, structure, warm).rig(drives)
        return rig_system(lumped.rig(drives), lumped.shown(outputs, drives), base_rig.free_shapes)

    def port_motion(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        warm = float(trial.temperature[0])
        structure, _, (gain, tare, *moved), loads = sorted_lumped(
            patch.in_trial(trial.name), cast(Model, self)
        )
        if trial.kind is TrialKind.RINGDOWN and trial.release is not None:
            system = self._system(conditions.parameters, structure, warm)
            motion = system.ringdown(
                self._input_row(trial.load_place), trial.release, conditions.initial, trial.time, NO_LAWS,
                clock=conditions.clock,
            )  # fmt: skip
            shapes = np.array(list(system.ports.values())).reshape(-1, len(system.mass)) @ system.shapes
            return motion.q @ shapes.T, motion.velocity @ shapes.T
        lumped = self._rig(conditions.parameters, structure, warm)
        place = self._moved_place(lumped, trial, *moved)
        return lumped.port_motion(trial, conditions, (gain, tare, place, loads))

    def apart(self) -> "tuple[PortedLumped, ModelPatch]":
        """Return the linear model, and the laws that it has beside that, at the prior means."""
        if not self.description.law:
            return self, ModelPatch()
        linear = self.description.model_copy(update={"law": []})
        return type(self)(linear), self.description.own_laws(self._factors(self._mean))  # type: ignore[call-arg]


def rig_system(rig: Rig, shown: Sequence[Shown], shapes: FloatArray) -> PortedSystem:
    """Return the system by which outputs see missing forces, in shapes (n + m, M) of what is free."""
    n, count = rig.displacements, shapes.shape[1]
    by_order = np.zeros((4, len(shown), count))
    force = np.zeros((len(rig.ports), len(shown)))
    acts = np.array(list(rig.acting_rows.values())).reshape(len(rig.ports), len(rig.mass))
    for number, item in enumerate(shown):
        if item.reaction is not None:
            along = rig.lift[:, item.reaction]
            for order, matrix in enumerate((rig.stiffness, rig.damping, rig.mass)):
                by_order[order, number] = along @ matrix @ shapes
            force[:, number] = acts @ along
        elif item.effort is not None:
            by_order[0, number] = item.effort.by_displacement @ shapes[:n]
            by_order[1, number] = item.effort.by_speed @ shapes[:n] + item.effort.by_state @ shapes[n:]
        else:
            by_order[item.order, number] += item.row[:n] @ shapes[:n]
            by_order[item.further + 1, number] += item.row[n:] @ shapes[n:]
    ports = {name: (row @ shapes, rig.acting_rows[name] @ shapes) for name, row in rig.ports.items()}
    matrices = [shapes.T @ matrix @ shapes for matrix in (rig.mass, rig.damping, rig.stiffness)]
    shown_rows = OutputRows(by_order[0], by_order[1], by_order[2], force)
    return modal_system((matrices[0], matrices[1], matrices[2]), ports, shown_rows, rig.moving)
