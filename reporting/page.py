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
from typing import TYPE_CHECKING, Any, NamedTuple

from markupsafe import Markup

from reporting.errors import InvalidFigureError
from reporting.templates import (
    evaluated,
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


class RenderedBlock(NamedTuple):
    """A block of a page or of printed output, filled with values.

    Attributes
    ----------
    kind : {"say", "card", "notice", "table", "figure", "highlights", "fold", "end of fold"}
        What the block is.
    content : object
        A text (say, card, notice, and the title of a fold), the name of a table and the `Table`,
        the name of a figure, or pairs of a value and its meaning (highlights).
    """

    kind: str
    content: Any


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
        self._shared: dict[str, Any] = shared
        file = resources.files(package).joinpath(name)
        self.content = tomllib.loads(file.read_text(encoding="utf-8"))

    def say(self, name: str, /, **values: object) -> str:
        """Return a sentence of the table ``[said]``."""
        return fill_template(self.content["said"][name], **self._shared | values)

    def table(
        self, name: str, rows: Sequence[Any], /, **values: Any
    ) -> tuple[list[PageColumn], list[Any]]:
        """Return the columns of a table and the cells of its rows.

        Parameters
        ----------
        name : str
            The name of the table.
        rows : sequence
            The cells of each row, or records from which the file makes cells.
        **values : object
            The values of the templates; `more` are further columns.
        """
        description = self.content["tables"][name]
        shown_headings = _shown_headings(description["columns"], values)
        columns = [_column_of_heading(heading, values) for heading in shown_headings]
        for extra in values.get("more", ()):
            columns.append(extra if isinstance(extra, PageColumn) else number_column(extra))
        all_values = values | self._shared
        cells: list[Any] = []
        for template_row in description.get("rows", ()):
            filled_row = [fill_template(cell, **all_values) for cell in template_row]
            if any(filled_row[1:]):
                cells.append(filled_row)
        if shown_headings and "cell" in shown_headings[0]:  # a table may have no columns but `more`
            cells += _cells_of_records(shown_headings, rows, all_values)
        else:
            cells += rows
        if cells:
            columns = columns[: len(cells[0])]
        return columns, cells

    def words(self, kind: str, name: str, /, **values: object) -> dict[str, str]:
        """Return the title and the caption of one of the `figures` or `tables`."""
        description = self.content[kind][name]
        all_values = self._shared | values
        return {key: fill_template(description[key], **all_values) for key in ("title", "caption")}

    def figure(self, name: str, figure: Any, /, **values: object) -> ReportFigure:
        """Return a figure with its title and caption."""
        return ReportFigure(name, figure, **self.words("figures", name, **values))

    def rendered_blocks(
        self, blocks: Iterable[Mapping[str, Any]], /, **values: Any
    ) -> Iterator[RenderedBlock]:
        """Yield blocks filled with values; blocks without content are left out.

        A block is a table with one of the keys

        - `say`, `notice`: a text. With `of`, an expression, it is repeated for each of its entries,
          the `row`;
        - `table`: the name of a table of this file, with the rows `of` and the columns `more`;
        - `figure`: the name of one of the value `figures`;
        - `card`: the one sentence that a reader must know;
        - `fold`: the title of `blocks` that are shown on demand;
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
                if block["figure"] in values["figures"]:
                    yield RenderedBlock("figure", block["figure"])
            elif "highlights" in block:
                yield RenderedBlock("highlights", _highlights(block["highlights"], values))
            elif "fold" in block:
                inner_blocks = list(self.rendered_blocks(block["blocks"], **values))
                if inner_blocks:
                    yield RenderedBlock("fold", fill_template(block["fold"], **values))
                    yield from inner_blocks
                    yield RenderedBlock("end of fold", "")
            else:
                yield from _text_blocks(block, values)

    def _table_block(
        self, block: Mapping[str, Any], values: Mapping[str, Any]
    ) -> Iterator[RenderedBlock]:
        """Yield a table of the file as a block, unless it has no rows."""
        name = block["table"]
        rows = evaluated(block["of"], **values) if "of" in block else None
        more = evaluated(block.get("more", "[]"), **values)
        columns, cells = self.table(name, rows or (), **{**values, "more": more})
        if cells:
            yield RenderedBlock("table", (name, Table(columns, cells)))

    def fill(self, page: "Page", drawings: Mapping[str, bytes], /, **values: Any) -> None:
        """Add the sections of the file to a page.

        Parameters
        ----------
        page : Page
            The page.
        drawings : mapping of str to bytes
            The SVG of each of the value `figures`.
        **values : object
            The values of the templates.
        """
        for section in self.content["page"]:
            if not evaluated(section.get("when", "true"), **values):
                continue
            page.add_section(fill_template(section["title"], **values))
            for kind, content in self.rendered_blocks(section["blocks"], **values):
                if kind == "figure":
                    figure = values["figures"][content]
                    page.add_figure(drawings[content], figure.caption, title=figure.title)
                elif kind == "table":
                    name, table = content
                    page.add_table(table, **self.words("tables", name, **values))
                elif kind == "highlights":
                    page.add_highlights(content)
                elif kind == "notice":
                    page.add_notice(in_one_line(content))
                elif kind == "card":
                    page.add_card(in_one_line(content))
                elif kind == "fold":
                    page.begin_fold(content)
                elif kind == "end of fold":
                    page.end_fold()
                else:
                    page.add_paragraph(in_one_line(content))

    def add_table(
        self, page: "Page", name: str, rows: Sequence[Any] = (), /, **values: Any
    ) -> None:
        """Add a table with its title and caption to a page, unless it has no rows; see `table`."""
        columns, cells = self.table(name, rows, **values)
        if cells:
            page.add_table(Table(columns, cells), **self.words("tables", name, **values))


def _shown_headings(
    headings: Iterable[str | dict[str, Any]], values: Mapping[str, object]
) -> list[dict[str, Any]]:
    """Return the headings of a table that are shown, as tables of TOML.

    A heading with the key `when` is left out if the value of that name is false.
    """
    shown_headings = []
    for heading in headings:
        if isinstance(heading, str):
            heading = {"text": heading}
        if "when" not in heading or values.get(heading["when"], True):
            shown_headings.append(heading)
    return shown_headings


def _column_of_heading(heading: dict[str, Any], values: Mapping[str, object]) -> PageColumn:
    """Return the column that a heading describes, with its name filled in."""
    name = fill_template(heading.get("text") or heading["number"], **values)
    return PageColumn(name, heading.get("unit", ""), numeric="number" in heading)


def _cells_of_records(
    headings: Sequence[dict[str, Any]], records: Sequence[Any], values: Mapping[str, object]
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


def _text_blocks(block: Mapping[str, Any], values: Mapping[str, object]) -> Iterator[RenderedBlock]:
    """Yield the text of a block once, or once for each entry of its expression `of`."""
    kind = next(kind for kind in ("notice", "card", "say") if kind in block)
    rows = evaluated(block["of"], **values) if "of" in block else [None]
    if rows is None:
        rows = [None]
    for row in rows:
        text = rendered(block[kind], **{**values, "row": row})
        if text.strip():
            yield RenderedBlock(kind, text)


class _PageBlock(NamedTuple):
    """A block of a page, as `page.html` takes it."""

    kind: str
    content: dict[str, Any]


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

    def _add(self, kind: str, **content: Any) -> None:
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

    def add_card(self, text: str) -> None:
        """Add the one sentence of the page that a reader must know, in large print."""
        self._add("card", text=text)

    def begin_fold(self, title: str) -> None:
        """Begin a part that the reader unfolds on demand; `end_fold` ends it."""
        self._add("fold", title=title)

    def end_fold(self) -> None:
        """End the part that `begin_fold` has begun."""
        self._add("end of fold")

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
        drawing = inline_svg(svg, prefix=f"f{number}", description=title)
        self._add(
            "figure",
            number=number,
            drawing=Markup(drawing.full),
            tiles=[Markup(tile) for tile in drawing.tiles],
            is_wide=drawing.is_wide,
            title=title,
            caption=caption,
        )
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
            " data-axes=" in block.content["drawing"]
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
