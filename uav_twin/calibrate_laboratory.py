"""`uav-twin calibrate ringdown` and `simulate`: records of a laboratory, and one of a virtual wing."""

import csv
import io
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from calibration.errors import ExperimentFileError
from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.files import atomic_write_text
from uav_twin.options import told

if TYPE_CHECKING:
    from calibration.virtual_wing import TestBench
    from fe.runtime.state import DigitalState, Geometry


@told("calibrate ringdown")
def calibrate_ringdown(
    *,
    data: Path,
    out: Path | None = None,
    fitted: bool = False,
    extremes: bool = False,
    start: float | None = None,
) -> None:
    """Natural frequencies and damping ratios of two modes from ring-down records."""
    from calibration.dynamics.records import read_records
    from calibration.dynamics.trials import (
        FIRST_PEAK,
        PUBLISHED_DAMPING_RATIOS,
        PUBLISHED_FREQUENCIES,
        Frequencies,
        ModalFigure,
        fit_trials,
        refine_by_extremes,
    )

    procedure = Frequencies.FITTED if fitted else Frequencies.PEAKS
    trials = fit_trials(read_records(data), procedure, start=FIRST_PEAK if start is None else start)
    if extremes:
        trials = refine_by_extremes(trials)
    headings = ("figure", "unit", "found", "between trials", "standard error", "paper")
    figures: tuple[tuple[ModalFigure, str, str, tuple[float, float]], ...] = (
        ("frequency", "natural frequency", "Hz", PUBLISHED_FREQUENCIES),
        ("damping_ratio", "damping ratio", "1", PUBLISHED_DAMPING_RATIOS),
    )
    rows = [
        (f"mode {mode + 1}, {title}", unit, (*trials.average(name, mode), published[mode]))
        for mode in (0, 1)
        for name, title, unit, published in figures
    ]
    terminal.print_table(headings, _cells(rows, ".5g"))
    if out is not None:
        from calibration.dynamics.figures import ring_down_figure
        from reporting.figures import save_figure

        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows((headings, *_cells(rows, ".10g")))
        atomic_write_text(out / "ringdown.csv", text.getvalue())
        save_figure(ring_down_figure(trials), out / "figures", "ringdown")


def _cells(rows: Sequence[tuple[str, str, tuple[float, ...]]], digits: str) -> list[tuple[str, ...]]:
    return [(figure, unit, *(format(value, digits) for value in values)) for figure, unit, values in rows]


TRUTH_FILE = "truth.json"


@told("calibrate simulate")
def calibrate_simulate(
    *,
    out: Path,
    e: float = 1.0073,
    servo_mass: float = 0.169,
    pitot_mass: float = 0.134,
    alpha: float = 1.03,
    beta: float = 0.000766,
    seed: int = 0,
    fmu: Path | None = None,
    design: Path | None = None,
    sampling_rate: float = 2000.0,
    noise: float = 0.0001,
    quantisation: float | None = None,
    frequency_error: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Measure a virtual wing: a folder as `calibrate` reads it, and truth.json beside it."""
    import json

    from calibration.result.record import STATE
    from calibration.virtual_wing import VirtualWing
    from fe.wing.design import load_design

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
    from calibration.wing.lab_data import write_lab_folder

    write_lab_folder(
        out,
        load_test=measure_load_test(bench, seed),
        records=measure_ring_down(bench, seed, **recorder),
        lengths=measure_lengths(truth.geometry, seed, designed=designed),
        total_mass=weigh(truth, seed),
    )
