"""What an engineer suspects first, hidden in 24 campaigns, and what the verdicts say of it.

The truth is CalculiX on a mesh of twice as many cells along each axis as the model has: its
displacements at rest and its modes. It hides a support that yields, a mass, a patch with less
stiffness, a load or a gauge beside its place, a gain error, two of these, or nothing. The model
knows none of it. The figures stand in docs/how_to/soft_clamp.md.

    python -m benchmarks.studies.suspected_first FOLDER            # all cases
    python -m benchmarks.studies.suspected_first FOLDER arm plate  # two parts

Truths are kept in FOLDER, so that a second run needs no CalculiX.
"""

import re
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import spsolve

from benchmarks.studies.suspected_parts import PARTS, Fault, Part, write_part
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.system.structures import StructureModel
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import investigate
from fe.reduction.model_cache import changeable_model
from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel
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


def support(place: str, motion: str, spring: float) -> Fault:
    """Return a support that yields against a spring [N/m or N m/rad]."""
    return Fault("support_compliance", place, motion, spring)


def mass(x: float, y: float, z: float, kilograms: float) -> Fault:
    """Return a mass at a point of the grid [mm]."""
    return Fault("added_mass", value=kilograms, point=(x, y, z))


def loss(low: tuple[float, ...], high: tuple[float, ...], fraction: float) -> Fault:
    """Return a loss of stiffness in a box of the grid [mm]."""
    x, y, z = 0.5 * (np.array(low) + np.array(high))
    return Fault(
        "region_stiffness_loss",
        value=fraction,
        point=(float(x), float(y), float(z)),
        box=((low[0], low[1], low[2]), (high[0], high[1], high[2])),
    )


GAIN_OF_G2 = Fault("gauge_gain", "g2", value=0.06)
BRACKET_MASS = mass(70.0, 15.0, 8.0, 0.04)
PORTAL_MASS = mass(67.0, 8.0, 150.0, 0.06)
PLATE_LOSS = loss((49.0, 0.0, 0.0), (81.0, 45.0, 4.0), 0.4)
CASES: tuple[tuple[str, tuple[Fault, ...]], ...] = (
    ("bracket", ()),
    ("bracket", (support("CLAMP", "ry", 3e4),)),
    ("bracket", (BRACKET_MASS,)),
    ("bracket", (loss((35.0, 0.0, 0.0), (54.0, 30.0, 8.0), 0.45),)),
    ("bracket", (Fault("gauge_offset", "g3", "along", 0.006),)),
    ("bracket", (support("CLAMP", "ry", 3e4), GAIN_OF_G2)),
    ("portal", ()),
    ("portal", ()),
    ("portal", (support("LEFT", "ry", 8e3),)),
    ("portal", (PORTAL_MASS,)),
    ("portal", (loss((232.0, 0.0, 15.0), (240.0, 16.0, 48.0), 0.45),)),
    ("portal", (Fault("load_offset", "down", "x", 0.009),)),
    ("portal", (PORTAL_MASS, GAIN_OF_G2)),
    ("plate", ()),
    ("plate", (support("CLAMP", "ry", 1.2e5),)),
    ("plate", (mass(110.0, 85.0, 4.0, 0.05),)),
    ("plate", (PLATE_LOSS,)),
    ("plate", (Fault("load_offset", "corner", "y", -0.007),)),
    ("plate", (mass(110.0, 85.0, 4.0, 0.05), PLATE_LOSS)),
    ("arm", ()),
    ("arm", ()),
    ("arm", (Fault("gauge_offset", "g2", "along", -0.006),)),
    ("arm", (Fault("gauge_gain", "g3", value=-0.06),)),
    ("arm", (support("CLAMP", "ry", 2.5e4), mass(120.0, 10.0, 8.0, 0.03))),
)
"""Part and faults of each campaign."""


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
    folder: Path, part: Part, truth: Truth, faults: Sequence[Fault], seed: int
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
        For each fault that is named at exactly its place: whether the 90 % interval holds it.
    """

    outcome: str
    places: list[bool]
    sizes: list[bool]


NAMING = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts that name effects."""


def score(verdict: Verdict, part: Part, faults: Sequence[Fault], model: ChangeableModel) -> Score:
    """Return what a verdict is worth against the faults that are hidden."""
    places: list[bool] = []
    sizes: list[bool] = []
    if verdict.kind is VerdictKind.GROUP:
        hidden = {fault.effect for fault in faults}
        members = [set(member.split(" + ")) for member in verdict.group]
        holds_truth = any(member <= hidden for member in members)
        outcome = "in part" if holds_truth else "wrong" if faults else "open"
        return Score(outcome, places, sizes)
    if verdict.kind not in NAMING:
        is_closed = verdict.kind in (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT)
        return Score("right" if is_closed and not faults else "open", places, sizes)
    matched = 0
    for effect in verdict.effects:
        faults_of_kind = [fault for fault in faults if fault.effect == effect.identifier]
        if not faults_of_kind:
            return Score("wrong", places, sizes)
        (fault,) = faults_of_kind
        if fault.effect in ("added_mass", "region_stiffness_loss"):
            candidates = model.mass_places
            if fault.effect == "region_stiffness_loss":
                candidates = model.loss_places
            places.append(_is_within_one_patch(effect.place, part.place(fault.point), candidates))
            matched += places[-1]
        elif _is_at(effect, fault):
            matched += 1
            sizes.append(_holds(effect, fault))
    if matched < len(verdict.effects):
        return Score("wrong", places, sizes)
    return Score("right" if matched == len(faults) else "in part", places, sizes)


def _is_at(effect: NamedEffect, fault: Fault) -> bool:
    """Return whether an effect is named at the place of a fault, with its motion."""
    (primitive,) = effect.patch.primitives
    named = [getattr(primitive, name, "") for name in ("support", "control", "channel", "gauge")]
    motion = getattr(primitive, "motion", getattr(primitive, "axis", fault.motion))
    return fault.place in named and motion == fault.motion


def _holds(effect: NamedEffect, fault: Fault) -> bool:
    """Return whether the 90 % interval of an effect's size holds that of a fault."""
    (primitive,) = effect.patch.primitives
    (estimate,) = effect.parameters
    sizes = ("compliance", "distance", "gain")
    (size,) = [getattr(primitive, name) for name in sizes if hasattr(primitive, name)]
    unit = size / estimate.value
    true_size = fault.value
    if fault.effect == "support_compliance":
        true_size = 1.0 / fault.value
    low, high = sorted((unit * estimate.low, unit * estimate.high))
    return bool(low <= true_size <= high)


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


def results(folder: Path, parts: Sequence[str], cases: Sequence[int]) -> Iterator[str]:
    """Yield a line for each campaign: what is hidden, the verdict and its worth; then the sums."""
    outcomes: Counter[str] = Counter()
    null_outcomes: Counter[str] = Counter()
    places: list[bool] = []
    sizes: list[bool] = []
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
    for number, (part_name, faults) in enumerate(CASES):
        if part_name not in parts or (cases and number not in cases):
            continue
        part = PARTS[part_name]
        folder_of_case = folder / f"case{number:02}"
        truth = truth_of(folder_of_case, part, faults)
        write_campaign(folder_of_case / "campaign", part, truth, faults, seed=number)
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
        hidden = " and ".join(
            f"{fault.effect} {fault.place} {fault.motion} {fault.value:g}" for fault in faults
        )
        yield (
            f"{number:2} {part_name:7} {worth.outcome:7} {hidden or 'nothing'}: "
            f"{_verdict_text(verdict)} [{seconds[-1]:.0f} s]"
        )
    yield f"with faults: {dict(outcomes)}; without: {dict(null_outcomes)}"
    yield f"places within one patch {sum(places)} of {len(places)}"
    yield f"sizes in their 90 % intervals {sum(sizes)} of {len(sizes)}"
    yield f"processor time: mean {np.mean(seconds):.0f} s, largest {np.max(seconds):.0f} s"


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


if __name__ == "__main__":
    arguments = sys.argv[2:]
    chosen_parts = [name for name in arguments if name in PARTS] or list(PARTS)
    chosen_cases = [int(name) for name in arguments if name.isdigit()]
    for line in results(Path(sys.argv[1]), chosen_parts, chosen_cases):
        print(line, flush=True)
