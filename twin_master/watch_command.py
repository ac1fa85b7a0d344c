"""The command `watch`: the twin of a real asset, from observations to decisions."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.formats.former_options import accepts_former_options
from reporting.terminal import NoReportOption
from reporting.words import counted
from twin_master.command_options import (
    CalibrationOption,
    CertificateOption,
    LibraryOption,
    LineProtocolOption,
    MetricsOption,
    SeedOption,
    ViewOption,
    complete_scenario,
)
from twin_master.fleet_command import view_beside
from twin_master.watch.cause_search import CauseSearch

if TYPE_CHECKING:
    from twin_master.watch.folder import Watch


PaceOption = Annotated[
    float,
    typer.Option(
        "--pace",
        min=0.0,
        max=3600.0,
        help="Seconds to wait after each step, to look at a recording.",
    ),
]
Decision = Mapping[str, Any]
"""The decision of a twin in a step, as `decision_from_line` returns it."""


@accepts_former_options(steps="--turns", from_step="--from-turn")
def watch(
    scenario: Annotated[
        str | None,
        typer.Argument(
            show_default=False,
            metavar="[SCENARIO]",
            autocompletion=complete_scenario,
            help="A shipped scenario, or the path of a TOML file.",
        ),
    ] = None,
    *,
    observations: Annotated[
        str | None,
        typer.Option(
            "--observations",
            metavar="SOURCE",
            show_default="the recording of the scenario, else -",
            help="A file (CSV, NetCDF, JSON lines, line protocol), the folder of a run or watch, "
            "`-` for lines on standard input, or mqtt://[USER@]HOST[:PORT]/TOPIC (mqtts:// with "
            "TLS).",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            show_default="runs/SCENARIO",
            help="The folder of the watch.",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Resume the watch in --out.",
        ),
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Replace the folder if it exists.",
        ),
    ] = False,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Wait at the end of a file for more.",
        ),
    ] = False,
    pace: PaceOption = 0.0,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=0,
            help="End after this many steps in total.",
        ),
    ] = None,
    model_patch: Annotated[
        Path | None,
        typer.Option(
            "--model-patch",
            help="Believe this patch (`patch.json` of `discrepancy run`) from --from-step on.",
        ),
    ] = None,
    from_step: Annotated[
        int | None,
        typer.Option(
            "--from-step",
            min=0,
            help="The first step that --model-patch is believed in.",
        ),
    ] = None,
    teach: Annotated[
        bool,
        typer.Option(
            "--teach",
            help="Look for the cause of an alarm, and believe the named effect.",
        ),
    ] = False,
    allow_unknown: Annotated[
        bool,
        typer.Option(
            "--allow-unknown",
            help="Ignore keys and columns that are not sensors.",
        ),
    ] = False,
    ca_file: CertificateOption = None,
    metrics: MetricsOption = None,
    line_protocol: LineProtocolOption = None,
    seed: SeedOption = None,
    calibration: CalibrationOption = None,
    library: LibraryOption = None,
    last: Annotated[
        int,
        typer.Option(
            "--last",
            min=1,
            help="Number of last steps in run.nc and report.",
        ),
    ] = 1000,
    view: ViewOption = False,
    no_report: NoReportOption = False,
    cause_search: CauseSearch | None = None,
) -> None:
    """Watch a real asset: observations in, a decision for each step out, as a line of JSON.

    The same scenario as for a simulated mission; its tables `asset` and `truth` are not needed.

    Everything is kept in the folder after every step. Ctrl-C ends a watch in order; --resume
    takes it up.

    Example: `uav-twin watch watched_wing --out runs/watched`
    """
    from twin_master.feeds import broker_address
    from twin_master.watch import workflow

    watches: list[Watch] = []
    is_broker = broker_address.is_broker(observations or "")
    is_live = follow or observations is None or observations == "-" or is_broker

    with view_beside(view) as show:

        def begin_watch(watched: "Watch") -> None:
            watches.append(watched)
            show(watched.folder)

        folder = workflow.watch(
            scenario,
            observations,
            out,
            {"seed": seed, "calibration": calibration, "library": library},
            decide=_decision_printer(watches, flush=is_live, pace=pace, needs_reader=not is_broker),
            resume=resume,
            follow=follow,
            steps=steps,
            model_patch=model_patch,
            from_step=from_step,
            teach=teach,
            allow_unknown=allow_unknown,
            ca_file=ca_file,
            replace=replace,
            last=last,
            report=not no_report,
            otherwise="-",
            begun=begin_watch,
            metrics=metrics,
            line_protocol=line_protocol,
            cause_search=cause_search,
            progress=terminal.progress(),
        )
        _print_end_of_watch(folder, watches[0], report=not no_report)
    _exit_on_complaint(watches[0])


def _exit_on_complaint(watched: "Watch") -> None:
    """End the command with exit code 1 if the observations of a watch were not in order."""
    complaint = watched.intake.complaint()
    if complaint:
        raise terminal.error_exit(complaint)


def _decision_printer(
    watches: "list[Watch]", *, flush: bool, pace: float, needs_reader: bool
) -> Callable[[Decision], None]:
    """Return a function that prints a decision, and then waits for `pace` seconds.

    Parameters
    ----------
    watches : list of Watch
        A list to which the watch is added once it has begun.
    flush : bool
        Whether each decision is written at once.
    pace : float
        The time to wait after each decision [s].
    needs_reader : bool
        Whether the watch ends once nobody reads the decisions any more.
    """

    def print_decision(decision: Decision) -> None:
        has_reader = _print_decision(watches[0], decision, flush=flush)
        time.sleep(pace)
        if needs_reader and not has_reader:
            signal.raise_signal(signal.SIGINT)  # which ends a watch in order

    return print_decision


def _print_end_of_watch(folder: Path, watched: "Watch", *, report: bool) -> None:
    """Flush the decisions; print the number of messages, and the paths of folder and report."""
    from twin_master.run_folder import REPORT_NAME

    _write_to_output("", flush=True)
    if terminal.loudness.quiet:
        return
    counts = watched.intake.counts
    refused_messages = ""
    if counts.rejected:
        refused_messages = f", {counted(counts.rejected, 'message')} refused (see rejected.jsonl)"
    received_messages = counted(counts.received, "message")
    typer.echo(f"Watch: {folder}, {received_messages}{refused_messages}.", err=True)
    if report and (folder / REPORT_NAME).is_file():
        typer.echo(f"Report: {folder / REPORT_NAME}", err=True)


def _print_decision(watched: "Watch", decision: Decision, *, flush: bool) -> bool:
    """Print a decision and its notices; return whether the output still has a reader."""
    from twin_master.mission.decision_record import decision_line, with_folder

    # Notices go to the error stream, so that people see them also if a program reads the decisions.
    for notice in decision["notices"]:
        typer.secho(with_folder(notice["sentence"], watched.folder), fg="yellow", err=True)
    if terminal.loudness.quiet:
        return True
    is_for_people = sys.stdout.isatty()
    if not is_for_people:
        return _write_to_output(json.dumps(decision) + "\n", flush=flush)
    if "control" not in decision:  # before the first observation nothing is decided
        return True
    return _write_to_output(decision_line(watched.scenario, decision) + "\n", flush=True)


def _write_to_output(text: str, *, flush: bool) -> bool:
    """Write to standard output; return whether it still has a reader."""
    try:
        sys.stdout.write(text)
        if flush:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has ended, as in `watch | head`. Python would complain at its end that it
        # cannot write the rest of the buffer, so the rest goes to the null device.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True
