"""Models around another model: one with a patch built in, and one that remembers its latest responses."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Trial
from discrepancy.errors import ModelError
from discrepancy.models.interface import (
    NO_PATCH,
    Conditions,
    Model,
    ModelParameter,
    Outputs,
    PortedSystem,
    Response,
    Scales,
)
from discrepancy.models.memory import Memory
from fe.runtime.patch import SENSORS, ModelPatch, PortForce, Primitive

KEPT = 400
"""Responses kept; the oldest goes first."""


class WrappedModel:
    """A `Model` of which everything is that of an inner one, but what the derived class gives.

    Parameters
    ----------
    model : Model
        The inner model.
    """

    def __init__(self, model: Model) -> None:
        self.inner, self.name = model, model.name

    @property
    def sensors(self) -> ModelPatch:
        """Sensor primitives that are built in; see `built_in_sensors`."""
        return built_in_sensors(self.inner)

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""
        return self.inner.parameters

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if the model has no such output."""
        return self.inner.output_quantity(output)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        return self.inner.supports(primitive)

    def ports(self) -> tuple[str, ...]:
        """Names of the ports where internal forces can act."""
        return self.inner.ports()

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m], None if the model has no length."""
        return self.inner.stations()

    def initial_sizes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return natural sizes (L,) of the state at the begin of a trial; empty: it cannot be unknown."""
        return initial_sizes(self.inner, campaign, trial)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""
        return self.inner.scales(campaign)


class MemoModel(WrappedModel):
    """A `Model` that keeps responses to the same question: sensors are tried by the dozen on one motion."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._kept = Memory(KEPT)

    def respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial, kept or computed; as `Model.respond`."""

        def answer() -> tuple[Trial, Response]:  # the trial lives as long, so that its id stays its own
            return trial, self.inner.respond(trial, outputs, patch, conditions)

        key = (id(trial), outputs, patch.primitives, conditions.key)
        return self._kept.get(key, answer)[1]


class PatchedModel(WrappedModel):
    """A `Model` that adds a patch to every question: a known addition, or an effect that was found.

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

    def respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial with both patches; as `Model.respond`."""
        return self.inner.respond(trial, outputs, self.patch + patch, conditions)

    # ------------------------------------------------------------ ports, where the inner model tells of them

    def ported(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> PortedSystem:
        """Return the system by which outputs see missing forces, see `PortedSystem`.

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


def innermost(model: Model) -> Model:
    """Return the model that others are wrapped around."""
    while isinstance(model, WrappedModel):
        model = model.inner
    return model


def initial_sizes(model: Model, campaign: Campaign, trial: Trial) -> FloatArray:
    """Return natural sizes (L,) of a model's state at the begin of a trial; empty: it is never unknown."""
    sizes = getattr(model, "initial_sizes", None)
    return np.zeros(0) if sizes is None else np.asarray(sizes(campaign, trial), dtype=np.float64)


def oscillates(model: Model) -> bool:
    """Whether a model has a mode that vibrates; models that do not say it have one."""
    return bool(getattr(innermost(model), "oscillates", True))


def follows_windows(model: Model) -> bool:
    """Whether a model can follow laws that act in windows only; models that do not say it cannot."""
    return bool(getattr(innermost(model), "follows_windows", False))


def has_law(model: Model) -> bool:
    """Whether a model has a law of a port of its own, such as one that was found."""
    while isinstance(model, WrappedModel):
        if len(getattr(model, "patch", ModelPatch()).of(PortForce)):
            return True
        model = model.inner
    return bool(getattr(getattr(model, "description", None), "law", ()))


def built_in_sensors(model: Model) -> ModelPatch:
    """Return the sensor primitives that a model has built in, for channels or for outputs of those names.

    They are no part of its responses: `discrepancy.models.sensing.observe` applies them, since what sensors
    show of a response depends on all of them together.
    """
    return model.sensors if isinstance(model, WrappedModel) else ModelPatch()


def shows_ports(model: Model) -> bool:
    """Whether a model tells how its ports move (`ported` and `port_motion`)."""
    return hasattr(innermost(model), "ported")


def apart(model: Model) -> tuple[Model, ModelPatch]:
    """Return a model without laws at its ports, and these at the prior means."""
    found: tuple[Model, ModelPatch] = model.apart() if hasattr(model, "apart") else (model, NO_PATCH)
    return found
