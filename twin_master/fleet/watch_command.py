"""`uav-twin fleet watch`."""

import json
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from twin_master.viewer.command import View, shown

if TYPE_CHECKING:
    from rich.table import Table

    from twin_master.fleet.standing import WatchedAsset
    from twin_master.fleet.watching import FleetWatch

ROWS = 20
"""Assets that the table on the console shows, the worst first."""
TABLE_SECONDS = 1.0


def watch(
    file: Annotated[
        Path, typer.Argument(help="The fleet file, its groups with `observations`.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option(help="The folder to make.", show_default="runs/NAME")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, in the place of that of the file.")] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for more at the end of CSV files, and for new files.")
    ] = False,
    turns: Annotated[
        int | None, typer.Option(min=0, help="Leave an asset alone after so many turns.")
    ] = None,
    ca_file: Annotated[
        Path | None, typer.Option(help="Certificate of the authority of an mqtts:// broker.")
    ] = None,
    view: View = False,
) -> None:
    """Watch many real assets: observations in, a decision for each turn of each asset out, as a line of JSON.

    Each asset has a folder DIR/GROUP/NAME, which is that of `uav-twin watch`. On a terminal a table shows the
    worst assets in the place of decisions. Ctrl-C ends it in order; the command repeated goes on.
    """
    from twin_master.fleet.plan import load_fleet
    from twin_master.fleet.view import is_fleet, serve_fleet
    from twin_master.fleet.watching import FleetWatch

    fleet = load_fleet(file, seed)
    folder = out if out is not None else Path("runs") / fleet.name
    console = _Console()
    watched = FleetWatch(
        fleet, folder, console.tell, console.say, follow=follow, turns=turns, authority=ca_file
    )

    def ask(_signal: int, _frame: object) -> None:
        watched.asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with shown(view, (is_fleet, serve_fleet)) as begun, console.showing(watched):
            if begun is not None:
                begun(folder)
            watched.run(console.refresh)
    except Exception as error:
        error.add_note("What was observed is kept: repeat the command to go on.")
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    console.say(_heading(watched) + f": {folder}.")
    if watched.failures and not watched.assets:
        raise typer.Exit(1)


class _Console:
    """Decisions as lines of JSON for a program, or a table for people; what is wrong as a line for both."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._people = sys.stdout.isatty()
        self._live = Live(console=Console(), auto_refresh=False, transient=False)
        self._shown = 0.0
        self._watched: FleetWatch | None = None

    def showing(self, watched: "FleetWatch") -> "Any":
        from contextlib import nullcontext

        self._watched = watched
        return self._live if self._people and not terminal.loudness.quiet else nullcontext()

    def tell(self, asset: "WatchedAsset", decision: Mapping[str, Any]) -> None:
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

    def refresh(self) -> None:
        """Show the table now and then, and hand on what was told."""
        if not self._people:
            sys.stdout.flush()
        elif self._watched is not None and time.monotonic() - self._shown > TABLE_SECONDS:
            self._shown = time.monotonic()
            self._live.update(_table(self._watched), refresh=True)


def _heading(watched: "FleetWatch") -> str:
    from reporting.words import counted

    assets = watched.assets.values()
    turns = sum(asset.keep.twin.turns for asset in assets)
    alarms = sum(asset.alarm_count for asset in assets)
    refused = sum(asset.keep.intake.counts.rejected for asset in assets)
    told = [counted(len(assets), "asset"), counted(turns, "turn"), counted(alarms, "alarm")]
    told += [f"{counted(refused, 'message')} refused"] * (refused > 0)
    told += [f"{len(watched.failures)} not watched"] * bool(watched.failures)
    return ", ".join(told)


def worst_first(assets: "list[WatchedAsset]") -> "list[WatchedAsset]":
    """Return assets with alarms, then those whose states are worst."""

    def badness(asset: "WatchedAsset") -> tuple[int, float]:
        health = (asset.decision or {"health": {}})["health"]
        return asset.alarm_count, sum(known["mean"] for known in health.values())

    return sorted(assets, key=badness, reverse=True)


def _table(watched: "FleetWatch") -> "Table":
    from rich import box
    from rich.table import Table

    from twin_master.report.view import printed_state

    assets = list(watched.assets.values())
    told = [asset for asset in worst_first(assets) if asset.decision is not None][:ROWS]
    states = list(dict.fromkeys(name for asset in told for name in asset.decision["health"]))  # type: ignore[index]
    table = Table("asset", "turn", "control", *states, "next", "alarms", box=box.SIMPLE_HEAD)
    table.title = _heading(watched)
    for asset in told:
        decision = asset.decision
        assert decision is not None
        cells = []
        for name in states:
            known = decision["health"].get(name)
            if known is None:
                cells.append("")
                continue
            scale, unit = printed_state(known["unit"])
            cells.append(f"{scale * known['mean']:.3g} ± {scale * known['standard_deviation']:.2g} {unit}")
        alarms = str(asset.alarm_count or "")
        table.add_row(
            asset.name, str(decision["turn"]), decision["control"], *cells, decision["next_control"], alarms
        )
    return table
