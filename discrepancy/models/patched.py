"""A model with a patch built in: a known addition, or an effect that was found."""

from discrepancy.campaign import Quantity, Trial
from fe.patch import ModelPatch

from .interface import Conditions, Model, Response
from .wrapped import WrappedModel


class PatchedModel(WrappedModel):
    """A `Model` that adds a patch to every question; sensors in it are not its business.

    Parameters
    ----------
    model : Model
        The model.
    patch : ModelPatch
        What is added.
    """

    def __init__(self, model: Model, patch: ModelPatch) -> None:
        super().__init__(model)
        self.patch = patch

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
