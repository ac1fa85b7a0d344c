"""A model with a patch built in: a known addition, or an effect that was found."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Quantity, Trial
from discrepancy.errors import ModelError
from fe.runtime.patch import SENSORS, ModelPatch, PortForce

from .interface import Conditions, Model, ModelParameter, Response
from .ported import NO_PATCH, PortedSystem, apart
from .wrapped import WrappedModel

FloatArray = NDArray[np.float64]


class PatchedModel(WrappedModel):
    """A `Model` that adds a patch to every question.

    What the patch makes of the structure, its forces and loads is in the responses; sensors in it are applied
    where those of a question are, in `discrepancy.models.sensing.observe`, and come first.

    Parameters
    ----------
    model : Model
        The model.
    patch : ModelPatch
        What is added; its sensors name channels of a campaign, or outputs of the model.
    calibrated : mapping of str to (float, float)
        Mean and standard deviation of calibrated parameters, where they are not those of the model.
    """

    def __init__(
        self,
        model: Model,
        patch: ModelPatch,
        calibrated: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        super().__init__(model)
        self.patch = patch
        self._parameters = tuple(
            replace(item, mean=mean, deviation=deviation)
            for item in model.parameters
            for mean, deviation in [calibrated.get(item.name, (item.mean, item.deviation))]
        )

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""
        return self._parameters

    @property
    def sensors(self) -> ModelPatch:
        """Sensor primitives of the inner model and of the patch."""
        return super().sensors + self.patch.of(*SENSORS)

    def respond(
        self,
        trial: Trial,
        outputs: tuple[tuple[str, Quantity], ...],
        patch: ModelPatch,
        conditions: Conditions,
        *,
        components: bool = False,
        refinement: int = 1,
    ) -> Response:
        """Return the response of a trial with both patches; as `Model.respond`."""
        return self.inner.respond(
            trial, outputs, self.patch + patch, conditions, components=components, refinement=refinement
        )

    # ------------------------------------------------------------ ports, where the inner model tells of them

    def ported(
        self,
        trial: Trial,
        outputs: tuple[tuple[str, Quantity], ...],
        parameters: FloatArray,
        patch: ModelPatch = NO_PATCH,
    ) -> PortedSystem:
        """Return the system by which outputs see missing forces, see `discrepancy.models.ported`.

        Raises
        ------
        ModelError
            If sensors are built in: what they make of a missing force is not known here.
        """
        if len(self.sensors):
            raise ModelError(
                f"{self.name} has sensors built in, through which no missing force is seen; leave them out."
            )
        inner: Any = self.inner
        found: PortedSystem = inner.ported(trial, outputs, parameters, self.patch + patch)
        return found

    def port_motion(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        inner: Any = self.inner
        found: tuple[FloatArray, FloatArray] = inner.port_motion(trial, conditions, self.patch + patch)
        return found

    def at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at the ports of `ported`."""
        return self.inner.at_ports(forces) if hasattr(self.inner, "at_ports") else forces

    def apart(self) -> tuple[Model, ModelPatch]:
        """Return the model without laws at ports, and these."""
        inner, laws = apart(self.inner)
        forces = ModelPatch(tuple(item for item in self.patch if isinstance(item, PortForce)))
        rest = ModelPatch(tuple(item for item in self.patch if not isinstance(item, PortForce)))
        calibrated = {item.name: (item.mean, item.deviation) for item in self.parameters}
        return PatchedModel(inner, rest, calibrated), laws + forces
