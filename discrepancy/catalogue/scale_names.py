"""Names of scales in the expressions of effects, and their values where a patch is built."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf, pi
from operator import attrgetter

import numpy as np
from scipy.special import beta

from discrepancy.catalogue.effect_in_setting import EffectInSetting, Target
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CatalogueError
from discrepancy.system.scales import PortScale
from fe.runtime.patch import EVERY_CHANNEL, RegionStiffnessLoss

LARGEST_SHARE = 0.9
"""Largest friction force at a port, as a fraction of its elastic force."""
LARGEST_LOSS = 0.9
"""Largest stiffness loss of a damage region if the model states none."""


@dataclass(frozen=True)
class BuildContext:
    """The effect, place and values for which a patch is built.

    The functions in `SCALES` compute from it the values of the names in the effect's expressions.

    Attributes
    ----------
    effect : EffectInSetting
        The effect in its setting.
    target : Target
        What its place stands for.
    values : mapping of str to float
        Values of its parameters and shape by name.
    """

    effect: EffectInSetting
    target: Target
    values: Mapping[str, float]

    @property
    def setting(self) -> Setting:
        """Campaign and model."""
        return self.effect.setting

    @property
    def port(self) -> PortScale:
        """Natural scales of the port; raises `CatalogueError` if the model has no such port."""
        ports = self.setting.scales.ports
        if self.target.name not in ports:
            port_names = ", ".join(ports) or "none"
            raise CatalogueError(
                f"The model {self.setting.model.name!r} has no port {self.target.name!r}; it has "
                f"{port_names}."
            )
        return ports[self.target.name]


def loss_integral(velocity_exponent: float, displacement_exponent: float) -> float:
    """Return the energy that a force dissipates in a cycle, over 2 F_0 A.

    Under the motion x = A sin w t, the force F_0 |v / (A w)|^p |x / A|^a sgn v dissipates F_0 A
    times the integral of |cos|^(p + 1) |sin|^a over a turn, which is twice the beta function of
    (p + 2) / 2 and (a + 1) / 2. For Coulomb friction (p = a = 0) the result is 2.

    Parameters
    ----------
    velocity_exponent, displacement_exponent : float
        Exponents p and a.
    """
    return float(beta(0.5 * velocity_exponent + 1.0, 0.5 * displacement_exponent + 0.5))


def _cycle_loss(context: BuildContext) -> float:
    """Return the energy that a force |v|^p |x|^a dissipates in a cycle, over 2 F_0 A.

    At a free port the exponent a counts as zero. A force that is spread over an area is summed over
    its places.
    """
    p = max(context.values["velocity_exponent"], 0.0)
    a = max(context.values["displacement_exponent"], 0.0) * _is_held(context)
    return loss_integral(p, a) * context.port.mean_power(p + a + 1.0)


def _is_held(context: BuildContext) -> float:
    """Return 1 if something holds the port, else 0: a free port has no zero of displacement."""
    return 0.0 if context.port.free else 1.0


def _holding_force(context: BuildContext) -> float:
    """Return the largest friction force at a port that does not hold the port still.

    This force is `LARGEST_SHARE` of the elastic force at the port's natural displacement. There is
    no limit (infinity) for a force that vanishes at rest (a velocity exponent of one or more), for
    a port that a drive moves, or if the stiffness at rest is not known.
    """
    port = context.port
    vanishes_at_rest = context.values["velocity_exponent"] >= 1.0
    if port.static_stiffness is None or port.driven or vanishes_at_rest:
        return inf
    return LARGEST_SHARE * port.static_stiffness * port.displacement


def _port_scale(name: str, fallback: str) -> Callable[[BuildContext], float]:
    """Return a function that returns a natural scale of the port, an attribute of `PortScale`.

    If the scale is None, the function returns the scale `fallback` instead.
    """

    def scale(context: BuildContext) -> float:
        value: float | None = getattr(context.port, name)
        return getattr(context.port, fallback) if value is None else value

    return scale


def _largest_reading(context: BuildContext) -> float:
    """Return the largest absolute reading that is used at the place [its unit]; 1 if all are zero.

    The reading is computed once and kept in the setting, because a fit builds patches at every
    step.
    """
    cached_readings = context.setting.largest
    key = (context.target, context.effect.section.acts_on)
    if key not in cached_readings:
        largest = _compute_largest_reading(context)
        cached_readings[key] = largest if largest > 0.0 and np.isfinite(largest) else 1.0
    return cached_readings[key]


def _compute_largest_reading(context: BuildContext) -> float:
    """Return the largest absolute reading of the channels on which an effect acts.

    The result has the unit of the channels, and is 0 if they have no reading. Readings that are
    marked as not used are left out.
    """
    target = context.target
    target_channels: tuple[str, ...] = (target.name,)
    if target.name == EVERY_CHANNEL:
        # all channels that measure the quantity of the target; "" stands for any quantity
        target_channels = context.effect.channels_of(
            lambda channel: target.quantity in ("", channel.quantity.value)
        )
    largest = 0.0
    for trial in context.effect.trials:  # the trials in which the effect can act
        for column, name in enumerate(trial.channels):
            used = trial.used[:, column]
            if name in target_channels and used.any():
                readings = np.abs(trial.values[used, column])
                largest = max(largest, float(np.max(readings)))
    return largest


def _sampling_interval(context: BuildContext) -> float:
    """Return the median time between samples of the trials that the effect acts on [s], or 0."""
    intervals = [np.diff(trial.time) for trial in context.effect.trials if len(trial.time) > 1]
    return float(np.median(np.concatenate(intervals))) if intervals else 0.0


def _largest_release(context: BuildContext) -> float:
    """Return the largest release displacement of the fitted trials that record the channel [m].

    Its unit is V or none if that is the unit of the release. The result is 1 if no such trial has a
    release.
    """
    releases = [
        abs(trial.release.displacement)
        for trial in context.setting.campaign.fitted
        if trial.release is not None and context.target.name in trial.channels
    ]
    return max(releases, default=0.0) or 1.0


def _largest_region_loss(context: BuildContext) -> float:
    """Return the largest further loss of stiffness of the damage region that the place names.

    The losses that the campaign and a patch of the model state, and the further loss, multiply.
    Together they may reach the largest loss for which the model holds.
    """
    region = context.target.name
    model = context.setting.model
    largest_loss = min(model.largest_losses.get(region, LARGEST_LOSS), LARGEST_LOSS)
    stated_losses = [
        float(np.max(trial.health[:, trial.regions.index(region)], initial=0.0))
        for trial in context.setting.campaign.trials
        if region in trial.regions
    ]
    remaining = 1.0 - max(stated_losses, default=0.0)
    for primitive in model.patch:
        if isinstance(primitive, RegionStiffnessLoss) and primitive.region == region:
            remaining *= 1.0 - primitive.loss
    return max(1.0 - (1.0 - largest_loss) / remaining, 0.0)


def _region_has_gauge(context: BuildContext) -> float:
    """Return 1 if a gauge sits on the patch that the place names, else 0."""
    return float(context.target.name in context.setting.model.places_with_gauges)


def _support_compliance(context: BuildContext) -> float:
    """Return the compliance of a support's or interface's motion that doubles the structure's."""
    target = context.target
    return context.setting.scales.support_compliance(target.name, target.motion)


def _mass_reach(context: BuildContext) -> float:
    """Return the distance from the place within which a mass is nearest to it [m]."""
    return context.setting.model.mass_reaches.get(context.target.name, 0.0)


def _station_of_end(end: int, context: BuildContext) -> float:
    """Return the station of an end of the model [m]: 0 for its root, 1 for its tip."""
    stations = context.setting.model.stations or (0.0, 0.0)
    return stations[end]


_SCALES_OF_MODEL = (
    "length",
    "tip_stiffness",
    "modal_mass",
    "angular_frequency",
    "force",
    "load_factor",
    "duration",
    "campaign_time",
)
SCALES: dict[str, Callable[[BuildContext], float]] = {
    **{name: attrgetter(f"setting.scales.{name}") for name in _SCALES_OF_MODEL},
    "pi": lambda context: pi,
    "root_station": partial(_station_of_end, 0),
    "tip_station": partial(_station_of_end, 1),
    "largest_reading": _largest_reading,
    "largest_release": _largest_release,
    "sampling_interval": _sampling_interval,
    "region_largest_loss": _largest_region_loss,
    "region_has_gauge": _region_has_gauge,
    "support_compliance": _support_compliance,
    "interface_compliance": _support_compliance,
    "mass_reach": _mass_reach,
    "number": lambda context: context.target.number,
    "port_displacement": lambda context: context.port.displacement,
    "port_stiffness": lambda context: context.port.stiffness,
    "port_angular_frequency": lambda context: context.port.angular_frequency,
    "port_stiffness_at_rest": _port_scale("static_stiffness", "stiffness"),
    "port_largest_displacement": _port_scale("largest_displacement", "displacement"),
    "port_holding_force": _holding_force,
    "port_is_held": _is_held,
    "mean_power": lambda context: context.port.mean_power(context.values["exponent"] + 1.0),
    "cycle_loss": _cycle_loss,
}
"""Values [SI] of the names in expressions, as functions of where a patch is built.

`number` is the number in the name of the place (side of a skin, frequency of a line), `mean_power`
that of the motion under a spread force with `exponent`.
"""
SHAPES_OF_SCALES: dict[str, set[str]] = {
    "mean_power": {"exponent"},
    "cycle_loss": {"velocity_exponent", "displacement_exponent"},
    "port_holding_force": {"velocity_exponent"},
}
