"""The structure of the wing in the states that are asked for: stiffness, motion, rows of outputs; kept."""

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import Quantity
from discrepancy.errors import ModelError
from discrepancy.models.memory import Memory
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch, ModulusTemperature, PointMass, RootCompliance
from fe.runtime.patched_structure import motion_basis
from fe.runtime.patched_wing import ON_MODES, PORTS, PatchedWing, Place, strain_gauge
from fe.runtime.state import Losses

FloatArray = NDArray[np.float64]
Outputs = tuple[tuple[str, Quantity], ...]
Key = Hashable

MODE_COUNT = 6
"""Modes that move in ring-downs and under forces; those of the FMU."""


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


class MovingWing(NamedTuple):
    """The wing in a basis (n, k) of its first modes and some static shapes."""

    basis: FloatArray
    system: SecondOrderSystem


class WingStructure:
    """The wing in the states and under the structural patches that were asked for, each made once.

    Parameters
    ----------
    wing : PatchedWing
        The wing for patches.

    Attributes
    ----------
    point_rows : (3, n) ndarray
        Displacements of `PORTS` by the unknowns.
    """

    def __init__(self, wing: PatchedWing) -> None:
        self.wing = wing
        self.point_rows = np.stack([wing.port_rows[port] for port in PORTS])
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
            lambda: Stiffness(
                self.wing.structure(float(parameters[0]), health, 0.0, 0.0, structure, temperature).stiffness
            ),
        )

    def moving(
        self,
        parameters: FloatArray,
        health: Losses,
        structure: ModelPatch,
        temperature: float,
        place: Place,
        ports: tuple[str, ...] = (),
    ) -> MovingWing:
        """Return the wing as it moves when released from, or pushed at, a place, with forces at `ports`."""
        key = self.stiffness_key(parameters, health, structure, temperature)
        masses = structure.of(PointMass)
        held = self.wing.held_ports(ports)

        def make() -> MovingWing:
            e, servo, pitot, alpha, beta = (float(value) for value in parameters)
            stiffness = self.stiffness(parameters, health, structure, temperature)
            mass = self.wing.structure(e, health, servo, pitot, masses).mass
            still = stiffness.solve(np.vstack((self.wing.force_row(place), *held.values())).T)
            basis = motion_basis(stiffness.solve, mass, self.wing.arrays.start_shapes, still)
            small_mass, small = basis.T @ mass @ basis, basis.T @ stiffness.matrix @ basis
            small_mass, small = 0.5 * (small_mass + small_mass.T), 0.5 * (small + small.T)
            return MovingWing(
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

    def static_units(
        self,
        stiffness: Stiffness,
        place: Place | None,
        loads: ModelPatch,
        blocks: list[FloatArray],
        port_rows: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return outputs (k, C) and motions (k, J) of ports of unit loads, and the same of unit port forces.

        Parameters
        ----------
        stiffness : Stiffness
            Of the wing.
        place : str or tuple of float, optional
            Of a force of 1 N; left out, the loads are the parts of the lift.
        loads : ModelPatch
            What changes them.
        blocks : list of (C, n) ndarray
            Rows of outputs.
        port_rows : (J, n) ndarray
            Rows of the ports.
        """
        units = self.wing.load_parts(loads) if place is None else self.wing.force_row(place, loads)[None]
        answer = stiffness.solve(np.concatenate((units, port_rows)).T)
        shown = np.concatenate([rows @ answer for rows in blocks]).T
        moved = (port_rows @ answer).T
        count = len(units)
        return shown[:count], moved[:count], shown[count:], moved[count:]
