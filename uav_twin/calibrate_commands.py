"""`uav-twin calibrate`, all three steps of a wing in order, and `calibrate campaign`: any model."""

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from uav_twin.calibrate_laboratory import calibrate_ringdown, calibrate_simulate
from uav_twin.options import refuse_before, show, told

if TYPE_CHECKING:
    from calibration.result.record import Calibration


@told("calibrate campaign")
def calibrate_campaign(
    campaign: Path,
    *,
    model: str | None = None,
    out: Path | None = None,
    asset: str | None = None,
    samples: int = 1000,
    seed: int = 0,
    json: bool = False,
    no_report: bool = False,
) -> None:
    """Posterior of the parameters of any model, an FMU or a structure too, from a campaign."""
    from calibration.result.file import check_folder
    from calibration.result.folder import write_calibration_folder
    from calibration.result.record import check_name
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.model_choice import choose_model
    from discrepancy.parameters.calibration import calibrate_parameters
    from uav_twin.discrepancy_run import one_thread

    one_thread()
    data = read_campaign(campaign)
    name = check_name(data.name if asset is None else asset)
    if out is not None:
        check_folder(out, name, wing=False)
    progress = terminal.progress()
    choice = choose_model(model, progress)
    result = calibrate_parameters(data, choice, asset=name, samples=samples, seed=seed, progress=progress)
    written = None if out is None else write_calibration_folder(result, out, progress, report=not no_report)
    conclude(result, written, json=json, report=not no_report)


def conclude(result: "Calibration", written: Path | None, *, json: bool, report: bool) -> None:
    """Say what a calibration found, and where it was written."""
    if json:
        terminal.print_json({"calibration": None if written is None else str(written)} | _record(result))
        return
    from calibration.result import text

    headline, correlations = text.headline(result), text.correlation_lines(result)
    show("calibration", words=text.WORDS, result=result, headline=headline, correlations=correlations)
    if written is None:
        terminal.say("Nothing was written: give --out DIR for calibration.nc and the report.")
        return
    terminal.say(f"Calibration: {written}")
    if report:
        from calibration.result.folder import REPORT_NAME

        terminal.say(f"Report: {written.with_name(REPORT_NAME)}")


def _record(result: "Calibration") -> dict[str, Any]:
    """Return the calibration as plain data."""
    from reporting.record_json import plain

    def posterior(name: str) -> dict[str, Any]:
        return {
            "posterior_mean": result.mean(name),
            "posterior_deviation": result.standard_deviation(name),
            "interval_90": list(result.interval(name)),
        }

    return {
        "asset": result.asset,
        "model": result.model,
        "campaign" if result.design is None else "laboratory": result.source,
        "procedure": result.procedure,
        "explained": result.explained,
        "seed": result.seed,
        "parameters": [
            asdict(prior) | posterior(prior.name) | {"prior_left": result.kept_share(prior.name)}
            for prior in result.priors
        ],
        "quantities": [asdict(figure) | posterior(figure.name) for figure in result.quantities],
        "correlation": result.correlation.tolist(),
        "information_nat": result.information,
        "readings": plain(result.readings),
        "channels": plain(result.channels),
        "findings": list(result.findings),
    }


class ProcedureName(StrEnum):
    """Whose samples are kept."""

    joint = "joint"
    paper = "paper"


@told("calibrate")
def calibrate_wing(
    context: typer.Context,
    *,
    data: Path | None = None,
    out: Path | None = None,
    seed: int = 0,
    asset: str | None = None,
    procedure: ProcedureName = ProcedureName.joint,
    design: Path | None = None,
    measured: bool | None = None,
    fitted: bool = False,
    json: bool = False,
    no_report: bool = False,
) -> None:
    """Tailor the model to one wing: planform, stiffness, masses and damping, in this order.

    A lab folder may hold one step alone; the sub-commands fit ring-downs, make a lab folder of a virtual
    wing, and calibrate any model from a campaign.
    """
    if context.invoked_subcommand is not None:
        refuse_before(context)
        return
    if measured and data is None:
        raise typer.BadParameter("--measured needs --data with ring-down records.")
    if fitted and (data is None or measured is False):
        raise typer.BadParameter("--fitted needs --data with ring-down records, and no --published.")
    from calibration.dynamics.trials import Frequencies
    from calibration.paper.table_1 import WORDS
    from calibration.result.file import check_folder
    from calibration.wing.calibrate import calibrate, write_wing_folder
    from calibration.wing.lab_data import Targets, published_data, read_lab_folder
    from fe.wing.design import load_design

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
        columns, rows = WORDS.table("table_1", calibration.table_1)
        terminal.print_table([column.name for column in columns], rows)
    written = None if out is None else write_wing_folder(calibration, out, progress, report=not no_report)
    conclude(calibration.result, written, json=json, report=not no_report)


calibrate_app = typer.Typer(no_args_is_help=False)
calibrate_app.callback(invoke_without_command=True)(calibrate_wing)
calibrate_app.command("ringdown")(calibrate_ringdown)
calibrate_app.command("simulate")(calibrate_simulate)
calibrate_app.command("campaign")(calibrate_campaign)
