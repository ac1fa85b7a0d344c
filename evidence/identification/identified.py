"""An identified wing design, with everything that its report and record contain."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .comparison import Comparison, Outputs
from .identifiability import Identifiability, Profile
from .least_squares import DesignFit
from .parameters import scaled
from .targets import Targets, Weights


class RemeshedComparison(NamedTuple):
    """Comparison of the identified wing on another mesh.

    Attributes
    ----------
    refinement : float
        Refinement of the mesh, relative to that of the design.
    unknowns : int
        Number of free unknowns of the full model.
    comparison : tuple of Comparison
        Rows of the comparison.
    """

    refinement: float
    unknowns: int
    comparison: tuple[Comparison, ...]


@dataclass(frozen=True, eq=False)
class Identification:
    """An identification, with everything that its report and record contain.

    Attributes
    ----------
    fit : DesignFit
        The fit.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    comparison, before : tuple of Comparison
        Rows of the identified wing, and of the start.
    outputs, outputs_before : Outputs
        Outputs of the identified wing, and of the start.
    analysis : Identifiability
        How well the outputs determine each number.
    profiles : tuple of Profile
        Objective along some of the numbers.
    remeshed : tuple of RemeshedComparison
        The identified wing on its own mesh and on others; empty unless asked for.
    """

    fit: DesignFit
    targets: Targets
    weights: Weights
    comparison: tuple[Comparison, ...]
    before: tuple[Comparison, ...]
    outputs: Outputs
    outputs_before: Outputs
    analysis: Identifiability
    profiles: tuple[Profile, ...]
    remeshed: tuple[RemeshedComparison, ...]

    @property
    def largest_change(self) -> float:
        """Largest change of a number from the start, in prior standard deviations."""
        fit = self.fit
        change = scaled(fit.parameters, fit.values) - scaled(fit.parameters, fit.start)
        return float(np.abs(change).max())
