"""A self-contained HTML page: sections, numbered figures and tables, one style sheet, nothing from outside.

No request to any server; light, and fit to be printed. One short script shows the values under the
pointer in figures; the page is whole without it. All text is escaped. `page.html` is its form; the words of a
page stand in a TOML file of its own, see `Words`.
"""

import re
import tomllib
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup, escape

from reporting import words
from reporting.errors import InvalidFigureError
from reporting.sentences import said

if TYPE_CHECKING:  # words are said where nothing is drawn, too
    from matplotlib.figure import Figure

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
            if (came := len(row)) != (needed := len(self.columns)):
                raise InvalidFigureError(said("page.row", number=number, came=came, needed=needed))


class ReportFigure(NamedTuple):
    """A figure with its words.

    Attributes
    ----------
    name
        Name of its file, without ending.
    figure
        The drawing.
    title, caption
        Below it.
    """

    name: str
    figure: "Figure"
    title: str
    caption: str


class Words:
    """The words of a page, from a TOML file; each is a Jinja2 template that is filled with values.

    Parameters
    ----------
    package
        Where the file is, such as ``twin_master.report``.
    name
        Of the file: ``[said]`` holds sentences by name, ``[figures]`` titles and captions, and ``[tables]``
        titles, captions and columns, each a heading, or ``{ number = heading, unit = unit }``. `cell` says
        what a column shows of each `row` and its `row_number`, where rows are records and no ready cells; a
        column with `when` is left out where the value of that name is false. `rows` are rows of templates
        before those that are given, each left out where it has nothing behind its first cell. `[[page]]`
        are sections, each a `title` and the `blocks` of `told`; `when` as there.
    **shared
        What every template may name beside its own values, such as functions that print numbers.
    """

    def __init__(self, package: str, name: str = "words.toml", **shared: Any) -> None:
        self._shared = shared
        self.content = tomllib.loads(resources.files(package).joinpath(name).read_text(encoding="utf-8"))

    def say(self, name: str, /, **values: Any) -> str:
        """Return a sentence of the table ``[said]``."""
        return filled(self.content["said"][name], **self._shared | values)

    def table(self, name: str, rows: Sequence[Any], /, **values: Any) -> tuple[list[Column], list[Any]]:
        """Return the columns of a table, and the cells of its rows; `more` are further columns."""
        heads = self.content["tables"][name]["columns"]
        heads = [{"text": head} if isinstance(head, str) else head for head in heads]
        heads = [head for head in heads if values.get(head.get("when", ""), True)]
        columns = [
            Column(
                filled(head.get("text") or head["number"], **values), head.get("unit", ""), "number" in head
            )
            for head in heads
        ]
        columns += [head if isinstance(head, Column) else numbers(head) for head in values.get("more", ())]
        values |= self._shared
        if heads and "cell" in heads[0]:  # a table may have no columns but `more`
            rows = [
                [filled(head["cell"], **values, row=row, row_number=number) for head in heads]
                for number, row in enumerate(rows, start=1)
            ]
        fixed = [
            [filled(cell, **values) for cell in row] for row in self.content["tables"][name].get("rows", ())
        ]
        rows = [*(row for row in fixed if any(row[1:])), *rows]
        return columns[: len(rows[0])] if rows else columns, rows

    def words(self, kind: str, name: str, /, **values: Any) -> dict[str, str]:
        """Return title and caption of one of the `figures` or `tables`."""
        told = self.content[kind][name]
        return {part: filled(told[part], **self._shared | values) for part in ("title", "caption")}

    def figure(self, name: str, figure: Any, /, **values: Any) -> ReportFigure:
        """Return a figure with its words."""
        return ReportFigure(name, figure, **self.words("figures", name, **values))

    def told(self, blocks: Iterable[Mapping[str, Any]], /, **values: Any) -> Iterator[tuple[str, Any]]:
        """Return what blocks say, each with its kind.

        A `say` or `notice` is a text, left out where it is empty; `of` is an expression of the values, for
        each of whose items, the `row`, it is said. A `table` is a table of this file with the rows `of`, left
        out where it has none, and `more` columns. A `figure` is one of the value `figures`, if it is there.
        `highlights` are pairs of a value and what it is, those with a value. Without its `when` nothing is
        said.
        """
        values = self._shared | values
        for block in blocks:
            if not evaluated(block.get("when", "true"), **values):
                continue
            rows = evaluated(block["of"], **values) if "of" in block else None
            if "table" in block:
                own = values | {"more": evaluated(block.get("more", "[]"), **values)}
                columns, cells = self.table(block["table"], rows or (), **own)
                if cells:
                    yield "table", (block["table"], Table(columns, cells))
            elif "figure" in block:
                if block["figure"] in values["figures"]:
                    yield "figure", block["figure"]
            elif "highlights" in block:
                pairs = ((filled(value, **values), what) for value, what in block["highlights"])
                yield "highlights", [(value, filled(what, **values)) for value, what in pairs if value]
            else:
                kind = "notice" if "notice" in block else "say"
                for row in (None,) if rows is None else rows:
                    if (text := rendered(block[kind], **values, row=row)).strip():
                        yield kind, text

    def fill(self, page: "Page", drawings: Mapping[str, bytes], /, **values: Any) -> None:
        """Add the sections of the file to a page; `drawings` are the `figures` as SVG."""
        adding: dict[str, Callable[[Any], None]] = {
            "say": page.add_paragraph, "notice": page.add_notice, "highlights": page.add_highlights,
        }  # fmt: skip
        for section in self.content["page"]:
            if not evaluated(section.get("when", "true"), **values):
                continue
            page.add_section(filled(section["title"], **values))
            for kind, what in self.told(section["blocks"], **values):
                if kind == "figure":
                    item = values["figures"][what]
                    page.add_figure(drawings[what], item.caption, title=item.title)
                elif kind == "table":
                    page.add_table(what[1], **self.words("tables", what[0], **values))
                else:
                    adding[kind](" ".join(what.split()) if isinstance(what, str) else what)

    def add_table(self, page: "Page", name: str, rows: Sequence[Any] = (), /, **values: Any) -> None:
        """Add a table with its words to a page, if it has rows; `more` are further columns."""
        columns, cells = self.table(name, rows, **values)
        if cells:
            page.add_table(Table(columns, cells), **self.words("tables", name, **values))


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
        self._head = {"title": title, "subtitle": subtitle, "footer": footer}
        self._blocks: list[tuple[str, dict[str, Any]]] = []

    def _add(self, kind: str, **content: Any) -> int:
        self._blocks.append((kind, content))
        return self._count(kind)

    def _count(self, kind: str) -> int:
        return sum(other == kind for other, _ in self._blocks)

    def add_section(self, title: str) -> None:
        """Begin a section; it appears in the contents."""
        self._add("section", title=title, number=self._count("section") + 1)

    def add_paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._add("paragraph", text=text)

    def add_notice(self, text: str) -> None:
        """Add a paragraph that the reader must not overlook."""
        self._add("notice", text=text)

    def add_highlights(self, items: Sequence[tuple[str, str]]) -> None:
        """Add a row of few figures in large print: (value with unit, what it is)."""
        self._add("highlights", items=items)

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
        from reporting.figures import inline_svg

        number = self._count("figure") + 1
        drawing = Markup(inline_svg(svg, prefix=f"f{number}", description=title))
        return self._add("figure", number=number, drawing=drawing, title=title, caption=caption)

    def add_report_figure(self, figure: ReportFigure) -> int:
        """Add a figure that has its words; return its number."""
        from reporting.figures import to_svg

        return self.add_figure(to_svg(figure.figure), figure.caption, title=figure.title)

    def add_table(self, table: Table, caption: str, *, title: str) -> int:
        """Add a numbered table; return its number."""
        return self._add("table", number=self._count("table") + 1, table=table, title=title, caption=caption)

    def render(self) -> str:
        """Return the page as one string of HTML."""
        drawn = any(" data-axes=" in content["drawing"] for kind, content in self._blocks if kind == "figure")
        return _environment().from_string(_own("page.html")).render(
            **self._head, blocks=self._blocks, style=Markup(_own("page.css")),
            script=Markup(_own("hover.js")) if drawn else "",
        )  # fmt: skip


def filled(template: str, /, **values: Any) -> str:
    """Return a text whose Jinja2 expressions are filled with values, in one line."""
    return " ".join(rendered(template, **values).split())


def rendered(template: str, /, **values: Any) -> str:
    """Return a text whose Jinja2 expressions are filled with values, as it is written."""
    return _plain(template).render(**values)


def evaluated(expression: str, /, **values: Any) -> Any:
    """Return what a Jinja2 expression gives; what is not there is None."""
    return _environment(plain=True).compile_expression(expression)(**values)


@cache
def _plain(template: str) -> Template:
    return _environment(plain=True).from_string(template)


@cache
def _environment(plain: bool = False) -> Environment:
    made = Environment(
        autoescape=not plain, undefined=StrictUndefined, trim_blocks=not plain, lstrip_blocks=not plain
    )
    made.filters["spaced"] = lambda text: Markup(_UNIT_SPACE.sub("\u00a0", str(escape(text))))
    shared: tuple[Callable[..., str], ...] = (words.listing, words.counted, words.number, words.capital)
    made.filters |= {function.__name__: function for function in shared}
    made.globals |= {"plus_minus": words.plus_minus, "between": words.between}
    return made


@cache
def script_source() -> str:
    """Return the source by which a Content-Security-Policy allows the script of pages."""
    return f"'sha256-{b64encode(sha256(_own('hover.js').encode()).digest()).decode()}'"


@cache
def _own(name: str) -> str:
    return resources.files("reporting").joinpath(name).read_text(encoding="utf-8")
