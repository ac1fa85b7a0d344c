"""The digital state of the wing: Kapteyn et al. 2021, eq. (5).

Standard library only, relative imports only: this file is copied into the FMU.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from .errors import InvalidStateError

Losses = tuple[float, ...]
"""Stiffness losses of the damage regions, in their order."""

GivenLosses = Mapping[str, float] | Iterable[float]
"""The same by name, or in their order."""
MOST_REGIONS = 8
"""Largest number of damage regions of a structure."""


def region_names(count: int) -> tuple[str, ...]:
    """Return the names of damage regions that bear none of their own: z1, z2 and so on."""
    return tuple(f"z{number}" for number in range(1, count + 1))


WING = "uav_wing"
"""Name of the reduced model of a wing."""

TIP_FORCE = 1
"""Number of the load near the tip among those of a wing; the first is the lift."""
STANDARD_GRAVITY = 9.80665
"""[m/s^2]."""


def wing_names(regions: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of all that can be chosen of a wing, in the order of `ReducedArrays.chosen`."""
    return ("young_modulus_factor", *regions, "servo_mass", "pitot_mass", "load_factor", "tip_force")


def losses_of(stiffness_loss: GivenLosses, regions: tuple[str, ...]) -> Losses:
    """Return one stiffness loss for each region, in their order.

    Parameters
    ----------
    stiffness_loss : mapping of str to float, or iterable of float
        Fractions by name, where regions that are left out are healthy; or in the order of the regions, where
        none at all means that all are healthy.
    regions : tuple of str
        Names of the regions.

    Raises
    ------
    InvalidStateError
        If a name is none of a region, or there are more or fewer values than regions.
    """
    if isinstance(stiffness_loss, Mapping):
        for name in stiffness_loss:
            if name not in regions:
                raise InvalidStateError(
                    f"There is no damage region {name!r}; the regions are {', '.join(regions)}."
                )
        return tuple(float(stiffness_loss.get(name, 0.0)) for name in regions)
    loss = tuple(stiffness_loss) or (0.0,) * len(regions)
    if len(loss) != len(regions):
        raise InvalidStateError(
            f"stiffness_loss must hold {len(regions)} fractions, one for each of {', '.join(regions)}, but "
            f"{len(loss)} were given."
        )
    return loss


def _require(name: str, value: float, *, positive: bool) -> None:
    if not (math.isfinite(value) and (value > 0.0 if positive else value >= 0.0)):
        wanted = "a positive finite number" if positive else "zero or a positive finite number"
        raise InvalidStateError(f"{name} must be {wanted}, but {value!r} was given.")


@dataclass(frozen=True)
class Geometry:
    """Planform of the half-wing, as built.

    Attributes
    ----------
    semi_span : float
        Distance from the root to the tip [m].
    root_chord, tip_chord : float
        Chords at the root and at the tip [m].

    Raises
    ------
    InvalidStateError
        If a length is not positive and finite.
    """

    semi_span: float = 1.828
    root_chord: float = 0.433
    tip_chord: float = 0.260

    def __post_init__(self) -> None:
        for name in ("semi_span", "root_chord", "tip_chord"):
            _require(f"geometry.{name}", getattr(self, name), positive=True)


@dataclass(frozen=True)
class DigitalState:
    """A point value of d = (g, e, m, alpha, beta, z), Kapteyn et al. 2021, eq. (5).

    Attributes
    ----------
    geometry : Geometry
        g, the planform [m].
    young_modulus_factor : float
        e, the factor on Young's modulus of the skin [1].
    servo_mass : float
        Mass of each of the two servos [kg].
    pitot_mass : float
        Mass of the pitot tube [kg].
    damping_alpha : float
        Mass-proportional Rayleigh coefficient, eq. (17) [1/s].
    damping_beta : float
        Stiffness-proportional Rayleigh coefficient, eq. (17) [s].
    stiffness_loss : tuple of float
        z, the fractions of stiffness that the damage regions have lost, in the order of the design [1]; 0 is
        healthy, 1 would be no stiffness at all and is refused. Empty: all regions are healthy.

    Raises
    ------
    InvalidStateError
        If a value is not finite or lies where no wing can be.
    """

    geometry: Geometry = field(default_factory=Geometry)
    young_modulus_factor: float = 1.0
    servo_mass: float = 0.169
    pitot_mass: float = 0.134
    damping_alpha: float = 1.0735
    damping_beta: float = 7.3124e-4
    stiffness_loss: Losses = ()

    @property
    def values(self) -> dict[str, float]:
        """Factor and masses by the names of `wing_names`."""
        names = ("young_modulus_factor", "servo_mass", "pitot_mass")
        return {name: getattr(self, name) for name in names}

    def __post_init__(self) -> None:
        _require("young_modulus_factor", self.young_modulus_factor, positive=True)
        for name in ("servo_mass", "pitot_mass", "damping_alpha", "damping_beta"):
            _require(name, getattr(self, name), positive=False)
        if len(self.stiffness_loss) > MOST_REGIONS:
            raise InvalidStateError(
                f"stiffness_loss must hold at most {MOST_REGIONS} fractions, one for each damage region, but "
                f"{len(self.stiffness_loss)} were given."
            )
        for number, loss in enumerate(self.stiffness_loss, start=1):
            if not (math.isfinite(loss) and 0.0 <= loss < 1.0):
                raise InvalidStateError(
                    f"stiffness_loss {number} must be a fraction from 0 to below 1 (not percent), "
                    f"but {loss!r} was given."
                )
