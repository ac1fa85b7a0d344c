"""What an engineer suspects first, named on a coarse mesh; the truth is CalculiX on a finer one.

A curved arm and a flat bar, clamped at one end, are loaded at the other end and released. The truth
has twice as many elements along each axis, and its displacements and modes are those of CalculiX.
It hides a soft clamp, a mass, a patch with less stiffness, a load that leans, a gauge that is
turned, a gain error, or nothing. The model knows none of it. The figures stand in
docs/how_to/soft_clamp.md.

    python -m benchmarks.studies.suspected_first            # all cases
    python -m benchmarks.studies.suspected_first arm clamp  # one part, one case
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import meshio
import numpy as np
from scipy.sparse.linalg import spsolve

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.model_choice import load_model
from discrepancy.workflow import investigate
from fe.elements.kinds import KINDS
from fe.runtime.arrays import FloatArray
from fe.structure.operators import Structure, load_and_assemble
from fe.verification.calculix_deck import Step, structure_deck
from fe.verification.calculix_run import read_frequencies, read_tables, run_calculix

LENGTH = 160.0
WIDTH = 20.0
HEIGHT = 8.0
"""Size of the parts along, across and through [mm]."""
RADIUS = LENGTH / (0.5 * np.pi)
"""Radius of the middle line of the arm, a quarter of a circle [mm]."""
DIVISIONS = (16, 2, 2)
"""Elements of the model along, across and through; the truth has twice as many."""
MODES = 6
FORCE = 300.0
"""Largest static force [N]."""
NOISE = {"strain": 2e-6, "displacement": 2e-6}
"""Standard deviations of readings [1 and m]."""
INTERVAL = 2e-4
"""Interval of the samples of a release [s]."""
SAMPLES = 200
"""Number of samples of a release."""
DAMPING = (1.0, 1e-5)
"""Rayleigh's alpha [1/s] and beta [s]."""

TEXT = """name = "{part}"
mesh = "part.vtu"
length_unit = "mm"
set = [{sets}]
control = [{{ name = "pull", unit = "N", nominal = 100, minimum = -2000, maximum = 2000 }}]
parameter = [{{ name = "e", minimum = 0.9, maximum = 1.1 }}]
support = [{support}]
load = [{{ name = "pull", control = "pull", point = {tip}, force = {force} }}]
damage = [{{ name = "z", set = "declared" }}]
mass = [{masses}]
gauge = [{gauges}]
displacement = [
    {{ name = "tip", point = {tip}, direction = {force} }},
    {{ name = "middle", point = {middle}, direction = {normal} }},
]
damping = {{ alpha = 1.0, beta = 1e-5 }}
{materials}
"""


@dataclass(frozen=True)
class Hidden:
    """What a truth hides: pieces of its structure file, a gain, and what a verdict should name."""

    effect: str = ""
    place: str = ""
    pieces: dict[str, object] = field(default_factory=dict)
    gain: float = 1.0
    value: float = 0.0


def arm(points: FloatArray) -> FloatArray:
    """Return points (n, 3) of a bar, bent to a quarter of a circle in the plane of x and z."""
    along, across, through = points.T
    angle = along / RADIUS
    radius = RADIUS + through - 0.5 * HEIGHT
    return np.column_stack((radius * np.sin(angle), across, radius * np.cos(angle) - RADIUS))


def bar(points: FloatArray) -> FloatArray:
    """Return points (n, 3) as they are, with the middle line at z = 0."""
    return points - [0.0, 0.0, 0.5 * HEIGHT]


PARTS: dict[str, Callable[[FloatArray], FloatArray]] = {"arm": arm, "bar": bar}


def hidden_causes() -> dict[str, Hidden]:
    """Return the cases by name."""
    return {
        "nothing": Hidden(),
        "clamp": Hidden(
            "support_compliance", "CLAMP, turn about y", {"spring": 6000.0}, value=6000.0
        ),
        "mass": Hidden("added_mass", "tip", {"mass": 0.02}, value=0.02),
        "loss": Hidden("region_stiffness_loss", "patch", {"loss": 0.35}, value=0.35),
        "lean": Hidden("load_direction", "pull, towards y", {"lean": 0.12}, value=0.12),
        "turned gauge": Hidden("gauge_misalignment", "g3", {"turn": 0.4}, value=0.4),
        "gain": Hidden("gauge_gain", "g2", gain=1.06, value=0.06),
    }


def write_part(folder: Path, part: str, refinement: int, hidden: Hidden) -> Path:
    """Write mesh and structure file of a part, with what a truth hides."""
    shape = PARTS[part]
    points, cells = _grid(tuple(count * refinement for count in DIVISIONS))
    mesh = meshio.Mesh(shape(points), [("hexahedron20", cells)])
    meshio.write(folder / "part.vtu", mesh)
    pieces = hidden.pieces

    def place(along: float, across: float = 10.0, through: float = HEIGHT) -> list[float]:
        point = shape(np.array([[along, across, through]]))[0]
        return [round(float(value), 6) for value in point]

    def direction(along: float, turn: float = 0.0) -> list[float]:
        step = np.subtract(place(along + 0.1), place(along - 0.1))
        tangent = step / np.linalg.norm(step)
        turned = np.cos(turn) * tangent + np.sin(turn) * np.array([0.0, 1.0, 0.0])
        return [float(value) for value in turned]

    def slab(name: str, begin: float, end: float) -> str:
        # parts are monotonic along x, so that slabs of x part them
        low, high = (place(value, 10.0, 0.5 * HEIGHT)[0] for value in (begin, end))
        return f'{{ name = "{name}", of = "cells", box = [[{low}, -99, -999], [{high}, 99, 999]] }}'

    patch_begin = 64.0
    patch_end = 80.0
    sets = [
        '{ name = "CLAMP", of = "nodes", box = [[-0.001, -99, -99], [0.001, 99, 99]] }',
        slab("declared", 0.0, 16.0),
    ]
    steel = 'density = 7850\nyoung_modulus = {modulus}\npoisson_ratio = 0.3\nscaled_by = "e"\n'
    materials = f'[[material]]\nname = "steel"\n{steel.format(modulus=2.1e11)}'
    if "loss" in pieces:
        slabs = {
            "inner": (0.0, patch_begin),
            "patch": (patch_begin, patch_end),
            "outer": (patch_end, LENGTH),
        }
        sets += [slab(name, *ends) for name, ends in slabs.items()]
        materials = ""
        for name in slabs:
            modulus = 2.1e11 * (1.0 - float(str(pieces["loss"])) * (name == "patch"))
            materials += (
                f'[[material]]\nname = "{name}"\nset = "{name}"\n{steel.format(modulus=modulus)}'
            )
    support = '{ set = "CLAMP", hold = ["x", "y", "z"] }'
    if "spring" in pieces:
        support = (
            f'{{ set = "CLAMP", rigid_about = {place(0.0, 10.0, 0.5 * HEIGHT)}, '
            'hold = ["x", "y", "z", "rx", "rz"], '
            f"springs = [0, 0, 0, 0, {pieces['spring']}, 0] }}"
        )
    masses = [f'{{ name = "tool", point = {place(150.0)}, mass = 0.1 }}']
    if "mass" in pieces:
        masses.append(f'{{ name = "hidden", point = {place(LENGTH)}, mass = {pieces["mass"]} }}')
    gauges = []
    for number, along in enumerate((24.0, 56.0, 72.0, 104.0), start=1):
        turn = float(str(pieces.get("turn", 0.0))) if number == 3 else 0.0
        gauges.append(
            f'{{ name = "g{number}", point = {place(along)}, direction = {direction(along, turn)}, '
            "length = 3 }"
        )
    lean = float(str(pieces.get("lean", 0.0)))
    force = [0.0, np.sin(lean), np.cos(lean)]
    text = TEXT.format(
        part=part,
        sets=", ".join(sets),
        support=support,
        tip=place(LENGTH - 2.0),
        force=[float(value) for value in force],
        masses=", ".join(masses),
        gauges=", ".join(gauges),
        middle=place(80.0),
        normal=[0.0, 0.0, 1.0],
        materials=materials,
    )
    text = text.replace(
        f'name = "tip", point = {place(LENGTH - 2.0)}, direction = {[float(v) for v in force]}',
        f'name = "tip", point = {place(LENGTH - 2.0)}, direction = [0.0, 0.0, 1.0]',
    )
    file = folder / "part.toml"
    file.write_text(text, encoding="utf-8")
    return file


def _grid(divisions: tuple[int, ...]) -> tuple[FloatArray, np.ndarray]:
    """Return points (n, 3) [mm] and cells (nc, 20) of a bar of 20-node hexahedra."""
    kind = KINDS["hexahedron20"]
    corners = np.array(
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    )
    starts = np.indices(divisions).reshape(3, -1).T
    doubled = 2 * (starts[:, np.newaxis] + corners)
    middles = [
        (doubled[:, first] + doubled[:, second])[:, np.newaxis] // 2 for first, second in kind.edges
    ]
    nodes = np.concatenate((doubled, *middles), axis=1)
    points, cells = np.unique(nodes.reshape(-1, 3), axis=0, return_inverse=True)
    size = np.array([LENGTH, WIDTH, HEIGHT]) / (2.0 * np.array(divisions))
    return points * size, cells.reshape(len(nodes), 20)


@dataclass(frozen=True)
class Truth:
    """Answers of CalculiX: outputs per newton at rest, and frequency, outputs and load of modes."""

    static: FloatArray
    frequency: FloatArray
    shapes: FloatArray
    load: FloatArray


def truth_of(file: Path, folder: Path) -> Truth:
    """Return the answers of CalculiX for a structure file."""
    structure: Structure = load_and_assemble(file, mass_as_stiffness=True)
    deck = structure_deck(structure)
    prints = ["*NODE PRINT, NSET=NALL", "U"]
    load = deck.loads["pull"]
    nodal = read_tables(
        run_calculix(deck.text(load._replace(lines=[*load.lines, *prints])), folder, "s")
    )
    modal_step = Step(lines=prints, procedure=("*FREQUENCY", f"{MODES}"))
    modal = run_calculix(deck.text(modal_step), folder, "f")
    rows = np.concatenate(
        (structure.gauge_output.toarray(), structure.displacement_output.toarray())
    )
    nodes = len(structure.mesh.points)

    def free(table: FloatArray) -> FloatArray:
        """Return the free unknowns of nodal displacements, by least squares of the expansion."""
        _, *displacements = table[:nodes].T
        full = np.transpose(displacements).ravel()
        expansion = structure.expansion
        return np.asarray(spsolve((expansion.T @ expansion).tocsc(), expansion.T @ full))

    shapes = np.column_stack([free(table) for table in _mode_tables(modal)])
    modal_mass = np.sum(shapes * (structure.mass(structure.masses) @ shapes), axis=0)
    shapes = shapes / np.sqrt(modal_mass)
    nominal = structure.control_value_alone("pull")
    return Truth(
        static=rows @ free(nodal["NALL"][0]) / nominal,
        frequency=read_frequencies(modal),
        shapes=rows @ shapes,
        load=structure.load("pull", 1.0) @ shapes,
    )


def _mode_tables(text: str) -> list[FloatArray]:
    """Return node number and displacement (nodes, 4) of each mode that CalculiX printed."""
    tables = []
    for piece in text.split("displacements (vx,vy,vz) for set NALL")[1:]:
        rows = []
        for line in piece.splitlines()[1:]:
            cells = line.split()
            if len(cells) == 4 and cells[0].isdigit():
                rows.append([float(cell) for cell in cells])
            elif rows:
                break
        tables.append(np.array(rows))
    return tables


def write_campaign(folder: Path, truth: Truth, hidden: Hidden, seed: int) -> None:
    """Write the campaign of a truth: two load lines, two releases and the noise at rest."""
    names = [*(f"g{number}" for number in range(1, 5)), "tip", "middle"]
    kinds = ["strain"] * 4 + ["displacement"] * 2
    deviation = np.array([NOISE[kind] for kind in kinds])
    generator = np.random.default_rng(seed)
    gains = np.where(
        [hidden.effect == "gauge_gain" and name == hidden.place for name in names], hidden.gain, 1.0
    )
    gains = gains * (1.0 + 0.003 * generator.standard_normal(len(names)))
    omega = 2.0 * np.pi * truth.frequency
    alpha, beta = DAMPING
    ratio = 0.5 * (alpha / omega + beta * omega)
    time_axis: FloatArray = np.arange(SAMPLES, dtype=np.float64) * INTERVAL

    def noisy(values: FloatArray) -> FloatArray:
        return values * gains + deviation * generator.standard_normal(values.shape)

    def write(name: str, head: str, first: FloatArray, values: FloatArray) -> None:
        table = np.column_stack((first, noisy(values)))
        np.savetxt(
            folder / name, table, delimiter=",", header=",".join([head, *names]), comments=""
        )

    lines = [
        "format = 1",
        'name = "part"',
        "[noise]",
        'file = "noise.csv"',
        f"interval = {INTERVAL}",
    ]
    for name, kind in zip(names, kinds, strict=True):
        unit = "1" if kind == "strain" else "m"
        lines += [
            "[[channel]]",
            f'name = "{name}"',
            f'quantity = "{kind}"',
            f'unit = "{unit}"',
            f'output = "{name}"',
            "gain_deviation = 0.005",
            f"offset_deviation = {2.0 * NOISE[kind]}",
        ]
    write("noise.csv", "time", time_axis, np.zeros((SAMPLES, len(names))))
    for number, levels in enumerate(
        (np.linspace(0.0, FORCE, 8), np.linspace(0.0, -0.8 * FORCE, 6))
    ):
        write(
            f"line{number}.csv",
            "force",
            np.asarray(levels, dtype=np.float64),
            np.outer(levels, truth.static),
        )
        lines += [
            "[[trial]]",
            f'name = "line {number}"',
            'kind = "static"',
            f'file = "line{number}.csv"',
        ]
        lines += ['load_place = "pull"', f"held_out = {str(number == 1).lower()}"]
    for number, force in enumerate((0.6 * FORCE, 0.4 * FORCE)):
        start = force * truth.load / omega**2
        damped = omega * np.sqrt(1.0 - ratio**2)
        phase = np.outer(time_axis, damped)
        envelope = np.exp(-np.outer(time_axis, ratio * omega))
        motion = (
            start * envelope * (np.cos(phase) + ratio / np.sqrt(1.0 - ratio**2) * np.sin(phase))
        )
        write(f"release{number}.csv", "time", time_axis, motion @ truth.shapes.T)
        displacement = float(force * truth.static[4])
        lines += [
            "[[trial]]",
            f'name = "release {number}"',
            'kind = "ringdown"',
            f'file = "release{number}.csv"',
        ]
        lines += ['load_place = "pull"', f"held_out = {str(number == 1).lower()}"]
        lines += [f'release = {{ displacement = {displacement!r}, unit = "m", deviation = 0.02 }}']
    (folder / "campaign.toml").write_text("\n".join(lines), encoding="utf-8")


def results(parts: list[str], cases: list[str]) -> Iterator[str]:
    """Yield a line for each campaign: what was hidden, and the verdict."""
    for number, (part, case) in enumerate((part, case) for part in parts for case in cases):
        hidden = hidden_causes()[case]
        with TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "truth").mkdir()
            (folder / "campaign").mkdir()
            truth = truth_of(write_part(folder / "truth", part, 2, hidden), folder / "ccx")
            write_campaign(folder / "campaign", truth, hidden, seed=number)
            model = load_model(write_part(folder, part, 1, Hidden()))
            begin = time.process_time()
            investigation = investigate(
                read_campaign(folder / "campaign"), model, library(), seed=1, thorough=False
            )
            seconds = time.process_time() - begin
        verdict = investigation.verdict
        phrases = []
        for effect in verdict.effects:
            sizes = [
                f"{item.value:.3g} [{item.low:.3g}, {item.high:.3g}]" for item in effect.parameters
            ]
            phrases.append(f"{effect.identifier} at {effect.place} ({', '.join(sizes)})")
        cause = f"{hidden.effect or 'nothing'} {hidden.place} {hidden.value:g}"
        named_causes = "; ".join(phrases) or ", ".join(verdict.group)
        name_of_case = f"{part:4} {case:13} hidden {cause}"
        yield f"{name_of_case}: {verdict.kind.value}: {named_causes} [{seconds:.0f} s]"


if __name__ == "__main__":
    chosen_parts = [name for name in sys.argv[1:] if name in PARTS] or list(PARTS)
    chosen_cases = [name for name in sys.argv[1:] if name in hidden_causes()] or list(
        hidden_causes()
    )
    for line in results(chosen_parts, chosen_cases):
        print(line, flush=True)
