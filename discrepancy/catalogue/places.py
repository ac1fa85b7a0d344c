"""Where an effect may act, by the words of its entry, and what a place stands for."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import isinf

import numpy as np

from discrepancy.campaign.noise import MAINS, aliased
from discrepancy.campaign.records import Campaign, Channel, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Setting
from fe.runtime.patch import EVERY_CHANNEL
from fe.runtime.planform_forces import PLANFORM

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


@dataclass(frozen=True, eq=False)
class _Same:
    """A campaign, equal to itself only; it holds arrays, so it has no hash of its own."""

    campaign: Campaign

    def __hash__(self) -> int:
        return id(self.campaign)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.campaign is other.campaign


def largest_reading(setting: Setting, names: Names, kinds: Kinds) -> float:
    """Return the largest magnitude among the used readings of channels [its unit], 1 if all are zero."""
    return _largest_reading(_Same(setting.campaign), names, kinds)


@lru_cache(maxsize=512)  # patches are built at every step of a fit
def _largest_reading(same: _Same, names: Names, kinds: Kinds) -> float:
    read = [
        np.abs(trial.values[trial.used[:, column], column])
        for trial in same.campaign.fitted
        for column, name in enumerate(trial.channels)
        if trial.kind in kinds and name in names
    ]
    largest = float(max((np.max(values) for values in read if values.size), default=0.0))
    return largest if largest > 0.0 and np.isfinite(largest) else 1.0


# ---------------------------------------------------------------- places


@dataclass(frozen=True)
class Asked:
    """What places are asked for: the setting, the trials that the effect changes, and the ports to prefer.

    `preferred` are ports that stand for all where the model has one of them. The port "planform" of a force
    that is spread over an area is "span" in a model without one.
    """

    setting: Setting
    kinds: Kinds = EVERY_TRIAL
    preferred: Names = ()


def _all_ports(asked: Asked) -> Names:
    return asked.setting.model.ports()


def state_ports(asked: Asked) -> Names:
    """Return the ports of states, at which laws are flows."""
    return tuple(name for name, scale in asked.setting.scales.ports.items() if scale.of_state)


def force_ports(asked: Asked) -> Names:
    """Return the ports where forces act: those of `preferred` that the model has, else all."""
    flows, spread = state_ports(asked), PLANFORM in asked.setting.scales.ports
    known = tuple(port for port in asked.setting.model.ports() if port not in flows)
    wanted = ["span" if name == PLANFORM and not spread else name for name in asked.preferred]
    return tuple(name for name in wanted if name in known or name == PLANFORM) or known


def _held_ports(asked: Asked) -> Names:
    """Return the ports that something holds, for forces that depend on where a port is."""
    free = {name for name, scale in asked.setting.scales.ports.items() if scale.free}
    return tuple(port for port in force_ports(asked) if port not in free)


def turning_ports(asked: Asked) -> Names:
    """Return the ports whose motion turns or is held, for forces with a memory or a zero.

    What moves one way only, a body that falls, cannot tell such a force from drag: speed and way grow as one.
    """
    ports = asked.setting.scales.ports
    return tuple(name for name in force_ports(asked) if name not in ports or ports[name].turns)


def _skins(asked: Asked) -> Names:
    return tuple(f"{port}, {skin}" for port in force_ports(asked) for skin in SKINS)


def _stores(asked: Asked) -> Names:
    found = state_ports(asked)
    return (*found, EVERY_PORT) if len(found) > 1 else found


def _channels(asked: Asked) -> Names:
    return tuple(channel.name for channel in channels(asked.setting, asked.kinds))


def strain_channels(asked: Asked) -> Names:
    """Return the strain channels."""
    recorded = channels(asked.setting, asked.kinds)
    return tuple(channel.name for channel in recorded if channel.quantity is Quantity.STRAIN)


def _or_all(names: Names) -> Names:
    return (EVERY_CHANNEL, *names) if len(names) > 1 else names


def _calibrated_channels(asked: Asked) -> Names:
    """Return the channels whose gain is known at all: a free gain absorbs an error of it."""
    recorded = channels(asked.setting, asked.kinds)
    return tuple(channel.name for channel in recorded if not isinf(channel.gain_deviation))


def _timed_gauges(asked: Asked) -> Names:
    """Return the gauges, else channels, that were read at more than one time since the campaign's start."""
    places = []
    for name in strain_channels(asked) or _channels(asked):
        times = [
            trial.time + (trial.start if trial.is_dynamic else 0.0)
            for trial in trials(asked.setting)
            if name in trial.channels and trial.time.size
        ]
        if times and max(map(np.max, times)) > max(min(map(np.min, times)), 0.0):
            places.append(name)
    return tuple(places)


def _all_runs(asked: Asked) -> Names:
    return tuple(dict.fromkeys(trial.run for trial in trials(asked.setting)))


def _zeroed_runs(asked: Asked) -> Names:
    """Return the runs whose trials have a displacement channel with a zero that is known at all."""
    names = {
        channel.name
        for channel in channels(asked.setting, asked.kinds)
        if channel.quantity is Quantity.DISPLACEMENT and not isinf(channel.offset_deviation)
    }
    measured = trials(asked.setting, asked.kinds)
    return tuple(dict.fromkeys(trial.run for trial in measured if names.intersection(trial.channels)))


def _loggers(asked: Asked) -> Names:
    """Return the loggers of a campaign; no choice where one records everything."""
    loggers = tuple(asked.setting.campaign.loggers)
    return loggers if len(loggers) > 1 else ("",)


def mains_lines(setting: Setting) -> Names:
    """Return the mains lines that can be seen, such as "50 Hz" or "50 or 400 Hz".

    A line whose alias makes less than one period in every record is an offset there and left out. Lines whose
    aliases differ by less than half a period in every record look alike and are one.
    """
    sampled = [(item.interval, float(item.time[-1] - item.time[0])) for item in trials(setting, DYNAMIC)]
    groups: list[list[float]] = []
    for frequency in MAINS:
        if all(aliased(frequency, interval) * length < 1.0 for interval, length in sampled):
            continue
        for group in groups:
            if all(
                abs(aliased(frequency, interval) - aliased(group[0], interval)) * length < 0.5
                for interval, length in sampled
            ):
                group.append(frequency)
                break
        else:
            groups.append([frequency])
    return tuple(" or ".join(f"{frequency:g}" for frequency in group) + " Hz" for group in groups)


def _seen_lines(asked: Asked) -> Names:
    """Return the mains lines at channels, and at "all strain" and the like for several of a quantity."""
    quantities = [channel.quantity.value for channel in channels(asked.setting, asked.kinds)]
    several = dict.fromkeys(ALL + quantity for quantity in quantities if quantities.count(quantity) > 1)
    seen = (*several, *_channels(asked))
    return tuple(f"{line}, {name}" for line in mains_lines(asked.setting) for name in seen)


_NO_STRAIN = "The campaign has no strain channel."
_NO_STATE = "The model has no port of a state (a level, a charge), at which a flow could act."
PLACES: dict[str, tuple[Callable[[Asked], Names], str]] = {
    "ports": (_all_ports, ""),
    "channels": (_channels, ""),
    "channels, or all": (lambda asked: _or_all(_channels(asked)), ""),
    "strain channels": (strain_channels, _NO_STRAIN),
    "strain channels, or all": (lambda asked: _or_all(strain_channels(asked)), _NO_STRAIN),
    "runs": (_all_runs, ""),
    "ports of forces": (force_ports, ""),
    "held ports": (_held_ports, "Nothing holds a port of the model, so that no place is its zero."),
    "turning ports": (
        turning_ports,
        "No port has a motion that turns: one that goes one way shows no memory and no zero.",
    ),
    "skins at ports": (_skins, ""),
    "ports of states": (state_ports, _NO_STATE),
    "ports of states, or all": (_stores, _NO_STATE),
    "calibrated channels": (
        _calibrated_channels,
        "The campaign has no channel whose gain is known, so no gain can be wrong.",
    ),
    "timed gauges": (_timed_gauges, "The campaign does not say at which times its channels were read."),
    "zeroed runs": (_zeroed_runs, "No static trial has a displacement channel whose zero is known."),
    "loggers": (_loggers, ""),
    "mains lines": (_seen_lines, "At these sampling rates every mains line is aliased to zero frequency."),
}
"""What finds the places of a word, and the reason against an effect that has none where it is known."""


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
        return tuple(Target(port) for port in state_ports(Asked(setting)))
    if word == "mains lines":
        line, _, name = place.partition(", ")
        frequency = float(line.split()[0])
        if name.startswith(ALL) and name not in _channels(Asked(setting, DYNAMIC)):
            return (Target(EVERY_CHANNEL, name.removeprefix(ALL), frequency),)
        return (Target(name, number=frequency),)
    return (Target(place or EVERY_CHANNEL),)
