"""`uav-twin calibrate`: all three steps in order, from the lab folder to the file of a tailored twin."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal


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
    json: terminal.Json = False,
    no_report: terminal.NoReport = False,
) -> None:
    """Tailor the model to one wing: planform, stiffness, masses and damping, in this order.

    A lab folder may hold one step alone; the sub-commands fit ring-downs, make a lab folder of a virtual
    wing, and calibrate any model from a campaign.
    """
    given = (data, out, asset, design, measured)
    if context.invoked_subcommand is not None:
        if (
            any(value is not None for value in given)
            or seed
            or fitted
            or no_report
            or json
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
    from calibration.paper.table_1 import HEADINGS
    from calibration.result.file import check_folder
    from calibration.wing.calibrate import calibrate
    from calibration.wing.lab_data import Targets, published_data, read_lab_folder
    from calibration.wing.page import write_wing_folder
    from fe.wing.design import load_design
    from uav_twin.calibrate_campaign import show

    drawn = load_design(design)
    name = drawn.name if asset is None else asset
    if out is not None:
        check_folder(out, name, wing=True)
    targets: Targets | None = None if measured is None else "measured" if measured else "published"
    frequencies = Frequencies.FITTED if fitted else Frequencies.PEAKS
    lab = published_data() if data is None else read_lab_folder(data, targets, frequencies)
    if not json:
        for origin in lab.origins:
            terminal.say(f"Step {origin.step}: {origin.text}.")
    progress = terminal.progress()
    calibration = calibrate(lab, drawn, asset=name, procedure=procedure.value, seed=seed, progress=progress)
    if not json:
        rows = [row.cells for row in calibration.table_1]
        terminal.print_table(HEADINGS, rows)
    written = None if out is None else write_wing_folder(calibration, out, progress, report=not no_report)
    show(calibration.result, written, json=json, report=not no_report)
