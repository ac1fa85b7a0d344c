"""A page as data, and the one function that renders pages as HTML.

A page makes no request to any server, is light, and prints well. One short script shows the values
under the pointer in figures; the page is complete without it. All text is escaped.
"""

from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple

from markupsafe import Markup

from reporting.pages.inline_svg import InlineDrawing, inline_svg
from reporting.pages.table import Table
from reporting.pages.templates import html_environment

if TYPE_CHECKING:  # text is made without figures, too, and matplotlib takes long to import
    from matplotlib.figure import Figure


class ReportFigure(NamedTuple):
    """A figure that is not rendered yet, with its title and caption.

    Attributes
    ----------
    name : str
        The name of its file, without ending.
    title, caption : str
        The text below it.
    """

    name: str
    figure: "Figure"
    title: str
    caption: str


class PageFigure(NamedTuple):
    """A rendered figure of a page.

    Attributes
    ----------
    name : str
        The name of its file, without ending.
    svg : bytes
        The drawing, from `reporting.pages.figures.to_svg`.
    title : str
        A few words in bold before the caption, which also describe the drawing to readers who
        cannot see it.
    caption : str
        What is seen, with units and source.
    """

    name: str
    svg: bytes
    title: str
    caption: str


class Notice(NamedTuple):
    """A paragraph that the reader must not overlook."""

    text: str


class Highlights(NamedTuple):
    """A row of a few values in large print, each with its meaning: pairs (value, meaning)."""

    items: Sequence[tuple[str, str]]


class Fold(NamedTuple):
    """A part that the reader unfolds on demand; a printed page shows it."""

    title: str
    blocks: "Sequence[Block]"


Block = str | Markup | Notice | Highlights | Fold | PageFigure | Table | None
"""A part of a page. A string is a paragraph; None and whatever is empty are left out.

`Markup` is an element as HTML, which the script of a live page fills.
"""


class Section(NamedTuple):
    """A part of a page with a heading, which appears in the contents; left out without blocks.

    A live page gives the sections that its script finds an identifier.
    """

    title: str
    blocks: Sequence[Block]
    identifier: str = ""


@dataclass(frozen=True)
class Page:
    """A page: its first screen, then sections with tables and further figures.

    Attributes
    ----------
    title, subtitle : str
        The title, also of the browser's window, and one line below it.
    sentence : str or Markup
        What a reader must know, in one or two sentences in large print.
    picture : PageFigure or None
        The picture that shows it.
    outcome : sequence of Block
        Notices, values and sentences that end the first screen.
    sections : sequence of Section
        Everything else.
    footer : sequence of str
        The lines at the end, such as the sources cited.
    scripts, style : sequence of str, str
        The addresses of further scripts and of a further style sheet, for a page that a server
        keeps up to date.
    """

    title: str
    subtitle: str = ""
    sentence: str = ""
    picture: PageFigure | None = None
    outcome: Sequence[Block] = ()
    sections: Sequence[Section] = ()
    footer: Sequence[str] = ()
    scripts: Sequence[str] = ()
    style: str = ""


class _NumberedBlock(NamedTuple):
    """A block as `page.html` takes it.

    Attributes
    ----------
    kind : str
        The name of its class, by which the template chooses the element.
    content : Block
        The block.
    number : int
        Which one of its kind it is on the page, from 1.
    drawing : InlineDrawing or None
        The elements of a figure.
    blocks : sequence of _NumberedBlock
        What a fold contains.
    """

    kind: str
    content: Block
    number: int
    drawing: InlineDrawing | None
    blocks: "Sequence[_NumberedBlock]"


def render_page(page: Page) -> str:
    """Return a page as one string of HTML.

    Figures and tables are numbered in the order of the page.

    Raises
    ------
    InvalidFigureError
        If the drawing of a figure is not an SVG that can be scaled.
    """
    last_numbers: Counter[str] = Counter()
    opening = _number_blocks((page.picture, *page.outcome), last_numbers)
    sections: list[tuple[str, list[_NumberedBlock], str]] = []
    for section in page.sections:
        blocks = _number_blocks(section.blocks, last_numbers)
        if blocks:
            identifier = section.identifier or f"section-{len(sections) + 1}"
            sections.append((section.title, blocks, identifier))
    all_blocks = [*opening, *(block for _, blocks, _ in sections for block in blocks)]
    needs_hover_script = any(_shows_values(block) for block in all_blocks)
    template = html_environment().from_string(_read_resource("page.html"))
    return template.render(
        page=page,
        opening=opening,
        sections=sections,
        style=Markup(_read_resource("page.css")),
        hover_script=Markup(_read_resource("hover.js")) if needs_hover_script else "",
    )


def _number_blocks(blocks: Iterable[Block], last_numbers: Counter[str]) -> list[_NumberedBlock]:
    """Return the blocks that are not empty, each with its number.

    Blocks of each kind (figures, tables, ...) are numbered on their own, those inside a fold too.

    Parameters
    ----------
    blocks : iterable of Block
        Consecutive blocks of the page.
    last_numbers : Counter
        The number of the last block of each kind so far. It is updated, so that the next call goes
        on counting.
    """
    numbered = []
    for block in blocks:
        if _is_empty(block):
            continue
        kind = type(block).__name__
        last_numbers[kind] += 1
        number = last_numbers[kind]
        drawing = None
        if isinstance(block, PageFigure):
            drawing = inline_svg(block.svg, prefix=f"f{number}", description=block.title)
        inner = _number_blocks(block.blocks, last_numbers) if isinstance(block, Fold) else ()
        numbered.append(_NumberedBlock(kind, block, number, drawing, inner))
    return numbered


def _shows_values(block: _NumberedBlock) -> bool:
    """Return whether a block is, or contains, a figure with values for the script of the page."""
    if block.drawing is not None and " data-axes=" in block.drawing.full:
        return True
    return any(_shows_values(inner) for inner in block.blocks)


def _is_empty(block: Block) -> bool:
    """Return whether a block has nothing to show."""
    if isinstance(block, Notice):
        return not block.text.strip()
    if isinstance(block, Highlights):
        return not block.items
    if isinstance(block, Fold):
        return all(_is_empty(inner) for inner in block.blocks)
    if isinstance(block, Table):
        return not block.rows
    if isinstance(block, str):
        return not block.strip()
    return block is None


@cache
def script_source() -> str:
    """Return the source that allows the script of pages in a Content-Security-Policy."""
    digest = sha256(_read_resource("hover.js").encode()).digest()
    return f"'sha256-{b64encode(digest).decode()}'"


@cache
def _read_resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
