"""What all commands have in common: `--quiet`, `--verbose`, results as text or JSON, and how they end.

Results go to the output stream, progress to the error stream. A command asks here for its console and its
progress, and takes no option for them: `with_common_options` gives every command the same two.
"""

import functools
import inspect
import json
import os
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated, Any

import typer

import reporting.progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from reporting.page import Words
    from reporting.progress import Progress

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

WIDTH_OF_A_PIPE = 1000
"""Columns of what is no terminal."""

SHARED = {
    "json": "Print the result as JSON, and nothing else.",
    "no_report": "Draw no report and no figures.",
}
"""What is said of the options of the commands that answer a question, and that draw a report."""


@functools.cache
def commands_of(package: str) -> dict[str, dict[str, Any]]:
    """Return the tables of `commands.toml` of a package, by the words that call a command."""
    return tomllib.loads(files(package).joinpath("commands.toml").read_text(encoding="utf-8"))


def told(words: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function as a command, by what `commands.toml` of its package tells of its parameters.

    Parameters before `*` are arguments, the others options. A text is the help; a table holds what else Typer
    takes (`metavar`, `min`, `show_default`, ...), and as `flags` the name of an option that has another one
    than its parameter. What stands in `[shared]` holds for all commands that do not say otherwise.
    """
    tables = commands_of(function.__module__.partition(".")[0])
    known = SHARED | tables["shared"] | tables.get(words, {})

    def described(parameter: inspect.Parameter) -> inspect.Parameter:
        if parameter.name not in known:
            return parameter
        told = known[parameter.name]
        given: dict[str, Any] = {"help": told} if isinstance(told, str) else dict(told)
        if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
            made = typer.Argument(**{"show_default": False} | given)
        else:
            made = typer.Option(given.pop("flags", "--" + parameter.name.replace("_", "-")), **given)
        return parameter.replace(annotation=Annotated[parameter.annotation, made])

    @functools.wraps(function)
    def command(*arguments: Any, **options: Any) -> Any:
        return function(*arguments, **options)

    signature = inspect.signature(function)
    parameters = [described(parameter) for parameter in signature.parameters.values()]
    vars(command)["__signature__"] = signature.replace(parameters=parameters)
    return command


@dataclass
class Loudness:
    """How much a command says."""

    quiet: bool = False
    verbose: bool = False


loudness = Loudness()
"""Of the command that runs."""


def console() -> "Console":
    """Return the console for results; with `--quiet` it prints nothing.

    In a pipe or a file nothing is cut or wrapped, unless COLUMNS says how wide it is.
    """
    from rich.console import Console

    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDTH_OF_A_PIPE
    return Console(highlight=False, markup=False, width=width, quiet=loudness.quiet)


def say(text: str, **look: Any) -> None:
    """Print a line of the result, unless `--quiet`; it may be `bold`, or have a colour `fg`."""
    if not loudness.quiet:
        typer.secho(text, **look)


def show(command: str, words: "Words | str", **values: Any) -> None:
    """Print what a command found as `[printed]` of a file of words says, or of that of a package by its name.

    It lists blocks as `Words.told` takes them. A row of a table with `colours` has that of its first cell of
    which they hold one.
    """
    from reporting.page import Words

    words = Words(words) if isinstance(words, str) else words
    for kind, what in words.told(words.content["printed"][command], **values):
        if kind == "table":
            name, table = what
            colours = words.content["tables"][name].get("colours", {})
            styles = [next((colours[cell] for cell in row if cell in colours), "") for row in table.rows]
            print_table([column.name for column in table.columns], table.rows, styles)
        else:
            say(what, fg="yellow" if kind == "notice" else None)


def answer(
    command: str, words: "Words | str", record: Mapping[str, Any], *, json: bool, **values: Any
) -> None:
    """Print a record as JSON, or as `show` does."""
    if json:
        print_json(record)
    else:
        show(command, words, record=record, **values)


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]], colours: Iterable[str] = ()) -> None:
    """Print a table of the result, unless `--quiet`.

    Parameters
    ----------
    headings : sequence of str
        One for each column; a column without any text is left out.
    rows : iterable of sequence of str
        Cells.
    colours : iterable of str
        The style of each row, where rows have one.
    """
    shown = console()
    table = console_table(headings, rows, shown.width)
    for row, colour in zip(table.rows, colours, strict=False):
        row.style = colour
    shown.print(table)


WIDE = 110
"""Columns of a terminal from which on identifiers are not broken."""
NARROWEST = 70
"""Columns of a terminal from which on the first column of a table is never broken elsewhere."""
LONGEST_NAME, LONGEST_WORD = 20, 14
"""Letters of a word that stay on one line in a narrower terminal, in the first column and in the others."""


def console_table(headings: Sequence[str], rows: Iterable[Sequence[str]], width: int) -> "Table":
    """Return a table without the columns that are empty, whose long words break at underscores and hyphens.

    Parameters
    ----------
    headings : sequence of str
        One for each column.
    rows : iterable of sequence of str
        Cells; what a row lacks at its end stays empty.
    width : int
        Columns of the terminal.
    """
    from rich import box
    from rich.table import Table

    cells = [(*row, *[""] * (len(headings) - len(row))) for row in rows]
    kept = [at for at in range(len(headings)) if not cells or any(row[at] for row in cells)]
    first = next(iter(kept), 0)
    if width < WIDE:
        longest_words = [LONGEST_NAME if at == first else LONGEST_WORD for at in range(len(headings))]
        cells = [tuple(map(broken, row, longest_words)) for row in cells]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for at in kept:
        # The first column names the row; the others make room for it, unless it would take more than half.
        longest = max((len(line) for row in cells for line in row[at].split("\n")), default=0)
        kept_whole = at == first and width >= NARROWEST and longest <= width // 2
        table.add_column(headings[at], overflow="fold", no_wrap=kept_whole)
    for row in cells:
        table.add_row(*(row[at] for at in kept))
    return table


def broken(text: str, longest: int) -> str:
    """Return a text whose longer words go on in a new line after an underscore or a hyphen."""
    return " ".join(_broken_word(word, longest) for word in text.split(" "))


def _broken_word(word: str, longest: int) -> str:
    lines = [""]
    for part in re.findall(r"[^_-]*[_-]|[^_-]+", word):
        if lines[-1] and len(lines[-1]) + len(part) > longest:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def progress() -> "Progress":
    """Return where the stages of a command are shown."""
    from reporting.progress import RichProgress, SilentProgress

    return SilentProgress() if loudness.quiet else RichProgress(lines=loudness.verbose)


def failed(text: str, code: int = 1) -> typer.Exit:
    """Return the end of a command that something was wrong with, and say what on the error stream."""
    typer.secho(text, fg="red", err=True)
    return typer.Exit(code)


@contextmanager
def interruptible(kept: Callable[[], str] = str) -> Iterator[None]:
    """End a command after Ctrl-C, and say what is kept and how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise failed("; ".join(filter(None, ("Interrupted", kept()))) + ".", INTERRUPTED) from None


def print_json(record: Mapping[str, Any]) -> None:
    """Print a record as JSON text; a number that is not finite becomes null."""
    from reporting.json_file import plain

    typer.echo(json.dumps(plain(record), indent=1, ensure_ascii=False, allow_nan=False, default=str))


def with_common_options(application: typer.Typer) -> Callable[..., None]:
    """Return a command line whose commands all take `--quiet` and `--verbose`, and end alike after Ctrl-C."""
    from typer.main import get_command

    loudness.quiet = loudness.verbose = False
    common = typer.Typer(add_completion=False)
    common.command()(_common_options)
    options = [option for option in get_command(common).params if option.name in ("quiet", "verbose")]
    for option in options:
        option.expose_value = False  # the commands ask this module instead
    command = get_command(application)
    _extend(command, options)
    return command


def _option(name: str, told: str) -> Any:
    """Return the option that makes commands `name`."""

    def louder(value: bool) -> None:
        setattr(loudness, name, getattr(loudness, name) or value)
        if loudness.quiet and loudness.verbose:
            raise typer.BadParameter("--quiet and --verbose exclude each other.")

    return typer.Option(f"--{name}", f"-{name[0]}", callback=louder, help=told)


def _common_options(
    quiet: Annotated[bool, _option("quiet", "Print nothing but errors, and what --json asks for.")] = False,
    verbose: Annotated[
        bool, _option("verbose", "Show stages as lines with their times, and the traceback of an error.")
    ] = False,
) -> None:
    """Carry the options that every command has."""


def _extend(command: Any, options: Sequence[Any]) -> None:
    command.params.extend(options)
    if command.callback is not None:
        command.callback = _narrated()(command.callback)
    for inner in getattr(command, "commands", {}).values():
        _extend(inner, options)


@contextmanager
def _narrated() -> Iterator[None]:
    """Show the stages of a command, and end it alike after Ctrl-C."""
    before, reporting.progress.narrator = reporting.progress.narrator, functools.cache(progress)
    try:
        with interruptible():
            yield
    finally:
        reporting.progress.narrator = before
