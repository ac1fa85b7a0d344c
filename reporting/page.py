"""A self-contained HTML page: sections, numbered figures and tables, one style sheet.

A page makes no request to any server, is light, and prints well. One short script shows the values
under the pointer in figures; the page is complete without it. All text is escaped. `page.html` is
the template of a page; the words of a page stand in a TOML file of its own, see `Words`.
"""

import tomllib
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple

from markupsafe import Markup

from reporting.errors import InvalidFigureError
from reporting.templates import fill_template, html_environment

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
        cells_needed = len(self.columns)
        for number, row in enumerate(self.rows):
            if len(row) != cells_needed:
                raise InvalidFigureError(
                    f"Row {number} of a table has {len(row)} cells; {cells_needed} are needed."
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


class Words:
    """The words of a page, from a TOML file: texts with plain fields, such as ``{{ step }}``.

    ``[said]`` holds sentences by name, ``[figures]`` titles and captions, ``[tables]`` titles,
    captions and, where a table always has the same, columns. A column is a heading of text, or a
    table with the heading of `number` and its `unit`.

    Parameters
    ----------
    package : str
        The package of the file, such as ``twin_master.report``.
    name : str
        The name of the file.
    """

    def __init__(self, package: str, name: str = "words.toml") -> None:
        file = resources.files(package).joinpath(name)
        self.content = tomllib.loads(file.read_text(encoding="utf-8"))

    def say(self, name: str, /, **fields: object) -> str:
        """Return a sentence of the table ``[said]``."""
        return fill_template(self.content["said"][name], **fields)

    def words(self, kind: str, name: str, /, **fields: object) -> dict[str, str]:
        """Return the title and the caption of one of the `figures` or `tables`."""
        texts = self.content[kind][name]
        return {key: fill_template(texts[key], **fields) for key in ("title", "caption")}

    def figure(self, name: str, figure: "Figure", /, **fields: object) -> ReportFigure:
        """Return a figure with its title and caption."""
        return ReportFigure(name, figure, **self.words("figures", name, **fields))

    def add_table(
        self,
        page: "Page",
        name: str,
        rows: Sequence[Sequence[str]],
        /,
        more: Sequence[PageColumn] = (),
        **fields: object,
    ) -> None:
        """Add a table with its title and caption to a page, unless it has no rows.

        Parameters
        ----------
        page : Page
            The page to which content is added.
        name : str
            The name of the table in the file.
        rows : sequence of sequence of str
            The cells of each row.
        more : sequence of PageColumn
            The columns after those of the file.
        **fields : object
            The fields of title, caption and headings.
        """
        if rows:
            headings = self.content["tables"][name]["columns"]
            columns = [_column_of_heading(heading, fields) for heading in headings]
            page.add_table(Table([*columns, *more], rows), **self.words("tables", name, **fields))


def _column_of_heading(heading: str | dict[str, str], fields: Mapping[str, object]) -> PageColumn:
    """Return the column that a heading in the file of texts describes, with fields filled in."""
    if isinstance(heading, str):
        return PageColumn(fill_template(heading, **fields))
    return number_column(fill_template(heading["number"], **fields), heading.get("unit", ""))


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
        """Append a block of content to the page."""
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
