"""`uav-twin discrepancy check`: what a campaign can decide, before anything is fitted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def check(
    campaign: Annotated[Path, typer.Argument(help="Folder with campaign.toml.", show_default=False)],
    model: Annotated[
        str | None,
        typer.Option(help="As of `discrepancy run`.", show_default="the shipped wing"),
    ] = None,
    effects: Annotated[
        list[Path] | None, typer.Option(help="A TOML file of further effects; may be given several times.")
    ] = None,
) -> None:
    """Say what is wrong with the data, which effects they can show, and which they cannot tell apart."""
    from rich.console import Console

    from discrepancy.campaign_file import read_campaign
    from discrepancy.catalogue.entry import Setting
    from discrepancy.catalogue.library import load_catalogue
    from discrepancy.model_choice import choose_model
    from discrepancy.report.check_tables import (
        HEADINGS,
        confused_lines,
        group_lines,
        needs,
        rows_of,
        untested_lines,
    )
    from discrepancy.separability import separability
    from discrepancy.workflow import checked
    from reporting.progress import RichProgress
    from reporting.words import counted
    from uav_twin.console_table import console_table

    data = read_campaign(campaign)
    catalogue = load_catalogue(effects or ())
    progress = RichProgress()
    choice = choose_model(model, progress)
    data, faults = checked(data, choice.model)
    console = Console(highlight=False, markup=False)
    held = [trial.name for trial in data.trials if trial.held_out]
    console.print(
        f"{data.name}: {counted(len(data.trials), 'trial')}, {counted(len(data.channels), 'channel')}, "
        f"beside {choice.model.name}; held out: {', '.join(held) or 'none'}.",
        soft_wrap=True,
    )
    for fault in faults:
        console.print(f"{'Fault' if fault.fatal else 'Limit'}: {fault.sentence}", soft_wrap=True)
    if any(fault.fatal for fault in faults):
        typer.secho("Mend the faults first: conclusions from these data would be wrong.", fg="red", err=True)
        raise typer.Exit(1)
    with progress.stage("What this campaign can decide"):
        able = separability(
            data, choice.model, Setting(data, choice.model, choice.model.scales(data)), catalogue
        )
    shown = [at for at, title in enumerate(HEADINGS) if title not in ("testable", "confused with")]
    rows = [
        [row[at] for at in shown]
        for row, item in zip(rows_of(able), able.detectability, strict=True)
        if not item.reason
    ]
    console.print(console_table([HEADINGS[at] for at in shown], rows, console.width))
    told = group_lines(able, "to which is said above")
    for line in (*untested_lines(able), *confused_lines(able), *told, *needs(able, data, catalogue)):
        console.print(line, soft_wrap=True)
