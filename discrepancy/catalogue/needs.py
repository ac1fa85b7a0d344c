"""Where an effect may act and what it needs, by the words of its entry, and why it cannot be tested."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isinf
from typing import Annotated

import numpy as np
from pydantic import Field

from discrepancy.campaign.noise import MAINS, aliased
from discrepancy.campaign.records import Channel, FloatArray, Quantity, Trial, TrialKind
from discrepancy.errors import SENTENCES, said
from discrepancy.system.interface import Model
from discrepancy.system.response import ACROSS
from discrepancy.system.scales import PortScale
from discrepancy.system.structures import StructureModel
from fe.runtime.patch import EVERY_CHANNEL, SENSORS, PortForce, Primitive
from fe.runtime.port_laws import PLANFORM
from fe.runtime.wing_rows import PORTS

from .entry import ROW, EffectKeys, Number, Setting

Kinds = frozenset[TrialKind]
Names = tuple[str, ...]

DYNAMIC = frozenset({TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN})
SKINS = {"lower skin": 1.0, "upper skin": -1.0}
"""Skin that is cracked, and the sign of x that opens it: upward bending stretches the lower skin."""
EVERY_PORT = "every port"
"""Place of a law that acts at all ports of states alike."""
ALL = "all "
"""Begins the place that stands for all channels of a quantity."""
CHANNELS_OR_ALL_OF_A_QUANTITY = "channels, or all of a quantity"
"""Word for places that are channels, and all channels of a quantity alike."""


USUAL = ("trial", "event", "law", "place")
"""Needs of an entry that does not name its own."""
Text = Annotated[str, Field(min_length=0)]


@dataclass(frozen=True, kw_only=True)
class EffectSection(EffectKeys):
    """`[[effect]]`, or the whole of a file with one."""

    __pydantic_config__ = ROW

    primitives: tuple[dict[str, Text | Number], ...] = ()
    places: str | tuple[str, ...] | None = None
    preferred: tuple[str, ...] = ()
    needs: tuple[str, ...] = USUAL
    events: tuple[str, ...] = ()


def _has_ports_of_a_wing(model: Model) -> bool:
    """Return whether one port of a model may stand for the others; the file of a structure names its own."""
    return set(model.ports) <= set(PORTS) and not isinstance(model, StructureModel)


@dataclass(frozen=True)
class Asked:
    """An effect in a setting, as its file says: where it may act, and why it cannot be tested.

    Attributes
    ----------
    setting : Setting
        Campaign and model.
    section : EffectSection
        What its file says. Its `places` are a word of `PLACES`, the places themselves, or none: there is no
        choice; `preferred` are ports of a wing that stand for its others. The port "planform"
        of a force that is spread over an area is "span" in a model without one.
    primitives : tuple of type
        What it is made of.
    moments : frozenset of str
        Events of which a trial must have all.
    """

    setting: Setting
    section: EffectSection
    primitives: tuple[type[Primitive], ...]
    moments: frozenset[str]

    # ------------------------------------------------------------ what the campaign and the model have

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Trials that it changes and that may be used for fitting."""
        return tuple(trial for trial in self.setting.campaign.fitted if trial.kind in self.section.acts_on)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What these recorded."""
        recorded = {name for trial in self.trials for name in trial.channels}
        return tuple(item for name, item in self.setting.campaign.channels.items() if name in recorded)

    def channels_of(self, chosen: Callable[[Channel], bool] = lambda channel: True) -> Names:
        """Return the names of the channels that are chosen."""
        return tuple(channel.name for channel in self.channels if chosen(channel))

    @property
    def strain_channels(self) -> Names:
        """Names of the strain channels."""
        return self.channels_of(lambda channel: channel.quantity is Quantity.STRAIN)

    @property
    def state_ports(self) -> Names:
        """Ports of states, at which laws are flows."""
        return tuple(name for name, scale in self.setting.scales.ports.items() if scale.of_state)

    def force_ports(self, chosen: Callable[[PortScale], bool] = lambda scale: True) -> Names:
        """Return the ports where forces act: of a wing those of `preferred` that it has, else all."""
        model, flows, scales = self.setting.model, self.state_ports, self.setting.scales.ports
        known = tuple(port for port in model.ports if port not in flows)
        preferred = self.section.preferred if _has_ports_of_a_wing(model) else ()
        wanted = ["span" if name == PLANFORM and name not in scales else name for name in preferred]
        found = tuple(name for name in wanted if name in known or name == PLANFORM) or known
        return tuple(name for name in found if name not in scales or chosen(scales[name]))

    @property
    def turning_ports(self) -> Names:
        """Ports whose motion turns or is held, for forces with a memory or a zero.

        What moves one way only, a body that falls, cannot tell such a force from drag: speed and way grow as
        one.
        """
        return self.force_ports(lambda scale: scale.turns)

    # ------------------------------------------------------------ what is asked

    def found_places(self) -> Names:
        """Return the places where it may act; ("",) if there is no choice."""
        places = self.section.places
        return PLACES[places](self) if isinstance(places, str) else places or ("",)

    def reason(self) -> str | None:
        """Return why it cannot be tested: the first of its needs that is not met; None if all are."""
        anywhere = replace(self, section=replace(self.section, preferred=()))
        return next((why for need in self.section.needs if (why := NEEDS[need](anywhere))), None)

    def targets(self, place: str) -> "tuple[Target, ...]":
        """Return what a place stands for; a law acts at each."""
        if self.section.places == "skins at ports":
            port, _, skin = place.rpartition(", ")
            return (Target(port, number=SKINS[skin]),)
        if place == EVERY_PORT:
            return tuple(map(Target, self.state_ports))
        if self.section.places == "mains lines":
            line, _, channels = place.partition(", ")
            return (replace(self._channels_at(channels), number=float(line.split()[0])),)
        if self.section.places == CHANNELS_OR_ALL_OF_A_QUANTITY:
            return (self._channels_at(place),)
        return (Target(place or EVERY_CHANNEL),)

    def _channels_at(self, place: str) -> "Target":
        """Return what a place stands for that is a channel, or "all strain" and the like."""
        if place.startswith(ALL) and place not in self.setting.campaign.channels:
            return Target(EVERY_CHANNEL, place.removeprefix(ALL))
        return Target(place)


@dataclass(frozen=True)
class Target:
    """What a place stands for: a port, channel, run or logger, its quantity, and the number in its name.

    The number is the side of a skin or the frequency of a line [Hz].
    """

    name: str
    quantity: str = ""
    number: float = 0.0


# ---------------------------------------------------------------- places


def _or_all(names: Names) -> Names:
    return (EVERY_CHANNEL, *names) if len(names) > 1 else names


def _timed_gauges(asked: Asked) -> Names:
    """Return the gauges, else channels, that were read at more than one time since the campaign's start."""
    places = []
    for name in asked.strain_channels or asked.channels_of():
        times = [
            trial.time + (trial.start if trial.is_dynamic else 0.0)
            for trial in asked.setting.campaign.fitted
            if name in trial.channels and trial.time.size
        ]
        if times and max(map(np.max, times)) > max(min(map(np.min, times)), 0.0):
            places.append(name)
    return tuple(places)


def _zeroed_runs(asked: Asked) -> Names:
    """Return the runs whose trials have a displacement channel with a zero that is known at all."""
    names = asked.channels_of(
        lambda item: item.quantity is Quantity.DISPLACEMENT and not isinf(item.offset_deviation)
    )
    return tuple(dict.fromkeys(trial.run for trial in asked.trials if {*names}.intersection(trial.channels)))


def _loggers(asked: Asked) -> Names:
    """Return the loggers of a campaign; no choice where one records everything."""
    loggers = tuple(asked.setting.campaign.loggers)
    return loggers if len(loggers) > 1 else ("",)


def mains_lines(setting: Setting) -> Names:
    """Return the mains lines that can be seen, such as "50 Hz" or "50 or 400 Hz".

    A line whose alias makes less than one period in every record is an offset there and left out. Lines whose
    aliases differ by less than half a period in every record look alike and are one.
    """
    fitted = [trial for trial in setting.campaign.fitted if trial.is_dynamic]
    sampled = [(item.interval, float(item.time[-1] - item.time[0])) for item in fitted]

    def periods(frequency: float) -> FloatArray:
        return np.array([aliased(frequency, interval) * length for interval, length in sampled])

    groups: list[list[float]] = []
    for frequency in MAINS:
        seen = periods(frequency)
        if np.any(seen >= 1.0):
            alike = (group for group in groups if np.all(np.abs(seen - periods(group[0])) < 0.5))
            if (group := next(alike, None)) is None:
                groups.append(group := [])
            group.append(frequency)
    return tuple(" or ".join(f"{frequency:g}" for frequency in group) + " Hz" for group in groups)


def _channels_or_all_of_a_quantity(asked: Asked) -> Names:
    """Return the channels, and "all strain" and the like before them where several have a quantity."""
    quantities = [channel.quantity.value for channel in asked.channels]
    several = dict.fromkeys(ALL + quantity for quantity in quantities if quantities.count(quantity) > 1)
    return (*several, *asked.channels_of())


def _seen_lines(asked: Asked) -> Names:
    """Return the mains lines at channels, and at all channels of a quantity."""
    seen = _channels_or_all_of_a_quantity(asked)
    return tuple(f"{line}, {name}" for line in mains_lines(asked.setting) for name in seen)


PLACES: dict[str, Callable[[Asked], Names]] = {
    "ports": lambda asked: asked.setting.model.ports,
    "channels": Asked.channels_of,
    "channels, or all": lambda asked: _or_all(asked.channels_of()),
    CHANNELS_OR_ALL_OF_A_QUANTITY: _channels_or_all_of_a_quantity,
    "strain channels": lambda asked: asked.strain_channels,
    "strain channels, or all": lambda asked: _or_all(asked.strain_channels),
    "runs": lambda asked: tuple(dict.fromkeys(trial.run for trial in asked.setting.campaign.fitted)),
    "ports of forces": Asked.force_ports,
    # of forces that depend on where a port is
    "held ports": lambda asked: asked.force_ports(lambda scale: not scale.free),
    "turning ports": lambda asked: asked.turning_ports,
    "skins at ports": lambda asked: tuple(
        f"{port}, {skin}" for port in asked.force_ports() for skin in SKINS
    ),
    "ports of states": lambda asked: asked.state_ports,
    "ports of states, or all": lambda asked: asked.state_ports + (EVERY_PORT,) * (len(asked.state_ports) > 1),
    # a free gain absorbs an error of it
    "calibrated channels": lambda asked: asked.channels_of(lambda item: not isinf(item.gain_deviation)),
    "timed gauges": _timed_gauges,
    "zeroed runs": _zeroed_runs,
    "loggers": _loggers,
    "mains lines": _seen_lines,
}
"""What finds the places of a word; `[places]` of `sentences.toml` says why there are none."""


# ---------------------------------------------------------------- needs


KIND_NAMES = {kind: kind.value for kind in TrialKind} | {TrialKind.RINGDOWN: "ring-down"}
"""How a kind of trial is called in a sentence."""
NO_PORT: str = SENTENCES.tables["needs"]["no_port"]
"""Reason against effects that are forces within a structure or between it and the ground."""
TEMPERATURE_STEP = 0.1
"""Least range of temperatures [K] in a campaign from which an effect of temperature can show."""
INPUTS = DYNAMIC - {TrialKind.RINGDOWN}


def _trial(asked: Asked, kinds: Kinds = frozenset()) -> str | None:
    wanted = kinds or asked.section.acts_on
    names = [name for kind, name in KIND_NAMES.items() if kind in wanted]
    return (
        None
        if any(trial.kind in wanted for trial in asked.setting.campaign.fitted)
        else said("needs.trial", kinds=" or ".join(names))
    )


def _event(asked: Asked) -> str | None:
    campaign = asked.setting.campaign
    fitted = [campaign.moment_names(trial.name) for trial in campaign.fitted]
    if not asked.moments or any(asked.moments <= names for names in fitted):
        return None
    there = ", ".join(sorted(frozenset[str]().union(*fitted))) or "none"
    return said("needs.event", events=" and ".join(sorted(asked.moments)), there=there)


def _law(asked: Asked) -> str | None:
    model = asked.setting.model
    for primitive in asked.primitives:
        if primitive not in SENSORS and not model.supports(primitive):
            no_port = issubclass(primitive, PortForce) and not model.ports
            what = NO_PORT if no_port else said("needs.cannot_carry", kind=primitive.kind)
            return said("needs.model", model=model.name, what=what)
    return None


def _place(asked: Asked) -> str | None:
    if asked.found_places():
        return None
    return SENTENCES.tables["places"].get(asked.section.places) or said(
        "needs.place", effect=asked.section.identifier
    )


def _port(asked: Asked) -> str | None:
    model = asked.setting.model.name
    if not asked.setting.model.ports:
        return said("needs.model", model=model, what=NO_PORT)
    return None if asked.force_ports() else said("needs.only_states", model=model)


def _temperature(asked: Asked) -> str | None:
    if asked.setting.campaign.reference_temperature is None:
        return said("needs.no_temperature")
    values = [trial.temperature for trial in asked.setting.campaign.fitted]
    varied = bool(values) and np.ptp(np.concatenate(values)) >= TEMPERATURE_STEP
    return None if varied else said("needs.one_temperature", step=TEMPERATURE_STEP)


def _sees_across(asked: Asked) -> bool:
    outputs = [asked.setting.campaign.channels[name].output for name in asked.strain_channels]
    return all(asked.setting.model.output_quantity(name + part) for name in outputs for part in ACROSS)


def _met(holds: Callable[[Asked], object], sentence: str) -> Callable[[Asked], str | None]:
    """Return what tells that something does not hold of a setting."""
    return lambda asked: None if holds(asked) else said(sentence, model=asked.setting.model.name)


NEEDS: dict[str, Callable[[Asked], str | None]] = {
    "trial": _trial,
    "event": _event,
    "law": _law,
    "place": _place,
    "port": _port,
    "turning port": _met(lambda asked: asked.turning_ports, "places.turning ports"),
    "stations": _met(lambda asked: asked.setting.model.stations is not None, "needs.no_length"),
    "force": _met(
        lambda asked: any(np.any(trial.force != 0.0) for trial in asked.setting.campaign.fitted),
        "needs.no_force",
    ),
    "temperature": _temperature,
    "channel": _met(lambda asked: asked.setting.campaign.fitted, "needs.no_channel"),
    "second clock": _met(
        lambda asked: len(asked.setting.campaign.loggers) != 1 or _trial(asked, INPUTS),
        "needs.no_second_clock",
    ),
    "input": lambda asked: _trial(asked, INPUTS),
    "strain across": _met(_sees_across, "needs.no_strain_across"),
}
"""What tells that a need is not met, by its word."""
