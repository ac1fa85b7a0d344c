"""The lines and numbers of decks of Abaqus, CalculiX and Nastran, and the words in them."""

import re
from collections.abc import Iterator, Mapping
from importlib import resources
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple, NoReturn

from fe.runtime.errors import MeshError
from reporting.text_file import read_text
from reporting.toml_file import parse_toml, short_repr

_WORDS_FILE = parse_toml(
    resources.files("fe.structure").joinpath("deck_words.toml").read_bytes(), "decks", MeshError
)

_LARGEST_NUMBER = 2**53
_OPEN_QUOTATION = re.compile(r"""(['"])(?!.*\1).*""")
_MISSING_EXPONENT = re.compile(r"(?<=[\d.])(?=[+-])")


class FlatType(NamedTuple):
    """A type of elements without volume: the number of its nodes, and of its corners."""

    node_count: int
    corner_count: int


FLAT: dict[str, FlatType] = {
    name: FlatType(*counts) for name, counts in _WORDS_FILE["flat"].items()
}
"""Elements that only name nodes and faces, by their names in meshio."""


class DeckWords(NamedTuple):
    """The words of a dialect of decks, by what the reader does with them; see `deck_words.toml`.

    Attributes
    ----------
    mark : str
        The character before a word.
    harmless : frozenset of str
        Words that are passed over.
    refused : dict of str to str
        Words without which the model would be another, with the end of the message on each.
    read : dict of str to list of str
        Words that are read, each with the parameters that are read.
    flat : dict of str to str
        Types of elements in `FLAT` with which other programs write lines and surfaces.
    """

    mark: str
    harmless: frozenset[str]
    refused: dict[str, str]
    read: Mapping[str, list[str]]
    flat: Mapping[str, str]


def words_of(dialect: str) -> DeckWords:
    """Return the words of "abaqus" or "nastran"."""
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
    """Raise the error for a fault in a file; `where` says file and line."""
    raise MeshError(f"{where}: {sentence}")


def lines_of(
    files: tuple[Path, ...], comment: re.Pattern[str], include: re.Pattern[str]
) -> Iterator[tuple[str, str]]:
    """Yield the lines of a file; a line that includes another file is replaced by its lines.

    Comments and empty lines are left out. The name of an included file may go on over several lines
    until its quotation mark closes.

    Parameters
    ----------
    files : tuple of Path
        The chain of files of which each includes the next one. The last file is read.
    comment : pattern
        The pattern of a comment.
    include : pattern
        Matches a line that includes a file, whose name is its group.

    Yields
    ------
    where, line : str
        File and number of the line, and its text.
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
    """Return a text as a whole number; `where` names its file and line, for messages."""
    try:
        number = int(text)
    except ValueError:
        fail(where, f"a whole number is expected, but {short_repr(text)} was given.")
    if abs(number) > _LARGEST_NUMBER:
        fail(where, f"the number {short_repr(text)} is too large.")
    return number


def real(where: str, text: str) -> float:
    """Return a text as a real number, an empty one as 0; `where` says file and line of it.

    Fortran writes D for E, and Nastran leaves the E out.
    """
    with_exponent = _MISSING_EXPONENT.sub("E", text.upper().replace("D", "E") or "0")
    try:
        number = float(with_exponent)
    except ValueError:
        number = nan
    if not isfinite(number):
        fail(where, f"a real number is expected, but {short_repr(text)} was given.")
    return number
