"""`uav-twin calibrate campaign`: the parameters of any model from a campaign."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal

if TYPE_CHECKING:
    from calibration.result.record import Calibration


def calibrate_campaign(
    campaign: Annotated[Path, typer.Argument(help="Folder with campaign.toml.", show_default=False)],
    model: Annotated[
        str | None,
        typer.Option(
            help="The model file of an FMU or a structure, a lumped model, a wing design: as of `discrepancy "
            "run`.",
            show_default="the shipped wing",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for calibration.nc and report.")] = None,
    asset: Annotated[
        str | None, typer.Option(help="Name of what was measured.", show_default="that of the campaign")
    ] = None,
    samples: Annotated[int, typer.Option(min=100, max=100_000, help="Samples that are kept.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of all samples.")] = 0,
    json: terminal.Json = False,
    no_report: terminal.NoReport = False,
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
    show(result, written, json=json, report=not no_report)


def show(result: "Calibration", written: Path | None, *, json: bool, report: bool) -> None:
    """Say what a calibration found, and where it was written."""
    if json:
        terminal.print_json({"calibration": None if written is None else str(written)} | _record(result))
        return
    _show(result)
    if written is None:
        terminal.say("Nothing was written: give --out DIR for calibration.nc and the report.")
        return
    terminal.say(f"Calibration: {written}")
    if report:
        from calibration.result.folder import REPORT_NAME

        terminal.say(f"Report: {written.with_name(REPORT_NAME)}")


def _record(result: "Calibration") -> dict[str, Any]:
    """Return the calibration as plain data."""
    from dataclasses import asdict

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


def _show(result: "Calibration") -> None:
    from calibration.result import text

    def table(name: str, rows: "list[tuple[str, ...]]") -> None:
        terminal.print_table(text.WORDS.headings(name), rows)

    terminal.say(text.headline(result))
    table("parameters", text.parameter_rows(result))
    for line in text.correlation_lines(result):
        terminal.say(line)
    if result.readings:
        table("readings", text.reading_rows(result))
    table("channels", text.channel_rows(result))
    for sentence in result.findings:
        terminal.say(f"- {sentence}")
