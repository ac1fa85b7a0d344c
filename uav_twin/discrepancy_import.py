"""`uav-twin discrepancy import`: files of a laboratory become a campaign."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal
from reporting.errors import FileNotWrittenError
from reporting.files import refuse_filled
from reporting.folders import whole_folder
from uav_twin.discrepancy_campaigns import campaign_size, shell_arguments
from uav_twin.import_dialogue import ImportCommand, ImportDialogue
from uav_twin.options import complete_model

if TYPE_CHECKING:
    from discrepancy.campaign.importing import LaboratoryImport

_FILE_OF_IMPORT = re.compile(r"campaign\.toml|noise\.csv|\d\d+_.*\.csv")
"""Names of the files that an import writes."""


def import_files(
    files: Annotated[
        list[Path],
        typer.Argument(
            show_default=False, help="CSV, FILE.xlsx, FILE.xlsx#SHEET, FILE.xlsx#all or FILE.mat."
        ),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", show_default="as the first file", help="The folder."),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            metavar="HEAD=WHAT",
            help="The model's output that a column measures; time, force, temperature or "
            "load_factor; input:NAME; or - to leave it out. May be given several "
            "times.",
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option(
            "--unit",
            metavar="HEAD=UNIT",
            help="Unit of a column whose head does not state it. May be given several times.",
        ),
    ] = None,
    quantity: Annotated[
        list[str] | None,
        typer.Option(
            "--quantity",
            metavar="HEAD=QUANTITY",
            help=(
                "Quantity of a column whose unit belongs to several, such as V, % and 1. May be "
                "given several times."
            ),
        ),
    ] = None,
    scale: Annotated[
        list[str] | None,
        typer.Option(
            "--scale",
            metavar="HEAD=SCALE",
            help=(
                "Factor from the cells to the measured quantity, such as 200 N/V; a plain number "
                "multiplies them. May be given several times."
            ),
        ),
    ] = None,
    zero: Annotated[
        list[str] | None,
        typer.Option(
            "--zero",
            metavar="[HEAD=]DEVIATION",
            show_default="1%",
            help="How well a zero is known: 0.1mm, 1% of the largest reading, exact or "
            "free. May be given several times.",
        ),
    ] = None,
    gain: Annotated[
        list[str] | None,
        typer.Option(
            "--gain",
            metavar="[HEAD=]DEVIATION",
            show_default="2%",
            help="How well a gain is known: 2%, exact or free. May be given several times.",
        ),
    ] = None,
    hold: Annotated[
        list[str] | None,
        typer.Option(
            "--hold",
            metavar="[HEAD=]HOLD",
            show_default="linear",
            help="What a load does between samples: zero_order, linear or smooth. May be "
            "given several times.",
        ),
    ] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            "--kind",
            metavar="[FILE=]KIND",
            help=(
                "Kind of the trial: static, ringdown, forced, driven or flight; noise for samples "
                "at rest. May be given several times."
            ),
        ),
    ] = None,
    release: Annotated[
        list[str] | None,
        typer.Option(
            "--release",
            metavar="[FILE=]SIZE",
            help="Displacement at which the release point was held, such as 15.5mm, or the force "
            "that held it, such as 600N. May be given several times.",
        ),
    ] = None,
    load_place: Annotated[
        list[str] | None,
        typer.Option(
            "--load-place",
            metavar="[FILE=]PLACE",
            show_default="tip_load",
            help="Where a force acts. May be given several times.",
        ),
    ] = None,
    decimal: Annotated[
        list[str] | None,
        typer.Option(
            "--decimal",
            metavar="[FILE=]MARK",
            help=(
                "Decimal sign, a point or a comma, if 1,234 can mean two numbers. May be given "
                "several times."
            ),
        ),
    ] = None,
    date_order: Annotated[
        list[str] | None,
        typer.Option(
            "--date-order",
            metavar="[FILE=]FIRST",
            help=(
                "What comes first in dates, day or month, if 3/4/2026 can mean two days. May be "
                "given several times."
            ),
        ),
    ] = None,
    interval: Annotated[
        list[str] | None,
        typer.Option(
            "--interval",
            metavar="[FILE=]SECONDS",
            help="Seconds between rows, if no column is a time. May be given several times.",
        ),
    ] = None,
    begins: Annotated[
        list[str] | None,
        typer.Option(
            "--begins",
            metavar="[FILE=]START",
            show_default="settled",
            help="How a forced or driven trial begins: settled, still or unknown. May be "
            "given several times.",
        ),
    ] = None,
    held_out: Annotated[
        list[str] | None,
        typer.Option(
            "--held-out",
            metavar="FILE[=no]",
            help=(
                "A file that is held out for the proof; =no takes it into the fit. May be given "
                "several times."
            ),
        ),
    ] = None,
    reference_temperature: Annotated[
        str | None,
        typer.Option(
            "--reference-temperature",
            metavar="DEGC",
            help="Temperature at which the model's parameters hold, such as 20, 293.15K or "
            "68degF, if a column is a temperature.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            autocompletion=complete_model,
            help="The same as for `discrepancy run`: columns may have the names of its outputs.",
        ),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the folder of an earlier import.")
    ] = False,
    ask_nothing: Annotated[
        bool,
        typer.Option(
            "--ask-nothing",
            help="Take the defaults without questions, as if there were no terminal.",
        ),
    ] = False,
) -> None:
    """Make a campaign from the files of a laboratory: show how they are read, and ask for missing information.

    Example: `uav-twin discrepancy import pull.csv --kind static --column F=force --out measured`
    """  # noqa: E501
    folder = out or Path(files[0].stem)
    _check_folder(folder, replace_it=replace)
    options = {
        "column": column,
        "unit": unit,
        "quantity": quantity,
        "scale": scale,
        "zero": zero,
        "gain": gain,
        "hold": hold,
        "kind": kind,
        "release": release,
        "load-place": load_place,
        "decimal": decimal,
        "date-order": date_order,
        "interval": interval,
        "begins": begins,
        "held-out": [_held_out_answer(text) for text in held_out or ()],
    }
    # The options are answers to questions about columns and files
    answers = {name: _answers_by_subject(texts or ()) for name, texts in options.items()}
    if reference_temperature is not None:
        answers["reference-temperature"] = {"": reference_temperature}
    imported = understand_files(files, answers, model)
    _print_laboratory_import(imported)
    # Without a terminal, a question that is still open is an error of `campaign`
    is_interactive = not ask_nothing and sys.stdin.isatty() and sys.stdout.isatty()
    if is_interactive:
        imported = _ask_and_confirm(ImportCommand(files, out, model), imported, folder)
    _write_imported(imported, folder)
    terminal.say(f"Next: uav-twin discrepancy check {shell_arguments(folder, model)}")


def _write_imported(imported: "LaboratoryImport", folder: Path) -> None:
    """Write the campaign of an import, and print its size and what is assumed of its sensors."""
    from discrepancy.campaign.writing import write_campaign

    campaign = imported.campaign(folder.resolve().name)
    with whole_folder(folder) as fresh:
        write_campaign(campaign, fresh, si=True, units=imported.units(), left_out_as_empty=True)
    terminal.say(f"Wrote {folder}: {campaign_size(campaign)}.")
    if imported.assumed:
        terminal.say(
            f"{imported.assumed} Where you know better, give --zero and --gain, or correct "
            f"offset_deviation and gain_deviation in {folder / 'campaign.toml'}."
        )


def _check_folder(folder: Path, *, replace_it: bool) -> None:
    """Raise an error if a folder is not empty, unless it has only an import to be replaced."""
    if not replace_it:
        refuse_filled(folder)
    if not folder.exists():
        return
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name]
    other_names = [name for name in names if not _FILE_OF_IMPORT.fullmatch(name)]
    if other_names:
        raise FileNotWrittenError(
            f"{folder} was left unchanged, because it also holds {sorted(other_names)[0]}, which "
            "is not of an earlier import: choose another --out."
        )


def _ask_and_confirm(
    command: ImportCommand, imported: "LaboratoryImport", folder: Path
) -> "LaboratoryImport":
    """Ask for missing information, and whether to write the folder; return the completed import.

    The command ends if the user stops the dialogue or wants nothing to be written.
    """
    dialogue = ImportDialogue(command, imported)
    has_asked = dialogue.ask_all()
    if has_asked:
        _print_laboratory_import(dialogue.understanding)
    dialogue.understanding.campaign(folder.resolve().name)  # report errors of the files first
    if has_asked:
        dialogue.print_repetition()
    if not dialogue.confirm(f"Write {folder}?"):
        terminal.say("Nothing was written.")
        raise typer.Exit(1)
    return dialogue.understanding


def _held_out_answer(text: str) -> str:
    """Return FILE=yes or FILE=no for the text of `--held-out`, which may be FILE alone."""
    return text if text.endswith(("=yes", "=no")) else f"{text}=yes"


def _answers_by_subject(texts: Sequence[str]) -> dict[str, str]:
    """Return the values of an option by subject, from texts SUBJECT=VALUE or VALUE.

    The subject is a column or a file; it is empty for a value that holds for all of them.
    """
    answers = {}
    for text in texts:
        subject, _, value = text.rpartition("=")
        answers[subject] = value
    return answers


def understand_files(
    files: list[Path], answers: dict[str, dict[str, str]], model: str | None
) -> "LaboratoryImport":
    """Read a laboratory's files, and return their import with the answers of the user.

    Parameters
    ----------
    answers : dict of str to (dict of str to str)
        The values of the options, by the name of the option and then by its subject, which is a
        column or a file.
    model : str or None
        The name or the file of a model. Columns with the name of an output are taken as
        measurements of this output. The model is loaded after the files were read, so that errors
        in the files are reported first.
    """
    from discrepancy.campaign.importing import LaboratoryImport
    from discrepancy.campaign.sheet import read_sheets
    from discrepancy.model_choice import choose_model
    from discrepancy.system.load_change import choose_load_place

    sheets = [sheet for file in files for sheet in read_sheets(file)]
    imported = LaboratoryImport(sheets, answers)
    if model is None:
        return imported
    chosen_model = choose_model(model).model
    if chosen_model.load_places is not None:
        for file, place in answers["load-place"].items():
            trials_text = f"the trial of {file}" if file else "the trials"
            choose_load_place(
                chosen_model.load_places, place, chosen_model.quoted_name, trials_text
            )
    return LaboratoryImport(
        imported.sheets,
        answers,
        chosen_model.output_quantity,
        chosen_model.outputs_with_quantities,
    )


_DECIMAL_MARKS = {".": "points", ",": "commas"}
"""The word for each decimal mark in the printed table."""


def _print_laboratory_import(imported: "LaboratoryImport") -> None:
    """Print how each file and column is understood, with one cell as an example."""
    decimal_signs = imported.decimals
    for sheet in imported.sheets:
        kind = imported.kinds[sheet.name] or "?"
        decimal_mark = _DECIMAL_MARKS.get(decimal_signs[sheet.name], "?")
        terminal.say(f"{sheet.name}: {kind}; {sheet.remark}; decimal {decimal_mark}")
    for sentence in imported.clock_sentences:
        terminal.say(sentence)
    table_rows = []
    for column in imported.columns:
        sheet = column.sheet
        cells = sheet.columns[sheet.heads.index(column.head)]
        example_row = _row_of_example(cells)
        si_value = column.cells_in_si(decimal_signs[sheet.name])[example_row]
        table_rows.append(
            (
                sheet.name,
                column.head,
                column.unit or "?",
                column.role or "?",
                column.quantity or "",
                cells[example_row],
                f"{float(si_value):.6g} {column.si}" if si_value else "",
            )
        )
    if table_rows:
        headings = ("file", "column", "unit", "is", "quantity", "a cell", "in SI")
        terminal.print_table(headings, table_rows)


def _row_of_example(cells: Sequence[str]) -> int:
    """Return the row of the first cell that is not zero, or -1 (the last) if all are.

    The decimal mark may be unknown, so cells are texts: any digit 1 to 9 counts.
    """
    nonzero_rows = (row for row, cell in enumerate(cells) if re.search("[1-9]", cell))
    return next(nonzero_rows, -1)
