"""Projects of `uav-twin init`: each kind runs at once, from its README to its report."""

import contextlib
import re
import shlex
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from fe.structure.mesh_file import read_mesh
from scenarios import structure_files
from tests.command_line import refused, said
from uav_twin import load_scenario, open_run
from uav_twin.init_command import KINDS
from uav_twin.projects.mesh import draft_part

REPORTS = {
    "mesh": "runs/first/report.html",
    "fmu": "runs/first/report.html",
    "rig": "verdict/report.html",
    "stream": "runs/first/report.html",
}
"""The report of each kind."""
WITHOUT_END = ("uav-twin view", "--follow", "--resume", "--seeds")
"""Commands that wait for Ctrl-C or depend on those, and flights that are the first one again."""


def commands_of(folder: Path) -> list[str]:
    return re.findall(r"^ {7}(uav-twin .*)$", (folder / "README.md").read_text(encoding="utf-8"), re.M)


@pytest.fixture(scope="module", params=KINDS)
def project(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("projects") / "mine"
    said("init", request.param, folder)
    return request.param, folder


def test_a_readme_has_five_commands(project):
    assert len(commands_of(project[1])) == 5


def test_a_project_runs_at_once_to_its_report(project):
    kind, folder = project
    copy = shutil.copytree(folder, folder.with_name("flown"))
    with contextlib.chdir(copy):
        for command in commands_of(copy):
            if not any(words in command for words in WITHOUT_END):
                said(*shlex.split(command)[1:])
    assert (copy / REPORTS[kind]).is_file()
    if kind != "rig":  # the first flight shows a decision: the twin leaves the hard control
        assert set(open_run(copy / "runs/first")["observed"]["control_index"].values) == {0, 1}


def test_every_file_names_its_schema_to_editors(project):
    for path in project[1].rglob("*.toml"):
        assert path.read_text(encoding="utf-8").startswith("#:schema "), path


def keys_without_comment(campaign: Path) -> set[str]:
    """Return the keys of a campaign, with their tables, that have no comment at their first place."""
    explained: dict[str, bool] = {}
    table = previous_line = ""
    for line in campaign.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            table = line
        elif match := re.match(r"(\w+) = ", line):
            has_comment = "  # " in line or previous_line.startswith("# ")
            explained.setdefault(table + match[1], has_comment)
        previous_line = line
    assert tomllib.loads(campaign.read_text(encoding="utf-8"))
    return {key for key, has_comment in explained.items() if not has_comment}


def test_keys_that_are_guessed_have_a_comment(project):
    campaign = project[1] / "measured" / "campaign.toml"
    assert not campaign.exists() or keys_without_comment(campaign) == set()
    for path in project[1].glob("*.toml"):
        text = path.read_text(encoding="utf-8")
        assert text.count("#") > 0.4 * text.count(" = "), path
        assert tomllib.loads(text)


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of a mesh of the user."""
    mesh = structure_files()["stiffened_panel"].with_suffix(".msh")
    folder = tmp_path_factory.mktemp("panel") / "panel"
    said("init", "mesh", folder, mesh)
    return folder


def test_the_mesh_of_a_user_is_in_its_project(panel):
    mesh = structure_files()["stiffened_panel"].with_suffix(".msh")
    assert (panel / mesh.name).read_bytes() == mesh.read_bytes()
    assert "unknowns" in said("structure", "info", panel / "part.toml")


def test_a_mission_of_a_mesh_has_a_state_for_each_region(panel):
    scenario = load_scenario(panel / "mission.toml").scenario
    assert scenario.state_names == ("z_root", "z_middle")
    assert scenario.observation.count == len(scenario.observation.titles) == 12


def test_regions_of_a_part_do_not_overlap_and_lie_within_it():
    mesh = read_mesh(structure_files()["bracket"].with_suffix(".inp"), 1e-3, "mm")
    draft = draft_part(mesh)
    first, second = draft.regions
    assert draft.axis == 0
    assert first[1, 0] == second[0, 0]
    centres = 1e3 * mesh.centres
    for low, high in draft.regions:
        assert np.all((centres >= low) & (centres <= high), axis=1).any()


def test_the_structure_of_a_user_is_watched(panel, tmp_path):
    said("init", "stream", tmp_path / "watched", panel / "part.toml")
    stream = (tmp_path / "watched" / "stream.csv").read_text(encoding="utf-8").splitlines()
    assert stream[0].startswith("time,control,strain_1_microstrain")
    assert len(stream) == 31


def test_a_ring_down_of_a_user_has_a_model_of_its_frequency(tmp_path):
    time = np.arange(0.0, 4.0, 0.005)
    displacement = 20.0 * np.exp(-0.3 * time) * np.cos(2 * np.pi * 7.0 * time)
    rows = [f"{t:.4f},{x:.4f}" for t, x in zip(time, displacement, strict=True)]
    (tmp_path / "release.csv").write_text("\n".join(["time [s],x [mm]", *rows]), encoding="utf-8")
    said("init", "rig", tmp_path / "rig", tmp_path / "release.csv")
    model = tomllib.loads((tmp_path / "rig" / "model.toml").read_text(encoding="utf-8"))
    assert model["stiffness"][0] == pytest.approx((2 * np.pi * 7.0) ** 2, rel=0.01)
    campaign = tomllib.loads((tmp_path / "rig" / "measured" / "campaign.toml").read_text(encoding="utf-8"))
    assert campaign["trial"][0]["kind"] == "ringdown"
    assert keys_without_comment(tmp_path / "rig" / "measured" / "campaign.toml") == set()


def test_a_folder_that_is_not_empty_is_kept(tmp_path):
    (tmp_path / "note.txt").write_text("mine", encoding="utf-8")
    assert "not an empty folder" in refused("init", "mesh", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("mesh", "cannot be read"),
        ("fmu", "not a valid FMU archive"),
        ("rig", "holds no table"),
        ("stream", "not a key of a structure"),
        ("car", "`KIND` must be 'mesh', 'fmu', 'rig' or 'stream'"),
    ],
)
def test_a_file_of_another_kind_is_refused(kind, sentence, tmp_path):
    (tmp_path / "other.toml").write_text('format = "none"\n', encoding="utf-8")
    assert sentence in refused("init", kind, tmp_path / "new", tmp_path / "other.toml")
    assert not (tmp_path / "new").exists()
