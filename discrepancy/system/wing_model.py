"""The wing as a model, with its patches."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.errors import CalibrationError
from calibration.joint.wing_table import SHIPPED_PRIOR, wing_priors
from calibration.result.file import load_calibration
from calibration.result.record import STATE
from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.campaign.units import quantity_with_unit
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.response import MOVES, TURNS, Outputs, Place
from discrepancy.system.scales import ForceShare, PortScale
from discrepancy.system.structures import linear_system
from discrepancy.system.system_model import SystemModel
from discrepancy.system.system_state import PatchedTrial, SystemState
from fe.reduction.model_cache import patch_arrays
from fe.runtime import patch as changes
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import PRIMITIVES, ROOT_TURN, ModelPatch, Primitive
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.port_laws import PLANFORM, STATION_PORTS
from fe.runtime.state import wing_input_names
from fe.runtime.wing_rows import PORTS, STATIC_TEST_LOAD, strain_gauge
from fe.wing.design import WingDesign, load_design
from reporting.progress import Progress

ROTATING_PORT = "root"
"""Port of the wing at which a force is a moment and a motion an angle."""
Prior = Mapping[str, tuple[float, float]]
"""Means and standard deviations of calibrated parameters, by the names of `STATE`."""


def _cholesky_solver(stiffness: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the function that solves K x = b by a Cholesky factor of K."""
    return partial(cho_solve, cho_factor(stiffness, check_finite=False), check_finite=False)


class WingModel(SystemModel):
    """The model of a wing; its system in each state and under each patch is computed once.

    Parameters
    ----------
    arrays : PatchArrays
        The arrays of the wing from which patches are computed.
    name : str
        The name of the model in messages and reports.
    prior : mapping of str to (float, float)
        The mean and standard deviation of the calibrated parameters, by the names of
        `calibration.result.record.STATE`.
    design : WingDesign, optional
        The design from which the arrays were made.

    Notes
    -----
    Load places are "tip_load" or (y [m], chord fraction). Outputs are strain[k],
    strain[k].transverse and strain[k].shear across it, tip_displacement, load_point_displacement
    and displacement[y, x].
    """

    reference = STATIC_TEST_LOAD

    def __init__(
        self,
        arrays: PatchArrays,
        name: str = "wing",
        prior: Prior = SHIPPED_PRIOR,
        design: WingDesign | None = None,
    ) -> None:
        self.name = name
        self.design = design
        self.wing = PatchedWing(arrays)
        self.wing.solver = _cholesky_solver
        names = wing_input_names(arrays.regions)
        validity = dict(zip(names, arrays.validity_box.tolist(), strict=True))
        self.parameters = wing_priors(validity, **prior)
        self.regions = arrays.regions
        self.largest_losses = {region: validity[region][1] for region in arrays.regions}
        self.length = self.wing.span
        self.stations = (0.0, self.wing.span)
        self.support_motions = (ROOT_TURN,)
        self.port_rows = self.wing.port_rows
        self.ports = tuple(PORTS)

    @cached_property
    def _output_row(self) -> Callable[[str], FloatArray | None]:
        """The function that returns the row (n,) of an output, with a cache."""
        return cache(self.wing.output_row)

    @classmethod
    def of_design(
        cls, path: Path | str | None = None, progress: Progress | None = None
    ) -> "WingModel":
        """Return the wing of a design file, or the shipped wing, with the shipped calibration.

        Raises
        ------
        ModelError
            If it cannot be read, modelled or reduced.
        """
        with ModelError.instead_of(FiniteElementError):
            design = load_design(path)
            return cls(patch_arrays(design, progress), design.name, design=design)

    @classmethod
    def of_calibration(cls, path: Path | str, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a calibration; the posterior of its parameters becomes their prior.

        Raises
        ------
        ModelError
            If the calibration cannot be read, or its wing not be modelled.
        """
        unusable = f"The calibration {path} cannot be used: "
        with ModelError.instead_of(FiniteElementError, CalibrationError, OSError, before=unusable):
            calibration = load_calibration(path)
            prior = {}
            for name in STATE:
                deviation = float(np.std(calibration.draws_of(name)))
                prior[name] = (calibration.mean(name), deviation)
            design = calibration.wing_design
            return cls(patch_arrays(design, progress), calibration.asset, prior, design)

    # ------------------------------------------------------------ outputs, ports and loads

    def output_quantity(self, output: str) -> Quantity | None:
        """Return the quantity of an output, or None if there is no such output."""
        if self._output_row(output) is None:
            return None
        return Quantity.STRAIN if output.startswith("strain") else Quantity.DISPLACEMENT

    def output_equations(
        self, case: PatchedTrial, outputs: Outputs, excitation: Excitation | None
    ) -> list[OutputEquation]:
        """Return the equations of outputs; the patch may scale the strain at gauges."""
        rows = np.array([self._output_row(output) for output, _ in outputs])  # (C, n)
        factors = self.wing.strain_factors(case.patch)
        if factors is not None:
            # the index of the gauge of each output; negative for a displacement
            gauges = np.array([strain_gauge(output) for output, _ in outputs])
            is_strain = gauges >= 0
            rows = rows * np.where(is_strain, factors[gauges], 1.0)[:, None]
        equations = []
        for row, (_, quantity) in zip(rows, outputs, strict=True):
            equations.append(OutputEquation.from_row(row, quantity.order))
        return equations

    @property
    def outputs_with_quantities(self) -> tuple[str, ...]:
        """The outputs with quantity and SI unit, as they are listed in a sentence."""
        strain = quantity_with_unit(Quantity.STRAIN)
        displacement = quantity_with_unit(Quantity.DISPLACEMENT)
        return (
            f"strain[1] to strain[{len(self.wing.arrays.gauge_stations)}] ({strain})",
            f"tip_displacement ({displacement})",
            f"load_point_displacement ({displacement})",
            f"displacement[y, x] with y from 0 to {self.wing.span:g} m and x the chord fraction "
            f"({displacement})",
        )

    def supports(self, primitive: type[Primitive]) -> bool:
        """Return whether the wing can carry a primitive: any but those that need what it lacks.

        It has no forces by a formula in time, no named places for masses, no interfaces of parts,
        and neither loads nor gauges that may be moved from their places.
        """
        not_carried = (
            changes.PortLoad,
            changes.PlaceMass,
            changes.InterfaceCompliance,
            changes.LoadOffset,
            changes.LoadTilt,
            changes.GaugeOffset,
        )
        return primitive in PRIMITIVES.values() and primitive not in not_carried

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of force and motion at a port: the root turns, others move."""
        return TURNS if port == ROTATING_PORT else MOVES

    def forces_at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return internal forces as forces at the ports of `port_rows`.

        A force that is spread over the planform acts at the ports of several stations.
        """
        return self.wing.internal_forces(forces)

    def force_row(
        self, place: Place, state: SystemState, change: ModelPatch = NO_PATCH
    ) -> FloatArray:
        """Return the load (n,) of 1 N at a place; raises `InvalidPatchError` off the wing."""
        return self.wing.force_row(place, change)

    def lift_loads(self, state: SystemState, change: ModelPatch) -> FloatArray:
        """Return the loads (2, n) of the load factor and of its square."""
        return self.wing.manoeuvre_loads(change)

    def distributed_scales(
        self, ports: Mapping[str, PortScale], shape: FloatArray
    ) -> dict[str, PortScale]:
        """Return the scales of a force over the planform, given the shape (n,) of the first mode.

        The scales are those of the port `span`, with the fraction of the area at each station.
        """
        weights = self.wing.planform_stations.area_fraction
        motions = np.array([self.wing.port_rows[port] @ shape for port in STATION_PORTS])
        relative_motions = motions / float(weights @ motions)
        distribution = tuple(map(ForceShare, weights.tolist(), relative_motions.tolist()))
        return {PLANFORM: replace(ports["span"], distribution=distribution)}

    def build_system(self, state: SystemState) -> LinearSystem:
        """Return the linear system of the wing in a state."""
        stiffness_factor, servo_mass, pitot_mass, alpha, beta = state.parameters
        values = np.array((stiffness_factor, *state.losses, servo_mass, pitot_mass, 0.0, 0.0))
        structure = self.wing.structure_at(values, state.structure, state.temperature_rise)
        return linear_system(structure, (alpha, beta), self.port_rows)
