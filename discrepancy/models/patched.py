"""A model with a patch built in: a known addition, or an effect that was found."""

from discrepancy.campaign import Campaign, Quantity, Trial
from fe.patch import ModelPatch, Primitive

from .interface import Conditions, Model, ModelParameter, Response, Scales


class PatchedModel:
    """A `Model` that adds a patch to every question; sensors in it are not its business.

    Parameters
    ----------
    model : Model
        The model.
    patch : ModelPatch
        What is added.
    """

    def __init__(self, model: Model, patch: ModelPatch) -> None:
        self.inner, self.patch = model, patch

    @property
    def name(self) -> str:
        """Name for people."""
        return self.inner.name

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
        """Return the natural scales under a campaign, without the patch."""
        return self.inner.scales(campaign)

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
