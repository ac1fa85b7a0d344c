"""The sandwich plate of `plate` against closed forms: a square plate and a cantilever strip."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skfem import MeshQuad

from fe.full.factorisation import Factorisation, lowest_eigenpairs

from .plate import FIELDS, A, B, Plate, Surface, U, V, W, plane_stress

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class FlatSandwich:
    """Two flat faces and a core that only shears.

    Attributes
    ----------
    height : float
        Distance of the faces from the middle [m].
    thickness : float
        Thickness of a face [m].
    young_modulus, poisson_ratio : float
        Young's modulus [Pa] and Poisson's ratio of the faces, which are isotropic.
    core_shear : float
        Shear modulus of the core [Pa].
    density : float
        Density of the faces [kg/m^3].
    """

    height: float = 0.02
    thickness: float = 0.001
    young_modulus: float = 10e9
    poisson_ratio: float = 0.3
    core_shear: float = 20e6
    density: float = 1000.0

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness D per width [N m]."""
        bending = 2.0 * self.young_modulus * self.thickness * self.height**2
        return bending / (1.0 - self.poisson_ratio**2)

    @property
    def shear_stiffness(self) -> float:
        """Shear stiffness S per width [N/m]."""
        return 2.0 * self.height * self.core_shear

    @property
    def mass(self) -> float:
        """Mass per area [kg/m^2]."""
        return 2.0 * self.thickness * self.density

    @property
    def rotary_inertia(self) -> float:
        """Rotary inertia per area [kg]."""
        return self.mass * self.height**2

    def matrices(self, plate: Plate) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Return stiffness and mass (5 N, 5 N) on a plate."""
        cells = plate.every_cell
        zero = np.zeros(plate.weights.shape)
        face_shear = self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))
        sheet = plane_stress(zero + self.young_modulus, self.poisson_ratio, zero + face_shear)
        core_shear = np.full((*zero.shape, 2), self.core_shear)
        stiffness = plate.core_stiffness(cells, zero + self.height, 0.0 * sheet, core_shear)
        for side in (1.0, -1.0):
            surface = Surface(zero + side * self.height, zero, zero)
            stiffness = stiffness + plate.face_stiffness(cells, surface, self.thickness, sheet)
        mass = plate.mass(cells, zero + self.mass, zero + self.rotary_inertia)
        return stiffness.tocsr(), mass


@dataclass(frozen=True)
class PlateCheck:
    """A result of the plate and its closed form, in one unit.

    Attributes
    ----------
    computed : float
        Result of the plate.
    exact : float
        Closed form.
    """

    computed: float
    exact: float

    @property
    def relative_error(self) -> float:
        """Relative error of the plate."""
        return self.computed / self.exact - 1.0


def _square(cells: int, side: float) -> tuple[Plate, IntArray]:
    """Return a square plate and the unknowns that a hard simple support of its bending leaves free.

    Parameters
    ----------
    cells : int
        Number of cells along each edge.
    side : float
        Length of an edge [m].
    """
    lines = np.linspace(0.0, side, cells + 1)
    plate = Plate(MeshQuad.init_tensor(lines, lines))
    x, y = plate.node_points.T
    on_edge_in_x = np.isclose(x * (side - x), 0.0)
    on_edge_in_y = np.isclose(y * (side - y), 0.0)
    held = np.zeros((len(FIELDS), plate.nodes), dtype=bool)
    held[[U, V]] = True
    held[W] = on_edge_in_x | on_edge_in_y
    held[A] = on_edge_in_y
    held[B] = on_edge_in_x
    return plate, np.flatnonzero(~held.ravel())


def _solution(stiffness: sparse.csr_array, load: FloatArray, free: IntArray) -> FloatArray:
    """Return the displacements (n,) under a load (n,), which are zero but for the free unknowns."""
    displacement = np.zeros(len(load))
    displacement[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    return displacement


def square_plate_deflection(cells: int = 8, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """Deflection [m] in the middle of a simply supported square plate under a uniform pressure.

    The closed form is Navier's double series for a shear-flexible plate. Each term is the sum of
    bending q / (D k^4) and shear q / (S k^2). See S. Timoshenko and S. Woinowsky-Krieger, "Theory
    of Plates and Shells" (1959), article 30, with the shear term of E. Reissner (1945).

    Parameters
    ----------
    cells : int
        Number of cells along each edge.
    sandwich : FlatSandwich, optional
        Section of the plate.
    """
    sandwich = sandwich or FlatSandwich()
    side = 1.0
    pressure = 100.0

    # Deflection of the plate
    plate, free = _square(cells, side)
    stiffness, _ = sandwich.matrices(plate)
    load = plate.load(W, np.full(plate.weights.shape, pressure))
    displacement = _solution(stiffness, load, free)
    middle = int(np.argmin(np.abs(plate.node_points - 0.5 * side).sum(axis=1)))
    computed = float(displacement[W * plate.nodes + middle])

    # Navier's double series
    odd = np.arange(1.0, 2000.0, 2.0)
    sign = np.where(odd % 4.0 == 1.0, 1.0, -1.0)
    wave = (np.pi / side) ** 2 * (odd[:, None] ** 2 + odd**2)
    bending_flexibility = 1.0 / (sandwich.bending_stiffness * wave**2)
    shear_flexibility = 1.0 / (sandwich.shear_stiffness * wave)
    flexibility = bending_flexibility + shear_flexibility
    terms = np.outer(sign, sign) / np.outer(odd, odd) * flexibility
    exact = 16.0 * pressure / np.pi**2 * float(terms.sum())
    return PlateCheck(computed, exact)


def square_plate_frequency(cells: int = 8, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """First frequency [Hz] of a simply supported square plate.

    In the closed form, w and the rotations are products of sines. With rotations -grad f, the
    amplitudes W and F of w and f obey S k^2 (W - F) = omega^2 m W and
    D k^2 F - S (W - F) = omega^2 J F, with the rotary inertia J (Mindlin 1951).

    Parameters
    ----------
    cells : int
        Number of cells along each edge.
    sandwich : FlatSandwich, optional
        Section of the plate.
    """
    sandwich = sandwich or FlatSandwich()
    side = 1.0

    # Frequency of the plate
    plate, free = _square(cells, side)
    stiffness, mass = sandwich.matrices(plate)
    eigenvalues, _ = lowest_eigenpairs(stiffness[free][:, free], mass[free][:, free], 1)
    computed = float(np.sqrt(eigenvalues[0])) / (2.0 * np.pi)

    # Equations of both amplitudes
    wave = 2.0 * (np.pi / side) ** 2
    bending = sandwich.bending_stiffness
    shear = sandwich.shear_stiffness
    stiffness_of_amplitudes = np.array(
        [[shear * wave, -shear * wave], [-shear, bending * wave + shear]]
    )
    inertia = np.array([sandwich.mass, sandwich.rotary_inertia])
    squared_frequencies = np.linalg.eigvals(stiffness_of_amplitudes / inertia[:, np.newaxis])
    exact = float(np.sqrt(squared_frequencies.real.min())) / (2.0 * np.pi)
    return PlateCheck(computed, exact)


def cantilever_strip(cells: int = 4, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """Tip deflection [m] of a clamped strip under a force at its end.

    The faces have no Poisson effect by default. The closed form is Timoshenko's beam,
    F L^3 / (3 D b) + F L / (S b).

    Parameters
    ----------
    cells : int
        Number of cells along the strip.
    sandwich : FlatSandwich, optional
        Section of the strip.
    """
    sandwich = sandwich or FlatSandwich(poisson_ratio=0.0)
    length = 1.0
    width = 0.2
    force = 10.0
    chord_lines = np.array([0.0, width])
    span_lines = np.linspace(0.0, length, cells + 1)
    plate = Plate(MeshQuad.init_tensor(chord_lines, span_lines))
    x, y = plate.node_points.T

    # The force over the nodes of the end by Simpson's rule
    end = np.flatnonzero(np.isclose(y, length))
    weights = np.where(np.isclose(x[end], 0.5 * width), 4.0, 1.0) / 6.0
    end_deflections = W * plate.nodes + end
    load = np.zeros(plate.unknowns)
    load[end_deflections] = force * weights

    stiffness, _ = sandwich.matrices(plate)
    free = np.flatnonzero(np.tile(y > 1e-9, len(FIELDS)))
    displacement = _solution(stiffness, load, free)
    bending = width * sandwich.bending_stiffness
    shear = width * sandwich.shear_stiffness
    exact = force * length**3 / (3.0 * bending) + force * length / shear
    return PlateCheck(float(displacement[end_deflections] @ weights), exact)
