"""`uav-twin fmu check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
) -> None:
    """Check an FMU in every way we know; exit code 1 if anything is wrong with it."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from fmu_asset.check import check_fmu
    from reporting.progress import RichProgress

    result = check_fmu(
        file,
        binding,
        cycles=cycles,
        step_size=step_size,
        step_timeout=step_timeout,
        memory_limit=memory_limit,
        progress=RichProgress(),
    )
    table = Table("check", "", "found", title=escape(str(file)))
    for finding in result.findings:
        colour = _COLOURS[finding.verdict]
        table.add_row(finding.check, f"[{colour}]{finding.verdict}[/]", escape(finding.text))
    Console(highlight=False).print(table)
    if not result.passed:
        count = len(result.problems)
        typer.secho(f"{file}: {count} problem{'' if count == 1 else 's'}.", fg="red", err=True)
        raise typer.Exit(1)
    typer.echo(f"{file}: no problem found.")
