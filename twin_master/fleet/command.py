"""`uav-twin fleet`, and `uav-twin run --seeds`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.words import counted
from twin_master.fleet.watch_command import watch

if TYPE_CHECKING:
    from twin_master.assets.resolution import Overrides
    from twin_master.fleet.engine import Engine
    from twin_master.fleet.flight import FleetOutcome
    from twin_master.fleet.plan import Fleet
    from twin_master.fleet.reading import Estimated

fleet_app = typer.Typer(no_args_is_help=True, help="Fly fleets of assets, and learn across them.")
fleet_app.command("watch")(watch)

SHOWN = 10
"""Failures that are printed; the others stand in `fleet.json`."""

Workers = Annotated[
    int | None,
    typer.Option(
        min=0, help="Worker processes; 0 flies in this process.", show_default="one for each processor"
    ),
]
Cluster = Annotated[
    str | None, typer.Option(help="Fly on the Dask cluster of this scheduler, such as tcp://host:8786.")
]
Replace = Annotated[bool, typer.Option("--replace", help="Replace another fleet in the folder.")]


@fleet_app.callback()
def fleet() -> None:
    """Fly fleets of assets, and learn across them."""


@fleet_app.command("run")
def run(
    file: Annotated[Path, typer.Argument(help="The fleet file.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="The folder to make.", show_default="runs/NAME")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, in the place of that of the file.")] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    replace: Replace = False,
    no_report: terminal.NoReport = False,
    json: terminal.Json = False,
) -> None:
    """Fly the assets of a fleet; repeated after an interruption, it goes on where it stopped."""
    from twin_master.fleet.plan import load_fleet

    found = load_fleet(file, seed)
    engine = engine_of(workers, cluster)
    fly_and_show(found, out, engine, replace=replace, report=not no_report, json=json)


@fleet_app.command("learn")
def learn(
    folder: Annotated[Path, typer.Argument(help="The folder of the fleet.", show_default=False)],
    out: Annotated[Path, typer.Option(help="The file to write.")] = Path("learnt.toml"),
    no_report: terminal.NoReport = False,
    json: terminal.Json = False,
) -> None:
    """Learn from all twins of a fleet: how fast damage grows, how noisy sensors are, how assets differ."""
    from twin_master.fleet.lessons import learn_from_fleet

    record = learn_from_fleet(folder, out, progress=terminal.progress())
    if not no_report:
        _report(folder)
    if json:
        terminal.print_json({"file": str(out), **record})
        return
    _show_lessons(record)
    terminal.say(f"Learnt: {out}")


def _show_lessons(record: dict[str, Any]) -> None:
    from rich import box
    from rich.table import Table

    table = Table("group", "learnt", "assumed", "mean", "95 % interval", box=box.SIMPLE_HEAD)
    for name, group in record["groups"].items():
        heading = f"{name}, {counted(group['twins'], 'twin')}"
        heading += f", {group['alarmed']} with an alarm" if group["alarmed"] else ""
        for control, rate in group["probability"].items():
            mean, interval = f"{rate['mean']:.4f}", f"{rate['lower_95']:.4f} to {rate['upper_95']:.4f}"
            if not rate["flown"]:
                mean, interval = "", "not flown"
            learnt = f"probability to worsen, {control}"
            table.add_row(heading, learnt, f"{rate['assumed']:.4f}", mean, interval)
            heading = ""
        rows = [("noise over the assumed", "1", group["noise_factor"])]
        if "population" in group:
            parameter, told = group["population"]["parameter"], group["population"]
            rows += [(f"{parameter}, mean", "", told["mean"]), (f"{parameter}, spread", "", told["spread"])]
        for title, assumed, line in rows:
            interval = f"{line['lower_95']:.4g} to {line['upper_95']:.4g}"
            table.add_row("", title, assumed, f"{line['mean']:.4g}", interval)
    for control, told in record.get("shared", {}).items():
        mean = f"{told['mean']:.4f} ± {told['standard_deviation']:.2g}"
        table.add_row("all groups", f"mean over groups, {control}", "", mean, "")
    terminal.console().print(table)


def engine_of(workers: int | None, cluster: str | None) -> "Engine":
    """Return who flies, by what the user said."""
    import os

    from twin_master.fleet.engine import Engine

    if cluster is not None:
        if workers is not None:
            raise typer.BadParameter("a cluster has its own workers.", param_hint="--workers")
        return Engine(cluster=cluster)
    return Engine(len(os.sched_getaffinity(0)) if workers is None else workers)


def run_ensemble(
    scenario: str,
    seeds: str,
    out: Path | None,
    overrides: "Overrides",
    engine: "Engine",
    *,
    replace: bool,
    report: bool,
    json: bool,
) -> None:
    """Fly one scenario under many seeds, for `uav-twin run --seeds`."""
    from twin_master.fleet.plan import ensemble, seed_range

    found = ensemble(scenario, seed_range(seeds), overrides)
    fly_and_show(found, out, engine, replace=replace, report=report, json=json)


def fly_and_show(
    fleet: "Fleet", out: Path | None, engine: "Engine", *, replace: bool, report: bool, json: bool
) -> "FleetOutcome":
    """Fly a fleet and print what became of it."""
    from twin_master.fleet.flight import fly_fleet

    folder = out if out is not None else Path("runs") / fleet.name
    try:
        outcome = fly_fleet(fleet, folder, engine, replace_old=replace, progress=terminal.progress())
    except KeyboardInterrupt:
        sentence = f"Interrupted; what was flown is kept in {folder}: repeat the command to go on."
        typer.secho(sentence, fg="red", err=True)
        raise typer.Exit(terminal.INTERRUPTED) from None
    if report:
        _report(outcome.folder)
    figures = _figures([outcome.folder])
    if json:
        told = {"folder": str(outcome.folder), "twins": outcome.twins, "failed": outcome.failed}
        terminal.print_json(
            told | {"failures": outcome.failures, "ended": outcome.ended, "groups": _plain(figures)}
        )
    else:
        _show(outcome, figures)
    return outcome


def _report(folder: Path) -> None:
    from twin_master.fleet.report import write_fleet_report

    with terminal.progress().stage("Writing the report"):
        write_fleet_report(folder)


def compare(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of fleets or ensembles.", show_default=False)
    ],
    json: terminal.Json = False,
) -> None:
    """Show the figures of several fleets or ensembles side by side."""
    figures = _figures(folders)
    if json:
        terminal.print_json(_plain(figures))
    else:
        _table(figures)


Figures = dict[str, dict[str, "Estimated | int"]]


def _figures(folders: list[Path]) -> Figures:
    """Return the figures of each group; with the folder's name where there are several folders."""
    from twin_master.fleet.reading import fleet_groups, group_figures

    found = {}
    for folder in folders:
        for name, group in fleet_groups(folder).items():
            found[name if len(folders) == 1 else f"{folder}: {name}"] = group_figures(group)
    return found


def _plain(figures: Figures) -> dict[str, Any]:
    return {
        name: {title: value if isinstance(value, int) else vars(value) for title, value in group.items()}
        for name, group in figures.items()
    }


def _table(figures: Figures) -> None:
    from rich import box
    from rich.table import Table

    from twin_master.fleet.reading import shown

    table = Table("figure", *figures, box=box.SIMPLE_HEAD)
    titles = dict.fromkeys(title for group in figures.values() for title in group)
    for title in titles:
        table.add_row(title, *(shown(group.get(title)) for group in figures.values()))
    terminal.console().print(table)


def _show(outcome: "FleetOutcome", figures: Figures) -> None:
    console = terminal.console()
    _table(figures)
    kept = f", {counted(outcome.shards_kept, 'shard')} there before" if outcome.shards_kept else ""
    rate = f"{counted(outcome.twins, 'twin')} in {outcome.seconds:.3g} s{kept}"
    short = f", {len(outcome.ended)} ended early" if outcome.ended else ""
    console.print(f"{rate}; {outcome.failed} failed in flight{short}.", soft_wrap=True)
    told = [*outcome.failures.items(), *outcome.ended.items()]
    for name, sentence in told[:SHOWN]:
        console.print(f"  {name}: {sentence}", soft_wrap=True, style="yellow")
    if len(told) > SHOWN:
        console.print(f"  and {len(told) - SHOWN} more, in {outcome.folder / 'fleet.json'}")
    page = outcome.folder / "report.html"
    console.print(f"Report: {page}" if page.is_file() else f"Fleet: {outcome.folder}", soft_wrap=True)
