"""Where an effect may act and what it needs, by the words of its entry, and why it cannot be tested."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isinf

import numpy as np

from discrepancy.campaign.noise import MAINS, aliased
from discrepancy.campaign.records import Channel, FloatArray, Quantity, Trial, TrialKind
from discrepancy.models.interface import ACROSS
from discrepancy.sentences import SENTENCES, said
from fe.runtime.motion import PLANFORM
from fe.runtime.patch import EVERY_CHANNEL, SENSORS, PortForce, Primitive

from .entry import Setting

Kinds = frozenset[TrialKind]
Names = tuple[str, ...]

EVERY_TRIAL = frozenset(TrialKind)
DYNAMIC = frozenset({TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN})
SKINS = {"lower skin": 1.0, "upper skin": -1.0}
"""Skin that is cracked, and the sign of x that opens it: upward bending stretches the lower skin."""
EVERY_PORT = "every port"
"""Place of a law that acts at all ports of states alike."""
ALL = "all "
"""Begins the place that stands for all channels of a quantity."""


# ---------------------------------------------------------------- what the campaign holds


def trials(setting: Setting, kinds: Kinds = EVERY_TRIAL) -> tuple[Trial, ...]:
    """Return the trials of the given kinds that may be used for fitting."""
    return tuple(trial for trial in setting.campaign.fitted if trial.kind in kinds)


def channels(setting: Setting, kinds: Kinds = EVERY_TRIAL) -> tuple[Channel, ...]:
    """Return the channels that trials of `kinds` recorded."""
    recorded = {name for trial in trials(setting, kinds) for name in trial.channels}
    return tuple(channel for name, channel in setting.campaign.channels.items() if name in recorded)


def largest_reading(setting: Setting, names: Names, kinds: Kinds) -> float:
    """Return the largest magnitude among the used readings of channels [its unit], 1 if all are zero."""
    if (names, kinds) not in setting.largest:
        read = [
            np.abs(trial.values[trial.used[:, column], column])
            for trial in trials(setting, kinds)
            for column, name in enumerate(trial.channels)
            if name in names
        ]
        largest = float(max((np.max(values) for values in read if values.size), default=0.0))
        setting.largest[names, kinds] = largest if largest > 0.0 and np.isfinite(largest) else 1.0
    return setting.largest[names, kinds]


# ---------------------------------------------------------------- places


@dataclass(frozen=True)
class Entry:
    """What an effect asks of a setting, as its file says.

    Attributes
    ----------
    identifier : str
        Of the effect.
    kinds : frozenset of TrialKind
        Trials that it changes.
    word : str
        For its places, empty where they are given.
    preferred : tuple of str
        Ports that stand for all where the model has one of them. The port "planform" of a force that is
        spread over an area is "span" in a model without one.
    primitives : tuple of type
        What it is made of.
    moments : frozenset of str
        Events of which a trial must have all.
    """

    identifier: str = ""
    kinds: Kinds = EVERY_TRIAL
    word: str = ""
    preferred: Names = ()
    primitives: tuple[type[Primitive], ...] = ()
    moments: frozenset[str] = frozenset()


ANY = Entry()
"""An effect of any kind."""


def state_ports(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the ports of states, at which laws are flows."""
    return tuple(name for name, scale in setting.scales.ports.items() if scale.of_state)


def force_ports(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the ports where forces act: those of `preferred` that the model has, else all."""
    flows, spread = state_ports(setting, entry), PLANFORM in setting.scales.ports
    known = tuple(port for port in setting.model.ports if port not in flows)
    wanted = ["span" if name == PLANFORM and not spread else name for name in entry.preferred]
    return tuple(name for name in wanted if name in known or name == PLANFORM) or known


def _held_ports(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the ports that something holds, for forces that depend on where a port is."""
    free = {name for name, scale in setting.scales.ports.items() if scale.free}
    return tuple(port for port in force_ports(setting, entry) if port not in free)


def turning_ports(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the ports whose motion turns or is held, for forces with a memory or a zero.

    What moves one way only, a body that falls, cannot tell such a force from drag: speed and way grow as one.
    """
    ports = setting.scales.ports
    return tuple(name for name in force_ports(setting, entry) if name not in ports or ports[name].turns)


def _stores(setting: Setting, entry: Entry = ANY) -> Names:
    found = state_ports(setting, entry)
    return (*found, EVERY_PORT) if len(found) > 1 else found


def _channels(setting: Setting, entry: Entry = ANY) -> Names:
    return tuple(channel.name for channel in channels(setting, entry.kinds))


def strain_channels(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the strain channels."""
    recorded = channels(setting, entry.kinds)
    return tuple(channel.name for channel in recorded if channel.quantity is Quantity.STRAIN)


def _or_all(names: Names) -> Names:
    return (EVERY_CHANNEL, *names) if len(names) > 1 else names


def _calibrated_channels(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the channels whose gain is known at all: a free gain absorbs an error of it."""
    recorded = channels(setting, entry.kinds)
    return tuple(channel.name for channel in recorded if not isinf(channel.gain_deviation))


def _timed_gauges(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the gauges, else channels, that were read at more than one time since the campaign's start."""
    places = []
    for name in strain_channels(setting, entry) or _channels(setting, entry):
        times = [
            trial.time + (trial.start if trial.is_dynamic else 0.0)
            for trial in trials(setting)
            if name in trial.channels and trial.time.size
        ]
        if times and max(map(np.max, times)) > max(min(map(np.min, times)), 0.0):
            places.append(name)
    return tuple(places)


def _zeroed_runs(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the runs whose trials have a displacement channel with a zero that is known at all."""
    names = {
        channel.name
        for channel in channels(setting, entry.kinds)
        if channel.quantity is Quantity.DISPLACEMENT and not isinf(channel.offset_deviation)
    }
    measured = trials(setting, entry.kinds)
    return tuple(dict.fromkeys(trial.run for trial in measured if names.intersection(trial.channels)))


def _loggers(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the loggers of a campaign; no choice where one records everything."""
    loggers = tuple(setting.campaign.loggers)
    return loggers if len(loggers) > 1 else ("",)


def mains_lines(setting: Setting) -> Names:
    """Return the mains lines that can be seen, such as "50 Hz" or "50 or 400 Hz".

    A line whose alias makes less than one period in every record is an offset there and left out. Lines whose
    aliases differ by less than half a period in every record look alike and are one.
    """
    sampled = [(item.interval, float(item.time[-1] - item.time[0])) for item in trials(setting, DYNAMIC)]

    def periods(frequency: float) -> FloatArray:
        return np.array([aliased(frequency, interval) * length for interval, length in sampled])

    groups: list[list[float]] = []
    for frequency in MAINS:
        seen = periods(frequency)
        alike = (group for group in groups if np.all(np.abs(seen - periods(group[0])) < 0.5))
        if (group := next(alike, None)) is not None and np.any(seen >= 1.0):
            group.append(frequency)
        elif np.any(seen >= 1.0):
            groups.append([frequency])
    return tuple(" or ".join(f"{frequency:g}" for frequency in group) + " Hz" for group in groups)


def _seen_lines(setting: Setting, entry: Entry = ANY) -> Names:
    """Return the mains lines at channels, and at "all strain" and the like for several of a quantity."""
    quantities = [channel.quantity.value for channel in channels(setting, entry.kinds)]
    several = dict.fromkeys(ALL + quantity for quantity in quantities if quantities.count(quantity) > 1)
    seen = (*several, *_channels(setting, entry))
    return tuple(f"{line}, {name}" for line in mains_lines(setting) for name in seen)


PLACES: dict[str, Callable[[Setting, Entry], Names]] = {
    "ports": lambda setting, entry: setting.model.ports,
    "channels": _channels,
    "channels, or all": lambda setting, entry: _or_all(_channels(setting, entry)),
    "strain channels": strain_channels,
    "strain channels, or all": lambda setting, entry: _or_all(strain_channels(setting, entry)),
    "runs": lambda setting, entry: tuple(dict.fromkeys(trial.run for trial in trials(setting))),
    "ports of forces": force_ports,
    "held ports": _held_ports,
    "turning ports": turning_ports,
    "skins at ports": lambda setting, entry: tuple(
        f"{port}, {skin}" for port in force_ports(setting, entry) for skin in SKINS
    ),
    "ports of states": state_ports,
    "ports of states, or all": _stores,
    "calibrated channels": _calibrated_channels,
    "timed gauges": _timed_gauges,
    "zeroed runs": _zeroed_runs,
    "loggers": _loggers,
    "mains lines": _seen_lines,
}
"""What finds the places of a word; `[places]` of `sentences.toml` says why there are none."""


@dataclass(frozen=True)
class Target:
    """What a place stands for: a port, channel, run or logger, its quantity, and the number in its name.

    The number is the side of a skin or the frequency of a line [Hz].
    """

    name: str
    quantity: str = ""
    number: float = 0.0


def targets_of(word: str, place: str, setting: Setting) -> tuple[Target, ...]:
    """Return what a place of a word stands for; a law acts at each."""
    if word == "skins at ports":
        port, _, skin = place.rpartition(", ")
        return (Target(port, number=SKINS[skin]),)
    if word == "ports of states, or all" and place == EVERY_PORT:
        return tuple(Target(port) for port in state_ports(setting))
    if word == "mains lines":
        line, _, name = place.partition(", ")
        frequency = float(line.split()[0])
        if name.startswith(ALL) and name not in _channels(setting, Entry(kinds=DYNAMIC)):
            return (Target(EVERY_CHANNEL, name.removeprefix(ALL), frequency),)
        return (Target(name, number=frequency),)
    return (Target(place or EVERY_CHANNEL),)


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
            no_port = issubclass(primitive, PortForce) and not model.ports
            what = NO_PORT if no_port else said("needs.cannot_carry", kind=primitive.kind)
            return said("needs.model", model=model.name, what=what)
    return None


def _place(setting: Setting, entry: Entry) -> str | None:
    if not entry.word or PLACES[entry.word](setting, replace(entry, preferred=())):
        return None
    return SENTENCES["places"].get(entry.word) or said("needs.place", effect=entry.identifier)


def _port(setting: Setting, entry: Entry) -> str | None:
    if not setting.model.ports:
        return said("needs.model", model=setting.model.name, what=NO_PORT)
    return None if force_ports(setting) else said("needs.only_states", model=setting.model.name)


def _temperature(setting: Setting, entry: Entry) -> str | None:
    if setting.campaign.reference_temperature is None:
        return said("needs.no_temperature")
    values = [trial.temperature for trial in trials(setting) if trial.temperature.size]
    varied = bool(values) and np.ptp(np.concatenate(values)) >= TEMPERATURE_STEP
    return None if varied else said("needs.one_temperature", step=TEMPERATURE_STEP)


def _strain_across(setting: Setting, entry: Entry) -> str | None:
    outputs = [
        setting.campaign.channels[name].output + part for name in strain_channels(setting) for part in ACROSS
    ]
    if all(map(setting.model.output_quantity, outputs)):
        return None
    return said("needs.no_strain_across", model=setting.model.name)


def _has_force(setting: Setting) -> bool:
    loaded = trials(setting, frozenset({TrialKind.STATIC, TrialKind.FORCED, TrialKind.DRIVEN}))
    return any(np.any(trial.force != 0.0) for trial in loaded)


def _met(holds: Callable[[Setting], object], sentence: str) -> Callable[[Setting, Entry], str | None]:
    """Return what tells that something does not hold of a setting."""
    return lambda setting, entry: None if holds(setting) else said(sentence, model=setting.model.name)


NEEDS: dict[str, Callable[[Setting, Entry], str | None]] = {
    "trial": _trial,
    "event": _event,
    "law": _law,
    "place": _place,
    "port": _port,
    "turning port": _met(turning_ports, "places.turning ports"),
    "stations": _met(lambda setting: setting.model.stations is not None, "needs.no_length"),
    "force": _met(_has_force, "needs.no_force"),
    "temperature": _temperature,
    "channel": _met(channels, "needs.no_channel"),
    "second clock": _met(
        lambda setting: len(setting.campaign.loggers) != 1 or not trials(setting, INPUTS),
        "needs.no_second_clock",
    ),
    "input": lambda setting, entry: _trial(setting, replace(entry, kinds=INPUTS)),
    "strain across": _strain_across,
}
"""What tells that a need is not met, by its word."""
USUAL = ("trial", "event", "law", "place")
"""Needs of an entry that does not name its own."""
