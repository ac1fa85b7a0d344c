"""What all commands share: `--quiet`, `--verbose`, results as text or JSON, and how they end.

Results go to the output stream, progress to the error stream. A command gets its console and its
progress from this module and has no options for them: `with_common_options` gives every command the
same two.
"""

import functools
import io
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any

import typer

import reporting.progress
from reporting.system.log import shown_log
from reporting.words import with_short_hashes

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from reporting.pages.table import Table as TextTable
    from reporting.progress import Progress

_Command = Any  # Typer does not export the classes of its commands and options.
_Option = Any

INTERRUPTED = 130
"""Exit code after Ctrl-C, as of shells."""

WIDTH_OF_A_PIPE = 1000
"""Width of a console that is not a terminal, in columns."""


LARGEST_SEED = 2**63 - 1
"""The largest seed, that of a signed integer of 64 bits."""

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
]
"""Whether a command prints JSON instead of text."""

NoReportOption = Annotated[bool, typer.Option("--no-report", help="Draw no report and no figures.")]
"""Whether a command leaves out its report."""


@dataclass
class Loudness:
    """How much a command prints."""

    quiet: bool = False
    verbose: bool = False


loudness = Loudness()
"""How much the running command prints."""


def make_streams_writable() -> None:
    """Let commands write to closed streams, and characters that the encoding of a stream lacks.

    What is written to a closed stream is lost. The null device takes its file descriptor, so that
    no file that is opened later gets it. A character that the encoding lacks becomes `?`.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def console() -> "Console":
    """Return the console for results; with `--quiet` it prints nothing.

    In a pipe or a file no line is cut or wrapped, unless the variable COLUMNS gives a width.
    """
    from rich.console import Console

    width = None if _has_width() else WIDTH_OF_A_PIPE
    return Console(highlight=False, markup=False, width=width, quiet=loudness.quiet)


def _has_width() -> bool:
    """Return whether results go to a terminal, or to a pipe with a width by COLUMNS."""
    return sys.stdout.isatty() or "COLUMNS" in os.environ


def say(text: str, *, fg: str | None = None, bold: bool | None = None) -> None:
    """Print a line of the result, unless `--quiet`; a SHA-256 in it is shortened.

    Parameters
    ----------
    text : str
        The line.
    fg : str, optional
        The colour.
    bold : bool, optional
        Whether the line is bold.
    """
    if not loudness.quiet:
        typer.secho(with_short_hashes(text), fg=fg, bold=bold)


def show(blocks: "Iterable[str | TextTable]") -> None:
    """Print the paragraphs and tables of a result in their order, without tables that are empty.

    A paragraph is broken between words where it is wider than the terminal.
    """
    for block in blocks:
        if isinstance(block, str):
            say(_fitted_to_terminal(block) if _has_width() else block)
        elif block.rows:
            print_table([column.name for column in block.columns], block.rows)


def _fitted_to_terminal(text: str) -> str:
    """Return a text whose lines are broken between words at the width of the terminal."""
    width = console().width
    lines = []
    for line in text.splitlines():
        lines.append(fill(line, width, break_long_words=False, break_on_hyphens=False))
    return "\n".join(lines)


def print_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], colours: Iterable[str] = ()
) -> None:
    """Print a table of results, unless `--quiet` was given.

    Parameters
    ----------
    headings : sequence of str
        The heading of each column; a column without any text is left out.
    rows : iterable of sequence of str
        The cells of each row.
    colours : iterable of str
        The style of each row; rows beyond the last style have none.
    """
    output = console()
    table = console_table(headings, rows, output.width)
    for row, colour in zip(table.rows, colours, strict=False):
        row.style = colour
    output.print(table)


WIDE = 110
"""Width of a terminal from which on identifiers are not broken, in columns."""
NARROWEST = 70
"""Width of a terminal from which on the first column of a table is not wrapped, in columns."""
LONGEST_NAME = 20
"""Longest part of a word on one line in a narrower terminal, in the first column of a table."""
LONGEST_WORD = 14
"""Longest part of a word on one line in a narrower terminal, in the other columns."""

_GAP = 2
"""Columns of characters that a column of a table needs beside its text."""

_UNBROKEN = re.compile(r"\S+(?: (?:±|to) \S+)*")
"""What stays on one line of a cell: a word, a value with its deviation, or an interval."""


def console_table(headings: Sequence[str], rows: Iterable[Sequence[str]], width: int) -> "Table":
    """Return a table for a terminal of a given width, without columns in which all cells are empty.

    The narrower the terminal, the more the table is changed, until each value has room on one line:

    1. From `WIDE` columns of characters on, no word is broken.
    2. Below that, long words may break after underscores and hyphens.
    3. If values still do not fit, the table is folded: all columns after the first one become one,
       whose cells say "heading: value; heading: value".

    Parameters
    ----------
    headings : sequence of str
        The heading of each column.
    rows : iterable of sequence of str
        The cells of each row; missing cells at its end are empty.
    width : int
        The width of the terminal in columns of characters.
    """
    from rich import box
    from rich.table import Table

    padded_rows = [[*row, *[""] * (len(headings) - len(row))] for row in rows]
    filled_columns = [
        column
        for column in range(len(headings))
        if not padded_rows or any(row[column] for row in padded_rows)
    ]
    table_headings = [headings[column] for column in filled_columns]
    whole_rows = [[row[column] for column in filled_columns] for row in padded_rows]
    table_rows = whole_rows
    if width < WIDE and filled_columns:
        table_rows = []
        for name, *values in whole_rows:
            broken_values = [break_words(value, LONGEST_WORD) for value in values]
            table_rows.append([break_words(name, LONGEST_NAME), *broken_values])
    widths = _column_widths(table_headings, table_rows, width)
    if widths is None and len(filled_columns) > 2:
        # a folded cell has more room, so it begins from the words as they were before breaking
        table_headings, table_rows, widths = _folded(table_headings, whole_rows, width)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for column, heading in enumerate(table_headings):
        # A table of two columns is not folded; without widths, rich breaks its values.
        fixed_width = None if widths is None else widths[column]
        table.add_column(heading, overflow="fold", width=fixed_width)
    for row in table_rows:
        table.add_row(*row)
    return table


def _column_widths(
    headings: Sequence[str], rows: Sequence[Sequence[str]], width: int
) -> list[int] | None:
    """Return widths of columns with which no value breaks; None if the terminal is too narrow.

    Each column begins as wide as its longest line. As long as the columns do not fit into the
    terminal, one of them is made narrower by one character: the first column, which holds the names
    of the rows, until it has its least width, and then the widest that is above its least width.

    The least width of a column is that of its longest piece that must stay on one line (see
    `_UNBROKEN`). In a terminal of at least `NARROWEST` columns, the least width of the first column
    is at least

    - that of its longest name, if this is at most half of the terminal;
    - two fifths of the terminal otherwise.
    """
    widths = []
    least_widths = []
    for column, heading in enumerate(headings):
        texts = [heading, *(row[column] for row in rows)]
        widths.append(_longest(texts))
        least_widths.append(_longest(value for text in texts for value in _UNBROKEN.findall(text)))
    room = width - _GAP * len(headings)
    if width >= NARROWEST and headings:
        longest_name = widths[0]
        kept_width = longest_name if longest_name <= width // 2 else 2 * width // 5
        least_widths[0] = max(least_widths[0], kept_width)
    while sum(widths) > room:
        narrowable = [column for column, least in enumerate(least_widths) if widths[column] > least]
        if not narrowable:
            return None
        if 0 in narrowable:
            narrowed_column = 0
        else:
            narrowed_column = max(narrowable, key=lambda column: widths[column])
        widths[narrowed_column] -= 1
    return widths


def _folded(
    headings: Sequence[str], rows: Sequence[Sequence[str]], width: int
) -> tuple[list[str], list[list[str]], list[int]]:
    """Fold a table into two columns; return its headings, rows and column widths.

    The second column has the values of all columns but the first, each with its heading, one after
    the other in lines that fit into the terminal.
    """
    name_width = min(width // 3, _longest([headings[0], *(row[0] for row in rows)]))
    room = width - 2 * _GAP - name_width
    folded_rows = []
    for name, *values in rows:
        lines = [""]
        for heading, value in zip(headings[1:], values, strict=True):
            if not value:
                continue
            entry = f"{heading}: {value}"
            separator = "; " if lines[-1] else ""
            if lines[-1] and len(lines[-1] + separator + entry) >= room:
                lines[-1] += ";"
                lines.append(entry)
            else:
                lines[-1] += f"{separator}{entry}"
        folded_rows.append([break_words(name, LONGEST_NAME), "\n".join(lines)])
    return [headings[0], ""], folded_rows, [name_width, room]


def _longest(texts: Iterable[str]) -> int:
    """Return the number of characters of the longest line of some texts."""
    return max((len(line) for text in texts for line in text.split("\n")), default=0)


def break_words(text: str, longest: int) -> str:
    """Return a text with line breaks in long words, after underscores or hyphens.

    Parameters
    ----------
    text : str
        The text, in one or more lines.
    longest : int
        The longest part of a word on one line, in characters.
    """
    return " ".join(_break_word(word, longest) for word in text.split(" "))


def _break_word(word: str, longest: int) -> str:
    """Return a word with line breaks after underscores or hyphens, if it is long."""
    lines = [""]
    for syllable in re.findall(r"[^_-]*[_-]|[^_-]+", word):
        if lines[-1] and len(lines[-1]) + len(syllable) > longest:
            lines.append("")
        lines[-1] += syllable
    return "\n".join(lines)


def progress() -> "Progress":
    """Return the progress that shows the stages of the running command."""
    from reporting.progress import RichProgress, SilentProgress

    if loudness.quiet:
        return SilentProgress()
    return RichProgress(lines=loudness.verbose)


def error_exit(text: str, code: int = 1) -> typer.Exit:
    """Print an error message, and return the exception that ends the command.

    Parameters
    ----------
    text : str
        The message, for the error stream.
    code : int
        The exit code.
    """
    typer.secho(text, fg="red", err=True)
    return typer.Exit(code)


@contextmanager
def interruptible(how_to_go_on: Callable[[], str] = str) -> Iterator[None]:
    """Return a context that ends the command with one line after Ctrl-C.

    Parameters
    ----------
    how_to_go_on : callable
        Returns what is kept and how to go on, for the message; nothing by default.
    """
    try:
        yield
    except KeyboardInterrupt:
        parts = ["Interrupted"]
        advice = how_to_go_on()
        if advice:
            parts.append(advice)
        raise error_exit("; ".join(parts) + ".", INTERRUPTED) from None


def print_json(record: Mapping[str, object]) -> None:
    """Print a record as JSON; a number that is not finite becomes null.

    Where the output stream is not UTF-8, characters beyond ASCII are escaped, so that none is lost.
    """
    from reporting.json_file import plain

    is_utf8 = (sys.stdout.encoding or "utf-8").lower().replace("-", "") == "utf8"
    text = json.dumps(
        plain(record), indent=1, ensure_ascii=not is_utf8, allow_nan=False, default=str
    )
    typer.echo(text)


def with_common_options(application: typer.Typer) -> Callable[..., None]:
    """Return a command line whose commands all take `--quiet` and `--verbose`.

    They also show their stages, and end with one line after Ctrl-C.
    """
    from typer.main import get_command

    loudness.quiet = False
    loudness.verbose = False
    command: _Command = get_command(application)
    _extend_commands(command, _make_common_options())
    entry_point: Callable[..., None] = command
    return entry_point


def _make_common_options() -> list[_Option]:
    """Return the options `--quiet` and `--verbose`, which set `loudness`."""
    from typer.main import get_command

    # Typer makes options only as parameters of a command.
    carrier = typer.Typer(add_completion=False)
    carrier.command()(_common_options)
    options = [
        option for option in get_command(carrier).params if option.name in ("quiet", "verbose")
    ]
    for option in options:
        option.expose_value = False  # functions of commands read `loudness` instead
    return options


def _loudness_option(name: str, help_text: str) -> _Option:
    """Return the option that sets the field `name` of `loudness`."""

    def set_loudness(value: bool) -> None:
        setattr(loudness, name, getattr(loudness, name) or value)
        if loudness.quiet and loudness.verbose:
            raise typer.BadParameter("--quiet and --verbose exclude each other.")

    return typer.Option(f"--{name}", f"-{name[0]}", callback=set_loudness, help=help_text)


def _common_options(
    quiet: Annotated[
        bool,
        _loudness_option("quiet", "Print nothing but errors, and what --json asks for."),
    ] = False,
    verbose: Annotated[
        bool,
        _loudness_option(
            "verbose", "Show stages as lines with their times, and the traceback of an error."
        ),
    ] = False,
) -> None:
    """Carry the options that every command has."""


def _extend_commands(command: _Command, options: Sequence[_Option]) -> None:
    """Add options to a command and its subcommands, and let them show their stages."""
    command.params.extend(options)
    if command.callback is not None:
        command.callback = _shown_progress()(command.callback)
    subcommands: Mapping[str, _Command] = getattr(command, "commands", {})
    for subcommand in subcommands.values():
        _extend_commands(subcommand, options)


@contextmanager
def _shown_progress() -> Iterator[None]:
    """Return a context for a command, in which library functions show their stages."""
    previous_progress = reporting.progress.default_progress
    # The cache makes one progress object for all stages of the command, when the first begins.
    reporting.progress.default_progress = functools.cache(progress)
    try:
        with interruptible(), _shown_log():
            yield
    finally:
        reporting.progress.default_progress = previous_progress


def _shown_log() -> AbstractContextManager[None]:
    """Return a context in which a command shows warnings, or with --verbose all of the log."""
    if loudness.quiet:
        return nullcontext()
    level = logging.DEBUG if loudness.verbose else logging.WARNING
    return shown_log(reporting.progress.note, level)
