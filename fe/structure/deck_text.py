"""Lines, numbers and keywords in decks of Abaqus, CalculiX and Nastran."""

import re
from collections.abc import Iterator, Mapping
from importlib import resources
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple, NoReturn

from fe.runtime.errors import MeshError
from reporting.formats.toml_file import parse_toml, short_repr
from reporting.text_file import read_text

_WORDS_FILE = parse_toml(
    resources.files("fe.structure").joinpath("deck_words.toml").read_bytes(), "decks", MeshError
)

_LARGEST_NUMBER = 2**53
_OPEN_QUOTATION = re.compile(r"""(['"])(?!.*\1).*""")
_MISSING_EXPONENT = re.compile(r"(?<=[\d.])(?=[+-])")


class FlatType(NamedTuple):
    """The number of nodes and of corners of an element type without volume."""

    node_count: int
    corner_count: int


FLAT: dict[str, FlatType] = {
    name: FlatType(*counts) for name, counts in _WORDS_FILE["flat"].items()
}
"""Elements that only name nodes and faces, by their names in meshio."""


class DeckWords(NamedTuple):
    """The keywords of a dialect, by what the reader does with them; see `deck_words.toml`.

    Attributes
    ----------
    mark : str
        The character before a keyword.
    harmless : frozenset of str
        Keywords that are ignored.
    refused : dict of str to str
        Keywords without which the model would be another one, each with the end of the error
        message.
    read : dict of str to list of str
        Keywords that are read, each with the parameters that are read.
    flat : dict of str to str
        Element types that other programs use for lines and surfaces, with their types in `FLAT`.
    """

    mark: str
    harmless: frozenset[str]
    refused: dict[str, str]
    read: Mapping[str, list[str]]
    flat: Mapping[str, str]


def words_of(dialect: str) -> DeckWords:
    """Return the keywords of "abaqus" or "nastran"."""
    table = _WORDS_FILE[dialect]
    remedies = {}
    for group in table["refused"]:
        for word in group["words"]:
            remedies[word] = group["remedy"]
    return DeckWords(
        mark=table["mark"],
        harmless=frozenset(table["harmless"]),
        refused=remedies,
        read=table.get("read", {}),
        flat=table["flat"],
    )


def fail(where: str, sentence: str) -> NoReturn:
    """Raise `MeshError` for a fault in a file; `where` gives file and line."""
    raise MeshError(f"{where}: {sentence}")


def lines_of(
    files: tuple[Path, ...], comment: re.Pattern[str], include: re.Pattern[str]
) -> Iterator[tuple[str, str]]:
    """Yield the lines of the last of the files, with included files in place.

    Comments and empty lines are left out. The name of an included file may continue over several
    lines until its quotation mark closes.

    Parameters
    ----------
    files : tuple of Path
        The file to read last, after the files that include it, outermost first.
    comment : pattern
        The pattern of a comment.
    include : pattern
        Matches a line that includes a file, whose name is its group.

    Yields
    ------
    where, line : str
        File and line number, and the text of the line.
    """
    file = files[-1]
    text = read_text(file, MeshError, what="mesh file", otherwise="latin-1")
    open_include = ""
    for number, line in enumerate(text.splitlines(), start=1):
        where = f"{file}, line {number}"
        line = comment.sub("", line).rstrip()
        if open_include:
            line = open_include + line.strip()
        match = include.fullmatch(line)
        open_include = line if match and _OPEN_QUOTATION.fullmatch(match[1].strip()) else ""
        if open_include:
            continue
        if match:
            included_file = (file.parent / match[1].strip(" '\"")).resolve()
            if included_file in files:
                fail(where, f"{included_file} includes itself.")
            yield from lines_of((*files, included_file), comment, include)
        elif line:
            yield where, line
    if open_include:
        fail(str(file), f"the quotation mark in {short_repr(open_include)} does not close.")


def whole(where: str, text: str) -> int:
    """Return a text as an integer; `where` gives file and line, for the error message."""
    try:
        number = int(text)
    except ValueError:
        fail(where, f"a whole number is expected, but {short_repr(text)} was given.")
    if abs(number) > _LARGEST_NUMBER:
        fail(where, f"the number {short_repr(text)} is too large.")
    return number


def real(where: str, text: str) -> float:
    """Return a text as a float, an empty one as 0; `where` gives file and line.

    The exponent may be written with D as in Fortran, or without a letter as in Nastran.
    """
    with_exponent = _MISSING_EXPONENT.sub("E", text.upper().replace("D", "E") or "0")
    try:
        number = float(with_exponent)
    except ValueError:
        number = nan
    if not isfinite(number):
        fail(where, f"a real number is expected, but {short_repr(text)} was given.")
    return number
