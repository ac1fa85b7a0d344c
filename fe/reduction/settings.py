"""Where a reduced model is to hold and how well, and the states at which that is looked at."""

import itertools
from dataclasses import dataclass, field
from math import prod

import numpy as np
import numpy.typing as npt

from fe.runtime.errors import ReductionError
from fe.runtime.reduced_arrays import MOST_ANCHORS

FloatArray = npt.NDArray[np.float64]
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


@dataclass(frozen=True)
class ReductionSettings:
    """Where the reduced model is to hold, and how well.

    Attributes
    ----------
    young_modulus_factor, stiffness_loss : tuple of float
        Ranges of e and of the loss of every damage region [1].
    load_factor, tip_force : tuple of float
        Ranges of the loads [1], [N]; the model is linear in them.
    servo_mass, pitot_mass : tuple of float
        Ranges of the masses [kg].
    nominal_masses : tuple of float
        Servo and pitot mass at which the flapwise modes are named [kg].
    bound_tolerance : float
        The certified bound of the strain error, relative to the largest strain, wanted everywhere on the
        training set, for each of the two loads.
    most_snapshots : int
        Limit of the greedy search.
    dual_anchors : tuple of int
        How many approximate dual solutions along each loss; empty: `default_anchors`.
    modal : ModalSettings
        Accuracy and number of modes.
    """

    young_modulus_factor: Range = (0.9, 1.1)
    stiffness_loss: Range = (0.0, 0.8)
    load_factor: Range = (-4.0, 6.0)
    tip_force: Range = (-100.0, 100.0)
    servo_mass: Range = (0.05, 0.30)
    pitot_mass: Range = (0.0, 0.30)
    nominal_masses: tuple[float, float] = (0.169, 0.134)
    bound_tolerance: float = 6e-4
    most_snapshots: int = 401
    dual_anchors: tuple[int, ...] = ()
    modal: ModalSettings = field(default_factory=ModalSettings)

    def validity_box(self, regions: int) -> FloatArray:
        """Return the ranges (K + 5, 2) for K regions, as `fe.runtime.state.wing_names`."""
        losses = (self.stiffness_loss,) * regions
        masses_and_loads = (self.servo_mass, self.pitot_mass, self.load_factor, self.tip_force)
        return np.array((self.young_modulus_factor, *losses, *masses_and_loads), dtype=np.float64)

    def reference(self, regions: int) -> FloatArray:
        """Return the values (K + 1,) of (e, 1 - z1, ...) whose stiffness is the norm of the error bound."""
        return np.array(
            (np.mean(self.young_modulus_factor), *(remaining_levels(self.stiffness_loss, 1)[0],) * regions)
        )

    def anchors(self, regions: int) -> tuple[int, ...]:
        """Return the number of approximate dual solutions along each of the losses.

        Raises
        ------
        ReductionError
            If `dual_anchors` does not fit the regions, or is more than a model holds.
        """
        counts = self.dual_anchors or default_anchors(regions)
        if len(counts) != regions or min(counts) < 1 or prod(counts) > MOST_ANCHORS:
            raise ReductionError(
                f"dual_anchors must be {regions} numbers, one for each damage region, whose product is at "
                f"most {MOST_ANCHORS}, but is {counts}."
            )
        return counts


def default_anchors(regions: int) -> tuple[int, ...]:
    """Return two approximate dual solutions along each loss, or one where they are combined."""
    return (2 if regions <= MOST_GRID_REGIONS else 1,) * regions


def remaining_levels(loss: Range, count: int) -> FloatArray:
    """Return `count` values of 1 - z in the middle of equal ratios over a range of z, ascending in z."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(high * (low / high) ** ((np.arange(count) + 0.5) / count))


def loss_splits(loss: Range, count: int) -> FloatArray:
    """Return the values of z that part a range into `count` equal ratios of 1 - z, ends left out."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(1.0 - high * (low / high) ** (np.arange(1, count) / count))


ALONE = 2
"""With so many regions a wing is reduced by one full solution after another, which repeats the shipped wing
to the bit; with more, several at once."""
TOGETHER = 4
"""Full solutions of the search, and states whose modes are refined, at once."""
TRAINING_LEVELS = 7
"""Losses of each region on the training set, while that is a grid."""
CHOSEN_STATES = 512
"""States inside the box on the training set, where that is no grid."""


def training_set(settings: ReductionSettings, regions: int) -> list[tuple[float, ...]]:
    """Return the states (e, z1, ...) on which the greedy search looks for the largest bound.

    A full grid up to `MOST_GRID_REGIONS`; beyond, the corners of the losses with either end of e and points
    of a Halton sequence between them. The bound itself is certified wherever it is evaluated.
    """
    low, high = settings.young_modulus_factor
    span = settings.stiffness_loss
    top, bottom = 1.0 - span[0], 1.0 - span[1]

    def loss_at(share: FloatArray) -> FloatArray:
        return np.asarray(np.clip(1.0 - top * (bottom / top) ** share, *span))

    if regions <= MOST_GRID_REGIONS:
        losses = loss_at(np.linspace(0.0, 1.0, TRAINING_LEVELS)).tolist()
        moduli = (float(low), float(0.5 * (low + high)), float(high))
        return [(e, *loss) for e in moduli for loss in itertools.product(losses, repeat=regions)]
    corners = [
        (float(e), *loss) for e in (low, high) for loss in itertools.product(map(float, span), repeat=regions)
    ]
    from scipy.stats import qmc  # takes a second to load

    points = qmc.Halton(regions + 1, scramble=False).random(CHOSEN_STATES)
    inside = np.column_stack((low + (high - low) * points[:, 0], loss_at(points[:, 1:])))
    return [*corners, *(tuple(state) for state in inside.tolist())]
