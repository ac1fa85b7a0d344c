"""What is asked of a model, checked, and a patch sorted by what its primitives change."""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, FloatArray, Release, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Model, Outputs, Place
from fe.runtime.errors import InvalidPatchError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    PortForce,
    Primitive,
)
from fe.runtime.state import Losses
from reporting.words import counted

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


def check_carried(patch: ModelPatch, model: Model, what: str) -> None:
    """Refuse a primitive that a model, `what`, cannot carry; those of sensors are not asked for."""
    for item in patch:
        at_port = isinstance(item, PortForce) and item.port in model.ports()
        if not (isinstance(item, SENSORS) or model.supports(type(item)) or at_port):
            port = " (it has no port)" if isinstance(item, INTERNAL_FORCES) and not model.ports() else ""
            raise ModelError(f"{what} cannot carry the primitive {item.kind!r}{port}.")


def laws_at(forces: ModelPatch, ports: Collection[str], *, in_windows: bool = True) -> Laws:
    """Return the laws of internal forces at ports; raises `ModelError` where one cannot be."""
    if not len(forces):
        return NO_LAWS
    try:
        return laws_of(forces, ports, in_windows=in_windows)
    except InvalidPatchError as cause:
        raise ModelError(str(cause)) from cause


def prior_mean(campaign: Campaign, parameters: Sequence[ParameterPrior]) -> FloatArray:
    """Return the means (P,) of parameters, those of the campaign where it says them."""
    return np.array([campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in parameters])


def check_parameters(what: str, parameters: Sequence[ParameterPrior], values: FloatArray) -> None:
    """Refuse values of another number than a model, `what`, has parameters."""
    if values.shape != (len(parameters),):
        raise ModelError(f"{what} has {counted(len(parameters), 'parameter')}, but {values.size} came.")


def check_outputs(what: str, model: Model, outputs: Outputs, known: Iterable[str]) -> None:
    """Refuse outputs that a model, `what`, does not have beside those `known`, or no channel can measure."""
    for output, quantity in outputs:
        own = model.output_quantity(output)
        if own is None:
            raise ModelError(f"{what} has no output {output!r}; it has {', '.join(known)}.")
        if not quantity.shows(own):
            raise ModelError(
                f"{what}: the output {output!r} is a {own.value}, but a channel measures {quantity.value}."
            )


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


def check_no_inputs(trial: Trial, what: str) -> None:
    """Refuse a static trial under other inputs than a force, for a model that has none."""
    if trial.kind is TrialKind.STATIC and trial.inputs:
        names = ", ".join(repr(item.name) for item in trial.inputs)
        raise ModelError(
            f"The trial {trial.name!r} is static under the inputs {names}, which {what} does not have at "
            'rest: describe the asset as an FMU model with [[input]], or record the trial as "driven".'
        )


def losses_of(trial: Trial, health: FloatArray, regions: Sequence[str], what: str) -> list[Losses]:
    """Return the losses of a model's regions in each row from those (N, K) that a trial names.

    Raises
    ------
    ModelError
        If one is of a region that the model, `what`, does not have.
    """
    losses = np.zeros((len(health), len(regions)))
    for name, column in zip(trial.regions, health.T, strict=False):
        if name in regions:
            losses[:, regions.index(name)] = column
        elif np.any(column):
            raise ModelError(
                f"The trial {trial.name!r} gives a loss of the damage region {name!r}, but {what} has "
                f"{', '.join(regions) or 'none'}."
            )
    return [tuple(row) for row in losses.tolist()]


def check_plain(trial: Trial, what: str) -> None:
    """Refuse a driven trial, and a forced one that is not settled, for a model that cannot follow them."""
    if trial.kind is TrialKind.DRIVEN or trial.begins is not Start.SETTLED:
        came = "is driven" if trial.kind is TrialKind.DRIVEN else f"begins {trial.begins.value}"
        raise ModelError(
            f"The trial {trial.name!r} {came}, which {what} cannot follow: describe the rig as a lumped "
            "model, or record it forced from rest."
        )
