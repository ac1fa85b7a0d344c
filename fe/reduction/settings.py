"""Where a reduced model is to hold and how well."""

from dataclasses import dataclass, field

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.structure.tables import ReductionLimits, StructureDesign

Range = tuple[float, float]

MOST_GRID_REGIONS = 3
"""Regions up to which the states that are looked at form a full grid; with more, they are chosen."""


@dataclass(frozen=True)
class ModalSettings:
    """How many modes are kept and how well.

    Attributes
    ----------
    mode_count : int
        Modes that the reduced model returns.
    residual_tolerance : float
        Relative residual of the sampled modes in the working basis; frequencies err by about its square.
    frequency_tolerance : float
        Relative error of any frequency that compression may add.
    most_corrections : int
        Limit of Davidson corrections for one state.
    """

    mode_count: int = 6
    residual_tolerance: float = 3e-3
    frequency_tolerance: float = 1e-5
    most_corrections: int = 12

    @property
    def sought(self) -> int:
        """Modes that are looked for: two more, because modes change places."""
        return self.mode_count + 2


@dataclass(frozen=True)
class StructureSettings:
    """How well the reduced model of a structure is to hold; where, and both limits, its design says.

    Attributes
    ----------
    bound_tolerance : float
        The certified bound wanted everywhere on the training set, for each load alone, of strains relative to
        the largest strain and of displacements relative to the largest of them.
    most_snapshots : int
        Limit of the greedy search.
    modal : ModalSettings
        Accuracy and number of modes.
    ranges : dict of str to (float, float)
        Least and largest value where it is to hold elsewhere than the design says, by name.
    """

    bound_tolerance: float = ReductionLimits().tolerance
    most_snapshots: int = ReductionLimits().most_solutions
    modal: ModalSettings = field(default_factory=ModalSettings)
    ranges: dict[str, Range] = field(default_factory=dict)

    @classmethod
    def of(cls, design: StructureDesign) -> "StructureSettings":
        """Return what the table `[reduction]` of a structure file says."""
        return cls(design.reduction.tolerance, design.reduction.most_solutions)


@dataclass(frozen=True)
class PatchSettings:
    """How far changes may go and how many vectors hold them.

    Attributes
    ----------
    strip_count : int
        Largest number of strips of the skin; by default each row of cells along the span is one.
    vectors : int
        Size n of the basis.
    states : int
        Patched states that are solved in the working basis.
    largest_loss : float
        Loss of stiffness in a box along the span.
    compliance_share : float
        Root compliance, as a share of the tip's compliance.
    largest_mass : float
        Point mass [kg].
    seed : int
        Of the states.
    """

    strip_count: int = 64
    vectors: int = 240
    states: int = 240
    largest_loss: float = 0.7
    compliance_share: float = 0.4
    largest_mass: float = 0.25
    seed: int = 1


def remaining_levels(loss: Range, count: int) -> FloatArray:
    """Return `count` values of 1 - z in the middle of equal ratios over a range of z, ascending in z."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(high * (low / high) ** ((np.arange(count) + 0.5) / count))


def loss_splits(loss: Range, count: int) -> FloatArray:
    """Return the values of z that part a range into `count` equal ratios of 1 - z, ends left out."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(1.0 - high * (low / high) ** (np.arange(1, count) / count))


TOGETHER = 4
"""Full solutions of the search, and states whose modes are refined, at once."""
