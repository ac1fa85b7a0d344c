"""Where a reduced model is to hold and how well, and the states at which that is looked at."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced_arrays import PARAMETER_NAMES

from .modal_basis import ModalSettings

FloatArray = npt.NDArray[np.float64]
Range = tuple[float, float]


@dataclass(frozen=True)
class ReductionSettings:
    """Where the reduced model is to hold, and how well.

    Attributes
    ----------
    young_modulus_factor, stiffness_loss_1, stiffness_loss_2 : tuple of float
        Ranges of e, z1 and z2 [1].
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
        How many approximate dual solutions along z1 and z2.
    modal : ModalSettings
        Accuracy and number of modes.
    """

    young_modulus_factor: Range = (0.9, 1.1)
    stiffness_loss_1: Range = (0.0, 0.8)
    stiffness_loss_2: Range = (0.0, 0.8)
    load_factor: Range = (-4.0, 6.0)
    tip_force: Range = (-100.0, 100.0)
    servo_mass: Range = (0.05, 0.30)
    pitot_mass: Range = (0.0, 0.30)
    nominal_masses: tuple[float, float] = (0.169, 0.134)
    bound_tolerance: float = 6e-4
    most_snapshots: int = 24
    dual_anchors: tuple[int, int] = (2, 2)
    modal: ModalSettings = field(default_factory=ModalSettings)

    def validity_box(self) -> FloatArray:
        """Return the ranges in the order of `fe.runtime.reduced_arrays.PARAMETER_NAMES`, (7, 2)."""
        ranges = {
            "young_modulus_factor": self.young_modulus_factor,
            "z1": self.stiffness_loss_1,
            "z2": self.stiffness_loss_2,
            "load_factor": self.load_factor,
            "tip_force": self.tip_force,
            "servo_mass": self.servo_mass,
            "pitot_mass": self.pitot_mass,
        }
        return np.array([ranges[name] for name in PARAMETER_NAMES], dtype=np.float64)


def remaining_levels(loss: Range, count: int) -> FloatArray:
    """Return `count` values of 1 - z in the middle of equal ratios over a range of z, ascending in z."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(high * (low / high) ** ((np.arange(count) + 0.5) / count))


def loss_splits(loss: Range, count: int) -> FloatArray:
    """Return the values of z that part a range into `count` equal ratios of 1 - z, ends left out."""
    high, low = 1.0 - loss[0], 1.0 - loss[1]
    return np.asarray(1.0 - high * (low / high) ** (np.arange(1, count) / count))


def training_set(settings: ReductionSettings) -> list[tuple[float, float, float]]:
    """Return the states (e, z1, z2) on which the greedy search looks for the largest bound."""
    low, high = settings.young_modulus_factor

    def losses(span: Range) -> FloatArray:
        top, bottom = 1.0 - span[0], 1.0 - span[1]
        return np.asarray(np.clip(1.0 - top * (bottom / top) ** np.linspace(0.0, 1.0, 7), *span))

    return [
        (float(e), float(z1), float(z2))
        for e in (low, 0.5 * (low + high), high)
        for z1 in losses(settings.stiffness_loss_1)
        for z2 in losses(settings.stiffness_loss_2)
    ]
