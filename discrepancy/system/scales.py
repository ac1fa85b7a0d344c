"""Natural scales of a model under a campaign: they make dimensionless effects physical."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class PortScale:
    """Natural scales of a port for the campaign at hand: they make dimensionless effects physical.

    Attributes
    ----------
    displacement : float
        A, the largest motion of the port by the unpatched model in the dynamic trials that are fitted; in the
        other trials if there are none [m or rad].
    stiffness : float
        k, the stiffness of the first bending mode seen at the port, w1^2 / phi1(port)^2 [N/m or N m/rad].
    angular_frequency : float
        w1 [rad/s].
    static_stiffness : float or None
        1 / (p . K^-1 p), the stiffness at rest seen at the port [N/m or N m/rad]. At a stiff joint it is a
        small part of `stiffness`, and no effect can take away more. None: not known, taken as `stiffness`.
    largest_displacement : float or None
        The largest motion of the port in all trials, flights too [m or rad]. None: taken as `displacement`.
    spread : tuple of (float, float)
        Where a force at the port acts: its share, and the motion there over that of the port, by place. A
        force that is spread over the wing acts on the motion of each place, and A is the mean's.
    free : bool
        Whether nothing holds the port (a body that falls or rolls), so that no place is its zero.
    turns : bool
        Whether its motion turns in a trial, or may: one that goes one way shows no memory.
    of_state : bool
        Whether it is a port of a state (a level, a temperature), at which laws are flows: `displacement`
        times `angular_frequency` is then its largest value, `displacement` times `stiffness` the flow scale.
    driven : bool
        Whether drives alone move it, so that no force holds it still.
    """

    displacement: float
    stiffness: float
    angular_frequency: float
    static_stiffness: float | None = None
    largest_displacement: float | None = None
    spread: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    free: bool = False
    turns: bool = True
    of_state: bool = False
    driven: bool = False

    def mean_power(self, exponent: float) -> float:
        """Return the mean of |motion / A|^exponent over the places where a force at the port acts."""
        return sum((share * float(abs(motion) ** exponent) for share, motion in self.spread), 0.0)


@dataclass(frozen=True)
class Scales:
    """Natural scales of a model under a campaign.

    Attributes
    ----------
    length : float
        Semi-span or characteristic length L [m].
    tip_stiffness : float
        Static stiffness at the load point [N/m].
    modal_mass : float
        Mass of the first mode referred to the load point [kg].
    angular_frequency : float
        w1 [rad/s].
    force, load_factor : float
        Largest applied force [N] and load factor [1] of the campaign.
    duration : float
        Longest dynamic record [s]; 1 without one.
    campaign_time : float
        Time from the first to the last sample of the campaign [s]; 1 if unknown.
    ports : mapping of str to PortScale
        By port name; besides those of `Model.ports` the places of forces that are spread over the structure.
    """

    length: float
    tip_stiffness: float
    modal_mass: float
    angular_frequency: float
    force: float
    load_factor: float
    duration: float
    campaign_time: float
    ports: Mapping[str, PortScale]
