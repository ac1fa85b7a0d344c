"""The picture of the whole is what its script draws."""

import runpy
from pathlib import Path
from xml.etree import ElementTree

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def test_the_committed_picture_is_what_the_script_draws():
    drawn = runpy.run_path(str(IMAGES / "draw_whole.py"))["draw"]()
    ElementTree.fromstring(drawn)
    assert (IMAGES / "whole.svg").read_text(encoding="utf-8") == drawn
