"""A model with a patch built in: a known addition, or an effect that was found."""

from discrepancy.campaign.records import Quantity, Trial
from fe.runtime.patch import SENSORS, ModelPatch

from .interface import Conditions, Model, Response
from .wrapped import WrappedModel


class PatchedModel(WrappedModel):
    """A `Model` that adds a patch to every question.

    What the patch makes of the structure, its forces and loads is in the responses; sensors in it are applied
    where those of a question are, in `discrepancy.models.sensing.observe`, and come first.

    Parameters
    ----------
    model : Model
        The model.
    patch : ModelPatch
        What is added; its sensors name outputs of the model as their channels.
    """

    def __init__(self, model: Model, patch: ModelPatch) -> None:
        super().__init__(model)
        self.patch = patch

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
