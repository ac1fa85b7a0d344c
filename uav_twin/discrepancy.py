"""`uav-twin discrepancy ...`: what a model lacks beside measured data, and the model with it (`apply`)."""

from pathlib import Path

import typer

from reporting import terminal
from uav_twin.discrepancy_catalogue import convert, effects, example
from uav_twin.discrepancy_check import check
from uav_twin.discrepancy_import import import_files
from uav_twin.discrepancy_run import run
from uav_twin.options import told


@told("discrepancy apply")
def apply(
    verdict: Path, *, out: Path | None = None, member: str | None = None, replace: bool = False
) -> None:
    """Write the model with the effect that was found and the parameters beside it."""
    from discrepancy.application import apply_verdict

    done = apply_verdict(verdict, out, member=member, replace=replace, progress=terminal.progress())
    terminal.say(f"{done.path}: {done.sentence}")
    if done.command:
        terminal.say(f"Next: {done.command}")


discrepancy_app = typer.Typer(
    no_args_is_help=True, help="Find, name, add and prove what a model lacks beside measured data."
)
discrepancy_app.command("run")(run)
discrepancy_app.command("apply")(apply)
discrepancy_app.command("check")(check)
discrepancy_app.command("effects")(effects)
discrepancy_app.command("example")(example)
discrepancy_app.command("import")(import_files)
discrepancy_app.command("convert")(convert)
