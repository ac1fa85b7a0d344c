"""What the names in an entry's arithmetic stand for: natural scales of campaign, model and place.

A force F = F_0 |v / (A w)|^p |x / A|^a sgn v takes F_0 A 2 B((p + 2) / 2, (a + 1) / 2) from a harmonic motion
x = A sin w t in each cycle (B is the beta function), a viscous damper of ratio zeta 2 pi zeta k A^2. Equal
losses give the equivalent viscous ratio zeta_eq = F_0 B / (pi k A); B is the name `cycle_loss`.

Spread over a wing, a force acts at each place by its share w of the area, on the place's motion r x, x the
mean's: the loss is sum w r^(p + a + 1) times as large.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf, pi
from operator import attrgetter

import numpy as np
from scipy.special import beta

from discrepancy.errors import CatalogueError, said
from discrepancy.models.scales import PortScale
from fe.runtime.patch import EVERY_CHANNEL

from .entry import Setting
from .needs import Asked, Target

LARGEST_SHARE = 0.9
"""Largest share of a port's stiffness at rest that a force which does not fall with the speed may have."""


@dataclass(frozen=True)
class Here:
    """Where a law is to be built: what is asked, what its place stands for, values of its parameters."""

    asked: Asked
    target: Target
    values: Mapping[str, float]

    @property
    def setting(self) -> Setting:
        """Campaign and model."""
        return self.asked.setting

    @property
    def port(self) -> PortScale:
        """Natural scales of the port; raises `CatalogueError` if the model has no such port."""
        ports = self.setting.scales.ports
        if self.target.name not in ports:
            known = ", ".join(ports) or "none"
            raise CatalogueError(
                said("effects.no_port", setting=self.setting, target=self.target, ports=known)
            )
        return ports[self.target.name]


def loss_integral(velocity_exponent: float, displacement_exponent: float) -> float:
    """Return B((p + 2) / 2, (a + 1) / 2): half the loss of a cycle over F_0 A; 2 for p = a = 0."""
    return float(beta(0.5 * velocity_exponent + 1.0, 0.5 * displacement_exponent + 0.5))


def _cycle_loss(here: Here) -> float:
    p = max(here.values["velocity_exponent"], 0.0)
    a = max(here.values["displacement_exponent"], 0.0) * _held(here)
    return loss_integral(p, a) * here.port.mean_power(p + a + 1.0)


def _held(here: Here) -> float:
    return 0.0 if here.port.free else 1.0  # a port that nothing holds has no zero


def _holding_force(here: Here) -> float:
    """Return the largest force that lets the port move: more, not falling with the speed, holds it still."""
    port = here.port
    if port.static_stiffness is None or port.driven or here.values["velocity_exponent"] >= 1.0:
        return inf
    return LARGEST_SHARE * port.static_stiffness * port.displacement


def _known(scale: str, usual: str) -> Callable[[Here], float]:
    """Return what gives a natural scale of the port, the usual one where it is not known."""
    return lambda here: next(x for key in (scale, usual) if (x := getattr(here.port, key)) is not None)


def _largest_reading(here: Here) -> float:
    """Return the largest magnitude among the used readings of the place [its unit], 1 if all are zero."""
    target, kept, key = here.target, here.setting.largest, (here.target, here.asked.kinds)
    if key not in kept:  # patches are built at every step of a fit
        every = here.asked.channels_of(lambda item: target.quantity in ("", item.quantity.value))
        names = every if target.name == EVERY_CHANNEL else (target.name,)
        read = [
            np.abs(trial.values[trial.used[:, column], column])
            for trial in here.asked.trials
            for column, name in enumerate(trial.channels)
            if name in names
        ]
        largest = float(max((np.max(values) for values in read if values.size), default=0.0))
        kept[key] = largest if largest > 0.0 and np.isfinite(largest) else 1.0
    return kept[key]


def _largest_release(here: Here) -> float:
    releases = [
        abs(trial.release.displacement)
        for trial in here.setting.campaign.fitted
        if trial.release is not None and here.target.name in trial.channels
    ]
    return max(releases, default=0.0) or 1.0


def _station(end: int, here: Here) -> float:
    return (here.setting.model.stations or (0.0, 0.0))[end]


SCALES: dict[str, Callable[[Here], float]] = {
    **{
        name: attrgetter(f"setting.scales.{name}")
        for name in (
            "length", "tip_stiffness", "modal_mass", "angular_frequency", "force", "load_factor", "duration",
            "campaign_time",
        )
    },
    "pi": lambda here: pi,
    "root_station": partial(_station, 0),
    "tip_station": partial(_station, 1),
    "largest_reading": _largest_reading,
    "largest_release": _largest_release,
    "number": lambda here: here.target.number,
    "port_displacement": lambda here: here.port.displacement,
    "port_stiffness": lambda here: here.port.stiffness,
    "port_angular_frequency": lambda here: here.port.angular_frequency,
    "port_stiffness_at_rest": _known("static_stiffness", "stiffness"),
    "port_largest_displacement": _known("largest_displacement", "displacement"),
    "port_holding_force": _holding_force,
    "port_is_held": _held,
    "mean_power": lambda here: here.port.mean_power(here.values["exponent"] + 1.0),
    "cycle_loss": _cycle_loss,
}  # fmt: skip
"""Every name: the value where a law is built [SI].

`number` is what the place has of it (side of a skin, frequency of a line), `mean_power` of the motion of a
spread force with `exponent`.
"""
_OF_SHAPES = {
    "mean_power": {"exponent"},
    "cycle_loss": {"velocity_exponent", "displacement_exponent"},
    "port_holding_force": {"velocity_exponent"},
}


def names_with(parameters: Collection[str]) -> frozenset[str]:
    """Return the names that may be used beside an effect's parameters; some need a shape among these."""
    return frozenset(name for name in SCALES if _OF_SHAPES.get(name, set()) <= {*parameters})
