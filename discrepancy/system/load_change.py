"""Changes of recorded loads by a patch, and the load place and release that a trial names."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.system.response import Place
from fe.runtime.patch import LoadGain, LoadPlace, Primitive

DEFAULT_PLACE = "tip_load"
"""Load place of a campaign that names none; a model with one input takes that one."""


class LoadChange(NamedTuple):
    """How the acting load differs from the recorded one.

    Attributes
    ----------
    gain, tare : float
        The acting force is (1 + gain) times the recorded one, plus the tare [N] at samples whose
        recorded force is not zero.
    along_span, along_chord : float
        How far the acting force is moved [m].
    """

    gain: float = 0.0
    tare: float = 0.0
    along_span: float = 0.0
    along_chord: float = 0.0

    @classmethod
    def from_patch(cls, patch: Iterable[Primitive]) -> "LoadChange":
        """Return the change of loads by the primitives `LoadGain` and `LoadPlace` of a patch.

        The primitives are applied in their order: a later gain also acts on earlier tares.
        """
        change = cls()
        for primitive in patch:
            if isinstance(primitive, LoadGain):
                change = change._replace(
                    gain=(1.0 + change.gain) * (1.0 + primitive.gain) - 1.0,
                    tare=change.tare * (1.0 + primitive.gain) + primitive.tare,
                )
            elif isinstance(primitive, LoadPlace):
                change = change._replace(
                    along_span=change.along_span + primitive.along_span,
                    along_chord=change.along_chord + primitive.along_chord,
                )
        return change

    def apply_to(self, values: FloatArray, recorded_values: FloatArray) -> FloatArray:
        """Return the acting load (N,) [N or N m].

        Parameters
        ----------
        values : (N,) array
            The recorded values, plus a constant offset of the recorder if one is fitted.
        recorded_values : (N,) array
            The recorded values themselves; a sample that is zero gets no tare.
        """
        return np.asarray((1.0 + self.gain) * values + self.tare * (recorded_values != 0.0))


def choose_load_place(
    places: Sequence[str], place: Place, model_name: str, trial_text: str = "a trial"
) -> str:
    """Return the load place of a trial; if the trial names none, the only one of the model.

    Parameters
    ----------
    places : sequence of str
        The load places of the model.
    place : str or (float, float)
        The load place that the trial names; `DEFAULT_PLACE` if it names none.
    model_name, trial_text : str
        Model and trial as they are called in a sentence.

    Raises
    ------
    ModelError
        If the model has no such place, or the trial names none of several.
    """
    if place == DEFAULT_PLACE and place not in places and len(places) == 1:
        return places[0]
    if isinstance(place, str) and place in places:
        return place
    problem = "no load_place is given" if place == DEFAULT_PLACE else f"the load place is {place!r}"
    forces = f"forces at {', '.join(places)}: name one of these" if places else "no force"
    raise ModelError(f"In {trial_text} {problem}, and {model_name} takes {forces}.")


def require_release(trial: Trial) -> Release:
    """Return how a ring-down began; raises `ModelError` if the trial does not say it."""
    if trial.release is None:
        raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
    return trial.release
