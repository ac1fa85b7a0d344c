"""The structure of the wing in the states that are asked for: stiffness, motion, rows of outputs; kept."""

from collections.abc import Hashable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.body import Moving, Outputs, Place
from discrepancy.models.interface import PortScale
from discrepancy.models.memory import Memory
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.patch import (
    PRIMITIVES,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PortLoad,
    Primitive,
    RootCompliance,
)
from fe.runtime.patched_wing import (
    LOAD_PLACE,
    MODE_COUNT,
    ON_MODES,
    PORTS,
    PatchedWing,
    motion_basis,
    strain_gauge,
)
from fe.runtime.planform_forces import PLANFORM, STATION_PORTS
from fe.runtime.state import Losses

FloatArray = NDArray[np.float64]
Key = Hashable


class Stiffness:
    """Factorised stiffness (n, n) of the wing in one state."""

    def __init__(self, matrix: FloatArray) -> None:
        self.matrix = matrix
        try:
            self._factor = cho_factor(matrix, lower=True, check_finite=False)
        except np.linalg.LinAlgError as cause:
            raise ModelError(
                f"The patched wing has no stiffness left in some direction ({cause})."
            ) from cause

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, (n,) or (n, k)."""
        return np.asarray(cho_solve(self._factor, loads, check_finite=False))


class WingStructure:
    """The wing in the states and under the structural patches that were asked for, each made once.

    Parameters
    ----------
    wing : PatchedWing
        The wing for patches.

    Attributes
    ----------
    regions, points, port_rows, missing, length, reference
        As of `discrepancy.models.structural.Body`.
    """

    missing: tuple[str, ...] = STATION_PORTS
    reference: str = LOAD_PLACE

    def __init__(self, wing: PatchedWing) -> None:
        self.wing, self.regions = wing, wing.arrays.regions
        self.length: float | None = wing.span
        self.port_rows: Mapping[str, FloatArray] = wing.port_rows
        self.points: Mapping[str, FloatArray] = {port: wing.port_rows[port] for port in PORTS}
        self._stiffnesses, self._systems = Memory(), Memory()
        self._rows = Memory()

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if there is no such output."""
        if self.wing.output_row(output) is None:
            return None
        return Quantity.STRAIN if output.startswith("strain") else Quantity.DISPLACEMENT

    def output_rows(self, outputs: Outputs, component: int, losses: ModelPatch) -> FloatArray:
        """Return the rows (C, n) of outputs; `component` 1 and 2: transverse and shear strain.

        Raises
        ------
        ModelError
            If there is no such output, or it is of another quantity.
        """
        rows = self._rows.get((outputs, component), lambda: self._made_rows(outputs, component))
        factors = self.wing.strain_factors(losses)
        if factors is None:
            return rows
        gauges = self._rows.get(
            (outputs, "gauges"), lambda: np.array([strain_gauge(output) for output, _ in outputs])
        )
        return rows * np.where(gauges >= 0, factors[gauges], 1.0)[:, None]

    def _made_rows(self, outputs: Outputs, component: int) -> FloatArray:
        rows = []
        for output, quantity in outputs:
            own = self.output_quantity(output)
            row = self.wing.output_row(output, component)
            if own is None or row is None:
                raise ModelError(
                    f"The wing has no output {output!r}; it has strain[1] to "
                    f"strain[{self.wing.gauge_count}], tip_displacement, load_point_displacement and "
                    f"displacement[y, x] with y from 0 to {self.wing.span:g} m and x the chord fraction."
                )
            if not quantity.shows(own):
                raise ModelError(
                    f"The output {output!r} of the wing is a {own.value}, but a channel measures "
                    f"{quantity.value}."
                )
            rows.append(row)
        return np.array(rows).reshape(len(rows), self.wing.size)

    @staticmethod
    def stiffness_key(
        parameters: FloatArray, health: Losses, structure: ModelPatch, temperature: float
    ) -> Key:
        """Return what the stiffness of a state depends on; primitives of other kinds are passed over."""
        kept = structure.of(RootCompliance, LocalStiffnessLoss, ModulusTemperature)
        if not any(isinstance(item, ModulusTemperature) for item in kept):
            temperature = 0.0
        losses = tuple(float(loss) for loss in health)
        return float(parameters[0]), losses, kept.primitives, float(temperature)

    def stiffness(
        self,
        parameters: FloatArray,
        health: Losses,
        structure: ModelPatch,
        temperature: float,
    ) -> Stiffness:
        """Return the stiffness at parameters, losses, a patch and a temperature less the reference [K]."""
        key = self.stiffness_key(parameters, health, structure, temperature)
        return self._stiffnesses.get(
            key,
            lambda: Stiffness(self.wing.stiffness(float(parameters[0]), health, structure, temperature)),
        )

    def moving(
        self,
        parameters: FloatArray,
        health: Losses,
        structure: ModelPatch,
        temperature: float,
        place: Place,
        ports: tuple[str, ...] = (),
    ) -> Moving:
        """Return the wing as it moves when released from, or pushed at, a place, with forces at `ports`."""
        key = self.stiffness_key(parameters, health, structure, temperature)
        masses = structure.of(PointMass)
        held = self.wing.held_ports(ports)

        def make() -> Moving:
            _, servo, pitot, alpha, beta = (float(value) for value in parameters)
            stiffness = self.stiffness(parameters, health, structure, temperature)
            mass = self.wing.mass(servo, pitot, masses)
            still = stiffness.solve(np.vstack((self.wing.force_row(place), *held.values())).T)
            basis = motion_basis(stiffness.solve, mass, self.wing.arrays.start_shapes, still)
            small_mass, small = basis.T @ mass @ basis, basis.T @ stiffness.matrix @ basis
            small_mass, small = 0.5 * (small_mass + small_mass.T), 0.5 * (small + small.T)
            return Moving(
                basis,
                SecondOrderSystem(
                    small_mass,
                    alpha * small_mass + beta * small,
                    small,
                    {port: row @ basis for port, row in held.items()},
                    MODE_COUNT,
                    beta,
                    ON_MODES,
                ),
            )

        return self._systems.get((key, masses.primitives, parameters[1:].tobytes(), place, tuple(held)), make)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the wing can carry a primitive; it can carry all but forces by a formula in time."""
        return primitive in PRIMITIVES.values() and primitive is not PortLoad

    def internal_forces(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at ports of `port_rows`."""
        return self.wing.internal_forces(forces)

    def force_row(self, place: Place, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the load (n,) of 1 N at a place; raises `InvalidPatchError` if it is off the wing."""
        return self.wing.force_row(place, loads)

    def units(self, trial: Trial, parameters: FloatArray, loads: ModelPatch) -> FloatArray:
        """Return the unit loads (k, n) of a trial at rest: the parts of the lift, or a force of 1 N."""
        if trial.kind is TrialKind.FLIGHT:
            return self.wing.load_parts(loads)
        return self.wing.force_row(trial.load_place, loads)[None]

    def always(self, parameters: FloatArray) -> None:
        """Return nothing: all loads of the wing are recorded."""

    def spread(self, ports: Mapping[str, PortScale], shape: FloatArray) -> dict[str, PortScale]:
        """Return the scales of a force over the planform, from those of its mean and the first mode."""
        share = self.wing.planform.share
        motion = np.array([self.wing.port_rows[port] @ shape for port in STATION_PORTS])
        ratio = motion / float(share @ motion)
        by_place = tuple(zip(share.tolist(), ratio.tolist(), strict=True))
        return {PLANFORM: replace(ports["span"], spread=by_place)}
