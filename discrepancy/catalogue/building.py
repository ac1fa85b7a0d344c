"""What the builders of effects share: places, scales of channels and ports, reasons against a test.

Everything here is a function at module level or a `functools.partial` of one, so that an effect can be
sent to another process.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from discrepancy.campaign.records import Campaign, Channel, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import PortScale
from fe.runtime.patch import EVERY_CHANNEL, PortForce, Primitive
from fe.runtime.planform_forces import PLANFORM

Check = Callable[[Setting], str | None]
Places = Callable[[Setting], tuple[str, ...]]

KIND_NAMES = {
    TrialKind.STATIC: "static",
    TrialKind.RINGDOWN: "ring-down",
    TrialKind.FORCED: "forced",
    TrialKind.DRIVEN: "driven",
    TrialKind.FLIGHT: "flight",
}
"""How a kind of trial is called in a sentence."""

NO_PORT = "has no port where an internal force can act"
"""Reason against effects that are forces within a structure or between it and the ground."""


EVERY_TRIAL = frozenset(TrialKind)
DYNAMIC = frozenset({TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN})
LOADED = frozenset({TrialKind.STATIC, TrialKind.FORCED, TrialKind.DRIVEN})

TEMPERATURE_STEP = 0.1
"""Least range of temperatures [K] in a campaign from which an effect of temperature can show."""


# ---------------------------------------------------------------- what the campaign holds


def trials(setting: Setting, *kinds: TrialKind) -> tuple[Trial, ...]:
    """Return the trials of the given kinds (all kinds if none is given) that may be used for fitting."""
    return tuple(trial for trial in setting.campaign.fitted if not kinds or trial.kind in kinds)


def channels(
    setting: Setting, *quantities: Quantity, kinds: frozenset[TrialKind] = EVERY_TRIAL
) -> tuple[Channel, ...]:
    """Return the channels of the given quantities (all if none is given) that trials of `kinds` recorded."""
    recorded = {name for trial in trials(setting, *kinds) for name in trial.channels}
    return tuple(
        channel
        for name, channel in setting.campaign.channels.items()
        if name in recorded and (not quantities or channel.quantity in quantities)
    )


def gauges(setting: Setting, *, kinds: frozenset[TrialKind] = EVERY_TRIAL) -> tuple[Channel, ...]:
    """Return the strain channels; in a campaign without any, every channel."""
    return channels(setting, Quantity.STRAIN, kinds=kinds) or channels(setting, kinds=kinds)


def largest_reading(
    setting: Setting, names: tuple[str, ...], kinds: frozenset[TrialKind] = EVERY_TRIAL
) -> float:
    """Return the largest magnitude among the used readings of channels [its unit], 1 if all are zero."""
    return _largest_reading(_Same(setting.campaign), names, kinds)


@dataclass(frozen=True, eq=False)
class _Same:
    """A campaign, equal to itself only; it holds arrays, so it has no hash of its own."""

    campaign: Campaign

    def __hash__(self) -> int:
        return id(self.campaign)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.campaign is other.campaign


@lru_cache(maxsize=512)  # patches are built at every step of a fit
def _largest_reading(same: _Same, names: tuple[str, ...], kinds: frozenset[TrialKind]) -> float:
    largest = 0.0
    for trial in same.campaign.fitted:
        if trial.kind not in kinds:
            continue
        for column, name in enumerate(trial.channels):
            if name in names:
                kept = trial.values[trial.used[:, column], column]
                if kept.size:
                    largest = max(largest, float(np.max(np.abs(kept))))
    return largest if largest > 0.0 and np.isfinite(largest) else 1.0


def temperature_range(setting: Setting) -> float:
    """Return highest less lowest temperature [K] of the campaign's trials, 0 where it was not recorded."""
    if setting.campaign.reference_temperature is None:
        return 0.0
    values = [trial.temperature for trial in trials(setting) if trial.temperature.size]
    return float(np.ptp(np.concatenate(values))) if values else 0.0


def campaign_times(setting: Setting, name: str) -> tuple[float, float]:
    """Return the first and the last time at which a channel was read [s since the campaign's start]."""
    times = [
        trial.time + (trial.start if trial.is_dynamic else 0.0)
        for trial in trials(setting)
        if name in trial.channels and trial.time.size
    ]
    if not times:
        return 0.0, 0.0
    joined = np.concatenate(times)
    return float(joined.min()), float(joined.max())


def port_scale(setting: Setting, port: str) -> PortScale:
    """Return the natural scales of a port.

    Raises
    ------
    CatalogueError
        If the model has no such port.
    """
    try:
        return setting.scales.ports[port]
    except KeyError as cause:
        raise CatalogueError(
            f"The model {setting.model.name!r} has no port {port!r}; "
            f"it has {', '.join(setting.scales.ports) or 'none'}."
        ) from cause


LARGEST_SHARE = 0.9
"""Largest share of a port's stiffness at rest that an effect takes away; beyond it, it is built as this."""


def removed_stiffness(setting: Setting, port: str, share: float) -> float:
    """Return a share of the port's stiffness at rest [N/m or N m/rad], at most `LARGEST_SHARE` of it."""
    scale = port_scale(setting, port)
    at_rest = scale.stiffness if scale.static_stiffness is None else scale.static_stiffness
    return min(share, LARGEST_SHARE) * at_rest


# ---------------------------------------------------------------- places


def at_ports(*preferred: str) -> Places:
    """Return the places of an internal force: those of `preferred` that the model has, else all its ports."""
    return partial(_ports, preferred)


def _ports(preferred: tuple[str, ...], setting: Setting) -> tuple[str, ...]:
    flows = state_ports(setting)
    known = tuple(port for port in setting.model.ports() if port not in flows)
    return tuple(port for port in preferred if port in known) or known


def state_ports(setting: Setting) -> tuple[str, ...]:
    """Return the ports of states, at which laws are flows."""
    return tuple(name for name, scale in setting.scales.ports.items() if scale.of_state)


def at_held_ports(*preferred: str) -> Places:
    """Return the same without ports that nothing holds, for forces that depend on where a port is."""
    return partial(_held_ports, preferred)


def _held_ports(preferred: tuple[str, ...], setting: Setting) -> tuple[str, ...]:
    free = {name for name, scale in setting.scales.ports.items() if scale.free}
    return tuple(port for port in _ports(preferred, setting) if port not in free)


ONE_WAY = "No port has a motion that turns: one that goes one way shows no memory and no zero."


def turning(places: Places) -> Places:
    """Return those of `places` whose motion turns or is held, for forces with a memory or a zero.

    What moves one way only, a body that falls, cannot tell such a force from drag: speed and way grow as one.
    """
    return partial(_turning, places)


def _turning(places: Places, setting: Setting) -> tuple[str, ...]:
    ports = setting.scales.ports
    return tuple(name for name in places(setting) if name not in ports or ports[name].turns)


def turns_somewhere(places: Places) -> Check:
    """Return the check that one of the places turns; where there is none at all, others say so."""
    return partial(_goes_one_way, places)


def _goes_one_way(places: Places, setting: Setting) -> str | None:
    return ONE_WAY if places(setting) and not _turning(places, setting) else None


def over_the_planform(*beside: str) -> Places:
    """Return the places of a force that is spread over the structure, and of the like at ports `beside`.

    A model without a planform has it at its mean displacement, "span", or else at all ports.
    """
    return partial(_over_the_planform, beside)


def _over_the_planform(beside: tuple[str, ...], setting: Setting) -> tuple[str, ...]:
    if PLANFORM not in setting.scales.ports:
        return _ports((*beside, "span"), setting)
    return (*(port for port in setting.model.ports() if port in beside), PLANFORM)


def at_gauges(setting: Setting) -> tuple[str, ...]:
    """Return the names of the strain channels; in a campaign without any, of every channel."""
    return tuple(channel.name for channel in gauges(setting))


def at_strain_channels(setting: Setting) -> tuple[str, ...]:
    """Return the names of the strain channels."""
    return tuple(channel.name for channel in channels(setting, Quantity.STRAIN))


def with_all(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names, after `EVERY_CHANNEL` if there are several."""
    return (EVERY_CHANNEL, *names) if len(names) > 1 else names


# ---------------------------------------------------------------- reasons


def needs(*checks: Check) -> Check:
    """Return the check that gives the first reason of several, None if none of them has one."""
    return partial(_first_reason, checks)


def _first_reason(checks: tuple[Check, ...], setting: Setting) -> str | None:
    return next((reason for check in checks if (reason := check(setting)) is not None), None)


def trial_of(kinds: frozenset[TrialKind]) -> Check:
    """Return the check for a trial of one of the kinds."""
    return partial(_lacks_trial, kinds)


def _lacks_trial(kinds: frozenset[TrialKind], setting: Setting) -> str | None:
    if trials(setting, *kinds):
        return None
    names = [name for kind, name in KIND_NAMES.items() if kind in kinds]
    return f"The campaign has no {' or '.join(names)} trial to fit."


def carried(*primitives: type[Primitive]) -> Check:
    """Return the check that the model can carry the primitives."""
    return partial(_cannot_carry, primitives)


def _cannot_carry(primitives: tuple[type[Primitive], ...], setting: Setting) -> str | None:
    for primitive in primitives:
        if not setting.model.supports(primitive):
            if issubclass(primitive, PortForce) and not setting.model.ports():
                return f"The model {setting.model.name!r} {NO_PORT}."
            return f"The model {setting.model.name!r} cannot carry the primitive {primitive.kind!r}."
    return None


def has_port(setting: Setting) -> str | None:
    """Return why no internal force can act, None if one can."""
    if not setting.model.ports():
        return f"The model {setting.model.name!r} {NO_PORT}."
    if not _ports((), setting):
        return f"All ports of the model {setting.model.name!r} are of states, where flows act and no forces."
    return None


def has_stations(setting: Setting) -> str | None:
    """Return why no place along the structure can be named, None if one can."""
    if setting.model.stations() is not None:
        return None
    return f"The model {setting.model.name!r} has no length along which the effect could have its place."


def applied_force(setting: Setting) -> str | None:
    """Return why no effect of the applied force can show, None if one can."""
    if any(np.any(trial.force != 0.0) for trial in trials(setting, *LOADED)):
        return None
    return "No static or forced trial of the campaign has an applied force."


def temperature_varies(setting: Setting) -> str | None:
    """Return why no effect of temperature can show, None if one can."""
    if setting.campaign.reference_temperature is None:
        return "No temperatures were recorded in the campaign."
    if temperature_range(setting) < TEMPERATURE_STEP:
        return f"All trials of the campaign have the same temperature within {TEMPERATURE_STEP:g} K."
    return None


def somewhere(places: Places, reason: str) -> Check:
    """Return the check that gives `reason` where there is no place to act at."""
    return partial(_no_place, places, reason)


def _no_place(places: Places, reason: str, setting: Setting) -> str | None:
    return None if places(setting) else reason


def along_span(setting: Setting, fraction: float) -> float:
    """Return the station [m] at a fraction of the modelled length (0 without a length)."""
    ends = setting.model.stations()
    return 0.0 if ends is None else ends[0] + fraction * (ends[1] - ends[0])


def at_least_zero(values: Mapping[str, float], name: str) -> float:
    """Return a shape value whose family ends at zero; its prior reaches below zero."""
    return max(values[name], 0.0)
