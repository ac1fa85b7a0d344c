"""The interface between structures and the integrator of motion.

Standard library, NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import TYPE_CHECKING, Protocol

from .arrays import FloatArray

if TYPE_CHECKING:
    from .port_laws import PortLaws


class ModeSet(Protocol):
    """Undamped modes of a structure."""

    @property
    def frequency(self) -> FloatArray:
        """Natural frequencies (M,) [Hz]."""
        ...


class StructureInMotion(Protocol):
    """A structure with fixed inputs and patch, in n coordinates of its own.

    It has L unit loads, J laws at ports, M modes, O static outputs and A accelerations.
    `ReducedStructure` and `PatchedStructure` are such structures.
    """

    @property
    def laws(self) -> "PortLaws | None":
        """The laws at its ports; None if the structure cannot have any."""
        ...

    @property
    def unit_loads(self) -> FloatArray:
        """Unit loads (n, L + J), the last J at the ports of the laws.

        As rows they give the displacements of their points.
        """
        ...

    @property
    def unit_responses(self) -> FloatArray:
        """Static displacements (n, L + J) under the unit loads."""
        ...

    @property
    def holding_load(self) -> int | None:
        """Index of the load that holds the structure before a release, and never acts later.

        When it ends, the displacement in the left-out modes decays with the same lag with which
        they follow forces of laws. None if the structure has no such load.
        """
        ...

    @property
    def modes(self) -> ModeSet:
        """The M modes with inertia; the others are left out."""
        ...

    @property
    def mode_shapes(self) -> FloatArray:
        """Shapes (n, M) of the modes, mass-normalised."""
        ...

    @property
    def modal_projection(self) -> FloatArray:
        """Matrix (M, n) from displacements to modal coordinates."""
        ...

    @property
    def rigid_ports(self) -> frozenset[str]:
        """Names of ports that have no residual flexibility in motion."""
        ...

    @property
    def output_rows(self) -> FloatArray:
        """Rows (O, n) of gauges and displacements; a release is measured by the last one."""
        ...

    @property
    def acceleration_rows(self) -> FloatArray:
        """Rows (A, n) of the accelerations."""
        ...

    @property
    def strain_component_rows(self) -> FloatArray:
        """Rows (2, G, n) of transverse and shear strains at G gauges, or none if unknown."""
        ...

    def load_coefficients(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (L,) of the loads for inputs (V,)."""
        ...
