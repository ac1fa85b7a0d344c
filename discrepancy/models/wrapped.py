"""What models around another model have in common: everything but the response is that of the inner one."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Campaign, Quantity, Trial
from fe.runtime.patch import ModelPatch, PortForce, Primitive

from .interface import Model, ModelParameter, Scales

FloatArray = NDArray[np.float64]


class WrappedModel:
    """A `Model` without its response, which is for the derived class to give.

    Parameters
    ----------
    model : Model
        The inner model.
    """

    def __init__(self, model: Model) -> None:
        self.inner = model

    @property
    def name(self) -> str:
        """Name for people."""
        return self.inner.name

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
