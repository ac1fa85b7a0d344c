"""A self-contained HTML page: sections, numbered figures and tables, one style sheet.

A page makes no request to any server, is light, and prints well. One short script shows the values
under the pointer in figures; the page is complete without it. All text is escaped. `page.html` is
the template of a page; the words of a page stand in a TOML file of its own, see `Words`.
"""

import tomllib
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple, TypedDict

from markupsafe import Markup

from reporting.errors import InvalidFigureError
from reporting.templates import (
    evaluated,
    evaluated_entries,
    fill_template,
    html_environment,
    rendered,
)
from reporting.words import in_one_line

if TYPE_CHECKING:  # text is made without figures, too, and matplotlib takes long to import
    from matplotlib.figure import Figure


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
        Whether cells are aligned to the right, in figures of equal width.
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
        The cells of each row, one for each column.

    Raises
    ------
    InvalidFigureError
        If a row does not have one cell for each column.
    """

    columns: Sequence[PageColumn]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        needed = len(self.columns)
        for number, row in enumerate(self.rows):
            if len(row) != needed:
                raise InvalidFigureError(
                    f"Row {number} of a table has {len(row)} cells; {needed} are needed."
                )


class ReportFigure(NamedTuple):
    """A figure with its title and caption.

    Attributes
    ----------
    name : str
        The name of its file, without ending.
    figure : Figure
        The drawing.
    title, caption : str
        The text below it.
    """

    name: str
    figure: "Figure"
    title: str
    caption: str


class HeadingDescription(TypedDict, total=False):
    """A column of a table in a file of words; see `Words`."""

    text: str
    number: str
    unit: str
    cell: str
    when: str


class TableDescription(TypedDict, total=False):
    """A table in a file of words; see `Words`."""

    title: str
    caption: str
    columns: Sequence[str | HeadingDescription]
    rows: Sequence[Sequence[str]]


class BlockDescription(TypedDict, total=False):
    """A block in a file of words; see `Words.rendered_blocks`."""

    say: str
    notice: str
    table: str
    figure: str
    highlights: Sequence[tuple[str, str]]
    of: str
    more: str
    when: str


class TextBlock(NamedTuple):
    """A text of a page or of printed output.

    Attributes
    ----------
    text : str
        The text.
    is_notice : bool
        Whether the reader must not overlook it.
    """

    text: str
    is_notice: bool


class TableBlock(NamedTuple):
    """A table of a page or of printed output, with its name in the file of words."""

    name: str
    table: Table


class FigureBlock(NamedTuple):
    """A figure of a page, by its name among the figures."""

    name: str


class HighlightsBlock(NamedTuple):
    """Pairs of a value and its meaning, of a page."""

    pairs: Sequence[tuple[str, str]]


RenderedBlock = TextBlock | TableBlock | FigureBlock | HighlightsBlock
"""A block of a page or of printed output, filled with values."""


class Words:
    """The words of a page, from a TOML file; each is a Jinja2 template that is filled with values.

    ``[said]`` holds sentences by name, ``[figures]`` titles and captions, ``[tables]`` titles,
    captions and columns. A column is a heading, or a table with the keys

    - `text` or `number`: the heading of a column of text or of numbers; `unit`: its unit;
    - `cell`: the template of its cells, with the values `row` and `row_number`, for tables whose
      rows are records and not cells;
    - `when`: the name of a value; the column is left out where that is false.

    `rows` of a table are templates of further rows, before the others; such a row is left out where
    all its cells but the first are empty. ``[[page]]`` holds the sections of a page, each with a
    `title`, `blocks` (see `rendered_blocks`) and perhaps an expression `when`.

    Parameters
    ----------
    package : str
        The package of the file, such as ``twin_master.report``.
    name : str
        The name of the file.
    **shared : object
        Values that every template may use, such as functions that format numbers.
    """

    def __init__(self, package: str, name: str = "words.toml", **shared: object) -> None:
        self._shared = shared
        file = resources.files(package).joinpath(name)
        self.content = tomllib.loads(file.read_text(encoding="utf-8"))

    def say(self, name: str, /, **values: object) -> str:
        """Return a sentence of the table ``[said]``."""
        return fill_template(self.content["said"][name], **self._shared | values)

    def table(
        self,
        name: str,
        rows: Iterable[object],
        /,
        *,
        more: Iterable[PageColumn | str] = (),
        **values: object,
    ) -> tuple[list[PageColumn], list[Sequence[str]]]:
        """Return the columns of a table and the cells of its rows.

        Parameters
        ----------
        name : str
            The name of the table.
        rows : iterable
            The cells of each row, or records from which the file makes cells.
        more : iterable of PageColumn or str
            Further columns; a text is the heading of a column of numbers.
        **values : object
            The values of the templates.
        """
        description: TableDescription = self.content["tables"][name]
        shown_headings = _shown_headings(description["columns"], values)
        columns = [_column_of_heading(heading, values) for heading in shown_headings]
        for extra in more:
            columns.append(extra if isinstance(extra, PageColumn) else number_column(extra))
        all_values = values | self._shared
        cells: list[Sequence[str]] = []
        for template_row in description.get("rows", ()):
            filled_row = [fill_template(cell, **all_values) for cell in template_row]
            if any(filled_row[1:]):
                cells.append(filled_row)
        if shown_headings and "cell" in shown_headings[0]:  # a table may have no columns but `more`
            cells += _cells_of_records(shown_headings, rows, all_values)
        else:
            cells += [_cells_of_row(row) for row in rows]
        if cells:
            columns = columns[: len(cells[0])]
        return columns, cells

    def words(self, kind: str, name: str, /, **values: object) -> dict[str, str]:
        """Return the title and the caption of one of the `figures` or `tables`."""
        description: TableDescription = self.content[kind][name]
        all_values = self._shared | values
        return {
            "title": fill_template(description["title"], **all_values),
            "caption": fill_template(description["caption"], **all_values),
        }

    def figure(self, name: str, figure: "Figure", /, **values: object) -> ReportFigure:
        """Return a figure with its title and caption."""
        return ReportFigure(name, figure, **self.words("figures", name, **values))

    def rendered_blocks(
        self, blocks: Iterable[BlockDescription], /, **values: object
    ) -> Iterator[RenderedBlock]:
        """Yield blocks filled with values; blocks without content are left out.

        A block is a table with one of the keys

        - `say`, `notice`: a text. With `of`, an expression, it is repeated for each of its entries,
          the `row`;
        - `table`: the name of a table of this file, with the rows `of` and the columns `more`;
        - `figure`: the name of one of the value `figures`;
        - `highlights`: pairs of a value and its meaning;

        and perhaps `when`, an expression: the block is left out where that is false.
        """
        values = self._shared | values
        for block in blocks:
            if not evaluated(block.get("when", "true"), **values):
                continue
            if "table" in block:
                yield from self._table_block(block, values)
            elif "figure" in block:
                figures = values["figures"]
                if isinstance(figures, Mapping) and block["figure"] in figures:
                    yield FigureBlock(block["figure"])
            elif "highlights" in block:
                yield HighlightsBlock(_highlights(block["highlights"], values))
            else:
                yield from _text_blocks(block, values)

    def _table_block(
        self, block: BlockDescription, values: Mapping[str, object]
    ) -> Iterator[TableBlock]:
        """Yield a table of the file as a block, unless it has no rows."""
        name = block["table"]
        rows: Iterable[object] = evaluated_entries(block["of"], **values) if "of" in block else ()
        more = evaluated_entries(block.get("more", "[]"), **values)
        columns, cells = self.table(
            name, rows, **values, more=[_further_column(column) for column in more]
        )
        if cells:
            yield TableBlock(name, Table(columns, cells))

    def fill(
        self,
        page: "Page",
        drawings: Mapping[str, bytes],
        /,
        *,
        figures: Mapping[str, ReportFigure],
        **values: object,
    ) -> None:
        """Add the sections of the file to a page.

        Parameters
        ----------
        page : Page
            The page.
        drawings : mapping of str to bytes
            The SVG of each figure.
        figures : mapping of str to ReportFigure
            The figures by name, also a value of the templates.
        **values : object
            The values of the templates.
        """
        all_values = {**values, "figures": figures}
        for section in self.content["page"]:
            if not evaluated(section.get("when", "true"), **all_values):
                continue
            page.add_section(fill_template(section["title"], **all_values))
            for block in self.rendered_blocks(section["blocks"], **all_values):
                if isinstance(block, FigureBlock):
                    figure = figures[block.name]
                    page.add_figure(drawings[block.name], figure.caption, title=figure.title)
                elif isinstance(block, TableBlock):
                    page.add_table(block.table, **self.words("tables", block.name, **all_values))
                elif isinstance(block, HighlightsBlock):
                    page.add_highlights(block.pairs)
                elif block.is_notice:
                    page.add_notice(in_one_line(block.text))
                else:
                    page.add_paragraph(in_one_line(block.text))

    def add_table(
        self,
        page: "Page",
        name: str,
        rows: Iterable[object] = (),
        /,
        *,
        more: Iterable[PageColumn | str] = (),
        **values: object,
    ) -> None:
        """Add a table with its title and caption to a page, unless it has no rows; see `table`."""
        columns, cells = self.table(name, rows, more=more, **values)
        if cells:
            page.add_table(Table(columns, cells), **self.words("tables", name, **values))


def _cells_of_row(row: object) -> Sequence[str]:
    """Return the cells of a row that is given as cells."""
    if not isinstance(row, tuple | list):
        raise TypeError(f"a row of a table must be a sequence of cells, not {row!r}.")
    return row


def _further_column(column: object) -> PageColumn | str:
    """Return a further column of a table, as the file of words states it."""
    return column if isinstance(column, PageColumn) else str(column)


def _shown_headings(
    headings: Iterable[str | HeadingDescription], values: Mapping[str, object]
) -> list[HeadingDescription]:
    """Return the headings of a table that are shown, as tables of TOML.

    A heading with the key `when` is left out if the value of that name is false.
    """
    shown_headings: list[HeadingDescription] = []
    for heading in headings:
        if isinstance(heading, str):
            heading = {"text": heading}
        if "when" not in heading or values.get(heading["when"], True):
            shown_headings.append(heading)
    return shown_headings


def _column_of_heading(heading: HeadingDescription, values: Mapping[str, object]) -> PageColumn:
    """Return the column that a heading describes, with its name filled in."""
    name = fill_template(heading.get("text") or heading["number"], **values)
    return PageColumn(name, heading.get("unit", ""), numeric="number" in heading)


def _cells_of_records(
    headings: Sequence[HeadingDescription], records: Iterable[object], values: Mapping[str, object]
) -> list[list[str]]:
    """Return the cells of a table, one row for each record, from the templates of its headings."""
    rows = []
    for number, record in enumerate(records, start=1):
        row_values = {**values, "row": record, "row_number": number}
        rows.append([fill_template(heading["cell"], **row_values) for heading in headings])
    return rows


def _highlights(
    pairs: Iterable[tuple[str, str]], values: Mapping[str, object]
) -> list[tuple[str, str]]:
    """Return pairs of a value and its meaning; pairs whose value is empty are left out."""
    highlights = []
    for value_template, meaning_template in pairs:
        value = fill_template(value_template, **values)
        if value:
            highlights.append((value, fill_template(meaning_template, **values)))
    return highlights


def _text_blocks(block: BlockDescription, values: Mapping[str, object]) -> Iterator[TextBlock]:
    """Yield the text of a block once, or once for each entry of its expression `of`."""
    is_notice = "notice" in block
    template = block["notice"] if "notice" in block else block["say"]
    rows: Iterable[object] = [None]
    if "of" in block and evaluated(block["of"], **values) is not None:
        rows = evaluated_entries(block["of"], **values)
    for row in rows:
        text = rendered(template, **{**values, "row": row})
        if text.strip():
            yield TextBlock(text, is_notice)


class _PageBlock(NamedTuple):
    """A block of a page, as `page.html` takes it."""

    kind: str
    content: dict[str, object]


class Page:
    """Builds one page from top to bottom.

    Parameters
    ----------
    title : str
        The title of the page and of the browser's window.
    subtitle : str
        One line below it.
    footer : sequence of str
        The lines at the end, such as the sources cited.
    """

    def __init__(self, title: str, subtitle: str = "", footer: Sequence[str] = ()) -> None:
        self._head = {"title": title, "subtitle": subtitle, "footer": footer}
        self._blocks: list[_PageBlock] = []

    def _add(self, kind: str, **content: object) -> None:
        """Append a block of a kind with its content."""
        self._blocks.append(_PageBlock(kind, content))

    def _next_number(self, kind: str) -> int:
        """Return the number of the next block of a kind; the first is 1."""
        return 1 + sum(block.kind == kind for block in self._blocks)

    def add_section(self, title: str) -> None:
        """Begin a section; it appears in the contents."""
        self._add("section", title=title, number=self._next_number("section"))

    def add_paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._add("paragraph", text=text)

    def add_notice(self, text: str) -> None:
        """Add a paragraph that the reader must not overlook."""
        self._add("notice", text=text)

    def add_highlights(self, items: Sequence[tuple[str, str]]) -> None:
        """Add a row of a few values in large print, each with its meaning."""
        self._add("highlights", items=items)

    def add_figure(self, svg: bytes, caption: str, *, title: str) -> int:
        """Add a numbered figure, and return its number.

        Parameters
        ----------
        svg : bytes
            The drawing, from `reporting.figures.to_svg`.
        caption : str
            What is seen, with units and source.
        title : str
            A few words in bold before the caption, which also describe the drawing to readers who
            cannot see it.

        Raises
        ------
        InvalidFigureError
            If `svg` is not an SVG that can be scaled.
        """
        from reporting.figures import inline_svg

        number = self._next_number("figure")
        drawing = Markup(inline_svg(svg, prefix=f"f{number}", description=title))
        self._add("figure", number=number, drawing=drawing, title=title, caption=caption)
        return number

    def add_report_figure(self, figure: ReportFigure) -> int:
        """Add a figure with its title and caption, and return its number."""
        from reporting.figures import to_svg

        return self.add_figure(to_svg(figure.figure), figure.caption, title=figure.title)

    def add_table(self, table: Table, caption: str, *, title: str) -> int:
        """Add a numbered table, and return its number."""
        number = self._next_number("table")
        self._add("table", number=number, table=table, title=title, caption=caption)
        return number

    def render(self) -> str:
        """Return the page as one string of HTML."""
        has_values_in_figures = any(
            " data-axes=" in str(block.content["drawing"])
            for block in self._blocks
            if block.kind == "figure"
        )
        template = html_environment().from_string(_read_resource("page.html"))
        return template.render(
            **self._head,
            blocks=self._blocks,
            style=Markup(_read_resource("page.css")),
            script=Markup(_read_resource("hover.js")) if has_values_in_figures else "",
        )


@cache
def script_source() -> str:
    """Return the source that allows the script of pages in a Content-Security-Policy."""
    digest = sha256(_read_resource("hover.js").encode()).digest()
    return f"'sha256-{b64encode(digest).decode()}'"


@cache
def _read_resource(name: str) -> str:
    return resources.files("reporting").joinpath(name).read_text(encoding="utf-8")
