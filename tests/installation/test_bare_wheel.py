"""The wheel without extras, in an environment that has nothing else: the first page runs."""

import json
import re
import zipfile
from pathlib import Path

import pytest

from tests.installation.bare import ROOT, BareEnvironment, dependencies_without_extras

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> BareEnvironment:
    return BareEnvironment(tmp_path_factory.mktemp("bare"))


def test_the_environment_has_no_extra_and_nothing_of_the_checkout(bare):
    code = "import importlib.util as u, uav_twin; print(uav_twin.__file__, *map(u.find_spec, %r))"
    names = ["numba", "distributed", "zarr", "paho", "gymnasium", "openpyxl", "ziglang", "pytest"]
    place, *specifications = bare.run("-c", code % names).split()
    assert Path(place).is_relative_to(bare.packages)
    assert specifications == ["None"] * len(names)


def test_the_first_page_runs(bare, tmp_path):
    """The mission of the tutorial, in plain Python."""
    said = bare.run("-m", "uav_twin", "run", "level_turns", "--out", "mission", cwd=tmp_path)
    assert "The twin left 3g for 2g at step" in said
    assert (tmp_path / "mission" / "report.html").stat().st_size > 100_000
    versions = json.loads((tmp_path / "mission" / "config.json").read_text(encoding="utf-8"))["provenance"][
        "versions"
    ]
    assert versions["numba"] == "not installed"


def test_the_shipped_recording_is_watched(bare, tmp_path):
    words = ["watch", "watched_wing", "--out", "watch", "--steps", "3", "--no-report"]
    lines = bare.run("-m", "uav_twin", *words, cwd=tmp_path).splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, 1, 2]


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (["run", "level_turns", "--seeds", "1:3", "--out", "fleet"], "fleet"),
        (["watch", "watched_wing", "--observations", "mqtt://localhost/a", "--out", "w"], "mqtt"),
    ],
)
def test_a_command_that_needs_an_extra_names_it(bare, tmp_path, words, extra):
    complaint = bare.run("-m", "uav_twin", *words, cwd=tmp_path, code=1)
    assert f"uav-twin[{extra}]" in " ".join(complaint.split())


def test_every_command_says_what_it_does(bare):
    """Its options are read, so that no module at its top needs an extra."""
    commands = re.findall(r"^│ ([a-z][a-z-]+) ", bare.run("-m", "uav_twin", "--help"), re.MULTILINE)
    assert len(commands) > 10
    for command in commands:
        assert "Usage" in bare.run("-m", "uav_twin", command, "--help")


def test_the_wheel_has_the_data_of_the_packages(bare):
    (wheel,) = bare.folder.parent.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    folders = {name.partition("/")[0] for name in names}
    assert not folders & {"tests", "benchmarks", "evidence", "docs"}
    for suffix in ("toml", "css", "js", "html", "jinja", "csv"):
        tracked = [
            path for path in ROOT.glob(f"[a-z]*/**/*.{suffix}") if path.relative_to(ROOT).parts[0] in folders
        ]
        missing = {path.relative_to(ROOT).as_posix() for path in tracked} - names
        assert not missing, suffix


def test_the_page_names_what_is_large():
    """Each distribution without extras that takes 10 MiB or more stands in the table of the page."""
    page = (ROOT / "docs/how_to/installation.md").read_text(encoding="utf-8").lower()
    for name, distribution in dependencies_without_extras().items():
        root = Path(str(distribution.locate_file("")))
        files = [root / file for file in distribution.files or () if file.suffix != ".pyc"]
        if sum(path.stat().st_size for path in files if path.is_file()) >= 10 * 2**20:
            assert name.lower() in page, name
