"""`uav-twin discrepancy import`: a laboratory's files become a campaign."""

import re
import sys
from pathlib import Path

import typer

from discrepancy.errors import CampaignFileError
from reporting import terminal
from reporting.files import refuse_filled
from uav_twin import parts
from uav_twin.discrepancy_catalogue import words_of
from uav_twin.options import show


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
    folder = out or Path(files[0].stem)
    refuse_filled(folder)
    given = (column, unit, quantity, kind, release, load_place, decimal)
    answers = {
        option: {about: value for about, _, value in (item.rpartition("=") for item in said or ())}
        for option, said in zip((*parts.OF_COLUMNS, *parts.OF_FILES), given, strict=True)
    }
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    found = parts.Understanding([*map(parts.read_sheet, files)], answers)
    if model is not None:
        known = parts.choose_model(model).model.output_quantity
        found = parts.Understanding(found.sheets, answers, known)
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
    parts.write_campaign(campaign, folder, si=True)
    show("import", folder=folder, campaign=campaign, given=words_of(folder, model))


def _asked(found: "parts.Understanding") -> "parts.Understanding":
    """Return what is understood with one answer more; one that does not fit is told, and changes nothing."""
    (option, expected), (about, *_) = next(iter(found.questions.items()))
    said = typer.prompt(f"{about}, {option} ({expected})" if about else f"{option} ({expected})")
    try:
        return found.with_answer(option, about, said.strip())
    except CampaignFileError as error:
        typer.secho(str(error), fg="red", err=True)
        return found


def _show(found: "parts.Understanding") -> None:
    rows = []
    for item in found.columns:
        cells = item.sheet.columns[item.sheet.heads.index(item.head)]
        told = next((row for row, cell in enumerate(cells) if re.search("[1-9]", cell)), -1)
        si = item.in_si(found.decimals[item.sheet.name])[told]
        value = f"{float(si):.6g} {item.si}" if si else ""
        known = (item.unit or "?", item.role or "?", item.quantity or "")
        rows.append((item.sheet.name, item.head, *known, cells[told], value))
    show("understood", found=found, rows=rows)
