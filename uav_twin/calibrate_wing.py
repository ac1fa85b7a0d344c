"""`uav-twin calibrate`: all three steps in order, from the lab folder to the file of a tailored twin."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal

if TYPE_CHECKING:
    from calibration.wing.three_steps import WingCalibration


class ProcedureName(StrEnum):
    """Whose samples are kept."""

    joint = "joint"
    paper = "paper"


Data = Annotated[
    Path | None,
    typer.Option(help="Lab folder with step1, step2, step3, or some of them; published figures otherwise."),
]
Out = Annotated[Path | None, typer.Option(help="Folder for calibration.nc, report, table and figures.")]
Asset = Annotated[str | None, typer.Option(help="Name of this wing.", show_default="that of the design")]
Procedure = Annotated[
    ProcedureName,
    typer.Option(help="Keep samples of the joint posterior, or of the paper's steps one after another."),
]
Design = Annotated[Path | None, typer.Option(help="The wing as drawn; the shipped design by default.")]
Measured = Annotated[
    bool | None,
    typer.Option(
        "--measured/--published",
        help="Aim step 3 at the ring-down records of --data or at the published figures.",
        show_default="measured where there are records",
    ),
]
Fitted = Annotated[
    bool,
    typer.Option("--fitted", help="Fit the frequencies of the records too; spectral peaks by default."),
]


def calibrate_wing(
    context: typer.Context,
    data: Data = None,
    out: Out = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of all samples.")] = 0,
    asset: Asset = None,
    procedure: Procedure = ProcedureName.joint,
    design: Design = None,
    measured: Measured = None,
    fitted: Fitted = False,
    no_report: terminal.NoReport = False,
) -> None:
    """Tailor the model to one wing: planform, stiffness, masses and damping, in this order.

    With a sub-command, one step alone.
    """
    given = (data, out, asset, design, measured)
    if context.invoked_subcommand is not None:
        if (
            any(value is not None for value in given)
            or seed
            or fitted
            or no_report
            or procedure is not ProcedureName.joint
        ):
            raise typer.BadParameter(
                f"options go behind the command: calibrate {context.invoked_subcommand} ..."
            )
        return
    if measured and data is None:
        raise typer.BadParameter("--measured needs --data with ring-down records.")
    if fitted and (data is None or measured is False):
        raise typer.BadParameter("--fitted needs --data with ring-down records, and no --published.")
    from calibration.dynamics.ringdown import Frequencies
    from calibration.reading import check_folder
    from calibration.wing.folder import write_calibration_folder
    from calibration.wing.lab_data import Targets, published_data, read_lab_folder
    from calibration.wing.result import CalibrationResult
    from calibration.wing.three_steps import calibrate_wing as calibrate
    from fe.wing.design import load_design

    drawn = load_design(design)
    name = drawn.name if asset is None else asset
    if out is not None:
        check_folder(out, name, CalibrationResult)
    targets: Targets | None = None if measured is None else "measured" if measured else "published"
    frequencies = Frequencies.FITTED if fitted else Frequencies.PEAKS
    lab = published_data() if data is None else read_lab_folder(data, targets, frequencies)
    for origin in lab.origins:
        terminal.say(f"Step {origin.step}: {origin.text}.")
    progress = terminal.progress()
    calibration = calibrate(lab, drawn, asset=name, procedure=procedure.value, seed=seed, progress=progress)
    _show(calibration)
    if out is None:
        terminal.say("Nothing was written: give --out DIR for calibration.nc and the report.")
        return
    paths = write_calibration_folder(calibration, out, progress, report=not no_report)
    terminal.say(f"Calibration: {paths.calibration}")
    if not no_report:
        terminal.say(f"Report: {paths.report}")


def _show(calibration: "WingCalibration") -> None:
    from rich import box
    from rich.table import Table

    from calibration.wing.disagreements import disagreements, misses
    from calibration.wing.table_1 import SHOWN, printed, signed, signed_number, table_1

    result = calibration.result
    console = terminal.console()
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("figure", "this wing", "in the paper", "difference"):
        table.add_column(heading, no_wrap=True)
    for row in table_1(calibration):
        shown = SHOWN[row.name]
        table.add_row(
            f"{shown.title}, {shown.unit}" if shown.unit else shown.title,
            printed(row.name, *row.found),
            printed(row.name, row.paper.mean, row.paper.standard_deviation),
            signed(row.name, row.difference),
        )
    console.print(f"{result.asset}, {result.procedure}, {len(result.samples)} samples")
    console.print(table)
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("quantity", "measured", "calibrated model", "off", "unit"):
        table.add_column(heading, no_wrap=True)
    for miss in misses(calibration):
        shown = SHOWN[miss.name]
        table.add_row(
            shown.title,
            printed(miss.name, *miss.measured),
            printed(miss.name, *miss.model),
            f"{signed_number(100.0 * miss.relative, 1)} %",
            shown.unit,
        )
    console.print(table)
    for sentence in disagreements(calibration):
        console.print(f"- {sentence}", soft_wrap=True)
