"""`uav-twin discrepancy import`: a laboratory's files become a campaign."""

import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.words import counted

if TYPE_CHECKING:
    from discrepancy.campaign.importing import Understanding

Said = list[str] | None


def _option(metavar: str, text: str, **more: Any) -> Any:
    return typer.Option(metavar=metavar, help=f"{text} May be given several times.", **more)


Column = Annotated[Said, _option(
    "HEAD=WHAT", "The model's output that a column measures; time, force, temperature or load_factor; "
    "input:NAME; or - to leave it out.",
)]  # fmt: skip
Unit = Annotated[Said, _option("HEAD=UNIT", "Where the head does not say it.")]
Quantity = Annotated[Said, _option("HEAD=QUANTITY", "Where a unit is of several, such as V, % and 1.")]
Kind = Annotated[Said, _option(
    "[FILE=]KIND", "What was done: static, ringdown, forced, driven or flight; noise: samples at rest."
)]  # fmt: skip
Release = Annotated[Said, _option("[FILE=]SIZE", "How far the point was held that was let go, as 15.5mm.")]
LoadPlace = Annotated[Said, _option("[FILE=]PLACE", "Where a force acts.", show_default="tip_load")]
Decimal = Annotated[Said, _option("[FILE=]MARK", "Point or comma, where 1,234 can be two numbers.")]


def import_files(
    files: Annotated[
        list[Path], typer.Argument(help="CSV, FILE.xlsx or FILE.xlsx#SHEET.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option(help="The folder.", show_default="as the first file")] = None,
    column: Column = None,
    unit: Unit = None,
    quantity: Quantity = None,
    kind: Kind = None,
    release: Release = None,
    load_place: LoadPlace = None,
    decimal: Decimal = None,
    reference_temperature: Annotated[
        str | None, typer.Option(metavar="DEGC", help="Where a column is a temperature.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="As of `discrepancy run`: columns may be called like its outputs.")
    ] = None,
) -> None:
    """Make a campaign of a laboratory's files: show how they are understood, and ask what they do not say."""
    from discrepancy.campaign.importing import OF_COLUMNS, OF_FILES, Understanding
    from discrepancy.campaign.sheet import read_sheet
    from discrepancy.campaign.writing import write_campaign
    from reporting.files import refuse_filled

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
    from discrepancy.errors import CampaignFileError

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
