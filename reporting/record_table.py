"""Tables of records: each column says how a record becomes a cell."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from reporting.page import Page, PageColumn, Table
from reporting.words import in_one_line

Record = TypeVar("Record")


@dataclass(frozen=True)
class RecordColumn(Generic[Record]):
    """One column of a table of records.

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
    return RecordColumn(PageColumn(name, unit, numeric=True), cell)


def table_of_records(columns: Sequence[RecordColumn[Record]], records: Iterable[Record]) -> Table:
    """Return a table with one row for each record."""
    rows = []
    for record in records:
        rows.append([in_one_line(column.cell(record)) for column in columns])
    return Table([column.column for column in columns], rows)


class TitledTable(NamedTuple):
    """A table with its title and caption.

    Attributes
    ----------
    table : Table
        The table to add.
    title, caption : str
        The text above it.
    """

    table: Table
    title: str
    caption: str


def add_titled_table(page: Page, titled: TitledTable) -> None:
    """Add a table to a page, unless it has no rows."""
    if titled.table.rows:
        page.add_table(titled.table, titled.caption, title=titled.title)
