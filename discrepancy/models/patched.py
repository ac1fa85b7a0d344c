"""A model with a patch built in: a known addition, or an effect that was found."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from discrepancy.campaign.records import Quantity, Trial
from fe.runtime.patch import SENSORS, ModelPatch

from .interface import Conditions, Model, ModelParameter, Response
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
