"""What another tool says of our FMUs: `fmutool -check` of the FMU Manipulation Toolbox."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.companions.build import companion_bytes
from fmu_asset.compiled.package import FmiVersion
from fmu_asset.packing.script import build_script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from scenarios import asset_scripts


@pytest.fixture(scope="module")
def fmutool() -> str:
    tool = shutil.which("fmutool", path=str(Path(sys.executable).parent)) or shutil.which("fmutool")
    if tool is None:
        pytest.skip("fmutool (fmu-manipulation-toolbox) is not installed")
    return tool


def opinion(fmutool: str, fmu: Path) -> tuple[int, str]:
    # It keeps its log and settings in the home of the user.
    home = {"HOME": str(fmu.parent), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [fmutool, "-input", str(fmu), "-check"], capture_output=True, text=True, env=home, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    "name",
    ["python", "source", "fmi3", "exchange", "exchange3", *sorted(COMPANION_NAMES), *sorted(asset_scripts())],
)
def test_it_has_no_complaint(fmutool: str, name: str, model: ReducedModel, tmp_path: Path) -> None:
    target = tmp_path / f"{name}.fmu"
    if name == "python":
        build_fmu(model, target)
    elif name == "source":  # the compiled one without its binary: the description is the same
        build_fmu(model, target, kind="source")
    elif name == "fmi3":
        build_fmu(model, target, kind="source", fmi=3)
    elif name in ("exchange", "exchange3"):
        fmi: FmiVersion = 3 if name == "exchange3" else 2
        build_fmu(model, target, kind="source", interface="model-exchange", fmi=fmi)
    elif name in COMPANION_NAMES:
        target.write_bytes(companion_bytes(name))
    else:
        build_script_fmu(asset_scripts()[name], target)
    code, said = opinion(fmutool, target)
    assert code == 0, said
    assert f"seems to be compliant with FMI-{3 if name in ('fmi3', 'exchange3') else 2}.0" in said
    assert "No semantic error" in said
    assert "ERROR" not in said
    assert "WARNING" not in said


def test_it_does_complain_where_there_is_reason(fmutool: str, model: ReducedModel, tmp_path: Path) -> None:
    good, bad = build_fmu(model, tmp_path / "good.fmu").path, tmp_path / "bad.fmu"
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                content = content.replace(b'causality="input"', b'causality="inward"', 1)
            target.writestr(name, content)
    code, said = opinion(fmutool, bad)
    assert code != 0
    assert "seems to be compliant" not in said
