"""`uav-twin fleet`, and `uav-twin run --seeds`; the process of `--view` for all commands."""

import json
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.errors import ReportingError
from reporting.formats.former_options import accepts_former_options
from reporting.system.operating_system import lower_priority
from reporting.terminal import JsonOption, NoReportOption
from reporting.words import counted
from twin_master.command_options import (
    CertificateOption,
    ClusterOption,
    EstimatorOption,
    FleetFolderOption,
    FleetSeedOption,
    LearningClusterOption,
    LearningWorkersOption,
    MetricsOption,
    PolicyOption,
    SensorModelOption,
    StoreOption,
    ViewOption,
    WorkersOption,
    choose_engine,
)
from twin_master.compare_command import print_figures
from twin_master.errors import TwinMasterError

if TYPE_CHECKING:
    from rich.table import Table

    from twin_master.fleet.engine import Engine
    from twin_master.fleet.flight import FleetOutcome
    from twin_master.fleet.plan import Fleet
    from twin_master.fleet.watched.watched_asset import WatchedAsset
    from twin_master.watch.metrics import MetricsServer


WatchedState = Mapping[str, Any]
"""The state of each asset of a watched fleet, as `FleetWatch.state` returns it."""
ROWS = 20
"""The number of assets in the table on the console, the worst first."""
MOST_ENDINGS = 10
"""The number of failed or ended flights whose reasons are printed."""


@accepts_former_options(steps="--turns")
def watch(
    file: Annotated[
        Path,
        typer.Argument(
            show_default=False,
            help="The fleet file, its groups with `observations`.",
        ),
    ],
    *,
    out: FleetFolderOption = None,
    seed: FleetSeedOption = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Wait for more at the end of CSV files, and for new files.",
        ),
    ] = False,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=0,
            help="Stop watching an asset after this many steps.",
        ),
    ] = None,
    ca_file: CertificateOption = None,
    metrics: MetricsOption = None,
    view: ViewOption = False,
) -> None:
    """Watch many real assets: observations in, a decision for each step of each asset out.

    Each asset has a folder DIR/GROUP/NAME, which is that of `uav-twin watch`.

    On a terminal a table shows the worst assets in the place of decisions.

    Ctrl-C ends it in order; the command repeated goes on.

    Example: `uav-twin fleet watch fleet.toml --follow`
    """
    from reporting.system.operating_system import call_on_end_signal
    from twin_master.fleet.page.view import is_fleet, serve_fleet
    from twin_master.fleet.plan import load_fleet
    from twin_master.fleet.watched.watching import FleetWatch
    from twin_master.watch.metrics import serve_metrics

    fleet = load_fleet(file, seed)
    folder = out if out is not None else Path("runs") / fleet.head.name
    console = _Console()
    watched = FleetWatch(
        fleet,
        folder,
        console.print_decision,
        console.say,
        follow=follow,
        steps=steps,
        authority=ca_file,
    )
    server = ViewServer(is_fleet, serve_fleet)
    try:
        with (
            serve_metrics(metrics) as console.metrics_server,
            call_on_end_signal(watched.request_end),
            view_beside(view, server) as show,
            console.live_display,
        ):
            show(folder)
            console.say_address_of_metrics()
            watched.run(lambda: console.refresh(watched.state))
    except Exception as error:
        error.add_note("What was observed is kept: repeat the command to go on.")
        raise
    console.say(f"{_heading(watched.state)}: {folder}.")
    for name, complaint in watched.complaints.items():
        console.say(f"{name}: {complaint}")
    if watched.failures or watched.complaints:
        raise typer.Exit(1)


class _Console:
    """The output of a watched fleet.

    A program gets decisions as lines of JSON; people see a table. Both get notices as lines of
    text.

    Attributes
    ----------
    live_display : context manager
        While it is open, people see the table.
    metrics_server : MetricsServer or None
        Serves the metrics of the assets; None without such a server.
    """

    metrics_server: "MetricsServer | None" = None

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._is_for_people = sys.stdout.isatty()
        self._live = Live(console=Console(), auto_refresh=False, transient=False)
        self._last_state: WatchedState = {}
        self.live_display: AbstractContextManager[object] = nullcontext()
        if self._is_for_people and not terminal.loudness.quiet:
            self.live_display = self._live

    def print_decision(self, asset: "WatchedAsset", decision: Mapping[str, Any]) -> None:
        """Print the new notices of a decision and, for a program, the decision."""
        from twin_master.mission.decision_record import with_folder

        if self.metrics_server is not None:
            self.metrics_server.attach(asset.name, asset.watch).note_decision(decision)
        for notice in decision["notices"]:
            is_printed = notice["sentence"] in asset.alarms
            if not is_printed:
                self.say(f"{asset.name}: {with_folder(notice['sentence'], asset.watch.folder)}")
        if self._is_for_people or terminal.loudness.quiet:
            return
        try:
            sys.stdout.write(json.dumps({"asset": asset.name, **decision}) + "\n")
        except BrokenPipeError:  # the reader has ended
            signal.raise_signal(signal.SIGINT)  # which ends the watch in order

    def say_address_of_metrics(self) -> None:
        """Print the address of the metrics, if they are served."""
        if self.metrics_server is not None:
            self.say(f"Metrics: {self.metrics_server.address}")

    def say(self, text: str) -> None:
        """Print a sentence: above the table for people, on the error stream for a program."""
        if self._is_for_people:
            self._live.console.print(text, soft_wrap=True, markup=False, highlight=False)
        else:
            typer.echo(text, err=True)

    def refresh(self, state: WatchedState) -> None:
        """Show the table if it has changed; for a program, flush the printed decisions."""
        if not self._is_for_people:
            sys.stdout.flush()
        elif state is not self._last_state:
            self._last_state = state
            self._live.update(_table_of_worst_assets(state), refresh=True)


def _heading(state: WatchedState) -> str:
    """Return the heading of the table of watched assets, such as "3 assets, 120 steps, 1 alarm".

    The numbers of refused messages and of assets that could not be watched are added if there are
    any.
    """
    from twin_master.fleet.watched.watched_asset import watched_fleet_counts

    counts = watched_fleet_counts(state)
    phrases = [
        counted(counts["assets"], "asset"),
        counted(counts["steps"], "step"),
        counted(counts["alarms"], "alarm"),
    ]
    if counts["messages refused"]:
        phrases.append(f"{counted(counts['messages refused'], 'message')} refused")
    if counts["not watched"]:
        phrases.append(f"{counts['not watched']} not watched")
    return ", ".join(phrases)


def _table_of_worst_assets(state: WatchedState) -> "Table":
    """Return the table of watched assets, those with most alarms and most severe damage first."""
    from twin_master.mission.decision_record import health_in_words

    assets = {}
    for name, asset in state["assets"].items():
        if asset["last"] is not None:  # it has had a step
            assets[name] = asset

    def urgency(name: str) -> tuple[int, float]:
        """Return alarms and severity; the severity is infinite if no state is believed."""
        severity = assets[name]["severity"]
        return assets[name]["alarms"], inf if severity is None else severity

    worst = sorted(assets, key=urgency, reverse=True)[:ROWS]
    states: dict[str, None] = {}  # the names of all state factors, in their order
    for name in worst:
        states |= dict.fromkeys(assets[name]["last"]["health"])
    rows = []
    for name in worst:
        last = assets[name]["last"]
        health = health_in_words(last)
        cells = [health.get(state, "") for state in states]
        alarms = str(assets[name]["alarms"] or "")
        row = [name, str(last["step"]), last["control"], *cells, last["next_control"], alarms]
        rows.append(row)
    headings = ["asset", "step", "control", *states, "next", "alarms"]
    table = terminal.console_table(headings, rows, terminal.console().width)
    table.title = _heading(state)
    return table


def run(
    file: Annotated[
        Path,
        typer.Argument(
            show_default=False,
            help="The fleet file.",
        ),
    ],
    *,
    out: FleetFolderOption = None,
    seed: FleetSeedOption = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    store: StoreOption = "",
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Replace another fleet in the folder.",
        ),
    ] = False,
    no_report: NoReportOption = False,
    json: JsonOption = False,
    policy: PolicyOption = None,
    sensor_model: SensorModelOption = None,
    estimator: EstimatorOption = None,
) -> None:
    """Fly the assets of a fleet; repeated after an interruption, it goes on where it stopped.

    Example: `uav-twin fleet run fleet.toml --workers 2`
    """
    from twin_master.fleet.plan import load_fleet
    from twin_master.mission.parts import TwinParts

    parts = TwinParts(policy, sensor_model, estimator)
    fleet = load_fleet(file, seed).with_parts(parts).with_store(store)
    fly_and_print_fleet(
        fleet,
        out,
        choose_engine(workers, cluster),
        replace=replace,
        report=not no_report,
        json=json,
    )


def learn(
    folder: Annotated[
        Path,
        typer.Argument(
            show_default=False,
            help="The folder of the fleet.",
        ),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="The file to write.",
        ),
    ] = Path("learnt.toml"),
    workers: LearningWorkersOption = None,
    cluster: LearningClusterOption = None,
    no_report: NoReportOption = False,
    json: JsonOption = False,
) -> None:
    """Learn from a fleet: how fast damage grows, how noisy sensors are, how assets differ.

    Example: `uav-twin fleet learn runs/fleet --out learnt.toml`
    """
    from twin_master.fleet.learning.learn import is_worth_workers, learn_from_fleet
    from twin_master.fleet.learning.lessons import lesson_rows

    if workers is None and cluster is None and not is_worth_workers(folder):
        workers = 0
    engine = choose_engine(workers, cluster)
    lessons = learn_from_fleet(folder, out, engine=engine, progress=terminal.progress())
    if not no_report:
        _write_report(folder)
    if json:
        terminal.print_json({"file": str(out), **lessons})
        return
    rows = lesson_rows(lessons)
    if rows:
        headings = ["group", "learnt", "assumed", "mean", "95 % interval"]
        terminal.print_table(headings, rows)
    terminal.say(f"Learnt: {out}")


def fly_and_print_fleet(
    fleet: "Fleet",
    out: Path | None,
    engine: "Engine",
    *,
    replace: bool,
    report: bool,
    json: bool,
) -> "FleetOutcome":
    """Fly a fleet, and print its figures.

    Parameters
    ----------
    fleet : Fleet
        The plan of the fleet.
    out : Path or None
        Its folder; ``runs/NAME`` if None.
    engine : Engine
        The processes that fly.
    replace : bool
        Whether to replace another fleet in the folder.
    report : bool
        Whether to write the report.
    json : bool
        Whether to print JSON.
    """
    from twin_master.fleet.comparison import statistics_of_fleets
    from twin_master.fleet.flight import fly_fleet
    from twin_master.run_folder import REPORT_NAME

    folder = out if out is not None else Path("runs") / fleet.head.name
    hint = f"what was flown is kept in {folder}: repeat the command to go on"
    with terminal.interruptible(lambda: hint):
        outcome = fly_fleet(
            fleet, folder, engine, replace_old=replace, progress=terminal.progress()
        )
    if report:
        _write_report(outcome.folder)
    figures = statistics_of_fleets([outcome.folder])
    if json:
        terminal.print_json(
            {
                "folder": str(outcome.folder),
                "twins": outcome.twins,
                "failed": len(outcome.failures),
                "failures": outcome.failures,
                "ended": outcome.ended,
                "groups": figures,
            }
        )
    else:
        _print_endings(outcome)
        print_figures(figures)
        report_file = outcome.folder / REPORT_NAME
        has_report = report_file.is_file()
        terminal.say(f"Report: {report_file}" if has_report else f"Fleet: {outcome.folder}")
    return outcome


def _print_endings(outcome: "FleetOutcome") -> None:
    """Print how many twins have flown, and why some flights failed or ended early."""
    flown_text = f"{counted(outcome.twins, 'twin')} in {outcome.seconds:.3g} s"
    if outcome.shards_kept:
        flown_text += f", {counted(outcome.shards_kept, 'shard')} flown before"
    endings = f"{len(outcome.failures)} failed in flight"
    if outcome.ended:
        endings += f", {len(outcome.ended)} ended early"
    terminal.say(f"{flown_text}; {endings}.")
    reasons = [*outcome.failures.items(), *outcome.ended.items()]
    for name, reason in reasons[:MOST_ENDINGS]:
        terminal.say(f"  {name}: {reason}", fg="yellow")
    if len(reasons) > MOST_ENDINGS:
        file = outcome.folder / "fleet.json"
        terminal.say(f"  and {len(reasons) - MOST_ENDINGS} more, in {file}")


def _write_report(folder: Path) -> None:
    """Write the report of a fleet, and show meanwhile that it is written."""
    from twin_master.fleet.page.report import write_fleet_report

    with terminal.progress().stage("Writing the report"):
        write_fleet_report(folder)


_POLLING_INTERVAL = 0.05
"""Seconds between two checks whether a flight can be shown yet."""
_NICENESS_OF_VIEW = 5
"""The niceness of the process that shows a mission: the mission itself comes first."""


@dataclass(frozen=True)
class ViewServer:
    """The server that shows a flight or a fleet in the browser.

    Attributes
    ----------
    is_ready : callable
        Takes a folder; returns whether it can be shown yet.
    serve : callable
        Takes a folder, a port, a function that is called with the address, and one that returns
        whether to go on; serves the page until then.
    """

    is_ready: Callable[[Path], bool]
    serve: Callable[[Path, int, Callable[[str], None], Callable[[], bool]], None]


@contextmanager
def view_beside(
    is_wanted: bool, server: ViewServer | None = None
) -> Iterator[Callable[[Path], None]]:
    """Show a mission in the browser, in a process of its own; at the end wait for Ctrl-C.

    Parameters
    ----------
    is_wanted : bool
        Whether to show the mission at all.
    server : ViewServer, optional
        The server that shows the mission; the view of one flight if left out.

    Yields
    ------
    callable
        Shows the mission in a folder; it must be called once the folder exists. Without `is_wanted`
        it does nothing.
    """
    if not is_wanted:
        yield lambda _folder: None
        return
    import multiprocessing

    process: multiprocessing.process.BaseProcess | None = None

    def show(folder: Path) -> None:
        nonlocal process
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_serve_mission, args=(folder, server), daemon=True)
        process.start()

    try:
        yield show
        if process is not None and process.is_alive():
            # The user may press Ctrl-C as soon as the sentence is printed.
            with suppress(KeyboardInterrupt):
                _print_beside_results("The view stays until Ctrl-C.")
                process.join()
    finally:
        if process is not None:
            process.terminate()
            process.join()


def _serve_mission(folder: Path, server: ViewServer | None) -> None:
    """Show a mission once it can be shown, until the process that flies it ends."""
    import multiprocessing

    if server is None:
        from twin_master.viewer.flight import is_prepared
        from twin_master.viewer.server import serve

        server = ViewServer(is_prepared, serve)
    # Ctrl-C is for the mission, which then ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    lower_priority(_NICENESS_OF_VIEW)
    mission_process = multiprocessing.parent_process()

    def is_mission_alive() -> bool:
        return mission_process is None or mission_process.is_alive()

    while is_mission_alive() and not server.is_ready(folder):
        time.sleep(_POLLING_INTERVAL)
    try:
        server.serve(
            folder, 0, lambda address: _print_beside_results(f"View: {address}"), is_mission_alive
        )
    except (TwinMasterError, ReportingError) as error:
        typer.secho(f"The view ended: {error}", fg="red", err=True)


def _print_beside_results(text: str) -> None:
    """Print a line on the error stream, because the results on the output may be JSON."""
    if not terminal.loudness.quiet:
        typer.echo(text, err=True)
