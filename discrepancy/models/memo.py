"""A model that remembers its latest responses: sensors are tried by the dozen on one motion."""

from collections import OrderedDict

from discrepancy.campaign import Campaign, Quantity, Trial
from fe.patch import ModelPatch, Primitive

from .interface import Conditions, Model, ModelParameter, Response, Scales

KEPT = 400
"""Responses kept; the oldest goes first."""


class MemoModel:
    """A `Model` around another one that keeps responses to the same question.

    Parameters
    ----------
    model : Model
        The model that answers.
    """

    def __init__(self, model: Model) -> None:
        self.inner = model
        self._kept: OrderedDict[object, tuple[Trial, Response]] = OrderedDict()

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
        """Return the natural scales under a campaign."""
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
        """Return the response of a trial, kept or computed; as `Model.respond`."""
        key = (
            id(trial), outputs, patch.primitives, conditions.parameters.tobytes(),
            conditions.initial.tobytes(), conditions.clock, conditions.health.tobytes(), components,
            refinement,
        )  # fmt: skip
        kept = self._kept.get(key)
        if kept is not None:
            self._kept.move_to_end(key)
            return kept[1]
        found = self.inner.respond(
            trial, outputs, patch, conditions, components=components, refinement=refinement
        )
        self._kept[key] = (trial, found)  # the trial lives as long, so that its id stays its own
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found
