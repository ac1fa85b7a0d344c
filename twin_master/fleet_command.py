"""`uav-twin fleet`, and `uav-twin run --seeds`; the process behind `--view` of all commands."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

from reporting import terminal
from reporting.command_options import JsonOption, NoReportOption
from reporting.errors import ReportingError
from reporting.former_options import accepts_former_options
from twin_master import parts
from twin_master.command_options import (
    CertificateOption,
    ClusterOption,
    FleetFolderOption,
    FleetSeedOption,
    ViewOption,
    WorkersOption,
)
from twin_master.errors import TwinMasterError

WORDS = "twin_master.fleet"
"""Package whose words are printed."""
ROWS = 20
"""Assets that the table on the console shows, the worst first."""


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
            help="Leave an asset alone after so many steps.",
        ),
    ] = None,
    ca_file: CertificateOption = None,
    view: ViewOption = False,
) -> None:
    """Watch many real assets: observations in, a decision for each step of each asset out, as a line of JSON.

    Each asset has a folder DIR/GROUP/NAME, which is that of `uav-twin watch`.

    On a terminal a table shows the worst assets in the place of decisions.

    Ctrl-C ends it in order; the command repeated goes on.

    Example: `uav-twin fleet watch fleet.toml --follow`
    """
    fleet = parts.load_fleet(file, seed)
    folder = out if out is not None else Path("runs") / fleet.head.name
    console = _Console()
    watched = parts.FleetWatch(
        fleet, folder, console.tell, console.say, follow=follow, steps=steps, authority=ca_file
    )

    fleet_view = parts.is_fleet, parts.serve_fleet
    try:
        with parts.listening(watched.ask), shown(view, fleet_view) as begun, console.showing:
            begun(folder)
            watched.run(lambda: console.refresh(watched.standing))
    except Exception as error:
        error.add_note("What was observed is kept: repeat the command to go on.")
        raise
    console.say(f"{_heading(watched.standing)}: {folder}.")
    for name, complaint in watched.complaints.items():
        console.say(f"{name}: {complaint}")
    if watched.failures or watched.complaints:
        raise typer.Exit(1)


class _Console:
    """Decisions as lines of JSON for a program, or a table for people; what is wrong as a line for both."""

    def __init__(self) -> None:

        self._people = sys.stdout.isatty()
        self._live = parts.Live(console=parts.Console(), auto_refresh=False, transient=False)
        self._shown: Mapping[str, Any] = {}
        self.showing: Any = self._live if self._people and not terminal.loudness.quiet else nullcontext()

    def tell(self, asset: "parts.WatchedAsset", decision: Mapping[str, Any]) -> None:
        """Tell a decision to a program, and to people what is new of it."""
        for notice in decision["notices"]:
            if notice["sentence"] not in asset.alarms:  # which are told once
                sentence = notice["sentence"].replace(" DIR", f" {asset.watch.folder}")
                self.say(f"{asset.name}: {sentence}")
        if not self._people and not terminal.loudness.quiet:
            try:
                sys.stdout.write(json.dumps({"asset": asset.name, **decision}) + "\n")
            except BrokenPipeError:
                signal.raise_signal(signal.SIGINT)  # which ends the watch in order

    def say(self, text: str) -> None:
        """Say a sentence."""
        if self._people:
            self._live.console.print(text, soft_wrap=True, markup=False, highlight=False)
        else:
            typer.echo(text, err=True)

    def refresh(self, standing: Mapping[str, Any]) -> None:
        """Show the table where it has changed, and hand on what was told."""
        if not self._people:
            sys.stdout.flush()
        elif standing is not self._shown:
            self._shown = standing
            self._live.update(_watched_table(standing), refresh=True)


def _heading(standing: Mapping[str, Any]) -> str:

    return parts.Words(WORDS).say("heading", counts=parts.counts_of(standing))


def _watched_table(standing: Mapping[str, Any]) -> "parts.Table":

    told = [(name, asset) for name, asset in standing["assets"].items() if asset["last"] is not None]

    def urgency(row: tuple[str, Mapping[str, Any]]) -> tuple[int, float]:
        """Return alarms and severity of an asset; one in no state that is believed is the worst."""
        _, asset = row
        return asset["alarms"], inf if asset["severity"] is None else asset["severity"]

    worst = sorted(told, key=urgency, reverse=True)[:ROWS]
    states, rows = list(dict.fromkeys(name for _, asset in worst for name in asset["last"]["health"])), []
    for name, asset in worst:
        last, health = asset["last"], parts.health_in_words(asset["last"])
        cells = [health.get(state, "") for state in states]
        alarms = str(asset["alarms"] or "")
        rows.append((name, str(last["step"]), last["control"], *cells, last["next_control"], alarms))
    headings = "asset", "step", "control", *states, "next", "alarms"
    table = terminal.console_table(headings, rows, terminal.console().width)
    table.title = _heading(standing)
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
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Replace another fleet in the folder.",
        ),
    ] = False,
    no_report: NoReportOption = False,
    json: JsonOption = False,
) -> None:
    """Fly the assets of a fleet; repeated after an interruption, it goes on where it stopped.

    Example: `uav-twin fleet run fleet.toml --workers 2`
    """
    found = parts.load_fleet(file, seed)
    engine = engine_of(workers, cluster)
    fly_and_show(found, out, engine, replace=replace, report=not no_report, json=json)


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
    no_report: NoReportOption = False,
    json: JsonOption = False,
) -> None:
    """Learn from all twins of a fleet: how fast damage grows, how noisy sensors are, how assets differ.

    Example: `uav-twin fleet learn runs/fleet --out learnt.toml`
    """
    record = parts.learn_from_fleet(folder, out, progress=terminal.progress())
    if not no_report:
        _report(folder)
    told, rows = {"file": str(out), **record}, parts.lesson_rows(record)
    terminal.answer("learn", WORDS, told, json=json, rows=rows, out=out)


def engine_of(workers: int | None, cluster: str | None) -> "parts.Engine":
    """Return who flies, by what the user said."""
    if cluster is not None:
        if workers is not None:
            raise typer.BadParameter("a cluster has its own workers.", param_hint="--workers")
        return parts.Engine(cluster=cluster)
    return parts.Engine(len(os.sched_getaffinity(0)) if workers is None else workers)


def fly_and_show(
    fleet: "parts.Fleet", out: Path | None, engine: "parts.Engine", *, replace: bool, report: bool, json: bool
) -> "parts.FleetOutcome":
    """Fly a fleet and print what became of it."""
    folder = out if out is not None else Path("runs") / fleet.head.name
    with terminal.interruptible(lambda: f"what was flown is kept in {folder}: repeat the command to go on"):
        outcome = parts.fly_fleet(fleet, folder, engine, replace_old=replace, progress=terminal.progress())
    if report:
        _report(outcome.folder)
    figures = _figures([outcome.folder])
    told = {"folder": str(outcome.folder), "twins": outcome.twins, "failed": len(outcome.failures)}
    told |= {"failures": outcome.failures, "ended": outcome.ended, "groups": figures}
    terminal.answer(
        "run", WORDS, told, json=json, outcome=outcome, rows=parts.figure_rows(figures), groups=list(figures),
        told=[*outcome.failures.items(), *outcome.ended.items()], page=outcome.folder / "report.html",
    )  # fmt: skip
    return outcome


def _report(folder: Path) -> None:

    with terminal.progress().stage("Writing the report"):
        parts.write_fleet_report(folder)


def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(
            show_default=False,
            help="Folders of fleets or ensembles.",
        ),
    ],
    *,
    json: JsonOption = False,
) -> None:
    """Show the figures of several fleets or ensembles side by side.

    Example: `uav-twin compare runs/fleet runs/other_fleet`
    """
    figures = _figures(folders)
    terminal.answer(
        "compare", WORDS, figures, json=json, rows=parts.figure_rows(figures), groups=list(figures)
    )


Figures = dict[str, dict[str, "parts.Estimated | int"]]


def _figures(folders: list[Path]) -> Figures:
    """Return the figures of each group; with the folder's name where there are several folders."""
    found = {}
    for folder in folders:
        for name, group in parts.open_fleet(folder).items():
            found[name if len(folders) == 1 else f"{folder}: {name}"] = parts.group_figures(group)
    return found


_LOOK_AGAIN = 0.05
"""Seconds between two looks for a flight that is being prepared."""
_COURTESY = 5
"""Niceness of a view beside a mission: the mission comes first."""

Server = tuple[Callable[[Path], bool], Callable[[Path, int, Callable[[str], None], Callable[[], bool]], None]]
"""Whether a folder can be shown, and what shows it, as `viewer.server.serve`."""


@contextmanager
def shown(wanted: bool, server: Server | None = None) -> Iterator[Callable[[Path], None]]:
    """Give what shows a mission from its beginning in a process beside it; at the end wait for Ctrl-C.

    Parameters
    ----------
    wanted
        Whether to show it at all; if not, what is given does nothing.
    server
        Says whether a folder can be shown yet, and shows it; that of one flight if left out.
    """
    if not wanted:
        yield lambda _folder: None
        return
    import multiprocessing

    process: multiprocessing.process.BaseProcess | None = None

    def begin(folder: Path) -> None:
        nonlocal process
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_beside, args=(folder, os.getpid(), server), daemon=True)
        process.start()

    try:
        yield begin
        if process is not None and process.is_alive():
            with suppress(KeyboardInterrupt):  # from the sentence on, which a quick hand may answer at once
                _say("The view stays until Ctrl-C.")
                process.join()
    finally:
        if process is not None:
            process.terminate()
            process.join()


def _beside(folder: Path, mission: int, server: "Server | None") -> None:
    """Show a mission as soon as it is prepared; end with the process that flies it."""
    prepared, serving = server or (parts.is_prepared, parts.serve)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the mission ends it
    os.nice(_COURTESY)

    def wanted() -> bool:
        return os.getppid() == mission

    while wanted() and not prepared(folder):
        time.sleep(_LOOK_AGAIN)
    try:
        serving(folder, 0, lambda address: _say(f"View: {address}"), wanted)
    except (TwinMasterError, ReportingError) as error:
        typer.secho(f"The view ended: {error}", fg="red", err=True)


def _say(text: str) -> None:
    """Print beside the results of a mission, which may be JSON."""
    if not terminal.loudness.quiet:
        typer.echo(text, err=True)
