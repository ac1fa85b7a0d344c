"""The places where an effect may act, by the word in its file, such as "ports" or "runs"."""

from collections.abc import Callable, Sequence
from math import isinf

import numpy as np

from discrepancy.campaign.noise import MAINS, aliased_frequency
from discrepancy.campaign.records import FloatArray, Quantity, Trial
from discrepancy.catalogue.effect_in_setting import (
    ALL,
    CHANNELS_OR_ALL_OF_A_QUANTITY,
    EVERY_PORT,
    MOTION_WORDS,
    PREPOSITIONS,
    EffectInSetting,
    Names,
)
from discrepancy.catalogue.entry import Setting
from fe.runtime.patch import (
    EVERY_CHANNEL,
    ROOT_TURN,
    LocalStiffnessLoss,
    RegionStiffnessLoss,
)

_SAME_FREQUENCY = 0.01
"""Relative difference up to which a line is seen at its own frequency, beside rounded times."""


def _with_place_of_all(names: Names) -> Names:
    """Return places, with the place of all channels before them if there are several."""
    return (EVERY_CHANNEL, *names) if len(names) > 1 else names


def _state_ports_or_all(effect: EffectInSetting) -> Names:
    """Return the ports of states, with the place of all of them at the end if there are several."""
    ports = effect.state_ports
    return (*ports, EVERY_PORT) if len(ports) > 1 else ports


def _runs(effect: EffectInSetting) -> Names:
    """Return the runs of the fitted trials."""
    return tuple(dict.fromkeys(trial.run for trial in effect.setting.campaign.fitted))


def _skins_at_ports(effect: EffectInSetting) -> Names:
    """Return both skins, or both signs of x, at each port of forces."""
    return tuple(f"{port}, {side}" for port in effect.force_ports() for side in effect.crack_sides)


def _held_ports(effect: EffectInSetting) -> Names:
    """Return the force ports with a support or stiffness, for forces that depend on displacement.

    A free port (of a body that falls or rolls) has no zero of displacement.
    """
    return effect.force_ports(lambda scale: not scale.free)


def _damage_regions(effect: EffectInSetting) -> Names:
    """Return the damage regions and patches whose loss of stiffness is a hypothesis of its own.

    There is none in a model that can lose stiffness anywhere along its length, as a wing can: that
    loss includes those of the regions.
    """
    model = effect.setting.model
    if model.supports(LocalStiffnessLoss) or not model.supports(RegionStiffnessLoss):
        return ()
    return (*model.regions, *model.loss_places)


def _supports(effect: EffectInSetting) -> Names:
    """Return the supports that may yield, with the motion, such as "CLAMP, turn about z".

    There is no choice if the root is the only one.
    """
    support_motions = effect.setting.model.support_motions
    if support_motions == (ROOT_TURN,):
        return ("",)
    return tuple(f"{support}, {MOTION_WORDS[motion]}" for support, motion in support_motions)


def _interfaces(effect: EffectInSetting) -> Names:
    """Return the interfaces that may yield, with the motion: "joint, shift along its normal"."""
    interface_motions = effect.setting.model.interface_motions
    return tuple(f"{interface}, {MOTION_WORDS[motion]}" for interface, motion in interface_motions)


def _changes_of_loads(effect: EffectInSetting, change: str, places: str) -> Names:
    """Return the changes of forces that act in fitted trials, such as "pull, along x".

    `change` is "offset" or "tilt", and `places` the word of the file for such places. The only
    force of a model counts as acting even if no trial names it.
    """
    setting = effect.setting
    used_controls = {str(trial.load_place) for trial in effect.trials}
    controls = [control for control, _, _ in setting.model.load_changes]
    is_only_control = len(set(controls)) == 1
    return tuple(
        f"{control}, {PREPOSITIONS[places]} {axis}"
        for control, kind, axis in setting.model.load_changes
        if kind == change and (is_only_control or control in used_controls)
    )


def _offsets_of_gauges(effect: EffectInSetting) -> Names:
    """Return the gauges that are read, each with the direction, such as "g1, shifted along"."""
    outputs = {channel.output for channel in effect.channels}
    word = PREPOSITIONS["offsets of gauges"]
    return tuple(
        f"{gauge}, {word} {axis}"
        for gauge, axis in effect.setting.model.gauge_shifts
        if gauge in outputs
    )


def _calibrated_channels(effect: EffectInSetting) -> Names:
    """Return the channels with a known gain, because a free gain absorbs any gain error."""
    return effect.channels_of(lambda channel: not isinf(channel.gain_deviation))


def _gauges_read_repeatedly(effect: EffectInSetting) -> Names:
    """Return the strain gauges that were read at several times, for effects that grow with time.

    Without strain gauges all channels are considered.
    """
    names = effect.strain_channels or effect.channels_of()
    return tuple(name for name in names if _is_read_repeatedly(effect, name))


def _is_read_repeatedly(effect: EffectInSetting, name: str) -> bool:
    """Return whether fitted trials have readings of a channel at more than one time.

    Times count from the start of the campaign. The time of a static trial does so already, and
    that of a dynamic trial counts from the trial's own start.
    """
    first_time = np.inf
    last_time = -np.inf
    for trial in effect.setting.campaign.fitted:
        if name in trial.channels and trial.time.size:
            start = trial.start if trial.is_dynamic else 0.0
            first_time = min(first_time, np.min(trial.time + start))
            last_time = max(last_time, np.max(trial.time + start))
    # an effect that grows from time zero on changes only readings after this time
    return bool(last_time > max(first_time, 0.0))


def _zeroed_runs(effect: EffectInSetting) -> Names:
    """Return the runs with a displacement channel whose zero is known, so that it may be wrong."""
    channels_with_zero = effect.channels_of(
        lambda channel: (
            channel.quantity is Quantity.DISPLACEMENT and not isinf(channel.offset_deviation)
        )
    )
    runs = [
        trial.run for trial in effect.trials if {*channels_with_zero}.intersection(trial.channels)
    ]
    return tuple(dict.fromkeys(runs))


def _loggers(effect: EffectInSetting) -> Names:
    """Return the loggers of a campaign; no choice if one records everything."""
    loggers = tuple(effect.setting.campaign.loggers)
    return loggers if len(loggers) > 1 else ("",)


def mains_lines(setting: Setting) -> Names:
    """Return the mains frequencies that records can show, such as "50 Hz" or "50 or 400 Hz".

    Sampling shifts a mains frequency above half the sampling rate to its alias, which the name
    tells then, as in "400 Hz (seen at 100 Hz)". A line is left out if its alias has less than
    one period in every record, because it then looks like an offset. Lines whose aliases differ by
    less than half a period in every record cannot be distinguished, and form one place.
    """
    trials = [trial for trial in setting.campaign.fitted if trial.is_dynamic]

    def periods(frequency: float) -> FloatArray:
        """Return the number of periods (T,) of the alias of a frequency [Hz] in each record."""
        counts = []
        for trial in trials:
            duration = float(trial.time[-1] - trial.time[0])
            counts.append(aliased_frequency(frequency, trial.interval) * duration)
        return np.array(counts)

    groups: list[list[float]] = []
    for frequency in MAINS:
        periods_of_line = periods(frequency)
        if not np.any(periods_of_line >= 1.0):
            continue
        for group in groups:
            if np.all(np.abs(periods_of_line - periods(group[0])) < 0.5):
                group.append(frequency)
                break
        else:
            groups.append([frequency])
    names = []
    for group in groups:
        frequencies = " or ".join(f"{frequency:g}" for frequency in group)
        names.append(f"{frequencies} Hz{_alias_clause(group[0], trials)}")
    return tuple(names)


def _alias_clause(frequency: float, trials: Sequence[Trial]) -> str:
    """Return the part of a name on the alias of a line [Hz]; empty if it is not shifted."""
    aliases = {float(f"{aliased_frequency(frequency, trial.interval):.3g}") for trial in trials}
    if not aliases or max(aliases) >= frequency * (1.0 - _SAME_FREQUENCY):
        return ""
    if len(aliases) > 1:
        return f" (seen at {min(aliases):g} to {max(aliases):g} Hz)"
    return f" (seen at {aliases.pop():g} Hz)"


def _channels_or_all_of_a_quantity(effect: EffectInSetting) -> Names:
    """Return the channels, after "all strain" and the like if several have a quantity."""
    quantities = [channel.quantity.value for channel in effect.channels]
    repeated = [quantity for quantity in quantities if quantities.count(quantity) > 1]
    all_of_quantities = dict.fromkeys(f"{ALL}{quantity}" for quantity in repeated)
    return (*all_of_quantities, *effect.channels_of())


def _lines_in_channels(effect: EffectInSetting) -> Names:
    """Return the mains lines in single channels, and in all channels of a quantity."""
    channels = _channels_or_all_of_a_quantity(effect)
    lines = mains_lines(effect.setting)
    return tuple(f"{line}, {channel}" for line in lines for channel in channels)


PLACES: dict[str, Callable[[EffectInSetting], Names]] = {
    "ports": lambda effect: effect.setting.model.ports,
    "channels": EffectInSetting.channels_of,
    "channels, or all": lambda effect: _with_place_of_all(effect.channels_of()),
    CHANNELS_OR_ALL_OF_A_QUANTITY: _channels_or_all_of_a_quantity,
    "strain channels": lambda effect: effect.strain_channels,
    "strain channels, or all": lambda effect: _with_place_of_all(effect.strain_channels),
    "runs": _runs,
    "ports of forces": EffectInSetting.force_ports,
    "held ports": _held_ports,
    "turning ports": lambda effect: effect.turning_ports,
    "damage regions": _damage_regions,
    "skins at ports": _skins_at_ports,
    "ports of states": lambda effect: effect.state_ports,
    "ports of states, or all": _state_ports_or_all,
    "supports": _supports,
    "interfaces": _interfaces,
    "offsets of loads": lambda effect: _changes_of_loads(effect, "offset", "offsets of loads"),
    "tilts of loads": lambda effect: _changes_of_loads(effect, "tilt", "tilts of loads"),
    "offsets of gauges": _offsets_of_gauges,
    "places of masses": lambda effect: effect.setting.model.mass_places,
    "calibrated channels": _calibrated_channels,
    "timed gauges": _gauges_read_repeatedly,
    "zeroed runs": _zeroed_runs,
    "loggers": _loggers,
    "mains lines": _lines_in_channels,
}
"""Functions that return the places of an effect, by the word in its file."""


def places_of(effect: EffectInSetting) -> Names:
    """Return the places where an effect may act in its setting; ("",) if there is no choice."""
    places = effect.section.places
    if isinstance(places, str):
        return PLACES[places](effect)
    return places or ("",)


_NO_STRAIN = "The campaign has no strain channel."
NO_TURNING_PORT = (
    "No port moves back and forth, and a motion in one direction shows neither hysteresis nor a "
    "rest position."
)
_NO_STATE = "The model has no port of a state (a level, a charge), at which a flow could act."
NO_PLACES = {
    "strain channels": _NO_STRAIN,
    "strain channels, or all": _NO_STRAIN,
    "held ports": "No port of the model is held by a stiffness, so that none has a rest position.",
    "turning ports": NO_TURNING_PORT,
    "damage regions": (
        "The model can lose stiffness anywhere along its length, so that local_stiffness_loss is "
        "compared instead."
    ),
    "ports of states": _NO_STATE,
    "ports of states, or all": _NO_STATE,
    "supports": "The model names no support that could yield.",
    "interfaces": "The model names no interface of two parts that could yield.",
    "offsets of loads": "The model says no place of a load that could be wrong.",
    "tilts of loads": "The model says no direction of a load that could be wrong.",
    "offsets of gauges": "The model knows no strain beside the places of its gauges.",
    "places of masses": "The model names no place where a mass could be added or lost.",
    "calibrated channels": (
        "The campaign has no channel whose gain is known, so no gain can be wrong."
    ),
    "timed gauges": "The campaign does not say at which times its channels were read.",
    "zeroed runs": "No static trial has a displacement channel whose zero is known.",
    "mains lines": "At these sampling rates every mains line is aliased to zero frequency.",
}
"""Why there is no place, by the word of `PLACES`."""
