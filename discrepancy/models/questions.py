"""What a patch makes of loads and laws, and where and how a trial begins."""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Release, Trial
from discrepancy.errors import ModelError
from discrepancy.models.interface import Place
from fe.runtime.errors import InvalidPatchError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import LoadGain, LoadPlace, ModelPatch, Primitive

DEFAULT_PLACE = "tip_load"
"""What a campaign says when it does not say where the force acts; a model with one input takes that one."""


class LoadChange(NamedTuple):
    """What of recorded loads changes.

    Attributes
    ----------
    gain, tare : float
        The acting force is (1 + gain) times the recorded one, plus the tare [N] where it is not zero.
    along_span, along_chord : float
        How far the acting force is moved [m].
    """

    gain: float = 0.0
    tare: float = 0.0
    along_span: float = 0.0
    along_chord: float = 0.0

    @classmethod
    def of(cls, patch: Iterable[Primitive]) -> "LoadChange":
        """Return the change by gains and places, one upon the other."""
        gain, tare, span, chord = cls()
        for item in patch:
            if isinstance(item, LoadGain):
                gain, tare = (1.0 + gain) * (1.0 + item.gain) - 1.0, tare * (1.0 + item.gain) + item.tare
            elif isinstance(item, LoadPlace):
                span, chord = span + item.along_span, chord + item.along_chord
        return cls(gain, tare, span, chord)

    def changed(self, values: FloatArray, recorded: FloatArray) -> FloatArray:
        """Return what acts (N,) of recorded values [N, or N m], the values themselves or with a constant."""
        if not (self.gain or self.tare):
            return values
        return np.asarray((1.0 + self.gain) * values + self.tare * (recorded != 0.0))


def laws_at(forces: ModelPatch, ports: Collection[str], *, in_windows: bool = True) -> Laws:
    """Return the laws of internal forces at ports; raises `ModelError` where one cannot be."""
    if not len(forces):
        return NO_LAWS
    try:
        return laws_of(forces, ports, in_windows=in_windows)
    except InvalidPatchError as cause:
        raise ModelError(str(cause)) from cause


def place_among(places: Sequence[str], place: Place, what: str, where: str = "a trial") -> str:
    """Return the load place of a model, `what`, that a trial means: the only one where it says none.

    Raises
    ------
    ModelError
        If there is no such place, or none is named of several.
    """
    if place == DEFAULT_PLACE and place not in places and len(places) == 1:
        return places[0]
    if not isinstance(place, str) or place not in places:
        said = "no load_place is said" if place == DEFAULT_PLACE else f"the load place is {place!r}"
        known = f"forces at {', '.join(places)}: name one of these" if places else "no force"
        raise ModelError(f"In {where} {said}, and {what} takes {known}.")
    return place


def release_of(trial: Trial) -> Release:
    """Return how a ring-down began; raises `ModelError` where it does not say it."""
    if trial.release is None:
        raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
    return trial.release
