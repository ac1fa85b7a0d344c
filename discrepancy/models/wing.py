"""The wing as a model: its reduced structure under patches, in static tests, flights and ring-downs."""

from pathlib import Path

import numpy as np

from calibration.errors import CalibrationError
from calibration.joint.prior import wing_priors
from calibration.result.file import load_calibration
from calibration.result.record import STATE
from discrepancy.errors import ModelError
from discrepancy.models.interface import ModelParameter
from discrepancy.models.structural import StructuralModel
from discrepancy.models.wing_structure import WingStructure
from fe.reduction.model_cache import patch_arrays
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.state import wing_names
from fe.wing.design import load_design
from reporting.progress import Progress

SHIPPED_PRIOR = {
    "young_modulus_factor": (1.0073, 0.0103),
    "servo_mass": (0.1685, 0.0041),
    "pitot_mass": (0.1350, 0.0083),
    "damping_alpha": (1.03, 0.37),
    "damping_beta": (7.56e-4, 1.84e-4),
}
"""Mean and standard deviation of the calibrated state of the shipped wing (docs/calibration.md): e of the
paper, its masses, and the damping of the joint posterior, whose spread holds the measurement too."""


class WingModel(StructuralModel):
    """The wing.

    Parameters
    ----------
    arrays : PatchArrays
        The wing for patches.
    name : str
        For people.
    prior : mapping of str to (float, float)
        Mean and standard deviation of the calibrated parameters, by the names of
        `calibration.result.record.STATE`.

    Notes
    -----
    Load places are "tip_load" or (y [m], chord fraction). Outputs are strain[k], tip_displacement,
    load_point_displacement and displacement[y, x].
    """

    def __init__(
        self, arrays: PatchArrays, name: str = "wing", prior: dict[str, tuple[float, float]] | None = None
    ) -> None:
        self.wing = PatchedWing(arrays)
        prior = prior or SHIPPED_PRIOR
        box = dict(zip(wing_names(arrays.regions), arrays.validity_box.tolist(), strict=True))
        parameters = tuple(
            ModelParameter(item.name, item.mean, item.deviation, item.unit, item.low, item.high)
            for item in wing_priors(box, **prior)
        )
        super().__init__(WingStructure(self.wing), name, parameters)

    @classmethod
    def shipped(cls, progress: Progress | None = None) -> "WingModel":
        """Return the shipped wing with the calibration that the documentation states."""
        return cls.of_design(None, progress)

    @classmethod
    def of_design(cls, path: Path | str | None, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a design file, calibrated as the shipped wing is.

        Raises
        ------
        ModelError
            If it cannot be read, modelled or reduced.
        """
        try:
            design = load_design(path)
            return cls(patch_arrays(design, progress), design.name)
        except FiniteElementError as cause:
            raise ModelError(str(cause)) from cause

    @classmethod
    def of_calibration(cls, path: Path | str, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a calibration, its posterior as prior.

        Raises
        ------
        ModelError
            If the calibration cannot be read, or its wing not be modelled.
        """
        try:
            result = load_calibration(path)
            prior = {name: (result.mean(name), float(np.std(result.draws_of(name)))) for name in STATE}
            return cls(patch_arrays(result.wing_design, progress), result.asset, prior)
        except (FiniteElementError, CalibrationError, OSError) as cause:
            raise ModelError(f"The calibration {path} cannot be used: {cause}") from cause
