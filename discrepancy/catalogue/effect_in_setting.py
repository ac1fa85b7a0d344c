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
from fe.runtime.patch import EVERY_CHANNEL, Primitive
from fe.runtime.port_laws import PLANFORM
from fe.runtime.wing_rows import PORTS

Names = tuple[str, ...]
DYNAMIC = frozenset({TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN})
SKINS = {"lower skin": 1.0, "upper skin": -1.0}
"""Skin with a crack, and the sign of x that opens it: upward bending stretches the lower skin."""
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
    """The table `[[effect]]`, or the whole of a file with one effect.

    Attributes
    ----------
    primitives : tuple of dict
        Primitives of the patch, whose values may be expressions.
    places : str, tuple of str or None
        A word of `PLACES`, the names of the places, or None if there is no choice.
    preferred : tuple of str
        Ports of a wing that stand for its others.
    needs : tuple of str
        Words of `NEEDS`.
    events : tuple of str
        Names of events that expressions use.
    """

    __pydantic_config__ = ROW

    primitives: tuple[dict[str, Text | Number], ...] = ()
    places: str | tuple[str, ...] | None = None
    preferred: tuple[str, ...] = ()
    needs: tuple[str, ...] = USUAL
    events: tuple[str, ...] = ()


def _has_ports_of_a_wing(model: Model) -> bool:
    """Return whether some ports of a model may stand for its others, as those of a wing do.

    The file of a structure names the ports that it means.
    """
    return set(model.ports) <= set(PORTS) and not isinstance(model, StructureModel)


@dataclass(frozen=True)
class EffectInSetting:
    """An effect of a file in a setting: where it may act there, and why it cannot be tested.

    Attributes
    ----------
    setting : Setting
        Campaign and model.
    section : EffectSection
        Content of its file. The port "planform" of a force that is spread over an area is "span" in
        a model without one.
    primitives : tuple of type
        Kinds of primitives that it consists of.
    moments : frozenset of str
        Moments of events that its expressions use; it acts in trials that have all of them.
    """

    setting: Setting
    section: EffectSection
    primitives: tuple[type[Primitive], ...]
    moments: frozenset[str]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Fitted trials that it changes."""
        kinds = self.section.acts_on
        return tuple(trial for trial in self.setting.campaign.fitted if trial.kind in kinds)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of these trials."""
        recorded = {name for trial in self.trials for name in trial.channels}
        channels = self.setting.campaign.channels
        return tuple(channel for name, channel in channels.items() if name in recorded)

    def channels_of(self, condition: Callable[[Channel], bool] = lambda channel: True) -> Names:
        """Return the names of its channels that fulfil a condition; all by default."""
        return tuple(channel.name for channel in self.channels if condition(channel))

    @property
    def strain_channels(self) -> Names:
        """Names of its strain channels."""
        return self.channels_of(lambda channel: channel.quantity is Quantity.STRAIN)

    @property
    def state_ports(self) -> Names:
        """Ports of states, at which laws are flows."""
        return tuple(name for name, scale in self.setting.scales.ports.items() if scale.of_state)

    def force_ports(self, condition: Callable[[PortScale], bool] = lambda scale: True) -> Names:
        """Return the ports at which forces may act.

        For a wing these are the `preferred` ones that it has, otherwise all.

        Parameters
        ----------
        condition : callable
            Condition on the natural scales of a port; all ports by default.
        """
        model = self.setting.model
        scales = self.setting.scales.ports
        state_ports = self.state_ports
        ports = tuple(port for port in model.ports if port not in state_ports)
        if _has_ports_of_a_wing(model):
            preferred = []
            for name in self.section.preferred:
                port = "span" if name == PLANFORM and name not in scales else name
                if port in ports or port == PLANFORM:
                    preferred.append(port)
            ports = tuple(preferred) or ports
        return tuple(port for port in ports if port not in scales or condition(scales[port]))

    @property
    def turning_ports(self) -> Names:
        """Ports whose motion turns or is held, for forces with a memory or a zero.

        A body that moves one way only, as in a fall, cannot distinguish such a force from drag: its
        speed and its way grow together.
        """
        return self.force_ports(lambda scale: scale.turns)

    def targets(self, place: str) -> "tuple[Target, ...]":
        """Return the targets of a place; a law acts at each of them."""
        if self.section.places == "skins at ports":
            port, _, skin = place.rpartition(", ")
            return (Target(port, number=SKINS[skin]),)
        if place == EVERY_PORT:
            return tuple(Target(port) for port in self.state_ports)
        if self.section.places == "mains lines":
            line, _, channels = place.partition(", ")
            frequency = float(line.split()[0])
            return (replace(self._channels_at(channels), number=frequency),)
        if self.section.places == CHANNELS_OR_ALL_OF_A_QUANTITY:
            return (self._channels_at(place),)
        return (Target(place or EVERY_CHANNEL),)

    def _channels_at(self, place: str) -> "Target":
        """Return the target of a place that is a channel, or "all strain" and the like."""
        if place.startswith(ALL) and place not in self.setting.campaign.channels:
            return Target(EVERY_CHANNEL, place.removeprefix(ALL))
        return Target(place)


@dataclass(frozen=True)
class Target:
    """What a place stands for in a primitive.

    Attributes
    ----------
    name : str
        Port, channel, run or logger.
    quantity : str
        Quantity of the channels that are meant; empty for any.
    number : float
        Number in the place's name: the side of a skin, or the frequency of a line [Hz].
    """

    name: str
    quantity: str = ""
    number: float = 0.0
