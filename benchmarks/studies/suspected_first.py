"""What an engineer suspects first, hidden in 24 campaigns, and what the verdicts say of it.

The truth is CalculiX on a mesh of twice as many cells along each axis as the model has: its
displacements at rest and its modes. It hides a support that yields, a mass, a patch with less
stiffness, a load or a gauge beside its place, a gain error, two of these, or nothing. The model
knows none of it. The figures stand in docs/how_to/soft_clamp.md.

    python -m benchmarks.studies.suspected_first FOLDER                    # all cases
    python -m benchmarks.studies.suspected_first FOLDER --seed 8           # other places and sizes
    python -m benchmarks.studies.suspected_first FOLDER --parts arm plate  # two parts
    python -m benchmarks.studies.suspected_first FOLDER --cases 2 3        # two campaigns

Truths are kept in FOLDER, so that a second run needs no CalculiX.
"""

import argparse
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import spsolve

from benchmarks.studies.suspected_parts import PARTS, Fault, Part, Point, write_part
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.system.structures import StructureModel
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import investigate
from fe.reduction.model_cache import changeable_model
from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel
from fe.runtime.patch import PlaceMass
from fe.structure.operators import load_and_assemble
from fe.verification.calculix_deck import Step, structure_deck
from fe.verification.calculix_run import read_frequencies, read_tables, run_calculix

MODES = 8
"""Number of modes in the motion of a truth."""
NOISE = {"strain": 2e-6, "displacement": 2e-6}
"""Standard deviations of readings [1 and m]."""
GAIN_DEVIATION = 0.005
"""Standard deviation of the gains of the truth; the campaign states twice as much [1]."""
SAMPLES = 200
"""Number of samples of a release."""
SAMPLES_PER_PERIOD = 30.0
"""Samples in a period of the first mode."""
DAMPING = (1.0, 1e-5)
"""Rayleigh's alpha [1/s] and beta [s]."""
RELEASES = (("first", 0, 0.6), ("second", 1, 0.5), ("held out", 0, 0.4))
"""Name of each release, number of its load, and fraction of the largest force."""


Span = tuple[float, float]


@dataclass(frozen=True)
class Hidden:
    """What may be hidden in a part, with the ranges from which places and sizes are drawn.

    Attributes
    ----------
    springs : dict of str to float
        For each support that may turn about y, the spring about which that of the truth is drawn
        [N m/rad].
    mass : float
        The mass about which that of the truth is drawn [kg].
    mass_box : three pairs of float
        Where the mass may be, on the grid of the part [mm].
    loss_boxes : tuple of pairs of (3,) tuples
        Cells of which one box may lose stiffness [mm].
    loss_shift : (3,) tuple of float
        Largest shift of these boxes [mm].
    load_offsets, gauge_offsets : tuple of (str, str)
        Loads with the axis of their offset, and gauges with the direction.
    """

    springs: dict[str, float]
    mass: float
    mass_box: tuple[Span, Span, Span]
    loss_boxes: tuple[tuple[Point, Point], ...]
    loss_shift: Point
    load_offsets: tuple[tuple[str, str], ...] = ()
    gauge_offsets: tuple[tuple[str, str], ...] = ()


HIDDEN = {
    "bracket": Hidden(
        springs={"CLAMP": 3e4},
        mass=0.04,
        mass_box=((45.0, 96.0), (4.0, 26.0), (8.0, 8.0)),
        loss_boxes=(((15.0, 0.0, 0.0), (34.0, 30.0, 8.0)),),
        loss_shift=(30.0, 0.0, 0.0),
        gauge_offsets=(("g3", "along"), ("g4", "along")),
    ),
    "portal": Hidden(
        springs={"LEFT": 8e3, "RIGHT": 8e3},
        mass=0.06,
        mass_box=((40.0, 200.0), (8.0, 8.0), (150.0, 150.0)),
        loss_boxes=(
            ((232.0, 0.0, 8.0), (240.0, 16.0, 41.0)),
            ((0.0, 0.0, 8.0), (8.0, 16.0, 41.0)),
        ),
        loss_shift=(0.0, 0.0, 80.0),
        load_offsets=(("down", "x"),),
    ),
    "plate": Hidden(
        springs={"CLAMP": 1.2e5},
        mass=0.05,
        mass_box=((80.0, 150.0), (10.0, 90.0), (4.0, 4.0)),
        loss_boxes=(
            ((25.0, 0.0, 0.0), (57.0, 45.0, 4.0)),
            ((25.0, 55.0, 0.0), (57.0, 100.0, 4.0)),
        ),
        loss_shift=(50.0, 0.0, 0.0),
        load_offsets=(("corner", "y"), ("corner", "x"), ("edge", "y"), ("edge", "x")),
    ),
    "arm": Hidden(
        springs={"CLAMP": 2.5e4},
        mass=0.03,
        mass_box=((80.0, 150.0), (4.0, 16.0), (8.0, 8.0)),
        loss_boxes=(((10.0, 0.0, 0.0), (26.0, 20.0, 8.0)),),
        loss_shift=(60.0, 0.0, 0.0),
        gauge_offsets=(("g2", "along"), ("g3", "along")),
    ),
}
"""What may be hidden in each part."""
CASES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("bracket", ()),
    ("bracket", ("support_compliance",)),
    ("bracket", ("added_mass",)),
    ("bracket", ("region_stiffness_loss",)),
    ("bracket", ("gauge_offset",)),
    ("bracket", ("support_compliance", "gauge_gain")),
    ("portal", ()),
    ("portal", ()),
    ("portal", ("support_compliance",)),
    ("portal", ("added_mass",)),
    ("portal", ("region_stiffness_loss",)),
    ("portal", ("load_offset",)),
    ("portal", ("added_mass", "gauge_gain")),
    ("plate", ()),
    ("plate", ("support_compliance",)),
    ("plate", ("added_mass",)),
    ("plate", ("region_stiffness_loss",)),
    ("plate", ("load_offset",)),
    ("plate", ("added_mass", "region_stiffness_loss")),
    ("arm", ()),
    ("arm", ()),
    ("arm", ("gauge_offset",)),
    ("arm", ("gauge_gain",)),
    ("arm", ("support_compliance", "added_mass")),
)
"""Part and effects of each campaign."""


def drawn_fault(effect: str, part_name: str, generator: np.random.Generator) -> Fault:
    """Return a fault at a place and of a size that are drawn."""
    hidden = HIDDEN[part_name]
    scale = float(np.exp(generator.uniform(np.log(0.7), np.log(1.5))))
    sign = float(generator.choice((-1.0, 1.0)))
    if effect == "support_compliance":
        place = str(generator.choice(list(hidden.springs)))
        return Fault(effect, place, "ry", hidden.springs[place] * scale)
    if effect == "added_mass":
        x, y, z = [float(generator.uniform(*span)) for span in hidden.mass_box]
        return Fault(effect, value=hidden.mass * scale, point=(x, y, z))
    if effect == "region_stiffness_loss":
        corners = np.array(hidden.loss_boxes[generator.integers(len(hidden.loss_boxes))])
        low, high = corners + generator.uniform(0.0, 1.0) * np.array(hidden.loss_shift)
        x, y, z = 0.5 * (low + high)
        return Fault(
            effect,
            value=float(generator.uniform(0.35, 0.5)),
            point=(float(x), float(y), float(z)),
            box=((low[0], low[1], low[2]), (high[0], high[1], high[2])),
        )
    if effect == "gauge_gain":
        gauges = [gauge.name for gauge in PARTS[part_name].gauges]
        return Fault(effect, str(generator.choice(gauges)), value=0.06 * sign * scale)
    offsets = hidden.load_offsets if effect == "load_offset" else hidden.gauge_offsets
    place, axis = offsets[generator.integers(len(offsets))]
    return Fault(effect, place, axis, 0.007 * sign * scale)


def drawn_cases(seed: int) -> list[tuple[str, tuple[Fault, ...]]]:
    """Return the part and the faults of each campaign."""
    generator = np.random.default_rng(seed)
    return [
        (part, tuple(drawn_fault(effect, part, generator) for effect in effects))
        for part, effects in CASES
    ]


class Truth(NamedTuple):
    """Answers of CalculiX.

    Attributes
    ----------
    static : (L, O) array
        Outputs at rest per newton of each load.
    frequency : (M,) array
        Natural frequencies [Hz].
    shapes : (O, M) array
        Outputs of mass-normalised modes.
    loads : (L, M) array
        Each load on the modes.
    """

    static: FloatArray
    frequency: FloatArray
    shapes: FloatArray
    loads: FloatArray


def truth_of(folder: Path, part: Part, faults: Sequence[Fault]) -> Truth:
    """Return the answers of CalculiX for a part with faults, or those that a folder keeps."""
    archive = folder / "truth.npz"
    if archive.is_file():
        with np.load(archive) as arrays:
            return Truth(**arrays)
    folder.mkdir(parents=True, exist_ok=True)
    structure = load_and_assemble(write_part(folder, part, 2, faults), mass_as_stiffness=True)
    losses = [fault.value for fault in faults if fault.effect == "region_stiffness_loss"]
    deck = replace(structure_deck(structure), values={"lost": losses[0]} if losses else {})
    prints = ["*NODE PRINT, NSET=NALL", "U"]
    rows = np.concatenate(
        (structure.gauge_output.toarray(), structure.displacement_output.toarray())
    )
    nodes = len(structure.mesh.points)
    expansion = structure.expansion
    gram = (expansion.T @ expansion).tocsc()

    def free_unknowns(table: FloatArray) -> FloatArray:
        """Return the free unknowns (n,) of nodal displacements, by least squares."""
        _, *displacements = table[:nodes].T
        return np.asarray(spsolve(gram, expansion.T @ np.transpose(displacements).ravel()))

    # statics
    static = []
    for load in part.loads:
        step = deck.loads[load.name]
        job = deck.text(step._replace(lines=[*step.lines, *prints]))
        nodal = read_tables(run_calculix(job, folder / load.name, "static"))["NALL"][0]
        nominal = structure.control_value_alone(load.name)
        static.append(rows @ free_unknowns(nodal) / nominal)
    # modes
    modal_step = Step(lines=prints, procedure=("*FREQUENCY", f"{MODES}"))
    modal = run_calculix(deck.text(modal_step), folder / "modes", "modes")
    shapes = np.column_stack([free_unknowns(table) for table in _mode_tables(modal)])
    modal_mass = np.sum(shapes * (structure.mass(structure.masses) @ shapes), axis=0)
    shapes = shapes / np.sqrt(modal_mass)
    truth = Truth(
        static=np.array(static),
        frequency=read_frequencies(modal),
        shapes=rows @ shapes,
        loads=np.array([structure.load(load.name, 1.0) @ shapes for load in part.loads]),
    )
    np.savez(archive, **truth._asdict())
    return truth


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


def write_campaign(
    folder: Path, part: Part, truth: Truth, faults: Sequence[Fault], seed: tuple[int, int]
) -> None:
    """Write the campaign of a truth: load lines, releases and the noise at rest."""
    folder.mkdir(parents=True, exist_ok=True)
    kinds = {gauge.name: "strain" for gauge in part.gauges}
    kinds |= {sensor.name: "displacement" for sensor in part.displacements}
    deviation = np.array([NOISE[kind] for kind in kinds.values()])
    generator = np.random.default_rng(seed)
    errors = {fault.place: fault.value for fault in faults if fault.effect == "gauge_gain"}
    gains = np.array([1.0 + errors.get(name, 0.0) for name in kinds])
    gains *= 1.0 + GAIN_DEVIATION * generator.standard_normal(len(kinds))
    interval = float(f"{1.0 / (SAMPLES_PER_PERIOD * truth.frequency[0]):.3g}")
    times: FloatArray = interval * np.arange(SAMPLES, dtype=np.float64)

    def write(name: str, head: str, first: FloatArray, values: FloatArray) -> None:
        noisy = values * gains + deviation * generator.standard_normal(values.shape)
        columns = ",".join([head, *kinds])
        table = np.column_stack((first, noisy))
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=columns, comments="")

    lines = ["format = 1", 'name = "part"', "[noise]", 'file = "noise.csv"']
    lines.append(f"interval = {interval}")
    for name, kind in kinds.items():
        unit = "1" if kind == "strain" else "m"
        lines += [
            "[[channel]]",
            f'name = "{name}"\nquantity = "{kind}"\nunit = "{unit}"\noutput = "{name}"',
            f"gain_deviation = {2.0 * GAIN_DEVIATION}\noffset_deviation = {2.0 * NOISE[kind]}",
        ]
    write("noise", "time", times, np.zeros((SAMPLES, len(kinds))))
    # load lines
    load_lines = [(0, 1.0, False), (1, 1.0, False), (0, -0.8, True)]
    for number, (load, largest, held_out) in enumerate(load_lines):
        levels = np.asarray(np.linspace(0.0, largest * part.force, 8), dtype=np.float64)
        write(f"line{number}", "force", levels, np.outer(levels, truth.static[load]))
        lines += [
            "[[trial]]",
            f'name = "line {number}"\nkind = "static"\nfile = "line{number}.csv"',
            f'load_place = "{part.loads[load].name}"\nheld_out = {str(held_out).lower()}',
        ]
    # releases
    omega = 2.0 * np.pi * truth.frequency
    alpha, beta = DAMPING
    ratio = 0.5 * (alpha / omega + beta * omega)
    damped = omega * np.sqrt(1.0 - ratio**2)
    phase = np.outer(times, damped)
    decay = np.exp(-np.outer(times, ratio * omega))
    course = decay * (np.cos(phase) + ratio / np.sqrt(1.0 - ratio**2) * np.sin(phase))
    for name, load, fraction in RELEASES:
        force = fraction * part.force
        motion = force * truth.loads[load] / omega**2 * course
        write(name, "time", times, motion @ truth.shapes.T)
        along_load = [
            number
            for number, sensor in enumerate(part.displacements)
            if sensor.direction == part.loads[load].direction
            and sensor.point == part.loads[load].point
        ]
        released = float(force * truth.static[load][len(part.gauges) + along_load[0]])
        lines += [
            "[[trial]]",
            f'name = "release {name}"\nkind = "ringdown"\nfile = "{name}.csv"',
            f'load_place = "{part.loads[load].name}"',
            f"held_out = {str(name == 'held out').lower()}",
            f'release = {{ displacement = {released!r}, unit = "m", deviation = 0.02 }}',
        ]
    (folder / "campaign.toml").write_text("\n".join(lines), encoding="utf-8")


class Score(NamedTuple):
    """What a verdict is worth.

    Attributes
    ----------
    outcome : str
        "right", "in part", "open" (nothing is named though something is hidden) or "wrong".
    places : list of bool
        For each mass and loss that is named: whether it lies within one patch.
    sizes : list of bool
        For each fault that is named at exactly its place, and each mass: whether the 90 % interval
        holds its size.
    distances : list of bool
        For each mass, whether the 90 % intervals hold its distances along and across.
    """

    outcome: str
    places: list[bool]
    sizes: list[bool]
    distances: list[bool]


NAMING = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts that name effects."""


def score(verdict: Verdict, part: Part, faults: Sequence[Fault], model: ChangeableModel) -> Score:
    """Return what a verdict is worth against the faults that are hidden."""
    places: list[bool] = []
    sizes: list[bool] = []
    distances: list[bool] = []
    if verdict.kind is VerdictKind.GROUP:
        hidden = {fault.effect for fault in faults}
        members = [set(member.split(" + ")) for member in verdict.group]
        holds_truth = any(member <= hidden for member in members)
        outcome = "in part" if holds_truth else "wrong" if faults else "open"
        return Score(outcome, places, sizes, distances)
    if verdict.kind not in NAMING:
        is_closed = verdict.kind in (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT)
        return Score("right" if is_closed and not faults else "open", places, sizes, distances)
    matched = 0
    for effect in verdict.effects:
        faults_of_kind = [fault for fault in faults if fault.effect == effect.identifier]
        if not faults_of_kind:
            return Score("wrong", places, sizes, distances)
        (fault,) = faults_of_kind
        if fault.effect == "region_stiffness_loss":
            at_patch = _is_within_one_patch(
                effect.place, part.place(fault.point), model.loss_places
            )
            places.append(at_patch)
            matched += at_patch
        elif fault.effect == "added_mass":
            point, held = _place_of_mass(effect, part.place(fault.point), model)
            reach = 1.5e3 * float(model.mass_reaches.max())
            places.append(float(np.linalg.norm(point - np.array(part.place(fault.point)))) <= reach)
            matched += places[-1]
            sizes.append(_holds(effect, fault))
            distances += held
        elif _is_at(effect, fault):
            matched += 1
            sizes.append(_holds(effect, fault))
    if matched < len(verdict.effects):
        return Score("wrong", places, sizes, distances)
    # two neighbouring patches may be named for one fault
    named = Counter(effect.identifier for effect in verdict.effects)
    is_whole = named == Counter(fault.effect for fault in faults)
    return Score("right" if is_whole else "in part", places, sizes, distances)


def _is_at(effect: NamedEffect, fault: Fault) -> bool:
    """Return whether an effect is named at the place of a fault, with its motion."""
    (primitive,) = effect.patch.primitives
    named = [getattr(primitive, name, "") for name in ("support", "control", "channel", "gauge")]
    motion = getattr(primitive, "motion", getattr(primitive, "axis", fault.motion))
    return fault.place in named and motion == fault.motion


def _holds(effect: NamedEffect, fault: Fault) -> bool:
    """Return whether the 90 % interval of an effect's size holds that of a fault."""
    (primitive,) = effect.patch.primitives
    estimate = effect.parameters[0]
    sizes = ("compliance", "distance", "gain", "mass")
    (size,) = [getattr(primitive, name) for name in sizes if hasattr(primitive, name)]
    unit = size / estimate.value
    true_size = fault.value
    if fault.effect == "support_compliance":
        true_size = 1.0 / fault.value
    low, high = sorted((unit * estimate.low, unit * estimate.high))
    return bool(low <= true_size <= high)


def _place_of_mass(
    effect: NamedEffect, true_point: Sequence[float], model: ChangeableModel
) -> tuple[FloatArray, list[bool]]:
    """Return the point of a named mass [mm], and whether its intervals hold that of the truth."""
    (primitive,) = effect.patch
    assert isinstance(primitive, PlaceMass)
    number = model.mass_places.index(primitive.place)
    reach = float(model.mass_reaches[number])
    if reach == 0.0:  # a set
        return np.full(3, np.nan), []
    axes = model.mass_axes[number]
    point = model.mass_points[number] + primitive.along * axes[0] + primitive.across * axes[1]
    true_distances = axes @ (1e-3 * np.array(true_point) - model.mass_points[number])
    held = [
        bool(reach * estimate.low <= distance <= reach * estimate.high)
        for estimate, distance in zip(effect.parameters[1:], true_distances, strict=True)
    ]
    return 1e3 * point, held


def _is_within_one_patch(name: str, point: Sequence[float], candidates: Sequence[str]) -> bool:
    """Return whether a named place is the candidate nearest to a point [mm], or next to it."""
    positions = {}
    for candidate in candidates:
        in_brackets = re.search(r"\(([^)]*)\) mm", candidate)
        if in_brackets:
            coordinates = [float(value) for value in in_brackets[1].split(",")]
            positions[candidate] = np.array(coordinates)
    if name not in positions:
        return False
    distances = [float(np.linalg.norm(place - point)) for place in positions.values()]
    nearest = [*positions.values()][int(np.argmin(distances))]
    spacings = sorted(float(np.linalg.norm(place - nearest)) for place in positions.values())
    reach = min(distances) + 1.5 * spacings[1]
    return float(np.linalg.norm(positions[name] - point)) <= reach


def results(folder: Path, seed: int, parts: Sequence[str], cases: Sequence[int]) -> Iterator[str]:
    """Yield a line for each campaign: what is hidden, the verdict and its worth; then the sums."""
    outcomes: Counter[str] = Counter()
    null_outcomes: Counter[str] = Counter()
    places: list[bool] = []
    sizes: list[bool] = []
    distances: list[bool] = []
    seconds = []
    models = {}
    for part_name in parts:
        model_folder = folder / part_name
        model_folder.mkdir(parents=True, exist_ok=True)
        begin = time.process_time()
        models[part_name] = changeable_model(write_part(model_folder, PARTS[part_name], 1, ()))
        error = models[part_name].change_errors.max()
        built = time.process_time() - begin
        yield f"{part_name}: largest error of the reduced model {error:.1e} [{built:.0f} s]"
    for number, (part_name, faults) in enumerate(drawn_cases(seed)):
        if part_name not in parts or (cases and number not in cases):
            continue
        part = PARTS[part_name]
        folder_of_case = folder / f"seed{seed}" / f"case{number:02}"
        truth = truth_of(folder_of_case, part, faults)
        write_campaign(folder_of_case / "campaign", part, truth, faults, seed=(seed, number))
        begin = time.process_time()
        campaign = read_campaign(folder_of_case / "campaign")
        model = StructureModel(models[part_name])
        verdict = investigate(campaign, model, library(), seed=1, thorough=False).verdict
        seconds.append(time.process_time() - begin)
        worth = score(verdict, part, faults, models[part_name])
        counted = outcomes if faults else null_outcomes
        counted[worth.outcome] += 1
        places += worth.places
        sizes += worth.sizes
        distances += worth.distances
        hidden = " and ".join(
            f"{fault.effect} {fault.place} {fault.motion} {fault.value:.3g} {_point_text(fault)}"
            for fault in faults
        )
        yield (
            f"{number:2} {part_name:7} {worth.outcome:7} {hidden or 'nothing'}: "
            f"{_verdict_text(verdict)} [{seconds[-1]:.0f} s]"
        )
    yield f"with faults: {dict(outcomes)}; without: {dict(null_outcomes)}"
    yield f"places within one patch {sum(places)} of {len(places)}"
    yield f"sizes in their 90 % intervals {sum(sizes)} of {len(sizes)}"
    yield f"distances of masses in their 90 % intervals {sum(distances)} of {len(distances)}"
    yield f"processor time: mean {np.mean(seconds):.0f} s, largest {np.max(seconds):.0f} s"


def _point_text(fault: Fault) -> str:
    """Return the point of a mass or a loss [mm]; empty for other faults."""
    return "" if fault.place else f"({', '.join(f'{value:.0f}' for value in fault.point)})"


def _verdict_text(verdict: Verdict) -> str:
    """Return kind, effects and sizes of a verdict on one line."""
    phrases = []
    for effect in verdict.effects:
        numbers = [
            f"{estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"
            for estimate in effect.parameters
        ]
        phrases.append(f"{effect.identifier} at {effect.place} ({', '.join(numbers)})")
    return f"{verdict.kind.value}: {'; '.join(phrases)} {', '.join(verdict.group)}"


def main() -> None:
    """Run the campaigns that the command line asks for, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--cases", nargs="+", type=int, default=[])
    options = parser.parse_args()
    for line in results(options.folder, options.seed, options.parts, options.cases):
        print(line, flush=True)


if __name__ == "__main__":
    main()
