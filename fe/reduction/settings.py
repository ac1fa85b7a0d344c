"""Where a reduced model is to hold and how well."""

from dataclasses import dataclass, field

from fe.structure.tables import ReductionLimits, StructureDesign


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
    mode_count : int
        Modes that the reduced model returns.
    ranges : dict of str to (float, float)
        Least and largest value where it is to hold elsewhere than the design says, by name.
    """

    bound_tolerance: float = ReductionLimits().tolerance
    most_snapshots: int = ReductionLimits().most_solutions
    mode_count: int = 6
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, design: StructureDesign) -> "StructureSettings":
        """Return what the table `[reduction]` of a structure file says."""
        return cls(design.reduction.tolerance, design.reduction.most_solutions)
