"""The picture of a structure from a mesh in the view."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from scenarios import structure_files
from twin_master.assets.structure_source import MODEL_COPY
from twin_master.viewer.part_picture import NO_REGION, PartPicture, part_picture
from uav_twin import load_scenario


def run_folder_of(folder: Path, structure: str) -> Path:
    """Write the copies that a run folder has of a shipped structure."""
    file = structure_files()[structure]
    copy = folder / MODEL_COPY
    copy.parent.mkdir(parents=True)
    shutil.copy(file, copy)
    for mesh in file.parent.glob(f"{structure}.*"):
        if mesh.suffix != ".toml":
            shutil.copy(mesh, copy.parent)
    return folder


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> PartPicture:
    folder = run_folder_of(tmp_path_factory.mktemp("bracket"), "bracket")
    picture = part_picture(folder, load_scenario("bracket").scenario)
    assert picture is not None
    return picture


def test_each_region_has_faces_and_some_faces_have_none(bracket):
    assert set(bracket.region) == {NO_REGION, 0, 1}
    assert len(bracket.region) == len(bracket.faces)


def test_the_picture_has_the_width_one(bracket):
    points = np.concatenate([np.array(face) for face in bracket.faces])
    assert points[:, 0].min() == pytest.approx(0.0, abs=1e-4)
    assert points[:, 0].max() == pytest.approx(1.0, abs=1e-4)


def test_faces_of_hexahedra_have_four_corners_and_are_seen_from_one_side(bracket):
    """All turn the same way, or the other one: the corners of a kind are in a fixed order."""
    assert {len(face) for face in bracket.faces} == {4}
    areas = []
    for face in bracket.faces:
        x, y = np.array(face).T
        areas.append(0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    assert np.all(np.array(areas) > 0.0) or np.all(np.array(areas) < 0.0)


def test_every_gauge_has_its_place(bracket):
    assert len(bracket.gauges) == load_scenario("bracket").scenario.observation.count


def test_a_mission_with_other_sensors_has_no_picture(tmp_path):
    folder = run_folder_of(tmp_path, "bracket")
    assert part_picture(folder, load_scenario("level_turns").scenario) is None


def test_a_flight_without_a_structure_has_no_picture(tmp_path):
    assert part_picture(tmp_path, load_scenario("bracket").scenario) is None
