"""`uav-twin calibrate ...`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin import calibrate_campaign, calibrate_simulate, calibrate_steps
from uav_twin.calibrate_wing import calibrate_wing

calibrate_app = typer.Typer(no_args_is_help=False)
calibrate_app.callback(invoke_without_command=True)(calibrate_wing)


@calibrate_app.command("static")
def calibrate_static(
    data: Annotated[
        Path | None,
        typer.Option(
            help="Measured pairs: the authors' folder or a CSV file; the published eight by default."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for record, figures and report.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the particle filter.")] = 0,
    design: Annotated[
        Path | None, typer.Option(help="Use the stiffness curve of this wing design, not the published line.")
    ] = None,
) -> None:
    """Posterior of Young's modulus factor e from loads and displacements of the tip."""
    from rich.table import Table

    from calibration.static.stiffness import PUBLISHED_LINE, StiffnessCurve, stiffness_curve_of
    from calibration.static.workflow import result_files, run_static, summary_rows

    curve: StiffnessCurve = PUBLISHED_LINE
    if design is not None:
        from fe.reduction.model_cache import reduced_model
        from fe.wing.design import load_design

        curve = stiffness_curve_of(
            reduced_model(load_design(design), progress=terminal.progress()), name=str(design)
        )
    result = run_static(data, out, seed, curve)
    console = terminal.console()
    table = Table("figure", "found", "paper", "unit")
    for row in summary_rows(result):
        paper = "" if row.paper is None else f"{row.paper:.4g}"
        table.add_row(row.name, f"{row.ours:.5g}", paper, "" if row.unit == "1" else row.unit)
    console.print(table)
    if out is not None:
        console.print(f"Report: {result_files(out).report}", soft_wrap=True)


calibrate_app.command("geometry")(calibrate_steps.calibrate_geometry)
calibrate_app.command("ringdown")(calibrate_steps.calibrate_ringdown)
calibrate_app.command("dynamics")(calibrate_steps.calibrate_dynamics)
calibrate_app.command("simulate")(calibrate_simulate.calibrate_simulate)
calibrate_app.command("campaign")(calibrate_campaign.calibrate_campaign)
