"""Packages that add laws, effects, assets, beliefs, sensor models and estimators, as pip installs them."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from discrepancy.catalogue.library import effects_of_entry_points
from discrepancy.errors import CatalogueError
from fe.runtime.errors import PlugInError
from fe.runtime.plug_ins import find_plug_in, load_plug_ins
from reporting.provenance import collect_provenance
from tests.kept import ROOT
from tests.refusals import refused
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.mission.parts import object_by_name
from twin_master.run_folder import check_versions

EXAMPLE = ROOT / "docs" / "how_to" / "add" / "example_plug_in"

USE_OF_ALL = """
import json
import sys

import discrepancy.document
import uav_twin
from discrepancy.catalogue.library import load_catalogue
from fe.runtime.laws import LAWS, force_and_slope
from fe.runtime.patch import ModelPatch

row = {"kind": "saturating_spring", "port": "root", "limit": 2.0, "transition": 0.1}
(law,) = ModelPatch.from_list([row])
force, slope = force_and_slope(LAWS.index(type(law)), law.parameter_row, None, 0.05, 0.0)
parts = {"sensor_model": "student", "estimator": "wary"}
outcome = uav_twin.fly(sys.argv[1], sys.argv[2], report=False, **parts)
run = uav_twin.open_run(sys.argv[2])
uses = {
    "force": [float(force), float(slope)],
    "effects": [effect.identifier for effect in load_catalogue()],
    "believed": run.filtered["mean"].values[:, 0].tolist(),
    "asset": run.attrs["asset"],
    "belief": run.attrs["twin_model"],
}
print("USES", json.dumps(uses))
"""


@pytest.fixture(scope="module")
def example_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder where pip has installed the example of the page."""
    folder = tmp_path_factory.mktemp("example")
    source, target = folder / "source", folder / "installed"
    shutil.copytree(EXAMPLE, source)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", target, source]
    subprocess.run(command, check=True, capture_output=True)
    return target


def provenance_with(**plug_ins: str) -> dict[str, Any]:
    """Return the configuration of a run that was begun with some plug-ins and this program."""
    return {"provenance": {**collect_provenance(0).as_dict(), "plug_ins": plug_ins}}


def test_a_run_is_not_resumed_without_a_plug_in_of_its_beginning(tmp_path):
    config = provenance_with(**{"uav_twin.laws: gone": "lost-laws 1.2"})
    with refused(
        NotResumableError, r"other plug-ins: uav_twin.laws: gone \(lost-laws 1.2, now not installed\)"
    ):
        check_versions(tmp_path, config, 0)


def test_a_run_is_not_resumed_with_another_version_of_a_plug_in(tmp_path, monkeypatch):
    """The version is that of the metadata beside the package."""
    metadata = tmp_path / "my_laws-2.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: my-laws\nVersion: 2.0\n", encoding="utf-8"
    )
    (metadata / "entry_points.txt").write_text("[uav_twin.laws]\nmine = my_laws:Mine\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    check_versions(tmp_path, provenance_with(**{"uav_twin.laws: mine": "my-laws 2.0"}), 0)
    with refused(NotResumableError, "my-laws 1.0, now my-laws 2.0"):
        check_versions(tmp_path, provenance_with(**{"uav_twin.laws: mine": "my-laws 1.0"}), 0)


def test_a_run_is_resumed_beside_plug_ins_that_were_installed_since(tmp_path):
    """So it is if an earlier version has begun it, which recorded no plug-ins."""
    config = provenance_with()
    check_versions(tmp_path, config, 0)
    del config["provenance"]["plug_ins"]
    check_versions(tmp_path, config, 0)


class RunWithPlugIns(NamedTuple):
    """What a process said of the plug-ins that it used, and the plug-ins that its run recorded."""

    uses: dict[str, Any]
    recorded: dict[str, str]


@pytest.fixture(scope="module")
def run_with_plug_ins(example_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> RunWithPlugIns:
    """A mission with one plug-in of each kind, in a process that finds them as installed."""
    folder = tmp_path_factory.mktemp("run_with_plug_ins") / "run"
    run = subprocess.run(
        [sys.executable, "-c", USE_OF_ALL, EXAMPLE / "bar.toml", folder],
        env={**os.environ, "PYTHONPATH": str(example_folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    return RunWithPlugIns(json.loads(run.stdout.partition("USES")[2]), config["provenance"]["plug_ins"])


@pytest.mark.slow
def test_a_run_records_its_plug_ins(run_with_plug_ins):
    recorded = run_with_plug_ins.recorded
    assert set(recorded.values()) == {"bar-plug-in 1.0"}
    assert {"uav_twin.laws: saturating_spring", "uav_twin.estimators: wary"} < set(recorded)


@pytest.mark.slow
def test_the_example_of_the_page_adds_a_law(run_with_plug_ins):
    slope_at_rest = 2.0 / 0.1
    ratio = np.tanh(0.5)
    expected = [2.0 * ratio, slope_at_rest * (1.0 - ratio**2)]
    np.testing.assert_allclose(run_with_plug_ins.uses["force"], expected)


@pytest.mark.slow
def test_the_example_of_the_page_adds_an_effect_an_asset_and_a_belief(run_with_plug_ins):
    uses = run_with_plug_ins.uses
    assert uses["effects"][-1] == "saturating_support"
    assert (uses["asset"], uses["belief"]) == ("bar", "bar")


@pytest.mark.slow
def test_the_example_of_the_page_adds_a_sensor_model_and_an_estimator(run_with_plug_ins):
    """The bar has lost 20 % from step 4 on. The estimator leaves out the last observation.

    So the belief only worsens by the probability 0.1 of one more level of 20 %.
    """
    *_, second_last, last = run_with_plug_ins.uses["believed"]
    assert second_last == pytest.approx(0.2, abs=0.003)
    assert last - second_last == pytest.approx(0.02, abs=0.001)


# ---------------------------------------------------------------------- packages that do not fit


def install(folder: Path, name: str, points: str, module: str = "") -> None:
    """Write a module and the metadata of its package, as pip would leave them.

    Parameters
    ----------
    folder : Path
        The folder of installed packages.
    name : str
        The name of the package and of its module.
    points : str
        The content of its `entry_points.txt`.
    module : str
        The source of the module.
    """
    (folder / f"{name}.py").write_text(module, encoding="utf-8")
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir(parents=True)
    header = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    (metadata / "METADATA").write_text(header, encoding="utf-8")
    (metadata / "entry_points.txt").write_text(points, encoding="utf-8")


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages that this process sees."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_a_broken_plug_in_is_named_with_its_package_and_its_error(packages):
    install(packages, "without_licence", "[g]\nx = without_licence:x\n", "raise OSError('expired')")

    sentence = (
        "The entry point 'x' of the group 'g' in the package without_licence 1.0 failed: OSError: "
        "expired. Mend the package, or uninstall it."
    )
    with pytest.raises(PlugInError, match=re.escape(sentence)):
        find_plug_in("g", "x")


def test_two_plug_ins_with_one_name_are_refused_with_their_packages(packages):
    for name in ("first_bar", "second_bar"):
        install(packages, name, f"[g]\nbar = {name}:bar\n", "bar = 1")

    sentence = r"packages first_bar 1\.0 and second_bar 1\.0 both have an entry point 'bar' of the"
    with pytest.raises(PlugInError, match=sentence):
        load_plug_ins("g")


def test_an_effect_that_is_no_function_is_refused(packages):
    install(packages, "no_function", "[uav_twin.effects]\nx = no_function:x\n", "x = 3")

    with pytest.raises(CatalogueError, match="must be a function that returns effects, but is 3"):
        effects_of_entry_points()


def test_a_broken_estimator_is_refused_with_its_package(packages):
    install(packages, "wary", "[uav_twin.estimators]\nwary = wary:make\n")

    with pytest.raises(MissionInputError, match=r"in the package wary 1\.0 failed: AttributeError"):
        object_by_name("estimator", "wary")


KIND = """
from typing import Literal

from twin_master.scenario.kinds import AssetSection


class Kind(AssetSection):
    kind: Literal["{0}"] = "{0}"

    def source(self, scenario):
        raise NotImplementedError
"""


@pytest.mark.parametrize(
    ("point", "module", "command", "sentence"),
    [
        (
            "[uav_twin.laws]\nspring = misfit:Stop",
            "from fe.runtime.laws.interface import PortForce\nclass Stop(PortForce): pass\n",
            "discrepancy effects",
            "in the package misfit 1.0 must be named 'stop', as its law is",
        ),
        (
            "[uav_twin.assets]\ndesign = misfit:Kind",
            KIND.format("design"),
            "scenario check level_turns",
            "in the package misfit 1.0 has the kind 'design', which uav-twin itself defines",
        ),
        (
            "[uav_twin.beliefs]\nrod = misfit:Kind",
            KIND.format("rod"),
            "scenario check level_turns",
            "in the package misfit 1.0 must be a subclass of BeliefSection, but is",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(tmp_path, point, module, command, sentence):
    """In a process of its own, because classes stay known as long as their process lives."""
    install(tmp_path, "misfit", point, module)

    run = subprocess.run(
        [sys.executable, "-m", "uav_twin", *command.split()],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )

    assert run.returncode == 1
    assert sentence in run.stderr
    assert "Traceback" not in run.stderr
