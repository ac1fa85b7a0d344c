"""What models around another model have in common: everything but the response is that of the inner one."""

from discrepancy.campaign.records import Campaign, Quantity
from fe.runtime.patch import ModelPatch, Primitive

from .interface import Model, ModelParameter, Scales


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
        """Sensor primitives that are built in, their channels named by outputs; see `built_in_sensors`."""
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

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""
        return self.inner.scales(campaign)


def built_in_sensors(model: Model) -> ModelPatch:
    """Return the sensor primitives that a model has built in, their channels named by its outputs.

    They are no part of its responses: `discrepancy.models.sensing.observe` applies them, since what sensors
    show of a response depends on all of them together.
    """
    return model.sensors if isinstance(model, WrappedModel) else ModelPatch()
