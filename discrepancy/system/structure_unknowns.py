"""The unknowns of a structure that are fitted: its parameters, masses, and errors of its mesh."""

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import FloatArray
from discrepancy.system.linear_system import SolvedStructure
from fe.runtime.changed_structure import ChangedModes
from fe.runtime.reduced import ReducedModel

DEVIATION = 0.25
"""Standard deviation of a parameter that was not calibrated, as a fraction of its range."""
MESH_DEVIATION = 0.01
"""Standard deviation of the relative error of a frequency by the mesh. A ring-down shows a
frequency to a few parts in 10^5, while a mesh of ordinary fineness has errors of 0.1 to 1.5 percent
that differ from mode to mode: without an allowance they would be named a soft support."""
LARGEST_MESH_ERROR = 0.05
"""Largest relative error of a frequency by the mesh that is fitted."""
MODES_OF_MESH_ERRORS = 4
"""Number of modes whose frequencies may differ by the mesh; readings hardly show higher ones."""


def parameter_priors(model: ReducedModel) -> tuple[ParameterPrior, ...]:
    """Return the priors of parameters and free masses.

    The means are the nominal values, and the standard deviations `DEVIATION` times the ranges.
    """
    nominal_values = dict(zip(model.input_names, model.nominal.tolist(), strict=True))
    units = dict.fromkeys(model.parameters, "1") | dict.fromkeys(model.masses, "kg")
    priors = []
    for name, unit in units.items():
        low, high = model.validity[name]
        deviation = DEVIATION * (high - low)
        priors.append(ParameterPrior(name, unit, nominal_values[name], deviation, low, high))
    return tuple(priors)


def mesh_errors_of(model: ReducedModel) -> tuple[ParameterPrior, ...]:
    """Return the priors of the relative errors of the lowest frequencies by the mesh."""
    return tuple(
        ParameterPrior(
            f"mesh_mode_{number}",
            "1",
            0.0,
            MESH_DEVIATION,
            -LARGEST_MESH_ERROR,
            LARGEST_MESH_ERROR,
            title=f"frequency error of the mesh in mode {number}",
        )
        for number in range(1, 1 + min(model.mode_count, MODES_OF_MESH_ERRORS))
    )


class WithMeshErrors:
    """A solved structure whose lowest frequencies differ by relative errors of its mesh.

    Shapes and flexibility are those of the structure.
    """

    def __init__(self, structure: SolvedStructure, errors: FloatArray) -> None:
        self._structure = structure
        frequency = structure.modes.frequency.copy()
        frequency[: len(errors)] *= 1.0 + errors
        self.modes = ChangedModes(frequency, structure.mode_shapes)
        self.mode_shapes = structure.mode_shapes

    def static(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, for loads (k,) or (k, m)."""
        return self._structure.static(loads)
