"""`uav-twin fmu check`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from reporting.words import counted

_COLOURS = {"ok": "green", "warning": "yellow", "problem": "red", "skipped": "dim"}


def check(
    file: Annotated[Path, typer.Argument(help="An FMU.", show_default=False)],
    binding: Annotated[
        Path | None, typer.Option(help="A binding file; drafted from the model description by default.")
    ] = None,
    cycles: Annotated[
        int, typer.Option(help="Instances to make and free in one process; 0 for none.", min=0)
    ] = 2000,
    step_size: Annotated[
        float | None, typer.Option(help="Communication step size in seconds of a drafted binding.", min=0.0)
    ] = None,
    step_timeout: Annotated[
        float | None, typer.Option(help="Wall-clock limit of a step in seconds.", min=0.0)
    ] = None,
    memory_limit: Annotated[
        float | None, typer.Option(help="Limit of a worker's memory in MiB.", min=0.0)
    ] = None,
    json: terminal.Json = False,
) -> None:
    """Check an FMU in every way we know; exit code 1 if anything is wrong with it."""
    from dataclasses import asdict

    from fmu_asset.check import check_fmu

    result = check_fmu(
        file,
        binding,
        cycles=cycles,
        step_size=step_size,
        step_timeout=step_timeout,
        memory_limit=memory_limit,
        progress=terminal.progress(),
    )
    if json:
        findings = [asdict(finding) for finding in result.findings]
        terminal.print_json({"file": str(file), "passed": result.passed, "findings": findings})
    else:
        terminal.say(str(file))
        rows = [(found.check, found.verdict, found.text) for found in result.findings]
        colours = [_COLOURS[found.verdict] for found in result.findings]
        terminal.print_table(("check", "verdict", "found"), rows, colours)
    if not result.passed:
        typer.secho(f"{file}: {counted(len(result.problems), 'problem')}.", fg="red", err=True)
        raise typer.Exit(1)
    if not json:
        terminal.say(f"{file}: no problem found.")
