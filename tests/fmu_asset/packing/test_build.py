"""The FMU file: reproducible, self-contained, right by the standard, and of the command line too."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fmu_asset.check import check_fmu
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu, recorded_content_hash

BIN = Path(sys.executable).parent
ROOT = Path(__file__).parents[3]


def test_two_builds_in_different_processes_are_equal(fmu: Path, model: ReducedModel, tmp_path: Path) -> None:
    model.save(tmp_path / "model.npz")
    program = (
        "import sys; from fe.runtime.reduced import ReducedModel; "
        "from fmu_asset.packing.structure_fmu import build_fmu; "
        "build_fmu(ReducedModel.load(sys.argv[1]), sys.argv[2])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "LC_ALL": "C"}
    subprocess.run(
        [sys.executable, "-c", program, tmp_path / "model.npz", tmp_path / "other.fmu"],
        cwd=ROOT,
        check=True,
        env=environment,
    )
    assert (tmp_path / "other.fmu").read_bytes() == fmu.read_bytes()


def test_other_content_gives_another_guid_and_other_names(
    fmu: Path, make_model: Callable[[float], ReducedModel], tmp_path: Path
) -> None:
    other = build_fmu(make_model(1e5), tmp_path / "other.fmu")
    tailored = build_fmu(make_model(9e4), tmp_path / "e.fmu", state=DigitalState(young_modulus_factor=1.02))
    first = read_model_description(str(fmu))
    assert len({first.guid, other.guid, tailored.guid}) == 3
    with zipfile.ZipFile(fmu) as one, zipfile.ZipFile(other.path) as two:
        shared = {name for name in one.namelist() if name.endswith(".py")} & set(two.namelist())
    assert not shared


def test_a_note_and_a_further_file(model: ReducedModel, fmu: Path, tmp_path: Path) -> None:
    note, content = 'Calibrated for "Wing <7> & é".', b'{"asset": "Wing <7>"}\n'
    made = [
        build_fmu(model, tmp_path / name, note=note, resources={"calibration.json": content}).path
        for name in ("one.fmu", "two.fmu")
    ]
    assert made[0].read_bytes() == made[1].read_bytes()
    assert validate_fmu(str(made[0])) == []
    assert check_fmu(made[0]).passed
    described = read_model_description(str(made[0]))
    assert described.description.endswith(note)
    assert described.guid != read_model_description(str(fmu)).guid
    with zipfile.ZipFile(made[0]) as archive:
        assert archive.read("resources/calibration.json") == content
        page = archive.read("documentation/index.html").decode()
    assert "Wing &lt;7&gt; &amp; é" in page
    declared, actual = recorded_content_hash(made[0])
    assert declared == actual
    for name in ("start.json", "a/b.json", ""):
        with pytest.raises(FmuBuildError, match="cannot have the name"):
            build_fmu(model, tmp_path / "three.fmu", resources={name: content})
    assert not (tmp_path / "three.fmu").exists()


def test_fmpy_finds_nothing_to_complain_of(fmu: Path) -> None:
    assert validate_fmu(str(fmu)) == []
    done = subprocess.run([BIN / "fmpy", "validate", fmu], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    check = check_fmu(fmu)
    assert check.passed, check.problems
    assert "warning" not in {finding.verdict for finding in check.findings}


def test_description_declares_units_ranges_and_starts(fmu: Path, model: ReducedModel) -> None:
    description = read_model_description(str(fmu))
    variables = {variable.name: variable for variable in description.modelVariables}
    assert description.variableNamingConvention == "structured"
    assert description.coSimulation.canGetAndSetFMUstate
    assert description.coSimulation.canSerializeFMUstate
    assert all(v.unit is not None for v in variables.values() if v.type == "Real")
    low, high = model.validity["load_factor"]
    assert (float(variables["load_factor"].min), float(variables["load_factor"].max)) == (low, high)
    strain = variables["strain[24]"]
    assert (strain.unit, strain.displayUnit) == ("1", "microstrain")
    factors = {u.name: {d.name: float(d.factor) for d in u.displayUnits} for u in description.unitDefinitions}
    assert factors["1"]["microstrain"] == 1e6
    assert float(variables["mass.servo"].start) == DigitalState().servo_mass


def test_fmpy_simulates_on_the_command_line(fmu: Path, tmp_path: Path) -> None:
    result = tmp_path / "out.csv"
    subprocess.run(
        [
            *(BIN / "fmpy", "simulate", fmu, "--stop-time", "2", "--output-interval", "0.01"),
            *("--output-file", result, "--start-values", "response", "2", "load_factor", "0"),
            *("initial_tip_displacement", "0.05"),
        ],
        check=True,
        capture_output=True,
    )
    with result.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    tip = [float(row["tip_displacement"]) for row in rows]
    assert len(rows) == 201
    assert tip[0] == pytest.approx(0.05, rel=0.05)
    assert min(tip) < -0.5 * tip[0]


def test_needs_numpy_alone(fmu: Path, tmp_path: Path) -> None:
    """The runtime loads with everything of the project and all other packages hidden."""
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(tmp_path)
    program = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        top = name.partition('.')[0]\n"
        "        ours = top == 'numpy' or top.startswith('uav_wing_')\n"
        "        if top not in sys.stdlib_module_names and not ours:\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "sys.path.insert(0, 'resources')\n"
        "name = open('resources/slavemodule.txt').read()\n"
        "module = __import__(name)\n"
        "wing = getattr(module, 'Structure_' + name.rpartition('_')[2])\n"
        "wing = wing(instance_name='a', resources='resources')\n"
        "wing.enter_initialization_mode(); wing.exit_initialization_mode()\n"
        "assert wing.do_step(0.0, 1.0) is True, wing.log_queue\n"
        "assert wing.get_real([12])[0] != 0.0\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)


def test_a_changed_file_is_noticed(fmu: Path, tmp_path: Path) -> None:
    declared, actual = recorded_content_hash(fmu)
    assert declared == actual
    changed = tmp_path / "changed.fmu"
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            target.writestr(name, data.replace(b'"chain"', b'"other"'))
    assert any("GUID" in problem for problem in check_fmu(changed).problems)
    foreign = tmp_path / "foreign.fmu"
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(foreign, "w") as target:
        for name in source.namelist():
            target.writestr(name, b"\xff" if name.endswith("slavemodule.txt") else source.read(name))
    assert any("was changed after its build" in problem for problem in check_fmu(foreign).problems)


def test_refuses_what_cannot_be_built(model: ReducedModel, fmu: Path, tmp_path: Path) -> None:
    with pytest.raises(FmuBuildError, match="exists"):
        build_fmu(model, fmu)
    with pytest.raises(FmuBuildError, match=r"suffix \.fmu"):
        build_fmu(model, tmp_path / "wing.zip")
    with pytest.raises(FmuBuildError, match=r"start value .* of young_modulus_factor"):
        build_fmu(model, tmp_path / "wing.fmu", state=DigitalState(young_modulus_factor=2.0))
    assert not (tmp_path / "wing.fmu").exists()
