"""An effect of a file in a setting: its trials, its channels and ports, and its targets."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from discrepancy.campaign.records import Channel, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import ROW, EffectKeys, Number, Setting
from discrepancy.system.interface import Model
from discrepancy.system.scales import PortScale
from discrepancy.system.structures import StructureModel
from fe.runtime.patch import EVERY_CHANNEL, LocalStiffnessLoss, Primitive
from fe.runtime.port_laws import PLANFORM
from fe.runtime.wing_rows import PORTS

Names = tuple[str, ...]
DYNAMIC = frozenset({TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN})
SKINS = {"lower skin": 1.0, "upper skin": -1.0}
"""Skin with a crack, and the sign of x that opens it: upward bending stretches the lower skin."""
SIDES = {"open at positive x": 1.0, "open at negative x": -1.0}
"""Side on which a crack opens in a model without skins, and the sign of the port's x there."""
MOTION_WORDS = {
    **{axis: f"shift along {axis}" for axis in "xyz"},
    **{f"r{axis}": f"turn about {axis}" for axis in "xyz"},
}
"""Words for each motion of a support, and of an interface, in the names of places."""
_AXES_OF_INTERFACES = {"n": "its normal", "s": "its longer extent", "t": "its shorter extent"}
MOTION_WORDS |= {axis: f"shift along {words}" for axis, words in _AXES_OF_INTERFACES.items()}
MOTION_WORDS |= {f"r{axis}": f"turn about {words}" for axis, words in _AXES_OF_INTERFACES.items()}
MOTION_OF_WORDS = {words: motion for motion, words in MOTION_WORDS.items()}
"""The motion of a support or an interface by these words."""
PREPOSITIONS = {
    "offsets of loads": "along",
    "tilts of loads": "towards",
    "offsets of gauges": "shifted",
}
"""Words before the axis in the names of places, such as "pull, along x"."""
EVERY_PORT = "every port"
"""Place of a law that acts at all ports of states."""
ALL = "all "
"""Prefix of the place that stands for all channels of a quantity."""
CHANNELS_OR_ALL_OF_A_QUANTITY = "channels, or all of a quantity"
"""Word of `PLACES` for single channels, and for all channels of a quantity."""
USUAL = ("trial", "event", "law", "place")
"""Needs of an effect whose file states none."""
Text = Annotated[str, Field(min_length=0)]


@dataclass(frozen=True, kw_only=True)
class EffectSection(EffectKeys):
    """The table `[[effect]]`, or the whole of a file with one effect."""

    __pydantic_config__ = ROW

    primitives: tuple[dict[str, Text | Number], ...] = ()
    """Primitives of the patch, whose values may be expressions [unit of the primitive]."""
    places: str | tuple[str, ...] | None = None
    """A word of `PLACES`, the names of the places, or None if there is no choice."""
    preferred: tuple[str, ...] = ()
    """Ports of a wing that stand for all its ports."""
    needs: tuple[str, ...] = USUAL
    """Words of `NEEDS`."""
    events: tuple[str, ...] = ()
    """Names of events that expressions use."""


@dataclass(frozen=True)
class EffectsFile:
    """A file with several effects."""

    __pydantic_config__ = ROW

    effect: tuple[EffectSection, ...]
    """The effects."""


def _has_ports_of_a_wing(model: Model) -> bool:
    """Return whether a model has the ports of a wing, of which some may stand for the others.

    A structure from a file is excluded: its file names exactly the ports that may be used.
    """
    return set(model.ports) <= set(PORTS) and not isinstance(model, StructureModel)


@dataclass(frozen=True)
class EffectInSetting:
    """An effect of the catalogue for one campaign and one model: where it may act.

    Attributes
    ----------
    setting : Setting
        Campaign and model.
    section : EffectSection
        Content of the effect's file.
    primitives : tuple of type
        Kinds of primitives that the effect consists of.
    event_times : frozenset of str
        Names of the event times that the effect's expressions use, such as `pump` and `pump_until`.
        The effect acts only in trials that have all of them.
    """

    setting: Setting
    section: EffectSection
    primitives: tuple[type[Primitive], ...]
    event_times: frozenset[str]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Fitted trials of the kinds that the effect acts on."""
        kinds = self.section.acts_on
        return tuple(trial for trial in self.setting.campaign.fitted if trial.kind in kinds)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels that are recorded in at least one of the trials that the effect acts on."""
        recorded = {name for trial in self.trials for name in trial.channels}
        channels = self.setting.campaign.channels
        return tuple(channel for name, channel in channels.items() if name in recorded)

    def channels_of(self, condition: Callable[[Channel], bool] = lambda channel: True) -> Names:
        """Return the names of the effect's channels that fulfil a condition; all by default."""
        return tuple(channel.name for channel in self.channels if condition(channel))

    @property
    def strain_channels(self) -> Names:
        """Names of the strain channels in the trials that the effect acts on."""
        return self.channels_of(lambda channel: channel.quantity is Quantity.STRAIN)

    @property
    def state_ports(self) -> Names:
        """Ports of states such as a level or a temperature; a law at such a port is a flow."""
        return tuple(name for name, scale in self.setting.scales.ports.items() if scale.of_state)

    def force_ports(self, condition: Callable[[PortScale], bool] = lambda scale: True) -> Names:
        """Return the ports of the model at which a force of this effect may act.

        Ports of states are excluded, because a law at such a port is a flow. If the model is a wing
        that has some of the effect's `preferred` ports, only these are returned. Otherwise all
        other ports of the model are returned.

        Parameters
        ----------
        condition : callable
            Condition on the natural scales of a port; always true by default. A port without
            natural scales is kept, because the condition cannot be evaluated for it.
        """
        model = self.setting.model
        scales = self.setting.scales.ports
        state_ports = self.state_ports
        ports = tuple(port for port in model.ports if port not in state_ports)
        if _has_ports_of_a_wing(model):
            preferred = []
            for name in self.section.preferred:
                # The port "planform" (a force spread over the area) is not in `model.ports`. A wing
                # that can carry such a force has scales for it; any other wing has "span" instead.
                port = "span" if name == PLANFORM and name not in scales else name
                if port in ports or port == PLANFORM:
                    preferred.append(port)
            ports = tuple(preferred) or ports
        return tuple(port for port in ports if port not in scales or condition(scales[port]))

    @property
    def crack_sides(self) -> Names:
        """Sides of a port on which a crack may be: the skins of a wing, or the signs of x."""
        return tuple(SKINS) if self.setting.model.supports(LocalStiffnessLoss) else tuple(SIDES)

    @property
    def turning_ports(self) -> Names:
        """Force ports whose motion changes direction, for forces with a memory or a zero position.

        Such a force cannot be distinguished from drag at a body that moves in one direction only,
        as in a fall, because speed and distance grow together.
        """
        return self.force_ports(lambda scale: scale.turns)

    def targets(self, place: str) -> "tuple[Target, ...]":
        """Return the ports, channels, runs or loggers that a place stands for.

        Parameters
        ----------
        place : str
            Name of one of the effect's places, such as a port, "root, lower skin", "rail, open at
            positive x" or "all strain"; empty if there is no choice.

        Returns
        -------
        tuple of Target
            Targets, at each of which all primitives of the effect act; several only for
            `EVERY_PORT`.
        """
        if self.section.places == "skins at ports":
            port, _, skin = place.rpartition(", ")
            return (Target(port, number=(SKINS | SIDES)[skin]),)
        if place == EVERY_PORT:
            return tuple(Target(port) for port in self.state_ports)
        if self.section.places in ("supports", "interfaces"):
            if not place:  # no choice, such as at a wing
                ((support, motion),) = self.setting.model.support_motions
                return (Target(support, motion=motion),)
            support, _, words = place.rpartition(", ")
            return (Target(support, motion=MOTION_OF_WORDS[words]),)
        if self.section.places in PREPOSITIONS:
            control, _, axis = place.rpartition(f", {PREPOSITIONS[self.section.places]} ")
            return (Target(control, motion=axis),)
        if self.section.places == "mains lines":
            line, _, channels = place.partition(", ")
            frequency = float(line.split()[0])
            return (replace(self._channels_at(channels), number=frequency),)
        if self.section.places == CHANNELS_OR_ALL_OF_A_QUANTITY:
            return (self._channels_at(place),)
        return (Target(place or EVERY_CHANNEL),)

    def _channels_at(self, place: str) -> "Target":
        """Return the target of a place that names one channel, or all channels of a quantity.

        "all strain" stands for all strain channels, unless a channel has this name.
        """
        if place.startswith(ALL) and place not in self.setting.campaign.channels:
            return Target(EVERY_CHANNEL, place.removeprefix(ALL))
        return Target(place)


@dataclass(frozen=True)
class Target:
    """The ports, channels, runs or loggers that a place of an effect stands for.

    Attributes
    ----------
    name : str
        Port, channel, run or logger.
    quantity : str
        Quantity of the channels that are meant; empty for any.
    number : float
        Number in the place's name: the side of a skin, or the frequency of a line [Hz].
    motion : str
        Motion of a support or an interface, such as "rx", or the axis of a change of a load.
    """

    name: str
    quantity: str = ""
    number: float = 0.0
    motion: str = ""
