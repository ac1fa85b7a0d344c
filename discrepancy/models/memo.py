"""A model that remembers its latest responses: sensors are tried by the dozen on one motion."""

from collections import OrderedDict

from discrepancy.campaign.records import Quantity, Trial
from fe.runtime.patch import ModelPatch

from .interface import Conditions, Model, Response
from .wrapped import WrappedModel

KEPT = 400
"""Responses kept; the oldest goes first."""


class MemoModel(WrappedModel):
    """A `Model` around another one that keeps responses to the same question.

    Parameters
    ----------
    model : Model
        The model that answers.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._kept: OrderedDict[object, tuple[Trial, Response]] = OrderedDict()

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
            id(trial), outputs, patch.primitives, conditions.key, components, refinement,
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
