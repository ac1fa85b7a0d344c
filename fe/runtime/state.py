"""The digital state of a wing: Kapteyn et al. 2021, eq. (5), and the names of a wing's inputs.

Standard library only, relative imports only: this file is copied into the FMU.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from .errors import InvalidStateError

Losses = tuple[float, ...]
"""Stiffness losses of the damage regions, in the order of the design."""

LossValues = Mapping[str, float] | Iterable[float]
"""Stiffness losses as a caller may give them: by region name, or in the order of the regions."""

MOST_REGIONS = 8
"""Largest number of damage regions of a structure."""

WING_MODEL_NAME = "uav_wing"
"""Name of the reduced model of a wing."""

TIP_FORCE = 1
"""Number of the load near the tip among the loads of a wing; load 0 is the lift."""

STANDARD_GRAVITY = 9.80665
"""[m/s^2]."""


def default_region_names(count: int) -> tuple[str, ...]:
    """Return names for damage regions without a name in the design: z1, z2 and so on."""
    return tuple(f"z{number}" for number in range(1, count + 1))


def wing_input_names(regions: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of all inputs of a wing, in the order of `ReducedArrays.input_names`."""
    return (
        "young_modulus_factor",
        *regions,
        "servo_mass",
        "pitot_mass",
        "load_factor",
        "tip_force",
    )


def losses_of(stiffness_loss: LossValues, regions: tuple[str, ...]) -> Losses:
    """Return one stiffness loss for each region, in the order of the regions.

    Parameters
    ----------
    stiffness_loss : mapping of str to float, or iterable of float
        Lost fractions of stiffness [1]. By name, a region that is left out is healthy; in the
        order of the regions, an empty sequence means that all regions are healthy.

    Raises
    ------
    InvalidStateError
        If a name is not that of a region, or the number of values is not that of the regions.
    """
    if isinstance(stiffness_loss, Mapping):
        for name in stiffness_loss:
            if name not in regions:
                raise InvalidStateError(
                    f"There is no damage region {name!r}; the regions are {', '.join(regions)}."
                )
        return tuple(float(stiffness_loss.get(name, 0.0)) for name in regions)
    losses = tuple(stiffness_loss)
    if not losses:
        return (0.0,) * len(regions)
    if len(losses) != len(regions):
        raise InvalidStateError(
            f"stiffness_loss must hold {len(regions)} fractions, one for each of "
            f"{', '.join(regions)}, but {len(losses)} were given."
        )
    return losses


def _require_positive(name: str, value: float) -> None:
    """Raise `InvalidStateError` unless a value is positive and finite."""
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidStateError(
            f"{name} must be a positive finite number, but {value!r} was given."
        )


def _require_not_negative(name: str, value: float) -> None:
    """Raise `InvalidStateError` unless a value is zero or positive, and finite."""
    if not (math.isfinite(value) and value >= 0.0):
        raise InvalidStateError(
            f"{name} must be zero or a positive finite number, but {value!r} was given."
        )


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
            _require_positive(f"geometry.{name}", getattr(self, name))


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
        z, the fractions of stiffness that the damage regions have lost, in the order of the design
        [1]. A healthy region has 0; 1 would be no stiffness at all and is refused. Empty: all
        regions are healthy.

    Raises
    ------
    InvalidStateError
        If a value is not finite or outside its physical range.
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
        """The modulus factor and the masses, by their names among a wing's inputs."""
        names = ("young_modulus_factor", "servo_mass", "pitot_mass")
        return {name: getattr(self, name) for name in names}

    def __post_init__(self) -> None:
        _require_positive("young_modulus_factor", self.young_modulus_factor)
        for name in ("servo_mass", "pitot_mass", "damping_alpha", "damping_beta"):
            _require_not_negative(name, getattr(self, name))
        if len(self.stiffness_loss) > MOST_REGIONS:
            raise InvalidStateError(
                f"stiffness_loss must hold at most {MOST_REGIONS} fractions, one for each damage "
                f"region, but {len(self.stiffness_loss)} were given."
            )
        for number, loss in enumerate(self.stiffness_loss, start=1):
            if not (math.isfinite(loss) and 0.0 <= loss < 1.0):
                raise InvalidStateError(
                    f"stiffness_loss {number} must be a fraction from 0 to below 1 (not percent), "
                    f"but {loss!r} was given."
                )
