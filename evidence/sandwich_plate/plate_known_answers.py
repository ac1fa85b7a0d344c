"""The sandwich plate of `plate` against closed forms: a square plate and a cantilever strip."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skfem import MeshQuad

from fe.full.factorisation import Factorisation, lowest_eigenpairs

from .plate import FIELDS, A, B, Plate, Surface, U, V, W, plane_stress

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FlatSandwich:
    """Two flat faces and a core that only shears.

    Attributes
    ----------
    height : float
        Distance of the faces from the middle [m].
    thickness : float
        Of a face [m].
    young_modulus, poisson_ratio : float
        Of the faces, isotropic [Pa], [1].
    core_shear : float
        Shear modulus of the core [Pa].
    density : float
        Of the faces [kg/m^3].
    """

    height: float = 0.02
    thickness: float = 0.001
    young_modulus: float = 10e9
    poisson_ratio: float = 0.3
    core_shear: float = 20e6
    density: float = 1000.0

    @property
    def bending_stiffness(self) -> float:
        """D [N m]."""
        return 2.0 * self.young_modulus * self.thickness * self.height**2 / (1.0 - self.poisson_ratio**2)

    @property
    def shear_stiffness(self) -> float:
        """S [N/m]."""
        return 2.0 * self.height * self.core_shear

    @property
    def mass(self) -> float:
        """Mass per area [kg/m^2]."""
        return 2.0 * self.thickness * self.density

    def matrices(self, plate: Plate) -> tuple[FloatArray, FloatArray]:
        """Stiffness and mass (5 N, 5 N) on a plate."""
        cells = np.arange(plate.mesh.nelements)
        flat = np.zeros(plate.weights.shape)
        shear = self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))
        sheet = plane_stress(flat + self.young_modulus, self.poisson_ratio, flat + shear)
        core_shear = np.full((*flat.shape, 2), self.core_shear)
        stiffness = plate.core_stiffness(cells, flat + self.height, 0.0 * sheet, core_shear)
        for side in (1.0, -1.0):
            surface = Surface(flat + side * self.height, flat, flat)
            stiffness = stiffness + plate.face_stiffness(cells, surface, self.thickness, sheet)
        mass = plate.mass(cells, flat + self.mass, flat + self.mass * self.height**2)
        return stiffness.tocsr(), mass


@dataclass(frozen=True)
class PlateCheck:
    """A result of the plate and its closed form, in one unit."""

    found: float
    exact: float

    @property
    def relative_error(self) -> float:
        """Found over exact, less one."""
        return self.found / self.exact - 1.0


def _square(cells: int, side: float) -> tuple[Plate, NDArray[np.int64]]:
    """Square plate and the unknowns left free by a hard simple support of its bending."""
    lines = np.linspace(0.0, side, cells + 1)
    plate = Plate(MeshQuad.init_tensor(lines, lines))
    x, y = plate.node_points.T
    on_x, on_y = np.isclose(x * (side - x), 0.0), np.isclose(y * (side - y), 0.0)
    held = np.zeros((len(FIELDS), plate.nodes), dtype=bool)
    held[[U, V]] = True
    held[W], held[A], held[B] = on_x | on_y, on_y, on_x
    return plate, np.flatnonzero(~held.ravel())


def square_plate_deflection(cells: int = 8, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """Deflection [m] in the middle of a simply supported square plate under a uniform pressure.

    Closed form: Navier's double series for a shear-flexible plate, each term the sum of bending
    q / (D k^4) and shear q / (S k^2); S. Timoshenko and S. Woinowsky-Krieger, "Theory of Plates and Shells"
    (1959), article 30, with the shear term of E. Reissner (1945).
    """
    sandwich = sandwich or FlatSandwich()
    side, pressure = 1.0, 100.0
    plate, free = _square(cells, side)
    stiffness, _ = sandwich.matrices(plate)
    load = plate.load(W, np.full(plate.weights.shape, pressure))
    found = np.zeros(plate.unknowns)
    found[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    middle = int(np.argmin(np.abs(plate.node_points - 0.5 * side).sum(axis=1)))
    odd = np.arange(1.0, 2000.0, 2.0)
    sign = np.where(odd % 4.0 == 1.0, 1.0, -1.0)
    wave = (np.pi / side) ** 2 * (odd[:, None] ** 2 + odd**2)
    flexibility = 1.0 / (sandwich.bending_stiffness * wave**2) + 1.0 / (sandwich.shear_stiffness * wave)
    terms = np.outer(sign, sign) / np.outer(odd, odd) * flexibility
    exact = 16.0 * pressure / np.pi**2 * float(terms.sum())
    return PlateCheck(float(found[W * plate.nodes + middle]), exact)


def square_plate_frequency(cells: int = 8, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """First frequency [Hz] of a simply supported square plate.

    Closed form: w and the rotations are products of sines; with rotations -grad f, the amplitudes W and F of
    w and f obey S k^2 (W - F) = omega^2 m W and D k^2 F - S (W - F) = omega^2 J F, J the rotary inertia
    (Mindlin 1951).
    """
    sandwich = sandwich or FlatSandwich()
    side = 1.0
    plate, free = _square(cells, side)
    stiffness, mass = sandwich.matrices(plate)
    values, _ = lowest_eigenpairs(stiffness[free][:, free], mass[free][:, free], 1)
    wave = 2.0 * (np.pi / side) ** 2
    bending, shear = sandwich.bending_stiffness, sandwich.shear_stiffness
    left = np.array([[shear * wave, -shear * wave], [-shear, bending * wave + shear]])
    inertia = np.array([sandwich.mass, sandwich.mass * sandwich.height**2])
    exact = np.linalg.eigvals(left / inertia[:, None]).real.min()
    return PlateCheck(float(np.sqrt(values[0])) / (2.0 * np.pi), float(np.sqrt(exact)) / (2.0 * np.pi))


def cantilever_strip(cells: int = 4, sandwich: FlatSandwich | None = None) -> PlateCheck:
    """Tip deflection [m] of a clamped strip of faces without Poisson effect, under a force at its end.

    Closed form: Timoshenko's beam, F L^3 / (3 D b) + F L / (S b).
    """
    sandwich = sandwich or FlatSandwich(poisson_ratio=0.0)
    length, width, force = 1.0, 0.2, 10.0
    plate = Plate(MeshQuad.init_tensor(np.array([0.0, width]), np.linspace(0.0, length, cells + 1)))
    stiffness, _ = sandwich.matrices(plate)
    free = np.flatnonzero(np.tile(plate.node_points[:, 1] > 1e-9, len(FIELDS)))
    load = np.zeros(plate.unknowns)
    tip = np.flatnonzero(np.isclose(plate.node_points[:, 1], length))
    share = np.where(np.isclose(plate.node_points[tip, 0], 0.5 * width), 4.0, 1.0) / 6.0  # Simpson's rule
    load[W * plate.nodes + tip] = force * share
    found = np.zeros(plate.unknowns)
    found[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    bending, shear = (width * s for s in (sandwich.bending_stiffness, sandwich.shear_stiffness))
    exact = force * length**3 / (3.0 * bending) + force * length / shear
    return PlateCheck(float(found[W * plate.nodes + tip] @ share), exact)
