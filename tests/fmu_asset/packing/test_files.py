"""Our FMUs as files, whatever is packed: sound, equal for equal input, guarded, refused in one sentence."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import WING_MODEL_NAME, DigitalState
from fmu_asset import errors
from fmu_asset.archive.fmu_file import inspect_fmu, read_fmu
from fmu_asset.checks.file_checks import check_file
from fmu_asset.checks.fmu_check import check_fmu
from fmu_asset.client.session import FmiAsset
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.compiled.compiler import compile_library, find_compiler
from fmu_asset.packing.script import build_script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.table import structure_table
from scenarios import asset_scripts
from tests.fmu_asset.client.kinds import BINDINGS, WING_BINDING
from tests.fmu_asset.making import DESCRIPTION, archive_of, members, run_python, tables
from tests.fmu_asset.ours import STRUCTURES

REFUSED, DECLARED = tables(__file__), tables(__file__, "declared")
BIN = Path(sys.executable).parent
PUMP = asset_scripts()["gear_pump"]
run = partial(subprocess.run, capture_output=True, text=True)
FURTHER = (*COMPANION_NAMES, *asset_scripts())
TOLD = ["python", "source", "fmi3", "exchange", "exchange3", "sensing", *FURTHER]
"""Of different model descriptions, which is all that the other tool reads."""
SOUND = [*TOLD, "compiled", "beam", "compiled_beam", "source3_beam"]
EQUAL = ["python", "compiled", "source3_beam", "beam", "sensing", "patched", *FURTHER]


def installed(program: str) -> str:
    """Return the path of a program, or skip."""
    path = shutil.which(program) or shutil.which(program, path=str(BIN))
    return path or pytest.skip(f"{program} is not installed")


# ---------------------------------------------------------------------- what holds of all


@pytest.mark.parametrize("name", SOUND)
def test_a_packed_fmu_is_sound(ours, name) -> None:
    """`fmpy validate`, the standard's rules and ours; of each kind one flies in a worker, without a word."""
    found = [*check_file(inspect_fmu(ours(name))[0])]
    if name in ("python", "compiled", "fmi3"):
        binding = BINDINGS["uav_wing_fmi3"] if name == "fmi3" else None
        check = check_fmu(ours(name), binding, cycles=5 if name != "python" else 0)
        assert {finding.verdict for finding in check.findings} == {"ok"}
    assert "problem" not in {finding.verdict for finding in found}
    checks = {finding.check for finding in found if finding.verdict == "ok"}
    assert "fmpy validate" in checks
    assert name not in STRUCTURES or "content" in checks


@pytest.mark.long
def test_more_instances_in_one_process_than_python_had_room_for(fmu) -> None:
    assert check_fmu(fmu, cycles=1100).passed


@pytest.mark.parametrize("name", TOLD)
def test_another_tool_has_no_complaint(ours, name, tmp_path) -> None:
    """The FMU manipulation toolbox."""
    environment = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}  # where it keeps its log
    done = run([installed("fmutool"), "-input", ours(name), "-check"], env=environment)
    said = f"{done.stdout}{done.stderr}"
    assert done.returncode == 0
    assert f"seems to be compliant with FMI-{3 if '3' in name else 2}.0" in said
    assert "No semantic error" in said
    assert not re.search("ERROR|WARNING", said)


@pytest.mark.parametrize("name", EQUAL)
def test_equal_input_gives_equal_bytes(ours, name, tmp_path, monkeypatch) -> None:
    """Also in another folder."""
    expected = ours(name).read_bytes()  # skips without a C compiler, where one is needed
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    monkeypatch.setenv("TMPDIR", str(elsewhere))
    if name in STRUCTURES:
        again = build_fmu(
            ReducedModel.from_bytes(ours.model(name).to_bytes()), tmp_path / "again.fmu", **ours.options(name)
        ).path
    else:
        again = ours.write(name, tmp_path / "again.fmu")
    assert again.read_bytes() == expected


def test_the_environment_does_not_show_and_other_content_does(ours, model, tmp_path) -> None:
    fmu = ours("python")
    (tmp_path / "model.npz").write_bytes(model.to_bytes())
    program = (
        "import sys; from fe.runtime.reduced import ReducedModel; "
        "from fmu_asset.packing.structure_fmu import build_fmu; "
        "build_fmu(ReducedModel.load(sys.argv[1]), sys.argv[2])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "LC_ALL": "C"}
    run_python(program, tmp_path / "model.npz", tmp_path / "other.fmu", env=environment)
    assert (tmp_path / "other.fmu").read_bytes() == fmu.read_bytes()
    stiffer = build_fmu(replace(model, damping=2.0 * model.damping), tmp_path / "stiffer.fmu")
    tailored = build_fmu(model, tmp_path / "e.fmu", state=DigitalState(young_modulus_factor=1.02))
    assert len({read_fmu(fmu).guid, stiffer.guid, tailored.guid}) == 3
    modules = [{name for name in members(path) if name.endswith(".py")} for path in (fmu, stiffer.path)]
    assert not modules[0] & modules[1]
    script = tmp_path / "gear_pump.py"
    script.write_text(PUMP.read_text("utf-8").replace("AMBIENT = 40.0", "AMBIENT = 41.0"))
    assert build_script_fmu(script, tmp_path / "pump.fmu").guid != read_fmu(ours("gear_pump")).guid
    assert not list(tmp_path.glob("__pycache__"))


CHANGED = {
    "python": [("design.json", b'_hash": "', b'_hash": "x'), ("slavemodule.txt", b"", b"\xff")],
    "compiled": [("sources/structure_static.c", b"", b" "), ("resources/reduced_model.bin", b"", b" ")],
}


@pytest.mark.parametrize("kind", CHANGED)
def test_a_changed_part_is_noticed(ours, kind, tmp_path) -> None:
    contents = members(ours(kind))
    for entry, old, new in CHANGED[kind]:
        name = next(name for name in contents if name.endswith(entry))
        content = contents[name].replace(old, new) if old else contents[name] + new
        changed = archive_of(tmp_path / "changed.fmu", contents | {name: content})
        findings = check_file(inspect_fmu(changed)[0])
        (said,) = (finding.text for finding in findings if finding.check == "content")
        assert said.endswith("the file was changed after its build."), entry


def test_what_cannot_be_packed_is_one_sentence(model, ours, tmp_path) -> None:
    target, state = tmp_path / "x.fmu", DigitalState(young_modulus_factor=2.0)
    for name, text, words in REFUSED["scripts"]:
        (tmp_path / name).write_text(text)
        with pytest.raises(errors.FmuBuildError, match=words):
            build_script_fmu(tmp_path / name, target)
    for options, words in (
        ({"state": state}, r"start value .* of young_modulus_factor"),
        ({"resources": {"a/b.json": b"x"}}, "cannot have the name"),
        *REFUSED["builds"],
    ):
        with pytest.raises(errors.FmuBuildError, match=words):
            build_fmu(model, target, **options)
    for build, source, path, words in (
        (build_fmu, model, tmp_path / "wing.zip", r"suffix \.fmu"),
        (build_fmu, model, ours("python"), "exists"),
        (build_script_fmu, PUMP, ours("gear_pump"), "exists"),
        (build_script_fmu, tmp_path / "missing.py", target, "cannot be read"),
    ):
        with pytest.raises(errors.FmuBuildError, match=words):
            build(source, path)
    assert not target.exists()


# ---------------------------------------------------------------------- what is declared


@pytest.mark.parametrize("name", DECLARED)
def test_what_is_declared_of_variables(ours, name) -> None:
    variables = {each.name: each for each in read_model_description(str(ours(name))).modelVariables}
    for variable, told in DECLARED[name].items():
        seen = {key: getattr(variables[variable], key) for key in told}
        assert told == {k: float(v) if isinstance(told[k], float) else v for k, v in seen.items()}


def test_the_compiled_one_declares_the_same_and_all_of_its_sources(ours) -> None:
    description, compiled = (read_model_description(str(ours(name))) for name in ("python", "compiled"))
    assert description.variableNamingConvention == "structured"
    factors = {u.name: {d.name: float(d.factor) for d in u.displayUnits} for u in description.unitDefinitions}
    assert factors["1"]["microstrain"] == 1e6
    told = "name", "valueReference", "type", "causality", "unit", "displayUnit", "min", "max", "start"
    facts = [[*map(attrgetter(*told), each.modelVariables)] for each in (description, compiled)]
    assert facts[0] == facts[1]
    for each in (description, compiled):
        assert each.coSimulation.canHandleVariableCommunicationStepSize
        assert not each.coSimulation.canBeInstantiatedOnlyOncePerProcess
    listed = set(compiled.buildConfigurations[0].sourceFileSets[0].sourceFiles)
    assert listed == {n.removeprefix("sources/") for n in members(ours("compiled")) if n.endswith(".c")}
    text = members(ours("source3_beam"))[DESCRIPTION].decode()
    assert all(f'<Float64 name="{name}" ' in text for name in ("strain", "health"))


def test_a_structure_of_the_wings_name_is_no_wing(ours) -> None:
    model = ours.model("beam")
    table, roles = structure_table(replace(model, name=WING_MODEL_NAME), {})
    assert roles.displacement_bound == "displacement_error_bound"
    assert [row.name for row in table] == [row.name for row in structure_table(model, {})[0]]


def test_a_note_and_a_further_file(model, fmu, tmp_path) -> None:
    note, content = 'Calibrated for "Wing <7> & é".', b'{"asset": "Wing <7>"}\n'
    path = build_fmu(model, tmp_path / "a.fmu", note=note, resources={"calibration.json": content}).path
    assert {finding.verdict for finding in check_file(inspect_fmu(path)[0])} == {"ok"}
    described, inside = read_model_description(str(path)), members(path)
    assert described.description.endswith(note)
    assert described.guid != read_model_description(str(fmu)).guid
    assert inside["resources/calibration.json"] == content
    assert "Wing &lt;7&gt; &amp; é" in inside["documentation/index.html"].decode()


# ---------------------------------------------------------------------- the kind in Python


ALONE = """
name = open("resources/slavemodule.txt").read()
Wing = getattr(__import__(name), "Structure_" + name.rpartition("_")[2])
wing = Wing(instance_name="a", resources="resources")
wing.enter_initialization_mode(); wing.exit_initialization_mode()
assert wing.do_step(0.0, 1.0) is True, wing.log_queue
assert wing.get_real([12])[0] != 0.0
"""


def test_it_needs_numpy_alone(ours, tmp_path) -> None:
    """The runtime loads where there is nothing of the project and no other package."""
    project = re.compile(rb"^\s*(?:from|import) (?:fe|fmu_asset|reporting)\b", re.MULTILINE)
    for name in ("python", "sensing", "patched"):
        texts = {entry: text for entry, text in members(ours(name)).items() if entry.endswith(".py")}
        assert not [entry for entry, text in texts.items() if project.search(text)]
    shutil.unpack_archive(ours("python"), tmp_path, "zip")
    assert {path.name for path in (tmp_path / "binaries").iterdir()} == {"linux64", "win64"}
    for folder in Path(np.__file__).parents[1].glob("numpy*"):
        (tmp_path / "resources" / folder.name).symlink_to(folder)
    environment = {"PYTHONPATH": str(tmp_path / "resources")}
    done = run([sys.executable, "-S", "-c", ALONE], cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------------- the compiled kind


def test_the_sources_alone_are_the_same_fmu_without_a_binary(ours, model, tmp_path, monkeypatch) -> None:
    whole = members(ours("compiled"))
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))  # needs no compiler
        sources = build_fmu(model, tmp_path / "source.fmu", kind="source")
    assert sources.guid == read_model_description(str(ours("compiled"))).guid
    assert members(sources.path) == {n: c for n, c in whole.items() if not n.startswith("binaries/")}
    assert len(whole) == len(members(sources.path)) + 1
    assert json.loads(whole["resources/design.json"]) == {"design_hash": model.design_hash}
    with pytest.raises(errors.FmuUnsupportedError, match="no binary for this platform"):
        FmiAsset(sources.path, WING_BINDING)


@pytest.mark.long
def test_fmpy_compiles_the_sources(ours, tmp_path) -> None:
    """As a user of another platform does: the sources alone, through fmpy's own CMake project."""
    installed("cmake")
    kept = {n: c for n, c in members(ours("compiled")).items() if not n.startswith("binaries/")}
    path = archive_of(tmp_path / "wing.fmu", kept)
    words = [BIN / "fmpy", "compile", path, "--all-warnings", "--warning-as-error"]
    run(words, check=True, env={**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"})
    assert check_fmu(path).passed
    with FmiAsset(path, WING_BINDING) as theirs, FmiAsset(ours("compiled"), WING_BINDING) as mine:
        for z1 in (0.0, 0.5):
            seen = [asset.step({"load_factor": 3.0}, {"z1": z1}) for asset in (theirs, mine)]
            np.testing.assert_allclose(seen[0].values, seen[1].values, rtol=1e-12)


def test_cmake_builds_the_sources(model, compiler, tmp_path) -> None:
    """As on another platform: the project among the sources puts the binary in its place."""
    cmake, wing = installed("cmake"), tmp_path / "wing"
    shutil.unpack_archive(build_fmu(model, tmp_path / "wing.fmu", kind="source", fmi=3).path, wing, "zip")
    place = ["-S", wing / "sources", "-B", tmp_path / "build", "-DCMAKE_C_FLAGS=-O0 -Werror"]
    for words in ([*place, "-DCMAKE_BUILD_TYPE=Debug"], ["--build", tmp_path / "build"]):
        run([cmake, *words], check=True)
    identifier = read_model_description(str(wing)).coSimulation.modelIdentifier
    assert [path.name for path in (wing / "binaries" / "x86_64-linux").iterdir()] == [f"{identifier}.so"]


def test_compilers_that_are_not_there_fail_or_are_chosen(compiler, model, tmp_path, monkeypatch) -> None:
    with pytest.raises(errors.FmuBuildError, match=r"failed with exit code 1.*(?s:.*)wing\.c:1"):
        compile_library({"wing.c": b"this is no C;\n"})
    monkeypatch.setenv("CC", f"{compiler[0]} -DANSWER=fmi2_answer")
    assert find_compiler()[1:] == ["-DANSWER=fmi2_answer"]
    source = b'__attribute__((visibility("default"))) int ANSWER(void) { return 42; }\n'
    assert b"fmi2_answer" in compile_library({"answer.c": source})
    monkeypatch.setenv("CC", shutil.which("true") or "true")
    with pytest.raises(errors.FmuBuildError, match="failed with exit code 0"):
        compile_library({"wing.c": b"int wing;\n"})
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    with pytest.raises(errors.FmuBuildError, match="looked for: CC=no-such-compiler -m64"):
        find_compiler()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC")
    words = r"looked for: cc, gcc, clang\); install one .* --kind source"
    with pytest.raises(errors.FmuBuildError, match=words):
        build_fmu(model, tmp_path / "wing.fmu", kind="compiled")
    assert not (tmp_path / "wing.fmu").exists()


# ---------------------------------------------------------------------- another host


@pytest.mark.parametrize("kind", ["compiled", "python"])
def test_fmpy_ends_a_simulation_at_a_refused_step(ours, kind) -> None:
    """In a process with a time limit: a host that is not told to end repeats the refused step for ever."""
    program = (
        "import sys, numpy as np; from fmpy import simulate_fmu\n"
        "course = np.array([(0.0, 1.0), (3.0, 99.0)], dtype=[('time', 'f8'), ('load_factor', 'f8')])\n"
        "seen = simulate_fmu(sys.argv[1], stop_time=5.0, step_size=1.0, output_interval=1.0, input=course,"
        " output=['strain[1]'])\n"
        "print(seen['time'].tolist())"
    )
    said = run_python(program, ours(kind), timeout=60)
    assert said.splitlines()[-1] == "[0.0, 1.0, 1.0]"
    assert kind == "python" or "load_factor = 33.6" in said
