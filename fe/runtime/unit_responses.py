"""Responses of a structure to unit loads, split into its modes and the modes that are left out.

NumPy and relative imports only: this file is copied into the FMU.
"""

from functools import cached_property

import numpy as np

from .arrays import FloatArray
from .modal_system import ModalSystem, rayleigh_damping_ratio
from .structure_in_motion import StructureInMotion


class UnitResponses:
    """Responses of a structure to its L + J unit loads: L loads, then forces at ports of J laws.

    Parameters
    ----------
    structure : StructureInMotion
        The structure, with M modes and n coordinates.
    damping_alpha, damping_beta : float
        Rayleigh damping [1/s], [s].
    """

    def __init__(
        self, structure: StructureInMotion, damping_alpha: float, damping_beta: float
    ) -> None:
        self.structure = structure
        self.alpha = damping_alpha
        self.beta = damping_beta
        law_count = 0 if structure.laws is None else len(structure.laws)
        self.load_count = structure.unit_loads.shape[1] - law_count

    @cached_property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,) of the modes."""
        return rayleigh_damping_ratio(self.alpha, self.beta, self.structure.modes.frequency)

    @cached_property
    def omega(self) -> FloatArray:
        """Angular frequencies (M,) of the modes [rad/s]."""
        return np.asarray(2.0 * np.pi * self.structure.modes.frequency)

    @cached_property
    def participation(self) -> FloatArray:
        """Modal forces (M, L + J) of the unit loads."""
        return np.asarray(self.structure.mode_shapes.T @ self.structure.unit_loads)

    @cached_property
    def modal_coordinates(self) -> FloatArray:
        """Static modal coordinates (M, L + J) under the unit loads."""
        return np.asarray(self.participation / self.omega[:, np.newaxis] ** 2)

    @cached_property
    def residual_displacements(self) -> FloatArray:
        """Static displacements (n, L + J) under the unit loads in the modes that are left out."""
        modal_displacements = self.structure.mode_shapes @ self.modal_coordinates
        return np.asarray(self.structure.unit_responses - modal_displacements)

    @cached_property
    def modal_outputs(self) -> FloatArray:
        """Outputs (O, M) per unit of modal coordinate."""
        return np.asarray(self.structure.output_rows @ self.structure.mode_shapes)

    @cached_property
    def residual_outputs(self) -> FloatArray:
        """Static outputs (O, L + J) under the unit loads in the modes that are left out."""
        return np.asarray(self.structure.output_rows @ self.residual_displacements)

    @property
    def law_loads(self) -> FloatArray:
        """Unit loads (n, J) at the ports of the laws."""
        return self.structure.unit_loads[:, self.load_count :]

    @cached_property
    def port_positions(self) -> FloatArray:
        """Static positions (J, L + J) of the laws' ports under the unit loads."""
        return np.asarray(self.law_loads.T @ self.structure.unit_responses)

    @property
    def port_positions_by_loads(self) -> FloatArray:
        """Static positions (J, L) of the laws' ports under the first L unit loads."""
        return self.port_positions[:, : self.load_count]

    @property
    def port_compliance(self) -> FloatArray:
        """Static positions (J, J) of the laws' ports under unit forces at them."""
        return self.port_positions[:, self.load_count :]

    @cached_property
    def system(self) -> ModalSystem:
        """The modes as a damped system, with the ports at which laws act."""
        damping = np.diag(self.alpha + self.beta * self.omega**2)
        if self.structure.laws is None:
            return ModalSystem(self.omega, damping)
        names = self.structure.laws.ports
        rows = self.participation[:, self.load_count :].T
        # residual flexibility: what the modes that are left out add, which is the static
        # compliance minus that of the modes; below 1e-9 of the former it is rounding
        flexibility = np.diag(self.port_compliance)
        residual_flexibility = flexibility - np.sum((rows / self.omega) ** 2, axis=1)
        is_flexible = np.array(
            [name not in self.structure.rigid_ports for name in names], dtype=bool
        )
        residual_flexibility = np.where(
            (residual_flexibility > 1e-9 * flexibility) & is_flexible, residual_flexibility, 0.0
        )
        # several laws may act at one port
        row_of_port = dict(zip(names, rows, strict=True))
        residual_of_port = dict(zip(names, residual_flexibility.tolist(), strict=True))
        return ModalSystem(
            angular_frequency=self.omega,
            damping=damping,
            ports=row_of_port,
            flexibility=np.array(list(residual_of_port.values())),
            relaxation=self.beta,
        )
