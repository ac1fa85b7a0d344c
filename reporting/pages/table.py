"""Tables of pages and terminals: formatted text in columns."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from reporting.errors import InvalidFigureError
from reporting.words import in_one_line

Record = TypeVar("Record")


@dataclass(frozen=True)
class PageColumn:
    """One column of a table.

    Attributes
    ----------
    name : str
        The heading.
    unit : str
        The unit, shown below the heading; empty for text and for plain counts.
    numeric : bool
        Whether cells are aligned to the right, with digits of equal width.
    """

    name: str
    unit: str = ""
    numeric: bool = False


def number_column(name: str, unit: str = "") -> PageColumn:
    """Return a column of numbers."""
    return PageColumn(name, unit, numeric=True)


@dataclass(frozen=True)
class Table:
    """A table of formatted text.

    Attributes
    ----------
    columns : sequence of PageColumn
        The headings and units.
    rows : sequence of sequence of str
        The cells of each row, one for each column. A page leaves out a table without rows.
    title, caption : str
        The text above the table on a page; the terminal prints neither.

    Raises
    ------
    InvalidFigureError
        If a row does not have one cell for each column.
    """

    columns: Sequence[PageColumn]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""

    def __post_init__(self) -> None:
        cells_needed = len(self.columns)
        for number, row in enumerate(self.rows):
            if len(row) != cells_needed:
                raise InvalidFigureError(
                    f"Row {number} of a table has {len(row)} cells; {cells_needed} are needed."
                )


@dataclass(frozen=True)
class RecordColumn(Generic[Record]):
    """A column of a table that has one row for each record.

    Attributes
    ----------
    column : PageColumn
        The heading and the unit.
    cell : callable
        Returns the text of the cell of a record.
    """

    column: PageColumn
    cell: Callable[[Record], str]


def text_cells(name: str, cell: Callable[[Record], str]) -> RecordColumn[Record]:
    """Return a column of text with the heading `name`."""
    return RecordColumn(PageColumn(name), cell)


def number_cells(name: str, cell: Callable[[Record], str], unit: str = "") -> RecordColumn[Record]:
    """Return a column of numbers with the heading `name` and perhaps a unit below it."""
    return RecordColumn(number_column(name, unit), cell)


def table_of_records(
    columns: Sequence[RecordColumn[Record]],
    records: Iterable[Record],
    title: str = "",
    caption: str = "",
) -> Table:
    """Return a table with one row for each record; line breaks in cells become blanks."""
    rows = []
    for record in records:
        rows.append([in_one_line(column.cell(record)) for column in columns])
    return Table([column.column for column in columns], rows, title, caption)


def item_table(items: Iterable[tuple[str, str]], title: str, caption: str) -> Table:
    """Return a table of named values; items without a value are left out."""
    rows = [(title, value) for title, value in items if value.strip()]
    return Table([PageColumn("item"), PageColumn("value")], rows, title, caption)
