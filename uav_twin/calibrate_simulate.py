"""`uav-twin calibrate simulate`: a laboratory folder of a virtual wing whose truth is known."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal

if TYPE_CHECKING:
    from calibration.virtual_wing import TestBench
    from fe.runtime.state import DigitalState, Geometry

TRUTH_FILE = "truth.json"


Fmu = Annotated[
    Path | None,
    typer.Option(
        help="Do the experiments on this wing FMU, not on the reduced model; of the shipped planform."
    ),
]
SamplingRate = Annotated[
    float, typer.Option(help="Samples per second of a ring-down record; the published have 100000.")
]
Quantisation = Annotated[float | None, typer.Option(help="Step of the recorder [V]; none by default.")]
FrequencyError = Annotated[
    tuple[float, float],
    typer.Option(help="Relative differences of the wing's f1 and f2 from its model's; not with --fmu."),
]


def calibrate_simulate(
    out: Annotated[Path, typer.Option(help="Folder to write; it must be empty or not exist.")],
    e: Annotated[float, typer.Option(help="True Young's modulus factor.")] = 1.0073,
    servo_mass: Annotated[float, typer.Option(help="True mass of each servo [kg].")] = 0.169,
    pitot_mass: Annotated[float, typer.Option(help="True mass of the pitot tube [kg].")] = 0.134,
    alpha: Annotated[float, typer.Option(help="True mass-proportional damping [1/s].")] = 1.03,
    beta: Annotated[float, typer.Option(help="True stiffness-proportional damping [s].")] = 7.66e-4,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of all errors.")] = 0,
    fmu: Fmu = None,
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
    sampling_rate: SamplingRate = 2000.0,
    noise: Annotated[float, typer.Option(min=0.0, help="Noise of a record [V], standard deviation.")] = 1e-4,
    quantisation: Quantisation = None,
    frequency_error: FrequencyError = (0.0, 0.0),
) -> None:
    """Measure a virtual wing: a folder as `calibrate` reads it, and truth.json beside it."""
    import json
    from contextlib import nullcontext
    from dataclasses import asdict

    from calibration.errors import ExperimentFileError
    from calibration.result.record import STATE
    from calibration.virtual_wing import VirtualWing
    from fe.runtime.state import DigitalState
    from fe.wing.design import load_design
    from reporting.files import atomic_write_text

    if fmu is not None and frequency_error != (0.0, 0.0):
        raise typer.BadParameter("--frequency-error needs the reduced model; an FMU has its own frequencies.")
    if fmu is not None and design is not None:
        raise typer.BadParameter("--fmu and --design exclude each other: the FMU holds its wing.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ExperimentFileError(f"{out} exists and is not an empty folder: choose another --out.")
    drawn = load_design(design)
    state: dict[str, Any] = dict(zip(STATE, (e, servo_mass, pitot_mass, alpha, beta), strict=True))
    truth = DigitalState(drawn.geometry, **state)
    designed = None if design is None else drawn.geometry
    recorder = {"sampling_rate": sampling_rate, "noise": noise, "quantisation": quantisation}
    told = asdict(drawn.geometry) | {
        **state,
        "frequency_error": list(frequency_error),
        "seed": seed,
        "bench": "reduced model" if fmu is None else fmu.name,
    }
    opened: AbstractContextManager[TestBench]
    if fmu is not None:
        from twin_master.assets.virtual_experiments import FmuTestBench

        opened = FmuTestBench(fmu, truth)
    else:
        from fe.reduction.model_cache import reduced_model

        model = reduced_model(drawn, progress=terminal.progress())
        opened = nullcontext(VirtualWing(model, truth, frequency_error))
    with opened as bench:
        _measure(bench, truth, designed, out, seed, recorder)
    atomic_write_text(out / TRUTH_FILE, json.dumps(told, indent=2) + "\n")
    terminal.say(f"Laboratory folder: {out}; its truth: {out / TRUTH_FILE}")


def _measure(
    bench: "TestBench",
    truth: "DigitalState",
    designed: "Geometry | None",
    out: Path,
    seed: int,
    recorder: Mapping[str, Any],
) -> None:
    """Do all experiments on a bench and write the laboratory folder."""
    from calibration.virtual_wing import measure_lengths, measure_load_test, measure_ring_down, weigh
    from calibration.wing.laboratory import write_lab_folder

    write_lab_folder(
        out,
        load_test=measure_load_test(bench, seed),
        records=measure_ring_down(bench, seed, **recorder),
        lengths=measure_lengths(truth.geometry, seed, designed=designed),
        total_mass=weigh(truth, seed),
    )
