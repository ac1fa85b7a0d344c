"""Gauges beside those of a structure file: what is refused, and in which words."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fe.runtime.errors import InvalidDesignError
from scenarios import structure_files
from twin_master.assets.candidates import with_candidates
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.assets.structure_source import StructureBelief
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario

ONE = '[[gauge]]\nname = "{}"\npoint = {}\ndirection = [1, 0, 0]\n'


@pytest.fixture
def panel() -> Scenario:
    return resolve_scenario(load_scenario("stiffened_panel"), Overrides())


def test_no_place_is_refused(panel: Scenario, tmp_path: Path) -> None:
    with pytest.raises(MissionInputError, match="--candidates needs at least one place"):
        with_candidates(panel, "0", tmp_path / "more")


@pytest.mark.parametrize(
    ("name", "point", "words"),
    [("end_1", "[150, 100, 2]", "end_1"), ("far", "[150, 100, 90]", r"gauge\[1\] \(far\): the point")],
)
def test_what_is_wrong_names_the_option(
    panel: Scenario, tmp_path: Path, name: str, point: str, words: str
) -> None:
    listed, folder = tmp_path / "more.toml", tmp_path / "gone"
    listed.write_text(ONE.format(name, point))
    with pytest.raises(InvalidDesignError, match=f"^--candidates .*more.toml: .*{words}") as caught:
        with_candidates(panel, str(listed), folder)
    assert str(folder) not in str(caught.value)


def test_gauges_in_a_list_cannot_be_joined(panel: Scenario, tmp_path: Path) -> None:
    source = structure_files()["stiffened_panel"]
    shutil.copy(source.with_suffix(".msh"), tmp_path)
    head, *rest = source.read_text().split("[[gauge]]")
    tail = rest[-1].partition("[[displacement]]")[2]
    rows = '[{ name = "end_1", point = [40, 50, -20], direction = [1, 0, 0] }]'
    inline = tmp_path / "panel.toml"
    inline.write_text(f"gauge = {rows}\n{head}[[displacement]]{tail}")
    assert isinstance(panel.belief, StructureBelief)
    believed = panel.belief.model_copy(update={"structure": str(inline)})
    with pytest.raises(MissionInputError, match=r"as tables \[\[gauge\]\], not in a list"):
        with_candidates(panel.model_copy(update={"belief": believed}), "3", tmp_path / "more")
