"""`uav-twin calibrate simulate`: a laboratory folder of a virtual wing whose truth is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from calibration.virtual_wing import TestBench
    from fe.state import DigitalState

TRUTH_FILE = "truth.json"


def calibrate_simulate(
    out: Annotated[Path, typer.Option(help="Folder to write; it must be empty or not exist.")],
    e: Annotated[float, typer.Option(help="True Young's modulus factor.")] = 1.0073,
    servo_mass: Annotated[float, typer.Option(help="True mass of each servo [kg].")] = 0.169,
    pitot_mass: Annotated[float, typer.Option(help="True mass of the pitot tube [kg].")] = 0.134,
    alpha: Annotated[float, typer.Option(help="True mass-proportional damping [1/s].")] = 1.03,
    beta: Annotated[float, typer.Option(help="True stiffness-proportional damping [s].")] = 7.66e-4,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all errors.")] = 0,
    fmu: Annotated[
        Path | None,
        typer.Option(
            help="Do the experiments on this wing FMU, not on the reduced model; of the shipped planform."
        ),
    ] = None,
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
    sampling_rate: Annotated[
        float, typer.Option(help="Samples per second of a ring-down record; the published have 100000.")
    ] = 2000.0,
    noise: Annotated[float, typer.Option(min=0.0, help="Noise of a record [V], standard deviation.")] = 1e-4,
    quantisation: Annotated[
        float | None, typer.Option(help="Step of the recorder [V]; none by default.")
    ] = None,
    frequency_error: Annotated[
        tuple[float, float],
        typer.Option(help="Relative differences of the wing's f1 and f2 from its model's; not with --fmu."),
    ] = (0.0, 0.0),
) -> None:
    """Measure a virtual wing: a folder as `calibrate` reads it, and truth.json beside it."""
    import json

    from calibration.errors import ExperimentFileError
    from calibration.laboratory import write_lab_folder
    from calibration.virtual_wing import (
        VirtualWing,
        measure_lengths,
        measure_load_test,
        measure_ring_down,
        weigh,
    )
    from fe.design import load_design
    from fe.state import DigitalState
    from reporting.files import atomic_write_text

    if fmu is not None and frequency_error != (0.0, 0.0):
        raise typer.BadParameter("--frequency-error needs the reduced model; an FMU has its own frequencies.")
    if fmu is not None and design is not None:
        raise typer.BadParameter("--fmu and --design exclude each other: the FMU holds its wing.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ExperimentFileError(f"{out} exists and is not an empty folder: choose another --out.")
    drawn = load_design(design)
    truth = DigitalState(
        geometry=drawn.geometry,
        young_modulus_factor=e,
        servo_mass=servo_mass,
        pitot_mass=pitot_mass,
        damping_alpha=alpha,
        damping_beta=beta,
    )

    def write(bench: TestBench) -> None:
        load_test = measure_load_test(bench, seed)
        records = measure_ring_down(
            bench, seed, sampling_rate=sampling_rate, noise=noise, quantisation=quantisation
        )
        write_lab_folder(
            out,
            lengths=measure_lengths(
                truth.geometry, seed, designed=None if design is None else drawn.geometry
            ),
            load_test=load_test,
            records=records,
            total_mass=weigh(truth, seed),
        )
        record = _truth(truth) | {
            "frequency_error": list(frequency_error),
            "seed": seed,
            "bench": "reduced model" if fmu is None else fmu.name,
        }
        atomic_write_text(out / TRUTH_FILE, json.dumps(record, indent=2) + "\n")

    if fmu is not None:
        from twin_master.virtual_experiments import FmuTestBench

        with FmuTestBench(fmu, truth) as bench:
            write(bench)
    else:
        from fe.cache import reduced_model
        from reporting.progress import RichProgress

        model = reduced_model(drawn, progress=RichProgress())
        write(VirtualWing(model, truth, frequency_error))
    typer.echo(f"Laboratory folder: {out}; its truth: {out / TRUTH_FILE}")


def _truth(truth: DigitalState) -> dict[str, object]:
    geometry = truth.geometry
    return {
        "semi_span": geometry.semi_span,
        "root_chord": geometry.root_chord,
        "tip_chord": geometry.tip_chord,
        "young_modulus_factor": truth.young_modulus_factor,
        "servo_mass": truth.servo_mass,
        "pitot_mass": truth.pitot_mass,
        "damping_alpha": truth.damping_alpha,
        "damping_beta": truth.damping_beta,
    }
