"""What a campaign and a model must have so that an effect can be tested.

The file of an effect lists its needs by words. For each word, a function here returns the reason
why the need is not met, or None if it is met.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.effect_in_setting import DYNAMIC, EffectInSetting
from discrepancy.catalogue.places import NO_PLACES, NO_TURNING_PORT, places_of
from discrepancy.system.interface import Model
from discrepancy.system.response import ACROSS
from fe.runtime.patch import SENSORS, PortForce, RegionStiffnessLoss

Kinds = frozenset[TrialKind]


KIND_NAMES = {kind: kind.value for kind in TrialKind} | {TrialKind.RINGDOWN: "ring-down"}
"""Names of kinds of trials in messages."""
NO_PORT = "has no port where an internal force can act"
"""Reason against effects that are forces within a structure or between it and the ground."""
TEMPERATURE_STEP = 0.1
"""Least range of temperatures [K] in a campaign from which an effect of temperature can show."""
INPUTS = DYNAMIC - {TrialKind.RINGDOWN}
"""Kinds of trials with recorded inputs in time."""


def _no_trial(effect: EffectInSetting, kinds: Kinds = frozenset()) -> str | None:
    """Return the reason if no fitted trial is of these kinds, else None.

    Without kinds, they are those that the effect acts on.
    """
    needed_kinds = kinds or effect.section.acts_on
    fitted_kinds = {trial.kind for trial in effect.setting.campaign.fitted}
    if not fitted_kinds.isdisjoint(needed_kinds):
        return None
    needed_names = [name for kind, name in KIND_NAMES.items() if kind in needed_kinds]
    return f"The campaign has no {' or '.join(needed_names)} trial to fit."


def _no_motion_or_weight(effect: EffectInSetting) -> str | None:
    """Return the reason if an added mass has neither inertia nor weight in any trial, else None."""
    model = effect.setting.model
    return _no_trial(effect, (DYNAMIC | model.kinds_with_weight) & effect.section.acts_on)


def _no_event(effect: EffectInSetting) -> str | None:
    """Return the reason if no fitted trial has the events that an effect needs, else None."""
    campaign = effect.setting.campaign
    names_of_trials = [campaign.names_of_event_times(trial.name) for trial in campaign.fitted]
    if not effect.event_times or any(effect.event_times <= names for names in names_of_trials):
        return None
    known_events = sorted({name for names in names_of_trials for name in names})
    needed_events = " and ".join(sorted(effect.event_times))
    return (
        f"No trial to fit has {needed_events} as [[event]]; those that are "
        f"fitted have {', '.join(known_events) or 'none'}."
    )


def _no_law(effect: EffectInSetting) -> str | None:
    """Return the reason if the model cannot carry the primitives of an effect, else None."""
    model = effect.setting.model
    for primitive in effect.primitives:
        if primitive in SENSORS or model.supports(primitive):
            continue
        reason = f"cannot carry the primitive {primitive.kind!r}"
        if issubclass(primitive, PortForce) and not model.ports:
            reason = NO_PORT
        if primitive is RegionStiffnessLoss:
            reason = "has no damage region"
        return _sentence_on_model(model, reason)
    return None


def _sentence_on_model(model: Model, predicate: str) -> str:
    """Return the sentence that a model lacks something."""
    return f"The model {model.name!r} {predicate}."


def _no_place(effect: EffectInSetting) -> str | None:
    """Return the reason if there is no place where an effect can act, else None."""
    if places_of(effect):
        return None
    word = effect.section.places
    if isinstance(word, str) and word in NO_PLACES:
        return NO_PLACES[word]
    return f"Neither model nor campaign has a place where {effect.section.identifier!r} could act."


def _no_port(effect: EffectInSetting) -> str | None:
    """Return the reason if the model has no port at which a force can act, else None."""
    model = effect.setting.model
    if not model.ports:
        return _sentence_on_model(model, NO_PORT)
    if not effect.force_ports():
        return (
            f"All ports of the model {model.name!r} are of states, where flows act and no forces."
        )
    return None


def _no_turning_port(effect: EffectInSetting) -> str | None:
    """Return the reason if no port has a motion that changes its direction, else None."""
    return None if effect.turning_ports else NO_TURNING_PORT


def _no_length(effect: EffectInSetting) -> str | None:
    """Return the reason if the model has no length with stations, else None."""
    model = effect.setting.model
    if model.stations is not None:
        return None
    return f"The model {model.name!r} has no length along which the effect could have its place."


def _no_force(effect: EffectInSetting) -> str | None:
    """Return the reason if no fitted trial has a force, else None."""
    if any(np.any(trial.force != 0.0) for trial in effect.setting.campaign.fitted):
        return None
    return "No static or forced trial of the campaign has an applied force."


def _no_temperature(effect: EffectInSetting) -> str | None:
    """Return the reason if the fitted trials do not differ in temperature, else None."""
    campaign = effect.setting.campaign
    if campaign.reference_temperature is None:
        return "No temperatures were recorded in the campaign."
    temperatures = [trial.temperature for trial in campaign.fitted]
    if temperatures and np.ptp(np.concatenate(temperatures)) >= TEMPERATURE_STEP:
        return None
    return f"All trials of the campaign have the same temperature within {TEMPERATURE_STEP:g} K."


def _no_channel(effect: EffectInSetting) -> str | None:
    """Return the reason if there is no trial to fit, else None."""
    return None if effect.setting.campaign.fitted else "The campaign has no channel to fit."


def _no_second_clock(effect: EffectInSetting) -> str | None:
    """Return the reason if motion and inputs were recorded by the same logger, else None.

    This is so if the campaign names exactly one logger. The result is also None if no trial has
    inputs, because another need reports that.
    """
    if len(effect.setting.campaign.loggers) != 1 or _no_trial(effect, INPUTS):
        return None
    return (
        "One logger records motion and inputs (`loggers`), so that the motion has no clock of its "
        "own."
    )


def _no_input(effect: EffectInSetting) -> str | None:
    """Return the reason if no fitted trial has recorded inputs in time, else None."""
    return _no_trial(effect, INPUTS)


def _no_strain_across(effect: EffectInSetting) -> str | None:
    """Return the reason if the model has no strains that a misaligned gauge measures, else None.

    These are the transverse strain and the shear strain.
    """
    setting = effect.setting
    for name in effect.strain_channels:
        output = setting.campaign.channels[name].output
        if not all(setting.model.output_quantity(output + suffix) for suffix in ACROSS):
            return (
                f"The model {setting.model.name!r} gives no transverse and shear strain, which a "
                "turned gauge sees."
            )
    return None


NEEDS: dict[str, Callable[[EffectInSetting], str | None]] = {
    "trial": _no_trial,
    "event": _no_event,
    "law": _no_law,
    "place": _no_place,
    "port": _no_port,
    "turning port": _no_turning_port,
    "stations": _no_length,
    "force": _no_force,
    "temperature": _no_temperature,
    "channel": _no_channel,
    "second clock": _no_second_clock,
    "input": _no_input,
    "strain across": _no_strain_across,
    "motion or weight": _no_motion_or_weight,
}
"""Functions that return why a need is not met, or None, by the word in the file."""


def untestable_reason(effect: EffectInSetting) -> str | None:
    """Return the reason why an effect cannot be tested: its first need that is not met, or None.

    Needs are checked at all ports of a model, not only at the preferred ones.
    """
    at_any_port = replace(effect, section=replace(effect.section, preferred=()))
    for need in effect.section.needs:
        reason = NEEDS[need](at_any_port)
        if reason:
            return reason
    return None
