"""Natural scales of a model under a campaign: they make dimensionless effects physical."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class ForceShare(NamedTuple):
    """A place at which part of a distributed force acts.

    Attributes
    ----------
    weight : float
        The fraction of the force that acts there.
    relative_motion : float
        The ratio of the motion of the place to the weighted mean motion, that of the port.
    """

    weight: float
    relative_motion: float


@dataclass(frozen=True)
class PortScale:
    """Natural scales of a port under a campaign: they make dimensionless effects physical.

    Attributes
    ----------
    displacement : float
        A, the largest motion of the port by the unpatched model in the dynamic trials that are
        fitted; in the other trials if there are none [m or rad].
    stiffness : float
        k, the stiffness of the first bending mode at the port, w1^2 / phi1(port)^2 [N/m or N
        m/rad].
    angular_frequency : float
        w1 [rad/s].
    static_stiffness : float or None
        1 / (p . K^-1 p), the static stiffness at the port [N/m or N m/rad]. At a stiff joint
        it is a small part of `stiffness`, and no effect can take away more. None: not known, taken
        as `stiffness`.
    largest_displacement : float or None
        The largest motion of the port in all trials, flights too [m or rad]. None: taken as
        `displacement`.
    distribution : tuple of ForceShare
        Places where a force at the port acts. A force distributed over the wing acts on the
        motion of each place, and `displacement` is that of the mean.
    free : bool
        Whether nothing holds the port (a body that falls or rolls), so that no position is its
        zero.
    turns : bool
        Whether the motion changes its direction in a trial, or may: a motion that goes one way
        shows no memory.
    of_state : bool
        Whether it is a port of a state (a level, a temperature), at which laws are flows:
        `displacement` times `angular_frequency` is then the largest value of the state, and
        `displacement` times `stiffness` the flow scale.
    driven : bool
        Whether drives alone move the port, so that no force holds it still.
    """

    displacement: float
    stiffness: float
    angular_frequency: float
    static_stiffness: float | None = None
    largest_displacement: float | None = None
    distribution: tuple[ForceShare, ...] = (ForceShare(1.0, 1.0),)
    free: bool = False
    turns: bool = True
    of_state: bool = False
    driven: bool = False

    def mean_power(self, exponent: float) -> float:
        """Return the mean of |motion / A|^exponent over the places where the port's force acts."""
        powers = [abs(share.relative_motion) ** exponent for share in self.distribution]
        weights = [share.weight for share in self.distribution]
        terms = [weight * float(power) for weight, power in zip(weights, powers, strict=True)]
        return sum(terms, 0.0)


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
        The mass of the first mode referred to the load point [kg].
    angular_frequency : float
        w1 [rad/s].
    force, load_factor : float
        Largest applied force [N] and load factor [1] of the campaign.
    duration : float
        Longest dynamic record [s]; 1 without one.
    campaign_time : float
        The time from the first to the last sample of the campaign [s]; 1 if unknown.
    ports : mapping of str to PortScale
        By port name: those of `Model.ports`, and the places of forces that are distributed over the
        structure.
    support_compliances : mapping of (str, str) to float
        For each support or interface that may yield, and each of its motions, the compliance that
        doubles the compliance of the structure under the load, or in the mode, where it matters
        most [m/N or rad/(N m)].
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
    support_compliances: Mapping[tuple[str, str], float] = field(default_factory=dict)

    def support_compliance(self, support: str, motion: str) -> float:
        """Return the compliance of a support that doubles the compliance of the structure.

        Of the root of a wing or a lumped model it is that whose turn doubles the displacement of
        the tip under a force there [rad/(N m)].
        """
        root_compliance = 1.0 / (self.tip_stiffness * self.length**2)
        return self.support_compliances.get((support, motion), root_compliance)
