"""The one name to import: what it hands on, that it does so lazily, and whose files may hide ours."""

import ast
import pydoc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import uav_twin
from tests.conftest import synthetic_calibration
from tests.discrepancy.rigs import measured
from uav_twin import _HOMES

ROOT = Path(__file__).parents[2]


def test_every_name_is_there_under_its_own_name_and_documented():
    tree = ast.parse(Path(uav_twin.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    told = {}
    for line in tree.body[1:]:
        assert isinstance(line, ast.ImportFrom)
        (alias,) = line.names
        assert alias.asname == alias.name  # which type checkers take as handed on
        told[alias.name] = line.module
    assert told == _HOMES
    assert 15 <= len(uav_twin.__all__) <= 45
    assert set(uav_twin.__all__) <= set(dir(uav_twin))
    # The import of a module of the command line would take the place of a name like it.
    assert not {path.stem for path in Path(uav_twin.__file__).parent.glob("*.py")} & {*uav_twin.__all__}
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    for name in uav_twin.__all__:
        found = getattr(uav_twin, name)
        assert (callable(found), found.__name__) == (True, name)
        assert found.__doc__, name
        assert f"`{name}`" in page, name
        text = pydoc.plaintext.document(found)
        assert f"class {name}" in text or f"{name}(" in text
    with pytest.raises(AttributeError, match=r"no attribute 'simulate_fmu'.*load_design"):
        uav_twin.simulate_fmu  # noqa: B018


MODULE, NAME = "import uav_twin; uav_twin.load_design()", "from uav_twin import load_design; load_design()"


@pytest.mark.parametrize(
    ("hidden", "words"),
    [
        ("fe.py", ("-c", MODULE)),
        ("scenarios/__init__.py", ("-c", NAME)),
        ("scenarios/mine.txt", ("-c", MODULE)),
        ("fe.py", ("-m", "uav_twin", "wing")),
    ],
)
def test_a_file_that_hides_a_package_is_named(hidden, words, tmp_path):
    """A folder without `__init__.py` hides ours in editable installs only; else it is left in peace."""
    (tmp_path / hidden).parent.mkdir(exist_ok=True)
    (tmp_path / hidden).write_text("", encoding="utf-8")
    line = [sys.executable, *words]
    found = subprocess.run(line, cwd=tmp_path, check=False, capture_output=True, text=True)
    if hidden == "scenarios/mine.txt" and not found.returncode:
        return
    assert found.returncode == 1
    *before, last = found.stderr.strip().splitlines()
    name, place = Path(hidden).parts[0].removesuffix(".py"), tmp_path / Path(hidden).parts[0]
    assert last.startswith("uav_twin.shadowing.ShadowedPackageError: ") or not before
    assert (found.stdout, bool(before)) == ("", "-c" in words)
    assert f"{place} hides the package `{name}` of uav-twin" in last
    assert "rename it" in last


def test_records_show_themselves_in_a_few_words(library_file):
    from calibration.wing.calibrate import WingCalibration
    from discrepancy.document import Origin
    from discrepancy.files.verdict import StoredVerdict
    from discrepancy.models.fmu import FmuModel
    from discrepancy.models.interface import Model
    from discrepancy.models.structures import WingModel
    from discrepancy.verdict import Verdict, VerdictKind
    from discrepancy.workflow import Investigation

    campaign, model = measured()
    verdict = Verdict(VerdictKind.NOTHING_MISSING, "Nothing.", 0.9, 0.0)
    wing = synthetic_calibration()
    knowledge = uav_twin.prepare_twin("level_turns", {"strain_library": library_file})
    shown: list[tuple[object, tuple[str, ...]]] = [
        (campaign, (campaign.name, "trials=", "channels=")),
        (model, ("LumpedModel", "parameters=")),
        (verdict, ("nothing missing", "0.9")),
        (Investigation(campaign, model, (), verdict), ("Verdict(", model.name)),
        (StoredVerdict(verdict, None, Origin("A rig", "A model", *[""] * 3, {})), ("Verdict(", "A rig")),
        (wing, (wing.asset, "samples=40")),
        (WingCalibration(wing, wing, "joint", *[None] * 4), ("Calibration(", "joint")),  # type: ignore[arg-type]
        (uav_twin.load_scenario("level_turns"), ("level_turns.toml",)),
        (knowledge, ("level_turns", "GraphicalModel(", "GaussianSensorModel(")),
        (knowledge.model, ("states=", "controls=2 (2g, 3g)")),
        (knowledge.sensor_model, ("draws=", "sensors=")),
        (knowledge.twin(), ("turns=0", "GraphicalModel(")),
        (uav_twin.load_design(), ("regions=2 (z1, z2)", "gauges=24")),
    ]
    for record, words in shown:
        text = repr(record)
        assert text.startswith(f"{type(record).__name__}(")
        assert len(text) < 400
        assert "array(" not in text
        for word in words:
            assert word in text, text
    assert FmuModel.__repr__ is WingModel.__repr__ is Model.__repr__


def test_a_policy_of_ones_own_is_flown_kept_and_resumed(tmp_path, library_file, monkeypatch):
    from twin_master.errors import InvalidModelError, MissionInputError, NotResumableError

    monkeypatch.setattr("twin_master.workflow._report", None)  # none is drawn where none is asked for
    flown = {"strain_library": library_file}
    known = uav_twin.prepare_twin("level_turns", flown)
    controls = known.model.controls
    gentle = np.zeros((known.model.states.size, len(controls)))
    gentle[:, 0] = 1.0
    folder = tmp_path / "run"
    with pytest.raises(InvalidModelError, match="expected a policy of shape"):
        uav_twin.fly("level_turns", folder, flown, policy=np.ones((3, 1)))
    with pytest.raises(MissionInputError, match="'sead' is not a key"):
        uav_twin.fly("level_turns", folder, {"sead": 1})
    assert not folder.exists()
    uav_twin.fly("level_turns", folder, flown, policy=gentle, report=False)
    run = uav_twin.open_run(folder)
    np.testing.assert_array_equal(np.load(folder / "policy.npy"), gentle)
    assert not run["policy"]["control_index"].values.any()
    first = int(run["observed"]["control_index"][0])
    assert run["observed"]["control_index"].values[1:].tolist() == [0] * (len(run["observed"]["step"]) - 1)
    assert first == controls.index(known.scenario.mission.first_control)
    before = (folder / "run.nc").read_bytes()
    uav_twin.resume(folder, report=False)
    assert (folder / "run.nc").read_bytes() == before
    (folder / "run.nc").unlink()  # a run that is finished is not flown again
    np.save(folder / "policy.npy", gentle[:, ::-1])
    with pytest.raises(NotResumableError, match="policy changed"):
        uav_twin.resume(folder, report=False)
