"""Structures and the wing against CalculiX on the identical mesh: statics, modes and a ring-down.

CalculiX (`ccx`, Debian package calculix-ccx) is an independent finite element code. It gets nodes, cells,
local material constants with their orientations, supports and springs, rigid sets as equations on two
reference nodes, and point masses as blocks tied to the structure; it integrates, assembles and solves on its
own, and applies pressures and acceleration fields itself. What is read are nodes whose displacement is the
strain or displacement, by an equation, because printed displacements hold seven digits only.

First the input, then how CalculiX runs on it, and the tables that it prints (`.dat`).
"""

import itertools
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import StrictUndefined, Template
from numpy.typing import ArrayLike
from scipy import sparse

from fe.elements.cells import CellMesh
from fe.elements.kinds import HEXAHEDRA_20, WEDGES_6, gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import CalculixError
from fe.runtime.state import DigitalState
from fe.sentences import said
from fe.structure.affine import AffineStructure, natural_frequencies
from fe.structure.design import Load
from fe.structure.mesh import Body
from fe.structure.operators import Structure
from fe.wing.operators import AffineOperators, wing_values

PRINTED = [0, 1, 2, 5, 4, 3]
"""Places of our strains in the order of CalculiX: xx, yy, zz, xy, xz, yz."""
ANISOTROPIC = tuple(
    np.array([(PRINTED[row], PRINTED[column]) for column in range(6) for row in range(column + 1)]).T
)
"""Rows and columns of an elasticity in the order of CalculiX's 21 anisotropic constants."""
TEST_FORCE = 10.0
"""Upward force of the static test of a wing, and before its ring-down [N]."""
_BLOCK = 0.01  # side of the block that stands for a point mass [m]
Term = tuple[int, int, float]
"""A node, its direction from 1, and what stands with it: a force or a factor."""


class Step(NamedTuple):
    """A step of a job.

    Attributes
    ----------
    load : (n,) N
        What acts, in the place of that of the step before; empty where that stays.
    lines : iterable of str
        Loads that CalculiX applies itself, and what is printed.
    nodal : bool
        Whether the load is given as forces of nodes, and not by lines.
    procedure : tuple of str
        Lines that say what is solved.
    """

    load: FloatArray = np.empty(0)
    lines: Iterable[str] = ()
    nodal: bool = True
    procedure: tuple[str, ...] = ("*STATIC",)


class Grading(NamedTuple):
    """Elasticity that changes inside cells: its `course`, rows of a temperature and a factor.

    Attributes
    ----------
    course : list of (float, float)
        Factor on the elasticity at rising temperatures.
    temperatures : (nodes,)
        Of the nodes, along which it changes.
    cells : (nc,) bool
        Where it changes; elsewhere the factor is one.
    """

    course: list[tuple[float, float]]
    temperatures: FloatArray
    cells: BoolArray


@dataclass(frozen=True)
class CalculixDeck:
    """A model in one state, as input for CalculiX.

    Attributes
    ----------
    title : str
        What it is.
    structure : AffineStructure
        The model.
    body : Body
        What it is made of; the n free unknowns are in the order of its supports.
    values : mapping of str to float
        Its state by name; what is left out is nominal, and healthy.
    loads : mapping of str to Step
        Static steps of its loads, each alone.
    grading : Grading, optional
        Where the elasticity changes inside cells.
    damping : (float, float)
        Rayleigh damping [1/s] and [s] of a step in time.
    """

    title: str
    structure: AffineStructure
    body: Body[CellMesh]
    values: Mapping[str, float]
    loads: Mapping[str, Step]
    grading: Grading | None = None
    damping: tuple[float, float] = (0.0, 0.0)

    @property
    def _materials(self) -> Iterator[tuple[list[tuple[float, FloatArray]], float, IntArray]]:
        """Constants of CalculiX at temperatures, density and cells of each material in this state."""
        parameters, losses, _ = self.structure.parted(self.values)
        body, factor = self.body, self.structure.theta(parameters, losses)[self.body.part]
        graded = np.zeros(len(factor)) if self.grading is None else self.grading.cells
        constants = factor[:, None] * body.elasticity[:, *ANISOTROPIC]
        whole = np.column_stack((constants, body.density, graded))
        rows, owner = np.unique(whole, axis=0, return_inverse=True)
        for number, (*own, density, changes) in enumerate(rows):
            course = self.grading.course if self.grading is not None and changes else [(0.0, 1.0)]
            courses = [(temperature, share * np.array(own)) for temperature, share in course]
            yield courses, density, np.flatnonzero(owner == number)

    @cached_property
    def probes(self) -> FloatArray:
        """Rows (m, n) of what is read, on the free unknowns."""
        rows = sparse.vstack((self.structure.gauge_output, self.structure.displacement_output))
        return np.asarray(rows.toarray())

    def text(self, *steps: Step) -> str:
        """Input of a job: the model, then its steps."""
        held, points = self.body.supports, self.body.mesh.points
        masses = ((self.values.get(own.name, own.mass), own.shares) for own in self.body.masses)
        heavy = [(mass, shares) for mass, places in masses for shares in places if mass > 0.0]
        # Behind the nodes of the mesh: those of rigid motions, eight of each point mass, then the probes.
        motions = len(held.springs) - len(held.alone)
        first = len(points) + 1 - (-motions // 3)
        first_probe = first + 8 * len(heavy)
        corners = np.arange(first, first_probe).reshape(-1, 8).tolist()
        blocks = [(nodes, *block) for nodes, block in zip(corners, heavy, strict=True)]
        side, still = HEXAHEDRA_20.places[:8] * _BLOCK, np.diff(held.expansion.indptr) == 0
        file = resources.files("fe.verification").joinpath("templates/calculix.inp.jinja")
        source = file.read_text(encoding="utf-8")
        template: Template = Template(source, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
        return template.render(
            deck=self,
            numbers=number_line,
            materials=self._materials,
            cells=np.column_stack((np.arange(len(self.body.mesh.cells)), self.body.mesh.cells)) + 1,
            motion_nodes=range(len(points) + 1, first),
            held=map(_place, (*np.flatnonzero(still), *range(3 * len(points) + motions, 3 * first - 3))),
            springs=[*self.terms(held.springs)],
            blocks=[
                (mass, [*zip(nodes, shares @ points + side, strict=True)]) for nodes, mass, shares in blocks
            ],
            block_side=_BLOCK,
            probe_nodes=range(first_probe, first_probe - (-len(self.probes) // 3)),
            equations=self._equations([(nodes, shares) for nodes, _, shares in blocks], first_probe),
            steps=steps,
        )

    def _equations(
        self, blocks: Iterable[tuple[list[int], FloatArray]], first_probe: int
    ) -> Iterator[list[Term]]:
        """Yield sums that are zero, of which the first term depends on the others."""
        held = self.body.supports
        for row in np.setdiff1d(np.flatnonzero(np.diff(held.expansion.indptr)), held.alone).tolist():
            yield [(*_place(row), -1.0), *self.terms(held.expansion[[row]].toarray()[0])]
        for nodes, shares in blocks:
            moved = [(own + 1, float(shares[own])) for own in np.flatnonzero(shares).tolist()]
            for node, component in itertools.product(nodes, (1, 2, 3)):
                yield [(node, component, -1.0), *((own, component, share) for own, share in moved)]
        for number, row in enumerate(self.probes):
            yield [(first_probe + number // 3, number % 3 + 1, -1.0), *self.terms(row)]

    @cached_property
    def places(self) -> list[tuple[int, int]]:
        """Node and direction of each free unknown."""
        held, behind = self.body.supports, self.body.mesh.unknowns
        motions = range(behind, behind + len(held.springs) - len(held.alone))
        return [_place(unknown) for unknown in (*held.alone.tolist(), *motions)]

    def terms(self, values: FloatArray) -> Iterator[Term]:
        """Yield node, direction and value of the values (n,) that are not zero."""
        for unknown in np.flatnonzero(values).tolist():
            yield (*self.places[unknown], float(values[unknown]))


def _place(unknown: int) -> tuple[int, int]:
    """Return node and direction, both from 1, of an unknown."""
    return unknown // 3 + 1, unknown % 3 + 1


def number_line(values: ArrayLike) -> str:
    """Return numbers with the digits of a double, at most 20 characters each, as CalculiX reads them."""
    return ",".join(f"{value:.13E}" for value in np.asarray(values).ravel().tolist())


def structure_deck(structure: Structure) -> CalculixDeck:
    """Return a structure, undamaged and with nominal parameters and masses.

    Raises
    ------
    CalculixError
        If CalculiX has no element that is integrated in the same way.
    """
    mesh, design = structure.mesh, structure.design
    if mesh.kind is WEDGES_6:  # C3D6 at two points
        raise CalculixError(said("calculix.wedges", kind=mesh.kind))
    loads = {load.name: _load_step(structure, load) for load in design.load}
    return CalculixDeck("structure", structure, structure.body, {}, loads)


def _load_step(structure: Structure, load: Load) -> Step:
    """Return the static step of a load of a structure, its control as of `control_value_alone`."""
    factor = structure.control_value_alone(load.name)
    lines = ["*DLOAD, OP=NEW"]
    if load.acceleration is not None:
        size = float(np.linalg.norm(load.acceleration))
        direction = np.sign(factor) * np.asarray(load.acceleration) / size
        lines.append(f"EHEAVY,GRAV,{number_line([abs(factor) * size, *direction])}")
    elif load.pressure is not None and load.set is not None:
        surface = structure.mesh.faces_of(load.set, load.name)
        for cell, face in zip(surface.cell, surface.face, strict=True):
            lines.append(f"{cell + 1},P{face + 1},{number_line([factor * load.pressure])}")
    else:
        lines.append("EALL,GRAV,0.,0.,0.,1.")
    return Step(structure.load(load.name, factor), lines, load.force is not None)


def wing_deck(operators: AffineOperators, state: DigitalState) -> CalculixDeck:
    """Return the wing in one state."""
    mesh, design, body = operators.wing_mesh, operators.wing_mesh.design, operators.body
    plan, lift, skin, grading = design.planform, design.lift, design.skin, None
    if skin.stations:  # the station of a node stands as its temperature, on which the skin depends
        graded = (mesh.web < 0) & (mesh.rib < 0)
        centre = np.where(graded, skin.young_modulus(mesh.centres[:, 1] / plan.semi_span), 1.0)
        body = replace(body, elasticity=body.elasticity / centre[:, None, None])
        course = [(place.station, place.young_modulus) for place in skin.stations]
        grading = Grading(course, mesh.points[:, 1] / plan.semi_span, graded)
    return CalculixDeck(
        "wing, design",
        operators,
        body,
        wing_values(operators, stiffness_loss=state.stiffness_loss, **state.values),
        {"tip force": Step(operators.turn(0.0, TEST_FORCE)), "lift": Step(operators.turn(lift.load_factor))},
        grading,
        (state.damping_alpha, state.damping_beta),
    )


PROGRAM = "ccx"
_TIME_LIMIT = 3600.0


def calculix_program() -> str | None:
    """Return the path of CalculiX, or nothing where it is not installed."""
    return shutil.which(PROGRAM)


def required_calculix() -> str:
    """Return the path of CalculiX; raises `CalculixError` where it is not installed."""
    if program := calculix_program():
        return program
    raise CalculixError(said("calculix.missing", program=PROGRAM))


_HEADER = re.compile(r"^ *(\w[\w ]*?) \(.*\) for set (\w+) and time +\S+$", re.MULTILINE)


def read_tables(text: str) -> dict[str, list[FloatArray]]:
    """Read the tables of nodes and integration points of a `.dat` file: rows (n, ...), by the names of sets.

    Raises
    ------
    CalculixError
        If a table holds something other than numbers.
    """
    tables: dict[str, list[FloatArray]] = {}
    _, *found = _HEADER.split(text)
    for what, name, body in zip(found[::3], found[1::3], found[2::3], strict=True):
        try:
            rows = np.loadtxt(body.splitlines(), ndmin=2)
        except ValueError as error:
            raise CalculixError(said("calculix.table", what=what, error=error)) from None
        tables.setdefault(name, []).append(rows)
    return tables


def read_frequencies(text: str) -> FloatArray:
    """Read the frequencies [Hz] of the table of eigenvalues in a `.dat` file.

    Raises
    ------
    CalculixError
        If there is no such table.
    """
    table = text.partition("E I G E N V A L U E   O U T P U T")[2].partition("P A R T I C I P A T I O N")[0]
    found = re.findall(r"^ *\d+ +\S+ +\S+ +(\S+) +\S+ *$", table, re.MULTILINE)
    if not found:
        raise CalculixError("CalculiX printed no eigenvalues; see its messages in the folder of the job.")
    return np.array(found, dtype=np.float64)


def run_calculix(text: str, folder: Path, name: str) -> str:
    """Run CalculiX on an input and return the content of its `.dat` file.

    Parameters
    ----------
    text : str
        The input.
    folder : Path
        Where input, results and messages (`NAME.log`) are written; it is made if it is not there.
    name : str
        Name of the job.

    Raises
    ------
    CalculixError
        If CalculiX is not installed, ends with an error or takes more than an hour.
    """
    program = required_calculix()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.inp").write_text(text, encoding="ascii")
    try:
        done = subprocess.run(
            [program, "-i", name],
            cwd=folder,
            env={"OMP_NUM_THREADS": "1", **os.environ},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIME_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CalculixError(f"CalculiX took more than {_TIME_LIMIT:g} s for {folder / name}.inp.") from None
    log = folder / f"{name}.log"
    log.write_text(done.stdout + done.stderr, encoding="utf-8")
    result = folder / f"{name}.dat"
    if done.returncode != 0 or "Job finished" not in done.stdout or not result.is_file():
        complaints = [line.strip() for line in done.stdout.splitlines() if "*ERROR" in line]
        said = f" ({complaints[0]})" if complaints else ""
        raise CalculixError(f"CalculiX did not finish {folder / name}.inp{said}; its messages are in {log}.")
    return result.read_text(encoding="ascii", errors="replace")


INTEGRATION_POINTS = gauss_points(3)[0][:, ::-1]
"""Local places (27, 3) in 0..1 of the integration points of a C3D20 element, in the order of its output."""


def _relative(theirs: FloatArray, ours: FloatArray) -> float:
    return float(np.abs(theirs - ours).max() / np.abs(ours).max())


class Agreement(NamedTuple):
    """A model and CalculiX.

    Attributes
    ----------
    loads : dict of str to dict of str to float
        Of each load the relative differences, over the largest of their kind: of `nodal displacements`; of
        `gauge strains` and `displacement outputs`, where there are some; of 20-node hexahedra also of
        `strains at integration points`, which CalculiX evaluates itself.
    ours, calculix : (m,) Hz
        Lowest frequencies of both codes.
    """

    loads: dict[str, dict[str, float]]
    ours: FloatArray
    calculix: FloatArray

    @property
    def modal(self) -> float:
        """Largest relative difference of the frequencies."""
        return float(np.abs(self.calculix / self.ours - 1.0).max())


def agreement(deck: CalculixDeck, folder: Path, modes: int = 6) -> Agreement:
    """Solve each load of a model alone, and its lowest modes, by both codes.

    Parameters
    ----------
    deck : CalculixDeck
        The model in one state; a structure is to be assembled with `mass_as_stiffness`, for frequencies that
        can be compared.
    folder : Path
        Where CalculiX works.
    modes : int
        Number of modes.

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    structure, strained = deck.structure, deck.body.mesh.kind is HEXAHEDRA_20
    prints = ["*NODE PRINT, NSET=NALL", "U"]
    prints += ["*NODE PRINT, NSET=NPROBES", "U"] if len(deck.probes) else []
    prints += ["*EL PRINT, ELSET=EALL, GLOBAL=YES", "E"] if strained else []
    text = deck.text(*(step._replace(lines=[*step.lines, *prints]) for step in deck.loads.values()))
    printed = read_tables(run_calculix(text, folder, "static")) if deck.loads else {}
    if (count := len(printed.get("NALL", ()))) != len(deck.loads):
        raise CalculixError(f"CalculiX printed {count} static solutions instead of {len(deck.loads)}.")
    frequencies = natural_frequencies(structure, modes, deck.values)[0]
    text = deck.text(Step(procedure=("*FREQUENCY", f"{modes}")))
    theirs = read_frequencies(run_calculix(text, folder, "modes"))
    if len(theirs) < modes:
        raise CalculixError(f"CalculiX printed {len(theirs)} frequencies instead of {modes}.")
    solve = Factorisation(structure.at(deck.values)[0]).solve
    gauges, end = len(structure.gauges), len(deck.probes)
    parts = {"gauge strains": slice(0, gauges), "displacement outputs": slice(gauges, end)}
    differences = {}
    for number, (name, step) in enumerate(deck.loads.items()):
        displacement, tables = solve(step.load), {key: rows[number] for key, rows in printed.items()}
        ours, nodes = deck.probes @ displacement, structure.full_displacement(displacement)
        found = differences[name] = {"nodal displacements": _relative(tables["NALL"][:, 1:], nodes)}
        for what, own in parts.items():
            if len(ours[own]):
                found[what] = _relative(tables["NPROBES"][:, 1:].ravel()[own], ours[own])
        if strained:
            strains = deck.body.mesh.strains(nodes, local=INTEGRATION_POINTS).reshape(-1, 6)
            strains[:, 3:] *= 0.5  # engineering to tensor shear
            found["strains at integration points"] = _relative(tables["EALL"][:, 2:], strains[:, PRINTED])
    return Agreement(differences, frequencies, theirs[:modes])
