"""`uav-twin discrepancy import`: a laboratory's files become a campaign."""

import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from discrepancy.errors import CampaignFileError
from reporting import terminal
from reporting.files import refuse_filled
from reporting.words import counted
from uav_twin.options import told

if TYPE_CHECKING:
    from discrepancy.campaign.importing import Understanding


@told("discrepancy import")
def import_files(
    files: list[Path],
    *,
    out: Path | None = None,
    column: list[str] | None = None,
    unit: list[str] | None = None,
    quantity: list[str] | None = None,
    kind: list[str] | None = None,
    release: list[str] | None = None,
    load_place: list[str] | None = None,
    decimal: list[str] | None = None,
    reference_temperature: str | None = None,
    model: str | None = None,
) -> None:
    """Make a campaign of a laboratory's files: show how they are understood, and ask what they do not say."""
    from discrepancy.campaign.importing import OF_COLUMNS, OF_FILES, Understanding
    from discrepancy.campaign.sheet import read_sheet
    from discrepancy.campaign.writing import write_campaign

    folder = out or Path(files[0].stem)
    refuse_filled(folder)
    given = (column, unit, quantity, kind, release, load_place, decimal)
    answers = {
        option: {about: value for about, _, value in (item.rpartition("=") for item in said or ())}
        for option, said in zip((*OF_COLUMNS, *OF_FILES), given, strict=True)
    }
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    found = Understanding([*map(read_sheet, files)], answers)
    if model is not None:
        from discrepancy.model_choice import choose_model

        output_quantity = choose_model(model, terminal.progress()).model.output_quantity
        found = Understanding(found.sheets, answers, output_quantity)
    _show(found)
    asked = sys.stdin.isatty() and sys.stdout.isatty()
    if asked and found.questions:
        while found.questions:
            found = _asked(found)
        _show(found)
    campaign = found.campaign(folder.resolve().name)
    if asked and not typer.confirm(f"Write {folder}?", default=True):
        terminal.say("Nothing was written.")
        raise typer.Exit(1)
    write_campaign(campaign, folder, si=True)
    size = f"{counted(len(campaign.trials), 'trial')}, {counted(len(campaign.channels), 'channel')}"
    terminal.say(f"Wrote {folder}: {size}.")
    terminal.say(f"Say in {folder / 'campaign.toml'} how well gains and zeros are known; now they are exact.")
    named = "" if model is None else f" --model {shlex.quote(model)}"
    terminal.say(f"Next: uav-twin discrepancy check {shlex.quote(str(folder))}{named}")


def _asked(found: "Understanding") -> "Understanding":
    """Return what is understood with one answer more; one that does not fit is told, and changes nothing."""
    (option, expected), (about, *_) = next(iter(found.questions.items()))
    said = typer.prompt(f"{about}, {option} ({expected})" if about else f"{option} ({expected})")
    try:
        return found.with_answer(option, about, said.strip())
    except CampaignFileError as error:
        typer.secho(str(error), fg="red", err=True)
        return found


def _show(found: "Understanding") -> None:
    for sheet in found.sheets:
        mark = {".": "points", ",": "commas"}.get(found.decimals[sheet.name], "?")
        kind = found.kinds[sheet.name] or "?"
        terminal.say(f"{sheet.name}: {kind}; {sheet.remark}; decimal {mark}")
    rows = []
    for item in found.columns:
        cells = item.sheet.columns[item.sheet.heads.index(item.head)]
        told = next((row for row, cell in enumerate(cells) if re.search("[1-9]", cell)), -1)
        si = item.in_si(found.decimals[item.sheet.name])[told]
        value = f"{float(si):.6g} {item.si}" if si else ""
        known = (item.unit or "?", item.role or "?", item.quantity or "")
        rows.append((item.sheet.name, item.head, *known, cells[told], value))
    headings = ("file", "column", "unit", "is", "quantity", "a cell", "in SI")
    terminal.print_table(headings, rows)
