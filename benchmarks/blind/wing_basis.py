"""The finite element model of the wing, projected once onto a rich basis for cheap simulation.

The basis holds static solutions under every load of the campaign and at every place where something
may be hidden at three values of e, fourteen modes at two of them, again with other masses, and for
a damaged region all of these again with the damage. A point mass pulls at its place with all of its
inertia, so that the basis has the solutions under forces at each mesh line and half way between
two. Were there only every second line, the sixth frequency of a wing with 90 g at 1.38 m would be
0.5 % too high and its third 0.01 %, which a release of 6 s shows. It is not the basis of the
package's reduced model, and holds ten times as many vectors.
"""

from __future__ import annotations

import hashlib
import itertools
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.state import STANDARD_GRAVITY
from fe.wing.design import SHIPPED_DESIGN, WingDesign, load_design
from fe.wing.gauges import gauge_output
from fe.wing.operators import (
    ROOT_UNKNOWNS,
    AffineOperators,
    assemble,
    point_masses,
    section_displacement,
)

FloatArray = NDArray[np.float64]

FACTORS = (0.97, 1.0073, 1.045)
"""Values of e at which solutions are taken; modes at the first and the last."""
MODE_COUNT = 14
MASSES = ((0.169, 0.134), (0.155, 0.160))
"""Servo and pitot masses [kg] of the modes in the basis."""
HOLDER_SPAN = {"tip": (1.6, 1.83), "middle": (0.78, 1.04)}
"""Stations [m] between which a load may be applied."""
CHORDS = (0.3, 0.6, 0.9)
"""Webs on which loads are applied."""
PORT_STATIONS = (0.4, 1.828)
"""Stations [m] between which something may sit on the wing."""
MIDDLE = (0.914, 0.3)
"""The place of a middle load and displacement: y [m], chord fraction; there a rib meets a web."""
REGION_LINES = (
    (4, 7),
    (7, 9),
    (12, 14),
    (13, 15),
    (15, 17),
    (17, 19),
    (24, 26),
    (26, 28),
    (27, 30),
)
"""Regions that may be damaged: first and last mesh line along the span."""
REGION_LOSSES = (0.2, 0.6)
"""Losses at which the solutions in a damaged region's basis are taken, at two values of e."""


@dataclass(frozen=True)
class WingBasis:
    """The wing on r coordinates.

    Attributes
    ----------
    stiffness : (4, r, r)
        Skin, defect 1, defect 2, rest with the root springs [N/m],
        `AffineOperators.stiffness_terms`.
    mass : (3, r, r)
        Structure, unit servos, unit pitot.
    damaged : (3, r, r)
        Parts of the first three stiffness terms in the damaged region (zero without one).
    strain : (3, G, r)
        Strain along the span, across it, and half way between, positive in compression.
    displacement : (3, r)
        Upward displacement at the tip load's place, at the tip, in the middle.
    root : (r,)
        Flapping rotation of the root.
    stations, line : (S,) m, (3, S, r)
        Mesh lines along the span, and the displacement of the straight chord line there along x, y,
        z.
    line_between : (3, S - 1, r)
        The same half way between neighbouring mesh lines.
    holder_stations, holders : dict
        By "tip" and "middle": stations (H,) [m] and, by web, upward displacements (3, H, r) there.
    lift_stations, lift : (L,) m, (L, r) N
        Lift at load factor 1 without the weight, by station.
    weight : (r,) N
        Weight of structure and nominal masses, downwards.
    flap_spring : float
        [N m/rad].
    region : (2,) m
        Where the damaged region starts and ends (nan without one).
    """

    stiffness: FloatArray
    mass: FloatArray
    damaged: FloatArray
    strain: FloatArray
    displacement: FloatArray
    root: FloatArray
    stations: FloatArray
    line: FloatArray
    line_between: FloatArray
    tip_stations: FloatArray
    tip_holders: FloatArray
    middle_stations: FloatArray
    middle_holders: FloatArray
    corner: FloatArray
    lift_stations: FloatArray
    lift: FloatArray
    weight: FloatArray
    flap_spring: float
    region: FloatArray

    def save(self, file: Path) -> None:
        """Write to an `.npz` file, whole or not at all."""
        temporary = file.with_name(f"{file.stem}.{np.random.default_rng().integers(1 << 40):x}.npz")
        np.savez(temporary, **self.__dict__)
        temporary.replace(file)

    @classmethod
    def load(cls, file: Path) -> WingBasis:
        """Read what `save` wrote."""
        with np.load(file) as content:
            values = {name: content[name] for name in content.files}
        values["flap_spring"] = float(values["flap_spring"])
        return cls(**values)


class WingBasisStore:
    """Cached bases of the shipped wing, without damage and with each damaged region.

    Parameters
    ----------
    folder : Path, optional
        Where they are kept; a folder in the system's temporary one by default.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.design = load_design(SHIPPED_DESIGN)
        source = Path(__file__).read_bytes() + self.design.hash.encode()
        name = f"uav-twin-blind-{hashlib.sha256(source).hexdigest()[:16]}"
        self._folder = (folder or Path(tempfile.gettempdir())) / name
        self._bases: dict[int, WingBasis] = {}
        self._operators: AffineOperators | None = None
        self._vectors: FloatArray | None = None

    @property
    def operators(self) -> AffineOperators:
        """The full model."""
        if self._operators is None:
            self._operators = assemble(self.design)
        return self._operators

    def basis(self, region: int = -1) -> WingBasis:
        """Return the basis of the wing with a region that may be damaged, -1 for none."""
        if region not in self._bases:
            file = self._folder / f"region{region}.npz"
            if not file.is_file():
                self._folder.mkdir(parents=True, exist_ok=True)
                _build(self.operators, self._snapshots(), region).save(file)
            self._bases[region] = WingBasis.load(file)
        return self._bases[region]

    def _snapshots(self) -> FloatArray:
        if self._vectors is None:
            file = self._folder / "snapshots.npy"
            if not file.is_file():
                self._folder.mkdir(parents=True, exist_ok=True)
                temporary = file.with_name(f"s{np.random.default_rng().integers(1 << 40):x}.npy")
                np.save(temporary, _snapshots(self.operators))
                temporary.replace(file)
            self._vectors = np.load(file)
        return self._vectors


@dataclass(frozen=True)
class _Functionals:
    """Rows (., n) of what is applied to the wing or read from it, on the full unknowns."""

    displacement: FloatArray
    line_stations: FloatArray
    line: tuple[FloatArray, ...]
    line_between: tuple[FloatArray, ...]
    tip_stations: FloatArray
    tip_holders: tuple[FloatArray, ...]
    middle_stations: FloatArray
    middle_holders: tuple[FloatArray, ...]
    corner: FloatArray
    lift_stations: FloatArray
    lift: FloatArray
    weight: FloatArray
    root: FloatArray


def _functionals(operators: AffineOperators) -> _Functionals:
    mesh = operators.wing_mesh
    design, expansion = mesh.design, operators.expansion

    def rows(places: list[tuple[float, float]], component: int = 2) -> FloatArray:
        full = np.zeros((len(places), mesh.unknowns))
        for row, (y, chord) in enumerate(places):
            full[row, component::3] = section_displacement(mesh, y, chord)
        return np.asarray((expansion.T @ full.T).T)

    lines = mesh.span_lines
    line = lines[(lines >= PORT_STATIONS[0]) & (lines <= PORT_STATIONS[1])]
    between = 0.5 * (line[:-1] + line[1:])
    tip, middle = (lines[(lines > low) & (lines < high)] for low, high in HOLDER_SPAN.values())
    corner = design.planform.semi_span - design.tip_load.distance_from_tip

    weight = np.zeros(mesh.unknowns)
    weight[2::3] = -STANDARD_GRAVITY * operators.body.nodal_mass
    weight = np.asarray(expansion.T @ weight)

    # Lift without weight, by the station of its unknowns; the root's unknowns lie at station 0.
    free = np.asarray(expansion.T @ np.repeat(mesh.points[:, 1], 3))
    count = np.asarray(expansion.T @ np.ones(mesh.unknowns))
    station = np.where(np.abs(count) > 0.0, free / np.where(count == 0.0, 1.0, count), 0.0)
    station[-ROOT_UNKNOWNS:] = 0.0
    places, owner = np.unique(np.round(station, 9), return_inverse=True)
    lift = np.zeros((len(places), operators.unknowns))
    lift[owner, np.arange(operators.unknowns)] = operators.load_lift - weight
    root = np.zeros(operators.unknowns)
    root[-2] = 1.0
    return _Functionals(
        displacement=np.vstack([operators.load_tip, operators.tip_row, rows([MIDDLE])]),
        line_stations=line,
        line=tuple(rows([(y, 0.3) for y in line], c) for c in range(3)),
        line_between=tuple(rows([(y, 0.3) for y in between], c) for c in range(3)),
        tip_stations=tip,
        tip_holders=tuple(rows([(y, chord) for y in tip]) for chord in CHORDS),
        middle_stations=middle,
        middle_holders=tuple(rows([(y, chord) for y in middle]) for chord in CHORDS),
        corner=rows([(corner, 0.9)])[0],
        lift_stations=np.asarray(places, dtype=np.float64),
        lift=lift,
        weight=weight,
        root=root,
    )


def _loads(functionals: _Functionals, design: WingDesign) -> FloatArray:
    """Return the loads (n, k) whose static solutions are in the basis."""
    f = functionals
    eta = f.lift_stations / design.planform.semi_span
    washed = [(eta**p) @ f.lift for p in (0.0, 1.0, 1.5, 2.0, 3.0)]
    return np.vstack(
        [
            f.displacement,
            f.corner,
            f.line[0][::2],
            f.line[2],
            f.line_between[2],
            *f.tip_holders,
            *f.middle_holders[:2],
            *washed,
            f.weight,
            f.root,
        ]
    ).T


def _snapshots(operators: AffineOperators) -> FloatArray:
    loads = _loads(_functionals(operators), operators.wing_mesh.design)
    found = []
    for factor in FACTORS:
        stiffness = operators.stiffness({"young_modulus_factor": factor})
        found.append(Factorisation(stiffness).solve(loads))
        for servo, pitot in MASSES if factor != FACTORS[1] else ():
            mass = operators.mass(point_masses(servo, pitot))
            found.append(lowest_eigenpairs(stiffness, mass, MODE_COUNT)[1])
    return np.hstack(found)


def _region_stiffness(
    operators: AffineOperators, region: int
) -> tuple[list[sparse.csr_array], FloatArray]:
    mesh = operators.wing_mesh
    start, end = (float(mesh.span_lines[k]) for k in REGION_LINES[region])
    inside = (mesh.centres[:, 1] > start) & (mesh.centres[:, 1] < end)
    parts = []
    for term in range(3):
        cells = np.flatnonzero(inside & (mesh.region == term))
        parts.append(operators.body.stiffness(cells))
    return parts, np.array([start, end])


def _build(operators: AffineOperators, snapshots: FloatArray, region: int) -> WingBasis:
    design = operators.wing_mesh.design
    f = _functionals(operators)
    parts: list[sparse.csr_array] = []
    place = np.full(2, np.nan)
    if region >= 0:
        parts, place = _region_stiffness(operators, region)
        vectors = [snapshots]
        loads = np.vstack([f.displacement, f.corner, f.lift.sum(axis=0), f.weight, f.root]).T
        # at both ends of e: a strain beside the damage depends on the ratio of skin and spar
        for factor, loss in itertools.product((FACTORS[0], FACTORS[-1]), REGION_LOSSES):
            sound = operators.stiffness({"young_modulus_factor": factor})
            stiffness = (sound - loss * (factor * parts[0] + parts[1] + parts[2])).tocsr()
            vectors.append(Factorisation(stiffness).solve(loads))
            mass = operators.mass(point_masses(*MASSES[0]))
            vectors.append(lowest_eigenpairs(stiffness, mass, MODE_COUNT)[1])
        snapshots = np.hstack(vectors)
    basis = _orthonormal(snapshots)

    def projected(matrix: sparse.sparray) -> FloatArray:
        small = basis.T @ (matrix @ basis)
        return np.asarray(0.5 * (small + small.T))

    r = basis.shape[1]
    strain = [operators.gauge_output @ basis]
    for angle in (0.5 * np.pi, 0.25 * np.pi):
        strain.append(gauge_output(operators.wing_mesh, angle) @ operators.expansion @ basis)
    return WingBasis(
        stiffness=np.array([projected(term.matrix) for term in operators.stiffness_terms]),
        mass=np.array([projected(term) for term in operators.mass_terms]),
        damaged=np.array([projected(part) for part in parts]) if parts else np.zeros((3, r, r)),
        strain=np.array(strain),
        displacement=f.displacement @ basis,
        root=f.root @ basis,
        stations=f.line_stations,
        line=np.array([rows @ basis for rows in f.line]),
        line_between=np.array([rows @ basis for rows in f.line_between]),
        tip_stations=f.tip_stations,
        tip_holders=np.array([rows @ basis for rows in f.tip_holders]),
        middle_stations=f.middle_stations,
        middle_holders=np.array([rows @ basis for rows in f.middle_holders]),
        corner=f.corner @ basis,
        lift_stations=f.lift_stations,
        lift=f.lift @ basis,
        weight=f.weight @ basis,
        flap_spring=design.root.flap_spring,
        region=place,
    )


def _orthonormal(vectors: FloatArray, least: float = 1e-8) -> FloatArray:
    """Return an orthonormal basis (n, r) of vectors (n, k) without nearly dependent directions.

    Orthonormal in the plain sense: energies of smooth fields are known to a millionth only.
    """
    basis, size, _ = linalg.svd(vectors / np.linalg.norm(vectors, axis=0), full_matrices=False)
    return np.ascontiguousarray(basis[:, size > least * size[0]])
