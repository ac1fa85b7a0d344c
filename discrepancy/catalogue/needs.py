"""What an effect needs of a campaign and a model, by the words of its entry: why it cannot be tested."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.places import (
    DYNAMIC,
    PLACES,
    Entry,
    channels,
    force_ports,
    strain_channels,
    trials,
    turning_ports,
)
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, Response
from discrepancy.sentences import SENTENCES, said
from fe.runtime.patch import SENSORS, ModelPatch, PortForce

KIND_NAMES = {kind: kind.value for kind in TrialKind} | {TrialKind.RINGDOWN: "ring-down"}
"""How a kind of trial is called in a sentence."""
NO_PORT: str = SENTENCES["needs"]["no_port"]
"""Reason against effects that are forces within a structure or between it and the ground."""
TEMPERATURE_STEP = 0.1
"""Least range of temperatures [K] in a campaign from which an effect of temperature can show."""
INPUTS = DYNAMIC - {TrialKind.RINGDOWN}


def first_reason(needs: tuple[str, ...], entry: Entry, setting: Setting) -> str | None:
    """Return why an effect cannot be tested: the first of its needs that is not met; None if all are."""
    return next((reason for need in needs if (reason := NEEDS[need](setting, entry))), None)


def _trial(setting: Setting, entry: Entry) -> str | None:
    names = [name for kind, name in KIND_NAMES.items() if kind in entry.kinds]
    return None if trials(setting, entry.kinds) else said("needs.trial", kinds=" or ".join(names))


def _event(setting: Setting, entry: Entry) -> str | None:
    fitted = [setting.campaign.event_times(trial.name) for trial in setting.campaign.fitted]
    if not entry.moments or any(entry.moments <= times.keys() for times in fitted):
        return None
    there = ", ".join(sorted({name for times in fitted for name in times})) or "none"
    return said("needs.event", events=" and ".join(sorted(entry.moments)), there=there)


def _law(setting: Setting, entry: Entry) -> str | None:
    model = setting.model
    for primitive in entry.primitives:
        if primitive not in SENSORS and not model.supports(primitive):
            no_port = issubclass(primitive, PortForce) and not model.ports()
            what = NO_PORT if no_port else said("needs.cannot_carry", kind=primitive.kind)
            return said("needs.model", model=model.name, what=what)
    return None


def _place(setting: Setting, entry: Entry) -> str | None:
    find, reason = PLACES[entry.word] if entry.word else (None, "")
    if find is None or find(setting, replace(entry, preferred=())):
        return None
    return reason or said("needs.place", effect=entry.identifier)


def _port(setting: Setting, entry: Entry) -> str | None:
    if not setting.model.ports():
        return said("needs.model", model=setting.model.name, what=NO_PORT)
    return None if force_ports(setting) else said("needs.only_states", model=setting.model.name)


def _temperature(setting: Setting, entry: Entry) -> str | None:
    if setting.campaign.reference_temperature is None:
        return said("needs.no_temperature")
    values = [trial.temperature for trial in trials(setting) if trial.temperature.size]
    varied = bool(values) and np.ptp(np.concatenate(values)) >= TEMPERATURE_STEP
    return None if varied else said("needs.one_temperature", step=TEMPERATURE_STEP)


def _strain_across(setting: Setting, entry: Entry) -> str | None:
    model, campaign = setting.model, setting.campaign
    names = strain_channels(setting)
    trial = next(trial for trial in trials(setting) if any(name in names for name in trial.channels))
    channel = campaign.channels[next(name for name in trial.channels if name in names)]
    means = [campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in model.parameters]
    conditions = Conditions(np.array(means), health=trial.health, components=True)
    given: Response | None = None
    with suppress(ModelError):
        given = model.respond(trial, ((channel.output, channel.quantity),), ModelPatch(), conditions)
    if given is None or given.transverse is None or given.shear is None:
        return said("needs.no_strain_across", model=model.name)
    return None


def _has_force(setting: Setting) -> bool:
    loaded = trials(setting, frozenset({TrialKind.STATIC, TrialKind.FORCED, TrialKind.DRIVEN}))
    return any(np.any(trial.force != 0.0) for trial in loaded)


def _has_second_clock(setting: Setting) -> bool:
    return len(setting.campaign.loggers) != 1 or not trials(setting, INPUTS)


def _met(holds: Callable[[Setting], object], sentence: str) -> Callable[[Setting, Entry], str | None]:
    """Return what tells that something does not hold of a setting."""
    return lambda setting, entry: (
        None if holds(setting) else said(f"needs.{sentence}", model=setting.model.name)
    )


NEEDS: dict[str, Callable[[Setting, Entry], str | None]] = {
    "trial": _trial,
    "event": _event,
    "law": _law,
    "place": _place,
    "port": _port,
    "turning port": _met(turning_ports, "no_turning_port"),
    "stations": _met(lambda setting: setting.model.stations() is not None, "no_length"),
    "force": _met(_has_force, "no_force"),
    "temperature": _temperature,
    "channel": _met(channels, "no_channel"),
    "second clock": _met(_has_second_clock, "no_second_clock"),
    "input": lambda setting, entry: _trial(setting, replace(entry, kinds=INPUTS)),
    "strain across": _strain_across,
}
"""What tells that a need is not met, by its word."""
USUAL = ("trial", "event", "law", "place")
"""Needs of an entry that does not name its own."""
