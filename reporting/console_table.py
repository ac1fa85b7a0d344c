"""Tables on the terminal that can still be read at 80 columns."""

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

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
