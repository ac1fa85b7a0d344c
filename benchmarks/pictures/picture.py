"""A picture of the documentation: drawing, numbers, and the sentences that quote them.

The numbers are kept in the PNG file itself, as a text chunk (PNG specification, 3rd edition,
11.3.3). So a committed picture can be compared with the pages without drawing it.
"""

import io
import json
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"

SIGNATURE = b"\x89PNG\r\n\x1a\n"
KEYWORD = b"Numbers"
"""Of the text chunk that holds the numbers of a picture, as JSON."""

PRINTED_NUMBER = r"[-−]?\d[\d,]*(?:\.\d+)?(?:e[-−+]?\d+)?"
ROUNDING = 0.6
"""Most by which a printed number may differ from the drawn one, in units of its last digit."""

VISIBLE = 0.25
"""Change of a colour channel, from 0 to 1, from which on a pixel counts as changed."""


@dataclass(frozen=True)
class Drawing:
    """A picture as PNG, and the numbers in it that pages quote."""

    png: bytes
    numbers: Mapping[str, float]


@dataclass(frozen=True)
class Statement:
    """A sentence of a page with the names of numbers in braces: `alarm at step {alarm}`."""

    page: str
    text: str

    def disagreements(self, numbers: Mapping[str, float]) -> list[str]:
        """Return how the page and the numbers of a picture differ, each as a sentence."""
        page = " ".join((ROOT / self.page).read_text(encoding="utf-8").split())
        matches = list(re.finditer(self._pattern(), page))
        if len(matches) != 1:
            return [f"{self.page} holds {self.text!r} {len(matches)} times, expected once."]
        printed = matches[0].groupdict()
        return [
            f"{self.page} says {text} where {numbers[name]:.6g} is drawn: {self.text!r}."
            for name, text in printed.items()
            if not agrees(text, numbers[name])
        ]

    def _pattern(self) -> str:
        """Return the sentence as a regular expression with a named group for each number."""
        pieces = re.split(r"\{(\w+)\}", self.text)
        for place, piece in enumerate(pieces):
            is_name = place % 2 == 1
            pieces[place] = f"(?P<{piece}>{PRINTED_NUMBER})" if is_name else re.escape(piece)
        return "".join(pieces)


def agrees(printed: str, value: float) -> bool:
    """Return whether a printed number is a value, rounded to the digits that are printed."""
    number = Decimal(printed.replace(",", "").replace("−", "-"))
    exponent = number.as_tuple().exponent
    assert isinstance(exponent, int), printed
    return abs(float(number) - value) <= ROUNDING * 10.0**exponent


@dataclass(frozen=True)
class Picture:
    """A picture of the documentation.

    Attributes
    ----------
    name : str
        Of its file, without `.png`.
    draw : callable
        Draws it. It takes the place of the published record where there is one.
    statements : tuple of Statement
        What pages say of it in numbers.
    record : str
        File or folder of a published record that is drawn, in the folder of published data; empty:
        none.
    minutes : bool
        Whether drawing takes minutes of processor time.
    browser : bool
        Whether it is a page in Chromium, whose fonts are those of the machine.
    source : str
        What several pictures have in common, so that one process draws them; empty: nothing.
    """

    name: str
    draw: Callable[..., Drawing]
    statements: tuple[Statement, ...] = ()
    record: str = ""
    minutes: bool = False
    browser: bool = False
    source: str = ""

    @property
    def committed(self) -> Path:
        """The file in the documentation."""
        return IMAGES / f"{self.name}.png"

    def drawn(self, data: Path) -> Drawing:
        """Draw the picture, with published records in a folder."""
        drawing = self.draw(data / self.record) if self.record else self.draw()
        return Drawing(with_numbers(drawing.png, drawing.numbers), drawing.numbers)

    def disagreements(self, numbers: Mapping[str, float]) -> list[str]:
        """Return where pages say other numbers than these."""
        return [
            sentence
            for statement in self.statements
            for sentence in statement.disagreements(numbers)
        ]


def with_numbers(png: bytes, numbers: Mapping[str, float]) -> bytes:
    """Return a PNG file with numbers in a text chunk behind its header."""
    kind = b"tEXt"
    content = KEYWORD + b"\0" + json.dumps(dict(numbers)).encode("ascii")
    chunk = (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )
    end_of_header = len(SIGNATURE) + 4 + 4 + 13 + 4  # length, kind, content and checksum of IHDR
    return png[:end_of_header] + chunk + png[end_of_header:]


def numbers_of(png: bytes) -> dict[str, Any]:
    """Return the numbers that `with_numbers` put into a PNG file.

    Raises
    ------
    ValueError
        If the file holds none.
    """
    for kind, content in _chunks(png):
        if kind == b"tEXt" and content.startswith(KEYWORD + b"\0"):
            numbers: dict[str, Any] = json.loads(content.removeprefix(KEYWORD + b"\0"))
            return numbers
    raise ValueError(
        "The picture holds no numbers: draw it anew with python -m benchmarks.pictures."
    )


def _chunks(png: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and content of each chunk of a PNG file."""
    place = len(SIGNATURE)
    while place < len(png):
        length, kind = struct.unpack(">I4s", png[place : place + 8])
        yield kind, png[place + 8 : place + 8 + length]
        place += length + 12


def share_of_changed_pixels(first: bytes, second: bytes) -> float:
    """Return the share of visibly different pixels of two PNG files; 1 if their sizes differ."""
    before, after = (imread(io.BytesIO(png), format="png")[..., :3] for png in (first, second))
    if before.shape != after.shape:
        return 1.0
    return float(np.mean(np.abs(before - after).max(axis=-1) > VISIBLE))
