"""`uav-twin calibrate geometry`, `ringdown` and `dynamics`: steps 1 and 3 of the calibration."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal

if TYPE_CHECKING:
    from calibration.static.summary import SummaryRow

Out = Annotated[Path | None, typer.Option(help="Folder for tables and figures.")]


def calibrate_geometry(
    data: Annotated[
        Path | None,
        typer.Option(help="Lengths: the authors' folder or a CSV file; the published ones by default."),
    ] = None,
    out: Out = None,
) -> None:
    """Posterior of semi-span and chords from design tolerance and measurement."""
    from calibration.dynamics.summary import geometry_rows, write_rows
    from calibration.geometry import published_lengths, read_lengths

    rows = geometry_rows(published_lengths() if data is None else read_lengths(data))
    _show(rows)
    if out is not None:
        write_rows(rows, out / "geometry.csv")


def calibrate_ringdown(
    data: Annotated[Path, typer.Option(help="Ring-down records: the authors' folder, or one file.")],
    out: Out = None,
    fitted: Annotated[
        bool,
        typer.Option("--fitted", help="Fit the frequencies too; by default those of the spectral peaks."),
    ] = False,
    extremes: Annotated[
        bool,
        typer.Option("--extremes", help="Fit the extremes of records read off a plot, not the middle."),
    ] = False,
    start: Annotated[
        float | None, typer.Option(min=0.0, help="Where records are cropped [s]; the first peak by default.")
    ] = None,
) -> None:
    """Natural frequencies and damping ratios of two modes from ring-down records."""
    from calibration.dynamics.records import read_records
    from calibration.dynamics.ringdown import FIRST_PEAK, Frequencies
    from calibration.dynamics.summary import ring_down_rows, write_figure, write_rows
    from calibration.dynamics.trials import fit_trials

    procedure = Frequencies.FITTED if fitted else Frequencies.PEAKS
    trials = fit_trials(read_records(data), procedure, start=FIRST_PEAK if start is None else start)
    if extremes:
        from calibration.dynamics.extremes import refine_by_extremes

        trials = refine_by_extremes(trials)
    rows = ring_down_rows(trials)
    _show(rows)
    if out is not None:
        from calibration.dynamics.figures import ring_down_figure

        write_rows(rows, out / "ringdown.csv")
        write_figure(ring_down_figure(trials), out / "figures" / "ringdown")


def calibrate_dynamics(
    data: Annotated[
        Path | None,
        typer.Option(help="The authors' folder: their samples of e; those of step 2 by default."),
    ] = None,
    out: Out = None,
    measured: Annotated[
        bool,
        typer.Option("--measured", help="Aim at the ring-down records in --data, not the published figures."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the samples of e.")] = 0,
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
) -> None:
    """Posterior of servo and pitot masses and of the Rayleigh damping, for 100 samples of e."""
    from calibration.dynamics import summary as summary
    from calibration.dynamics.masses_and_damping import DynamicTargets, calibrate_dynamics
    from calibration.dynamics.published import read_factor_samples, read_published_results
    from calibration.errors import ExperimentFileError
    from calibration.static.stiffness import exact_posterior, published_measurements
    from fe.reduction.model_cache import reduced_model
    from fe.wing.design import load_design

    if measured and data is None:
        raise typer.BadParameter("--measured needs --data with ring-down records.")
    if data is None:
        factors = exact_posterior(published_measurements()).samples(seed, 100, stratified=True)
    else:
        factors = read_factor_samples(data)
    targets = DynamicTargets()
    if measured and data is not None:
        from calibration.dynamics.extremes import refine_by_extremes
        from calibration.dynamics.records import read_records
        from calibration.dynamics.trials import fit_trials

        records = read_records(data)
        trials = fit_trials(records)
        if all(record.lowest is not None for record in records):
            trials = refine_by_extremes(trials)
        targets = DynamicTargets(trials.target_frequencies, trials.target_damping_ratios)
    model = reduced_model(None if design is None else load_design(design), progress=terminal.progress())
    result = calibrate_dynamics(model, factors, targets)
    rows = summary.dynamics_rows(result)
    _show(rows)
    if out is not None:
        from calibration.dynamics.figures import masses_figure

        authors = None
        if data is not None:
            try:
                authors = read_published_results(data)
            except ExperimentFileError:  # their results are only drawn beside ours
                authors = None
        summary.write_rows(rows, out / "dynamics.csv")
        summary.write_samples(result, out / "dynamics_samples.csv")
        summary.write_figure(masses_figure(result, authors), out / "figures" / "dynamics")


def _show(rows: "list[SummaryRow]") -> None:
    from rich.table import Table

    table = Table("figure", "found", "paper", "unit")
    for row in rows:
        paper = "" if row.paper is None else f"{row.paper:.5g}"
        table.add_row(row.name, f"{row.ours:.5g}", paper, "" if row.unit == "1" else row.unit)
    terminal.console().print(table)
