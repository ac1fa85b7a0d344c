"""Verdicts on effects hidden in the shipped bracket; docs/how_to/structures.md shows them.

`python -m benchmarks.studies.structure_effects` loads the bracket at its end in four cycles of
load levels, or with `--ringdown` releases its end from four deflections. The readings come from
the full finite element model (981 unknowns), with noise of gauges and of a displacement, and one
hidden effect. The search uses the FMU of the reduced structure by the file that
`uav-twin structure fmu --rig` writes; its Young's modulus is off. The verdict on each campaign and
its time are printed.
"""

import argparse
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.model_choice import load_model
from discrepancy.system.excitation import Excitation, ReleasePoint
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.motion import simulate_motion
from discrepancy.system.output_equation import OutputEquation
from discrepancy.verdict import Verdict, VerdictKind
from discrepancy.workflow import investigate
from fe.reduction.model_cache import reduced_model
from fe.runtime.patch import MicroSlip, ModelPatch, PowerDamping, PowerStiffness, Primitive
from fe.runtime.port_laws import port_laws
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures import rig_text
from scenarios import structure_files

FloatArray = NDArray[np.float64]

PORT, PLACE = "sag", "[80, 20, 3]"
PUSH = f"""
[[control]]
name = "push"
unit = "N"
nominal = 0.0
minimum = -400.0
maximum = 400.0

[[load]]
name = "pushed"
control = "push"
point = {PLACE}
force = [0, 0, 1]
"""
NOISE = {Quantity.STRAIN: 1e-6, Quantity.DISPLACEMENT: 2e-6}
ZERO = {Quantity.STRAIN: 1e-6}
LEVELS = np.array([20.0, 40.0, 60.0, 80.0, 60.0, 40.0, 20.0])
DAY = 4000.0  # s, of the campaign
INTERVAL = 5e-4
"""Sampling interval of ring-downs [s]."""
SAMPLES = 400
DEFLECTION = 5e-4
"""Deflection of the end before a release [m]."""
MODES = 12
"""Modes of the simulated ring-downs."""


@dataclass(frozen=True)
class BracketEffect:
    """A hidden effect: name, place, laws at the port, and its changes of readings and forces."""

    identifier: str
    place: str = ""
    laws: tuple[Primitive, ...] = ()
    readings: Callable[[str, FloatArray, FloatArray], FloatArray] = field(
        default=lambda _name, _time, values: values
    )
    force: float = 1.0
    tare: float = 0.0
    """Of what the load cell shows, what truly acts; and what it lacks [N]."""


HIDDEN = (
    BracketEffect(""),
    BracketEffect(
        "gauge_gain",
        "heel",
        readings=lambda name, _time, values: values * (1.06 if name == "heel" else 1.0),
    ),
    BracketEffect(
        "gauge_zero_drift",
        "arm",
        readings=lambda name, time, values: values + (3e-5 * time / DAY if name == "arm" else 0.0),
    ),
    BracketEffect("load_cell", force=1.05),
    BracketEffect("load_cell", tare=4.0),
    BracketEffect("cubic_stiffness", PORT, (PowerStiffness(PORT, 40.0, 3.0, 0, 1e-3),)),
    BracketEffect("breathing_crack", PORT, (PowerStiffness(PORT, -8.0, 1.0, -1, 1e-3),)),
    BracketEffect("joint_micro_slip", PORT, (MicroSlip(PORT, 8.0, 2e4, -0.5, 24),)),
)
IN_MOTION = (
    HIDDEN[0],
    HIDDEN[1],
    *HIDDEN[5:],
    BracketEffect("coulomb_friction", PORT, (PowerDamping(PORT, 0.4, 0.0, 0.0, 0.1, 1e-3),)),
    BracketEffect("quadratic_damping", PORT, (PowerDamping(PORT, 0.5, 2.0, 0.0, 0.1, 1e-3),)),
)


def structure_file(folder: Path) -> Path:
    """Write the bracket with a force at its end; return the file."""
    shipped = structure_files()["bracket"]
    shutil.copy(shipped.with_suffix(".inp"), folder)
    file = folder / "bracket.toml"
    file.write_text(shipped.read_text(encoding="utf-8") + PUSH, encoding="utf-8")
    return file


def rig(folder: Path) -> Path:
    """Pack the bracket and write its model file; return the model file."""
    file = structure_file(folder)
    build_fmu(reduced_model(file), folder / "bracket.fmu", kind="compiled")
    path = folder / "rig.toml"
    path.write_text(rig_text(load_structure(file), "bracket.fmu"), encoding="utf-8")
    return path


def campaign(file: Path, hidden: BracketEffect, seed: int, *, ringdown: bool = False) -> Campaign:
    """Return the campaign of a seed on the full bracket with a hidden effect."""
    random = np.random.default_rng(seed)
    structure = load_and_assemble(file)
    stiffness = structure.stiffness({"e": 1.0 + 0.02 * random.standard_normal()}, {}).toarray()
    mass = (structure.mass_terms[0] + 2.5 * structure.mass_terms[1]).toarray()
    rows = np.vstack(
        [part.toarray() for part in (structure.displacement_output, structure.gauge_output)]
    )
    names = (PORT, *structure.gauges)
    quantities = [Quantity.DISPLACEMENT, *[Quantity.STRAIN] * len(structure.gauges)]
    rayleigh = structure.design.damping
    damping = rayleigh.alpha * mass + rayleigh.beta * stiffness
    end = rows[0]
    system = LinearSystem(
        mass, damping, stiffness, {PORT: end}, MODES if ringdown else 1, rayleigh.beta
    )
    laws = port_laws(ModelPatch(hidden.laws), system.ports)
    channels = {
        name: Channel(
            name,
            quantity,
            name,
            NoiseRecord(NOISE[quantity], 200.0),
            0.005,
            ZERO.get(quantity, 0.0),
        )
        for name, quantity in zip(names, quantities, strict=True)
    }
    trials = []
    levels = np.concatenate([LEVELS, -LEVELS, LEVELS[:4]])
    minutes = 60.0 * np.arange(1, len(levels) + 1, dtype=np.float64)
    for number, sign in enumerate((1.0, -1.0, 1.0, -1.0)):
        time = 1100.0 * number + minutes
        force = sign * levels
        start = 0.0
        release = None
        if ringdown:
            time = INTERVAL * np.arange(SAMPLES, dtype=np.float64)
            force = np.zeros(SAMPLES)
            start = 1100.0 * number
            release = Release(sign * DEFLECTION * (1.0, 0.7, 0.5, 0.3)[number], 0.02, mode_count=1)
            initial = np.zeros((1, 2))
            initial[0, 0] = release.deviation * random.standard_normal()
            excitation = Excitation(
                time, time, initial=initial, release=ReleasePoint(end, end, release)
            )
            moved = simulate_motion(system, excitation, laws)
            values = moved.response([OutputEquation.from_row(row) for row in rows]).values
        else:
            values = (
                system.static_path(np.outer(hidden.force * force + hidden.tare, end), laws).values
                @ rows.T
            )
        for column, (name, quantity) in enumerate(zip(names, quantities, strict=True)):
            values[:, column] = hidden.readings(name, time, values[:, column])
            values[:, column] += NOISE[quantity] * random.standard_normal(len(time))
        zero = np.zeros(len(time))
        trials.append(
            Trial(
                name=f"trial_{number + 1}",
                kind=TrialKind.RINGDOWN if ringdown else TrialKind.STATIC,
                channels=names,
                values=values,
                release=release,
                used=np.ones(values.shape, bool),
                time=time,
                start=start,
                force=force,
                load_factor=zero,
                load_place="tip_load",
                temperature=zero,
                run="A",
                health=np.zeros((len(time), 2)),
                health_deviation=np.zeros((len(time), 2)),
            )
        )
    return Campaign("Bracket", channels, tuple(trials), None, {}, "")


def outcome(hidden: BracketEffect, verdict: Verdict) -> str:
    """Return what became of a hidden effect."""
    if not hidden.identifier:
        return (
            "none"
            if verdict.kind is VerdictKind.NOTHING_MISSING
            else f"wrong: {verdict.kind.value}"
        )
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY):
        names = [(effect.identifier, effect.place) for effect in verdict.effects]
        right = [name for name, _ in names] == [hidden.identifier] and names[0][1].startswith(
            hidden.place
        )
        return "named" if right else f"wrong: {names}"
    if verdict.kind is VerdictKind.GROUP:
        return (
            "in the group"
            if hidden.identifier in verdict.group
            else f"wrong group: {verdict.group}"
        )
    return verdict.kind.value


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=2021)
    parser.add_argument(
        "--ringdown", action="store_true", help="ring-downs in the place of load levels"
    )
    parser.add_argument("--only", help="identifiers of hidden effects, with commas")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = load_model(rig(folder))
        for hidden in IN_MOTION if arguments.ringdown else HIDDEN:
            if arguments.only is not None and hidden.identifier not in arguments.only.split(","):
                continue
            for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
                began = process_time()
                simulated = campaign(
                    folder / "bracket.toml", hidden, seed, ringdown=arguments.ringdown
                )
                verdict = investigate(simulated, model, seed=seed, thorough=False).verdict
                seconds = process_time() - began
                print(
                    f"{hidden.identifier or 'nothing'}, seed {seed}: {outcome(hidden, verdict)} "
                    f"({seconds:.0f} s)",
                    flush=True,
                )
                print(f"    {verdict.sentence}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
