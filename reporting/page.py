"""A self-contained HTML page: sections, numbered figures and tables, one style sheet, nothing from outside.

No request to any server; light, and fit to be printed. One short script shows the values under the
pointer in figures; the page is whole without it. All text is escaped.
"""

import html
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib import resources

from reporting.errors import InvalidFigureError
from reporting.figures import inline_svg

_UNIT_SPACE = re.compile(r"(?<=\d) (?=(%|µε|s|ms|µs|Hz|mm|m|kg|N)(?!\w))")


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes
    ----------
    name
        Heading.
    unit
        Unit, shown below the heading; empty for text and for plain counts.
    numeric
        Align to the right, in figures of equal width.
    """

    name: str
    unit: str = ""
    numeric: bool = False


def columns(*heads: Column | str) -> tuple[Column, ...]:
    """Return columns; a plain heading is one of text."""
    return tuple(Column(head) if isinstance(head, str) else head for head in heads)


def numbers(name: str, unit: str = "") -> Column:
    """Return a column of numbers."""
    return Column(name, unit, numeric=True)


@dataclass(frozen=True)
class Table:
    """A table of ready text; numbers are formatted by whoever knows what their digits mean.

    Attributes
    ----------
    columns
        Headings and units.
    rows
        One sequence of cells a row, as many as there are columns.

    Raises
    ------
    InvalidFigureError
        A row does not have one cell for each column.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise InvalidFigureError(
                    f"Row {number} of a table has {len(row)} cells; {len(self.columns)} are needed."
                )


class Page:
    """Builds one page from top to bottom.

    Parameters
    ----------
    title
        Title of the page and of the browser's window.
    subtitle
        One line below it.
    footer
        Lines at the end, such as the sources cited.
    """

    def __init__(self, title: str, subtitle: str = "", footer: Sequence[str] = ()) -> None:
        self._title = title
        self._subtitle = subtitle
        self._footer = tuple(footer)
        self._body: list[str] = []
        self._sections: list[str] = []
        self._figure_count = 0
        self._table_count = 0

    def add_section(self, title: str) -> None:
        """Begin a section; it appears in the contents."""
        if self._sections:
            self._body.append("</section>")
        self._sections.append(title)
        number = len(self._sections)
        self._body.append(f'<section id="section-{number}"><h2>{_text(title)}</h2>')

    def add_paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._body.append(f"<p>{_text(text)}</p>")

    def add_notice(self, text: str) -> None:
        """Add a paragraph that the reader must not overlook."""
        self._body.append(f'<p class="notice">{_text(text)}</p>')

    def add_highlights(self, items: Sequence[tuple[str, str]]) -> None:
        """Add a row of few figures in large print: (value with unit, what it is)."""
        cells = "".join(
            f"<div><strong>{_text(value)}</strong><span>{_text(meaning)}</span></div>"
            for value, meaning in items
        )
        self._body.append(f'<div class="highlights">{cells}</div>')

    def add_figure(self, svg: bytes, caption: str, *, title: str) -> int:
        """Add a numbered figure; return its number.

        Parameters
        ----------
        svg
            The drawing, from `reporting.figures.to_svg`.
        caption
            What is seen, with units and source.
        title
            A few words in bold before the caption, also the description for those who cannot see the drawing.

        Raises
        ------
        InvalidFigureError
            `svg` is not an SVG that can be scaled.
        """
        self._figure_count += 1
        number = self._figure_count
        drawing = inline_svg(svg, prefix=f"f{number}", description=title)
        self._body.append(
            f'<figure id="figure-{number}">{drawing}<figcaption><b>Figure {number}. '
            f"{_text(title)}.</b> {_text(caption)}</figcaption></figure>"
        )
        return number

    def add_table(self, table: Table, caption: str, *, title: str) -> int:
        """Add a numbered table; return its number."""
        self._table_count += 1
        number = self._table_count
        heads = "".join(
            f"<th{_alignment(column)}>{_text(column.name)}"
            + (f"<small>{_text(column.unit)}</small>" if column.unit else "")
            + "</th>"
            for column in table.columns
        )
        rows = "".join(
            "<tr>"
            + "".join(
                f"<td{_alignment(column)}>{_text(cell)}</td>"
                for column, cell in zip(table.columns, row, strict=True)
            )
            + "</tr>"
            for row in table.rows
        )
        self._body.append(
            f'<div class="table" id="table-{number}"><p class="caption"><b>Table {number}. '
            f"{_text(title)}.</b> {_text(caption)}</p>"
            f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
        )
        return number

    def render(self) -> str:
        """Return the page as one string of HTML."""
        contents = "".join(
            f'<li><a href="#section-{number}">{_text(title)}</a></li>'
            for number, title in enumerate(self._sections, start=1)
        )
        navigation = f"<nav><ol>{contents}</ol></nav>" if len(self._sections) > 1 else ""
        subtitle = f'<p class="subtitle">{_text(self._subtitle)}</p>' if self._subtitle else ""
        footer = "".join(f"<p>{_text(line)}</p>" for line in self._footer)
        body = "\n".join(self._body) + ("</section>" if self._sections else "")
        script = f"<script>{_own('hover.js')}</script>\n" if " data-axes=" in body else ""
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{_text(self._title)}</title>\n<style>\n{_own('page.css')}</style>\n</head>\n<body>\n<main>\n"
            f"<header><h1>{_text(self._title)}</h1>{subtitle}</header>\n{navigation}\n{body}\n"
            f"<footer>{footer}</footer>\n</main>\n{script}</body>\n</html>\n"
        )


def _text(text: str) -> str:
    """Escape text for HTML and keep a figure and its unit on one line."""
    return html.escape(_UNIT_SPACE.sub("\u00a0", text))


def _alignment(column: Column) -> str:
    return ' class="number"' if column.numeric else ""


@cache
def script_source() -> str:
    """Return the source by which a Content-Security-Policy allows the script of pages."""
    return f"'sha256-{b64encode(sha256(_own('hover.js').encode()).digest()).decode()}'"


@cache
def _own(name: str) -> str:
    return resources.files("reporting").joinpath(name).read_text(encoding="utf-8")
