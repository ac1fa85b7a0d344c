"""Pages and catalogue agree; every effect has its picture."""

import struct

from benchmarks.effect_pages import FOLDER, pages
from benchmarks.effect_pictures import draw, picture_setting
from discrepancy.catalogue.library import library
from tests.discrepancy.rigs import chosen

IDENTIFIERS = {effect.identifier for effect in library()}


def test_the_pages_are_those_of_the_catalogue():
    """If this fails: python -m benchmarks.effect_pages."""
    made = pages()
    assert {path.name for path in FOLDER.glob("*.md")} == set(made)
    for name, text in made.items():
        assert (FOLDER / name).read_text(encoding="utf-8") == text, name


def test_every_effect_has_a_small_picture():
    pictures = {path.stem: path.read_bytes() for path in (FOLDER / "images").iterdir()}
    assert pictures.keys() == IDENTIFIERS
    for name, data in pictures.items():
        width, height = struct.unpack(">II", data[16:24])
        assert len(data) <= 40 * 1024, name
        assert 500 <= width <= 700, name
        assert 150 <= height <= 300, name
    (effect,) = chosen("cubic_stiffness")
    assert draw(effect, picture_setting()).startswith(b"\x89PNG")  # again
