"""An identified wing design with everything that is reported of it."""

from dataclasses import dataclass

import numpy as np

from .comparison import Comparison, Outputs
from .identifiability import Identifiability, Profile
from .least_squares import DesignFit
from .parameters import scaled
from .targets import Targets, Weights


@dataclass(frozen=True, eq=False)
class Identification:
    """An identification with everything that is reported of it.

    Attributes
    ----------
    fit : DesignFit
    targets : Targets
    weights : Weights
    comparison, before : tuple of Comparison
        Of the identified wing, and of the start.
    outputs, outputs_before : Outputs
    analysis : Identifiability
    profiles : tuple of Profile
    remeshed : tuple of (refinement, unknowns, rows)
        The identified wing on other meshes, with its own first; empty unless asked for.
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
    remeshed: tuple[tuple[float, int, tuple[Comparison, ...]], ...]

    @property
    def largest_change(self) -> float:
        """Largest change of a number from the start, in prior standard deviations."""
        fit = self.fit
        return float(np.abs(scaled(fit.parameters, fit.values) - scaled(fit.parameters, fit.start)).max())
