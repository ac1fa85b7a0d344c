"""The compiled FMU as a file: reproducible, checked, compiled by other tools; clear where it cannot be."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fmu_asset.check import check_fmu
from fmu_asset.compiled.compiler import compile_library, find_compiler
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuBuildError, FmuCallError, FmuUnsupportedError
from fmu_asset.packing.structure_fmu import build_fmu, recorded_content_hash
from tests.command_line import command

BIN = Path(sys.executable).parent


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def repacked(path: Path, target: Path, change: Callable[[str, bytes], bytes]) -> Path:
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in members(path).items():
            archive.writestr(name, change(name, content))
    return target


def test_two_builds_are_equal_to_the_byte(
    compiled_fmu: Path, model: ReducedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    monkeypatch.setenv("TMPDIR", str(elsewhere))
    again = build_fmu(ReducedModel.from_bytes(model.to_bytes()), tmp_path / "again.fmu", kind="compiled")
    assert again.path.read_bytes() == compiled_fmu.read_bytes()


def test_the_sources_alone_are_the_same_fmu_without_a_binary(
    compiled_fmu: Path, model: ReducedModel, tmp_path: Path, binding: Binding, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # needs no compiler
    sources = build_fmu(model, tmp_path / "source.fmu", kind="source")
    assert sources.guid == read_model_description(str(compiled_fmu)).guid
    whole = members(compiled_fmu)
    assert members(sources.path) == {n: c for n, c in whole.items() if not n.startswith("binaries/")}
    assert len(whole) == len(members(sources.path)) + 1
    assert json.loads(whole["resources/design.json"]) == {"design_hash": model.design_hash}
    with pytest.raises(FmuUnsupportedError, match="no binary for this platform"):
        FmiAsset(sources.path, binding)


def test_the_description_is_that_of_the_python_fmu(compiled_fmu: Path, fmu: Path) -> None:
    ours, python = read_model_description(str(compiled_fmu)), read_model_description(str(fmu))
    facts = [
        [(v.name, v.valueReference, v.type, v.causality, v.unit, v.displayUnit, v.min, v.max, v.start)
         for v in description.modelVariables]
        for description in (ours, python)
    ]  # fmt: skip
    assert facts[0] == facts[1]
    can = ("canGetAndSetFMUstate", "canSerializeFMUstate", "canHandleVariableCommunicationStepSize")
    assert all(getattr(ours.coSimulation, name) for name in can)
    needs = ("needsExecutionTool", "canBeInstantiatedOnlyOncePerProcess")
    assert not any(getattr(ours.coSimulation, name) for name in needs)
    listed = set(ours.buildConfigurations[0].sourceFileSets[0].sourceFiles)
    there = {name.removeprefix("sources/") for name in members(compiled_fmu) if name.endswith(".c")}
    assert listed == there


def test_start_values_come_from_the_state(
    compiler: list[str], model: ReducedModel, open_slave: Callable[..., Any], tmp_path: Path
) -> None:
    state = DigitalState(young_modulus_factor=1.0 + 1e-15, stiffness_loss=(0.1, 1.0 / 3.0))
    path = build_fmu(model, tmp_path / "tailored.fmu", kind="compiled", state=state).path
    with closing(open_slave(path)) as slave:
        assert slave.everything()[1:3] == [0.1, 1.0 / 3.0]
        assert slave.fmu.getReal([slave.reference["young_modulus_factor"]]) == [1.0 + 1e-15]
        assert slave.start() == 0
        expected = model.static_response(
            young_modulus_factor=1.0 + 1e-15, stiffness_loss=(0.1, 1.0 / 3.0), load_factor=1.0
        )
        np.testing.assert_allclose(slave.everything()[10:34], expected.strain, rtol=1e-12)


def test_nothing_is_found_to_complain_of(compiled_fmu: Path) -> None:
    assert validate_fmu(str(compiled_fmu)) == []
    check = check_fmu(compiled_fmu)
    assert check.passed, check.problems
    assert "warning" not in {finding.verdict for finding in check.findings}


@pytest.mark.parametrize(
    "part",
    [
        "sources/structure_static.c",
        "resources/reduced_model.bin",
        pytest.param("sources/structure_variables.c", marks=pytest.mark.long),  # a source, as the first
    ],
)
def test_a_changed_part_is_noticed(compiled_fmu: Path, tmp_path: Path, part: str) -> None:
    declared, actual = recorded_content_hash(compiled_fmu)
    assert declared == actual
    changed = repacked(
        compiled_fmu, tmp_path / "changed.fmu", lambda name, content: content + b" " * (name == part)
    )
    assert any("GUID" in problem for problem in check_fmu(changed).problems)


def test_a_damaged_data_file_is_refused_with_a_sentence(
    compiled_fmu: Path, binding: Binding, tmp_path: Path
) -> None:
    def flip(name: str, content: bytes) -> bytes:
        if not name.endswith(".bin"):
            return content
        return content[:999] + bytes([content[999] ^ 4]) + content[1000:]

    damaged = repacked(compiled_fmu, tmp_path / "damaged.fmu", flip)
    for isolated in (False, True):
        with pytest.raises(FmuCallError, match="checksum is wrong"):
            FmiAsset(damaged, binding, isolated=isolated).step()


@pytest.mark.long
def test_fmpy_compiles_the_sources(
    compiled_fmu: Path, compiler: list[str], binding: Binding, tmp_path: Path
) -> None:
    """As a user of another platform does: the sources alone, through fmpy's own CMake project."""
    if shutil.which("cmake") is None and not (BIN / "cmake").exists():
        pytest.skip("cmake is not installed")
    path = tmp_path / "wing.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members(compiled_fmu).items():
            if not name.startswith("binaries/"):
                archive.writestr(name, content)
    words = [BIN / "fmpy", "compile", path, "--all-warnings", "--warning-as-error"]
    found = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=found)
    assert done.returncode == 0, done.stdout + done.stderr
    assert check_fmu(path).passed
    with FmiAsset(path, binding) as theirs, FmiAsset(compiled_fmu, binding) as ours:
        for z1 in (0.0, 0.5):
            seen = [asset.step({"load_factor": 3.0}, {"z1": z1}) for asset in (theirs, ours)]
            np.testing.assert_allclose(seen[0].values, seen[1].values, rtol=1e-12)


@pytest.mark.parametrize(
    ("fmi", "binary"), [pytest.param(2, "linux64", marks=pytest.mark.long), (3, "x86_64-linux")]
)
def test_cmake_builds_the_sources(
    model: ReducedModel, compiler: list[str], tmp_path: Path, fmi: Any, binary: str
) -> None:
    """As a user without fmpy does: the project among the sources puts the binary in its place."""
    cmake = shutil.which("cmake") or shutil.which("cmake", path=str(BIN))
    if cmake is None:
        pytest.skip("cmake is not installed")
    with zipfile.ZipFile(build_fmu(model, tmp_path / "wing.fmu", kind="source", fmi=fmi).path) as archive:
        archive.extractall(tmp_path / "wing")
    place = ["-S", tmp_path / "wing" / "sources", "-B", tmp_path / "build", "-DCMAKE_C_FLAGS=-O0 -Werror"]
    subprocess.run([cmake, *place, "-DCMAKE_BUILD_TYPE=Debug"], check=True, capture_output=True)
    subprocess.run([cmake, "--build", tmp_path / "build"], check=True, capture_output=True)
    identifier = read_model_description(str(tmp_path / "wing")).coSimulation.modelIdentifier
    assert [path.name for path in (tmp_path / "wing" / "binaries" / binary).iterdir()] == [f"{identifier}.so"]


def test_without_a_compiler_there_is_a_sentence(
    model: ReducedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(FmuBuildError, match=r"looked for: cc, gcc, clang\); install one .* --kind source"):
        build_fmu(model, tmp_path / "wing.fmu", kind="compiled")
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    with pytest.raises(FmuBuildError, match="looked for: CC=no-such-compiler -m64"):
        find_compiler()
    assert not (tmp_path / "wing.fmu").exists()


def test_a_compiler_that_fails_is_quoted(compiler: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FmuBuildError, match=r"failed with exit code 1.*(?s:.*)wing\.c:1"):
        compile_library({"wing.c": b"this is no C;\n"})
    monkeypatch.setenv("CC", shutil.which("true") or "true")
    with pytest.raises(FmuBuildError, match="failed with exit code 0"):
        compile_library({"wing.c": b"int wing;\n"})


def test_the_compiler_of_the_environment_is_taken(
    compiler: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", f"{compiler[0]} -DANSWER=fmi2_answer")
    assert find_compiler()[1:] == ["-DANSWER=fmi2_answer"]
    source = b'__attribute__((visibility("default"))) int ANSWER(void) { return 42; }\n'
    assert b"fmi2_answer" in compile_library({"answer.c": source})


def test_fmpy_simulates_on_the_command_line(compiled_fmu: Path, fmu: Path, tmp_path: Path) -> None:
    tables = []
    for path in (compiled_fmu, fmu):
        result = tmp_path / f"{path.parent.name}.csv"
        subprocess.run(
            [
                *(BIN / "fmpy", "simulate", path, "--stop-time", "1", "--output-interval", "0.01"),
                *("--output-file", result, "--start-values", "response", "2", "load_factor", "0"),
                *("initial_tip_displacement", "0.05"),
            ],
            check=True,
            capture_output=True,
        )
        tables.append(np.genfromtxt(result, delimiter=",", names=True, deletechars=""))
    for name in tables[0].dtype.names:
        scale = np.abs(tables[1][name]).max()
        np.testing.assert_allclose(tables[0][name], tables[1][name], rtol=0.0, atol=1e-12 * scale)


@pytest.mark.slow
def test_the_command_line_builds_each_kind(
    compiler: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(kind: str) -> subprocess.CompletedProcess[str]:
        return command("fmu", "build", "--kind", kind, "--out", tmp_path / f"{kind}.fmu")

    with monkeypatch.context() as patch:
        patch.setenv("CC", "no-such-compiler")
        refused = build("compiled")
    assert refused.returncode != 0
    assert "no-such-compiler" in " ".join(refused.stderr.split())
    assert not (tmp_path / "compiled.fmu").exists()
    for kind, platforms in (("compiled", {"linux64"}), ("source", set()), ("python", {"linux64", "win64"})):
        done = build(kind)
        assert done.returncode == 0, done.stderr
        names = members(tmp_path / f"{kind}.fmu")
        assert {name.split("/")[1] for name in names if name.startswith("binaries/")} == platforms
    assert build("fortran").returncode != 0


def test_fmpy_ends_a_simulation_at_a_refused_step(compiled_fmu: Path, fmu: Path) -> None:
    """In a process with a time limit: a host that is not told to end repeats the refused step for ever."""
    program = (
        "import sys, numpy as np; from fmpy import simulate_fmu\n"
        "course = np.array([(0.0, 1.0), (3.0, 99.0)], dtype=[('time', 'f8'), ('load_factor', 'f8')])\n"
        "seen = simulate_fmu(sys.argv[1], stop_time=5.0, step_size=1.0, output_interval=1.0, input=course,"
        " output=['strain[1]'])\n"
        "print(seen['time'].tolist())"
    )
    for path in (compiled_fmu, fmu):
        done = subprocess.run(
            [sys.executable, "-c", program, path], capture_output=True, text=True, timeout=60, check=True
        )
        assert done.stdout.splitlines()[-1] == "[0.0, 1.0, 1.0]"
        assert path == fmu or "load_factor = 33.6" in done.stdout
