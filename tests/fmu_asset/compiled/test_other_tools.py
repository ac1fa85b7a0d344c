"""The wing in other hosts: a program in C, libcosim with both FMUs, OMSimulator where it is installed."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.compiled.compiler import CROSS_COMPILER
from fmu_asset.packing.structure_fmu import build_fmu

COURSE = [(1.0 + 0.25 * k, 0.1 * (k // 3), 0.2, -5.0 if k % 2 else 0.0) for k in range(9)]

# In a process of its own: libcosim is native code with threads, and writes its log to the terminal.
LIBCOSIM = """
import json, sys
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

files, course = sys.argv[1:3], json.loads(sys.argv[3])
execution = CosimExecution.from_step_size(step_size=int(0.5e9))
observer, manipulator = CosimObserver.create_last_value(), CosimManipulator.create_override()
assert execution.add_observer(observer) and execution.add_manipulator(manipulator)
slaves = [execution.add_local_slave(CosimLocalSlave(fmu_path=file, instance_name=f"wing{number}"))
          for number, file in enumerate(files)]
seen = []
for inputs in course:
    for slave in slaves:
        assert manipulator.slave_real_values(slave, [0, 1, 2, 3], inputs)
    assert execution.step()
    seen.append([observer.last_real_values(slave, list(range(11, 37))) for slave in slaves])
print("SEEN" + json.dumps(seen))
"""


def test_a_host_without_python_needs_nothing_else(
    compiled_fmu: Path, compiler: list[str], model: ReducedModel, tmp_path: Path
) -> None:
    shutil.unpack_archive(compiled_fmu, tmp_path, "zip")
    host, source = tmp_path / "host", Path(__file__).with_name("host.c")
    warnings = ("-Wall", "-Wextra", "-Werror")
    words = [*compiler, *warnings, f"-I{tmp_path / 'sources'}", source, "-o", host, "-ldl"]
    subprocess.run(words, check=True)
    library = next((tmp_path / "binaries" / "linux64").glob("*.so"))
    # In a folder whose name must be encoded in the URI.
    resources = (tmp_path / "resources").rename(tmp_path / "resources of é 100%")
    given = [read_fmu(compiled_fmu).guid, resources.as_uri(), "3", *map(str, range(11, 35))]
    done = subprocess.run([host, library, *given], capture_output=True, text=True, check=False, env={})
    assert done.returncode == 0, done.stdout
    expected = model.static_response({"load_factor": 1.0}).strain
    np.testing.assert_allclose([float(line) for line in done.stdout.split()], expected, rtol=1e-12)


def test_the_windows_binary_gives_the_same_under_wine(
    compiled_fmu: Path, compiler: list[str], model: ReducedModel, tmp_path: Path
) -> None:
    """To the last bit: statics, bound and modes."""
    if shutil.which(CROSS_COMPILER) is None:
        pytest.skip(f"{CROSS_COMPILER} is not installed")
    path = build_fmu(model, tmp_path / "wing.fmu", kind="compiled", platforms=("linux64", "win64")).path
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(compiled_fmu) as linux:
        assert archive.read("modelDescription.xml") == linux.read("modelDescription.xml")
        archive.extractall(tmp_path)
    binary = next((tmp_path / "binaries" / "win64").glob("*.dll"))
    words = [CROSS_COMPILER.replace("gcc", "objdump"), "-p", binary]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    libraries = sorted(line.split()[-1].lower() for line in told if "DLL Name" in line)
    assert libraries == ["kernel32.dll", "msvcrt.dll"]  # of every Windows
    if shutil.which("wine") is None:
        pytest.skip("wine is not installed")
    source, host = Path(__file__).with_name("host.c"), tmp_path / "host"
    for program, target, flags in ((compiler, host, ["-ldl"]), ([CROSS_COMPILER], f"{host}.exe", [])):
        subprocess.run([*program, f"-I{tmp_path / 'sources'}", source, "-o", target, *flags], check=True)
    shared = next((tmp_path / "binaries" / "linux64").glob("*.so"))
    places = [str(place) for place in (*range(11, 37), *range(38, 51))]
    given = [read_fmu(path).guid, (tmp_path / "resources").as_uri(), "3", *places]
    environment = {**os.environ, "WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"}
    shown = [
        subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=120, env=environment
        ).stdout.split()
        for command in ([host, shared, *given], ["wine", f"{host}.exe", f"Z:{binary}", *given])
    ]
    assert len(shown[0]) == len(places)
    assert shown[0] == shown[1]


def test_both_fmus_fly_in_libcosim(compiled_fmu: Path, fmu: Path, model: ReducedModel) -> None:
    if importlib.util.find_spec("libcosimpy") is None:
        pytest.skip("libcosimpy is not installed")
    words = [sys.executable, "-c", LIBCOSIM, compiled_fmu, fmu, json.dumps(COURSE)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    seen = json.loads(done.stdout.split("SEEN", 1)[1].splitlines()[0])
    assert len(seen) == len(COURSE)
    for (load_factor, z1, z2, force), (compiled, python) in zip(COURSE, seen, strict=True):
        expected = model.static_response({"z1": z1, "z2": z2, "load_factor": load_factor, "tip_force": force})
        np.testing.assert_allclose(compiled[:24], expected.strain, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(compiled, python, rtol=1e-9, atol=1e-15)


def test_the_compiled_fmu_runs_in_omsimulator(
    compiled_fmu: Path, model: ReducedModel, tmp_path: Path
) -> None:
    simulator = shutil.which("OMSimulator")
    if simulator is None:
        pytest.skip("OMSimulator is not installed")
    result = tmp_path / "result.csv"
    options = ("--stopTime=3", "--stepSize=1", f"--resultFile={result}", f"--tempDir={tmp_path}")
    words = [simulator, compiled_fmu, *options]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with result.open(newline="") as lines:
        last = list(csv.DictReader(lines))[-1]
    strain = {
        int(name.split("[")[1].split("]")[0]): float(v) for name, v in last.items() if "strain[" in name
    }
    assert sorted(strain) == list(range(1, 25))
    expected = model.static_response({"load_factor": 1.0}).strain
    assert [strain[n] for n in range(1, 25)] == pytest.approx(expected, rel=1e-9, abs=1e-15)
