"""The C sources: clean under warnings and sanitizers, in other hosts; no damaged file is read."""

import csv
import importlib.util
import json
import os
import re
import shutil
import struct
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.compiled import package
from fmu_asset.compiled.package import CROSS_COMPILER, data_file_bytes, pack_arrays
from fmu_asset.packing.structure_fmu import build_fmu
from tests.fmu_asset.making import DESCRIPTION, members, run_python, tables

DRIVER, HOST = (Path(__file__).with_name(name) for name in ("driver.c", "host.c"))
REFUSED = tables(__file__)
WARNINGS = (
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wcast-qual", "-Wstrict-prototypes"),
    "-Werror",
)


@pytest.fixture(scope="module")
def extracted(compiled_fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sources")
    shutil.unpack_archive(compiled_fmu, folder, "zip")
    return folder


def compile_driver(
    compiler: list[str], extracted: Path, target: Path, *flags: str
) -> subprocess.CompletedProcess[str]:
    sources = sorted((extracted / "sources").glob("*.c"))
    words = ["-std=c11", *flags, f"-I{extracted / 'sources'}", *sources, DRIVER, "-o", target, "-lm"]
    return subprocess.run([*compiler, *words], capture_output=True, text=True, check=False)


def damaged(model: ReducedModel, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Return data files that are wrong, most of them with a right checksum."""
    content = data_file_bytes(model)
    with monkeypatch.context() as patch:
        patch.setattr(package, "pack_arrays", dict)
        arrays: dict[str, Any] = data_file_bytes(model)  # type: ignore[assignment]

    def sealed(body: bytes) -> bytes:
        return body + struct.pack("<I", zlib.crc32(body))

    body = content[:-4]
    files = {
        "empty": b"",
        "short": content[:20],
        "flipped": content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
        "longer": sealed(body + b"\0" * 8),
    }
    for name, at, form, value in REFUSED["places"]:
        piece = struct.pack(form, value if isinstance(value, int) else value.encode())
        files[name] = sealed(body[:at] + piece + body[at + len(piece) :])
    for name, array, value in REFUSED["arrays"]:
        files[name] = pack_arrays(arrays | {array: np.array(value)})
    for name, array, value, shape in REFUSED["filled"]:
        files[name] = pack_arrays(arrays | {array: np.full(shape, value)})
    files["gauges"] = pack_arrays(arrays | {"static_output": arrays["static_output"][:-1]})
    files["nan"] = pack_arrays(arrays | {"static_load": np.nan * arrays["static_load"]})
    for name in arrays:
        files[f"without_{name}"] = pack_arrays({key: array for key, array in arrays.items() if key != name})
    files |= {f"cut_{length}": sealed(body[:length]) for length in range(16, len(body), len(body) // 40)}
    return files


@pytest.mark.parametrize("name", ["compiled", "fmi3", "exchange", "exchange3"])
def test_the_sources_are_clean(compiler, ours, name, tmp_path) -> None:
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    sources = sorted((tmp_path / "sources").glob("*.c"))
    standard = ["-Wno-strict-prototypes"] if "3" in name else []  # which the headers of FMI 3.0 break
    subprocess.run([*compiler, "-std=c11", *WARNINGS, *standard, "-fsyntax-only", *sources], check=True)


def test_driven_in_c_under_sanitizers(compiler, extracted, model, tmp_path, monkeypatch) -> None:
    """Every FMI function, garbage as states, damaged files: no error of memory, no undefined behaviour."""
    driver = tmp_path / "driver"
    sanitized = "-fsanitize=address,undefined"
    done = compile_driver(compiler, extracted, driver, "-O1", "-g", sanitized, "-fno-sanitize-recover=all")
    if done.returncode != 0 and ("sanitize" in done.stderr or "asan" in done.stderr):
        pytest.skip(f"{compiler[0]} has no sanitizers: {done.stderr.splitlines()[0]}")
    assert done.returncode == 0, done.stderr
    folders = []
    for name, content in damaged(model, monkeypatch).items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "reduced_model.bin").write_bytes(content)
        folders.append(folder.as_uri())
    options = {**os.environ, "ASAN_OPTIONS": "detect_leaks=1:allocator_may_return_null=1"}
    run_well([driver, (extracted / "resources").as_uri(), *folders], env=options)


def run_well(words: list[Any], **options: Any) -> str:
    """Run a program, which must end well, and return what it says."""
    run = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.mark.long
@pytest.mark.parametrize("name", ["compiled", "compiled_beam"])
def test_driven_in_c_without_a_lost_byte(compiler, ours, name, tmp_path) -> None:
    """Optimised and warned of as much as the compiler can; valgrind watches, where it is installed."""
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    driver = tmp_path / "driver"
    done = compile_driver(compiler, tmp_path, driver, "-O2", "-g", *WARNINGS)
    assert done.returncode == 0, done.stderr
    valgrind = shutil.which("valgrind")
    watched = [] if valgrind is None else [valgrind, "--error-exitcode=9", "--leak-check=full", "--quiet"]
    run_well([*watched, driver, (tmp_path / "resources").as_uri()])


@pytest.mark.parametrize(("name", "version"), [("compiled", 2), ("fmi3", 3)])
def test_the_fmi_functions_of_the_header_are_exported_and_no_others(ours, name, version, tmp_path) -> None:
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("nm is not installed")
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    told = run_well([nm, "-D", "--defined-only", *(tmp_path / "binaries").rglob("*.so")])
    header = (tmp_path / "sources" / f"fmi{version}Functions.h").read_text()
    functions = re.findall(rf"^ *FMI{version}_Export .*?(\w+);", header, re.MULTILINE)
    assert sorted(line.split()[-1] for line in told.splitlines()) == sorted(functions)
    assert f"fmi{version}DoStep" in functions
    assert {*(tmp_path / "sources").glob("structure_fmi?.c")} == {
        tmp_path / "sources" / f"structure_fmi{version}.c"
    }


# ---------------------------------------------------------------------- other hosts

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


def test_a_host_without_python_needs_nothing_else(extracted, compiled_fmu, compiler, model, tmp_path) -> None:
    host = tmp_path / "host"
    words = [*compiler, "-Wall", "-Wextra", "-Werror", f"-I{extracted / 'sources'}", HOST, "-o", host, "-ldl"]
    subprocess.run(words, check=True)
    library = next((extracted / "binaries" / "linux64").glob("*.so"))
    # In a folder whose name must be encoded in the URI.
    resources = shutil.copytree(extracted / "resources", tmp_path / "resources of é 100%")
    given = [read_fmu(compiled_fmu).guid, resources.as_uri(), "3", *map(str, range(11, 35))]
    shown = run_well([host, library, *given], env={})
    expected = model.static_response({"load_factor": 1.0}).strain
    np.testing.assert_allclose([float(line) for line in shown.split()], expected, rtol=1e-12)


def test_the_windows_binary_gives_the_same_under_wine(compiled_fmu, compiler, model, tmp_path) -> None:
    """To the last bit: statics, bound and modes."""
    if shutil.which(CROSS_COMPILER) is None:
        pytest.skip(f"{CROSS_COMPILER} is not installed")
    path = build_fmu(model, tmp_path / "wing.fmu", kind="compiled", platforms=("linux64", "win64")).path
    assert members(path)[DESCRIPTION] == members(compiled_fmu)[DESCRIPTION]
    shutil.unpack_archive(path, tmp_path, "zip")
    binary = next((tmp_path / "binaries" / "win64").glob("*.dll"))
    told = run_well([CROSS_COMPILER.replace("gcc", "objdump"), "-p", binary]).splitlines()
    libraries = sorted(line.split()[-1].lower() for line in told if "DLL Name" in line)
    assert libraries == ["kernel32.dll", "msvcrt.dll"]  # of every Windows
    if shutil.which("wine") is None:
        pytest.skip("wine is not installed")
    host = tmp_path / "host"
    for program, target, flags in ((compiler, host, ["-ldl"]), ([CROSS_COMPILER], f"{host}.exe", [])):
        subprocess.run([*program, f"-I{tmp_path / 'sources'}", HOST, "-o", target, *flags], check=True)
    shared = next((tmp_path / "binaries" / "linux64").glob("*.so"))
    places = [str(place) for place in (*range(11, 37), *range(38, 51))]
    given = [read_fmu(path).guid, (tmp_path / "resources").as_uri(), "3", *places]
    options = {
        "timeout": 120,
        "env": {**os.environ, "WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"},
    }
    shown = [
        run_well([*words, *given], **options).split()
        for words in ([host, shared], ["wine", f"{host}.exe", f"Z:{binary}"])
    ]
    assert len(shown[0]) == len(places)
    assert shown[0] == shown[1]


def test_both_fmus_fly_in_libcosim(compiled_fmu, fmu, model) -> None:
    if importlib.util.find_spec("libcosimpy") is None:
        pytest.skip("libcosimpy is not installed")
    said = run_python(LIBCOSIM, compiled_fmu, fmu, json.dumps(COURSE))
    seen = json.loads(said.split("SEEN", 1)[1].splitlines()[0])
    names = "load_factor", "z1", "z2", "tip_force"
    for inputs, (compiled, python) in zip(COURSE, seen, strict=True):
        expected = model.static_response(dict(zip(names, inputs, strict=True))).strain
        np.testing.assert_allclose(compiled[:24], expected, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(compiled, python, rtol=1e-9, atol=1e-15)


def test_the_compiled_fmu_runs_in_omsimulator(compiled_fmu, model, tmp_path) -> None:
    simulator = shutil.which("OMSimulator")
    if simulator is None:
        pytest.skip("OMSimulator is not installed")
    result = tmp_path / "result.csv"
    options = ("--stopTime=3", "--stepSize=1", f"--resultFile={result}", f"--tempDir={tmp_path}")
    run_well([simulator, compiled_fmu, *options], cwd=tmp_path)
    with result.open(newline="") as lines:
        last = list(csv.DictReader(lines))[-1]
    found = {int(n.split("[")[1].rstrip("]")): float(v) for n, v in last.items() if "strain[" in n}
    expected = model.static_response({"load_factor": 1.0}).strain
    assert [found[n] for n in range(1, 25)] == pytest.approx(expected, rel=1e-9, abs=1e-15)
    assert len(found) == 24
