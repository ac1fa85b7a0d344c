"""What an effect needs of a campaign and a model, by the words of its entry: why it cannot be tested."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.places import (
    DYNAMIC,
    PLACES,
    Asked,
    Kinds,
    channels,
    force_ports,
    strain_channels,
    trials,
    turning_ports,
)
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, Response
from fe.runtime.patch import SENSORS, ModelPatch, PortForce, Primitive

KIND_NAMES = {kind: kind.value for kind in TrialKind} | {TrialKind.RINGDOWN: "ring-down"}
"""How a kind of trial is called in a sentence."""
NO_PORT = "has no port where an internal force can act"
"""Reason against effects that are forces within a structure or between it and the ground."""
TEMPERATURE_STEP = 0.1
"""Least range of temperatures [K] in a campaign from which an effect of temperature can show."""


@dataclass(frozen=True)
class Needing:
    """An effect that asks whether it can be tested.

    Attributes
    ----------
    identifier : str
        Of the effect.
    kinds : frozenset of TrialKind
        Trials that it changes.
    primitives : tuple of type
        What it is made of.
    moments : frozenset of str
        Events of which a trial must have all.
    places : str
        Word for its places, empty where they are given.
    """

    identifier: str
    kinds: Kinds
    primitives: tuple[type[Primitive], ...]
    moments: frozenset[str]
    places: str


def first_reason(needs: tuple[str, ...], needing: Needing, setting: Setting) -> str | None:
    """Return why an effect cannot be tested: the first of its needs that is not met; None if all are."""
    return next((reason for need in needs if (reason := NEEDS[need](needing, setting))), None)


def _trial(needing: Needing, setting: Setting) -> str | None:
    if trials(setting, needing.kinds):
        return None
    names = [name for kind, name in KIND_NAMES.items() if kind in needing.kinds]
    return f"The campaign has no {' or '.join(names)} trial to fit."


def _event(needing: Needing, setting: Setting) -> str | None:
    fitted = [setting.campaign.event_times(trial.name) for trial in setting.campaign.fitted]
    if not needing.moments or any(needing.moments <= times.keys() for times in fitted):
        return None
    there = sorted({name for times in fitted for name in times})
    return (
        f"No trial to fit has {' and '.join(sorted(needing.moments))} as [[event]]; those that are fitted "
        f"have {', '.join(there) or 'none'}."
    )


def _law(needing: Needing, setting: Setting) -> str | None:
    for primitive in needing.primitives:
        if primitive not in SENSORS and not setting.model.supports(primitive):
            if issubclass(primitive, PortForce) and not setting.model.ports():
                return f"The model {setting.model.name!r} {NO_PORT}."
            return f"The model {setting.model.name!r} cannot carry the primitive {primitive.kind!r}."
    return None


def _place(needing: Needing, setting: Setting) -> str | None:
    if not needing.places:
        return None
    find, reason = PLACES[needing.places]
    if find(Asked(setting, needing.kinds)):
        return None
    return reason or (f"Neither model nor campaign has a place where {needing.identifier!r} could act.")


def _port(needing: Needing, setting: Setting) -> str | None:
    if not setting.model.ports():
        return f"The model {setting.model.name!r} {NO_PORT}."
    if not force_ports(Asked(setting)):
        return f"All ports of the model {setting.model.name!r} are of states, where flows act and no forces."
    return None


def _turning_port(needing: Needing, setting: Setting) -> str | None:
    return None if turning_ports(Asked(setting)) else PLACES["turning ports"][1]


def _stations(needing: Needing, setting: Setting) -> str | None:
    if setting.model.stations() is not None:
        return None
    return f"The model {setting.model.name!r} has no length along which the effect could have its place."


def _force(needing: Needing, setting: Setting) -> str | None:
    loaded = trials(setting, frozenset({TrialKind.STATIC, TrialKind.FORCED, TrialKind.DRIVEN}))
    if any(np.any(trial.force != 0.0) for trial in loaded):
        return None
    return "No static or forced trial of the campaign has an applied force."


def _temperature(needing: Needing, setting: Setting) -> str | None:
    if setting.campaign.reference_temperature is None:
        return "No temperatures were recorded in the campaign."
    values = [trial.temperature for trial in trials(setting) if trial.temperature.size]
    if not values or np.ptp(np.concatenate(values)) < TEMPERATURE_STEP:
        return f"All trials of the campaign have the same temperature within {TEMPERATURE_STEP:g} K."
    return None


def _channel(needing: Needing, setting: Setting) -> str | None:
    return None if channels(setting) else "The campaign has no channel to fit."


def _second_clock(needing: Needing, setting: Setting) -> str | None:
    driven = trials(setting, DYNAMIC - {TrialKind.RINGDOWN})
    if len(setting.campaign.loggers) != 1 or not driven:
        return None
    return "One logger records motion and inputs (`loggers`), so that the motion has no clock of its own."


def _input(needing: Needing, setting: Setting) -> str | None:
    return _trial(replace(needing, kinds=DYNAMIC - {TrialKind.RINGDOWN}), setting)


def _strain_across(needing: Needing, setting: Setting) -> str | None:
    model, campaign = setting.model, setting.campaign
    names = strain_channels(Asked(setting))
    trial = next(trial for trial in trials(setting) if any(name in names for name in trial.channels))
    channel = campaign.channels[next(name for name in trial.channels if name in names)]
    means = [campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in model.parameters]
    conditions = Conditions(np.array(means), health=trial.health, components=True)
    given: Response | None = None
    with suppress(ModelError):
        given = model.respond(trial, ((channel.output, channel.quantity),), ModelPatch(), conditions)
    if given is None or given.transverse is None or given.shear is None:
        return f"The model {model.name!r} gives no transverse and shear strain, which a turned gauge sees."
    return None


NEEDS: dict[str, Callable[[Needing, Setting], str | None]] = {
    "trial": _trial,
    "event": _event,
    "law": _law,
    "place": _place,
    "port": _port,
    "turning port": _turning_port,
    "stations": _stations,
    "force": _force,
    "temperature": _temperature,
    "channel": _channel,
    "second clock": _second_clock,
    "input": _input,
    "strain across": _strain_across,
}
"""What tells that a need is not met, by its word."""
USUAL = ("trial", "event", "law", "place")
"""Needs of an entry that does not name its own."""
