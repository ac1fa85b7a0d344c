"""Our FMUs as files: sound, equal for equal input, guarded, refused in one sentence."""

import ctypes
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
from tests.fmu_asset.making import DESCRIPTION, HANGS, archive_of, members, run_python, tables
from tests.fmu_asset.ours import STRUCTURES

REFUSED = tables(__file__)
DECLARED = tables(__file__, "declared")
PROGRAMS = Path(sys.executable).parent
PUMP_SCRIPT = asset_scripts()["gear_pump"]
run = partial(subprocess.run, capture_output=True, text=True)

SCRIPTED = (*COMPANION_NAMES, *asset_scripts())
DESCRIBED = ["python", "source", "fmi3", "exchange", "exchange3", "sensing", *SCRIPTED]
"""FMUs with different model descriptions, which is all that the other tool reads."""
SOUND = [*DESCRIBED, "compiled", "beam", "compiled_beam", "source3_beam"]
EQUAL = ["python", "compiled", "source3_beam", "beam", "sensing", "patched", *SCRIPTED]


def find_program(program: str) -> str:
    """Return the path of a program, or skip."""
    path = shutil.which(program) or shutil.which(program, path=str(PROGRAMS))
    return path or pytest.skip(f"{program} is not installed")


def findings_of(path: Path):
    """Return what the checks of a file find."""
    inspection, *_ = inspect_fmu(path)
    return list(check_file(inspection))


def without_binaries(contents: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in contents.items() if not name.startswith("binaries/")}


# ---------------------------------------------------------------------- what holds of all


@pytest.mark.parametrize("name", SOUND)
def test_a_packed_fmu_is_sound(ours, name):
    """By `fmpy validate`, the rules of the standard and ours."""
    findings = findings_of(ours(name))

    passed = {finding.check for finding in findings if finding.verdict == "ok"}
    assert "problem" not in {finding.verdict for finding in findings}
    assert "fmpy validate" in passed
    assert name not in STRUCTURES or "content" in passed


@pytest.mark.parametrize(
    ("name", "binding", "cycles"),
    [("python", None, 0), ("compiled", None, 5), ("fmi3", BINDINGS["uav_wing_fmi3"], 5)],
)
def test_an_fmu_of_each_kind_flies_in_a_worker_without_a_word(ours, name, binding, cycles):
    check = check_fmu(ours(name), binding, cycles=cycles)

    assert {finding.verdict for finding in check.findings} == {"ok"}


@pytest.mark.long
def test_more_instances_in_one_process_than_python_had_room_for(fmu):
    assert check_fmu(fmu, cycles=1100).passed


@pytest.mark.parametrize("name", DESCRIBED)
def test_another_tool_has_no_complaint(ours, name, tmp_path):
    """The FMU manipulation toolbox."""
    environment = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}  # where it keeps its log
    version = 3 if "3" in name else 2

    done = run([find_program("fmutool"), "-input", ours(name), "-check"], env=environment)

    output = f"{done.stdout}{done.stderr}"
    assert done.returncode == 0
    assert f"seems to be compliant with FMI-{version}.0" in output
    assert_no_complaint(output)


def assert_no_complaint(output: str) -> None:
    assert "No semantic error" in output
    assert not re.search("ERROR|WARNING", output)


@pytest.mark.parametrize("name", EQUAL)
def test_equal_input_gives_equal_bytes(ours, name, tmp_path, monkeypatch):
    """Also in another folder."""
    expected = ours(name).read_bytes()  # skips without a C compiler, where one is needed
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    monkeypatch.setenv("TMPDIR", str(elsewhere))
    target = tmp_path / "again.fmu"

    if name in STRUCTURES:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no object code"))
        same_model = ReducedModel.from_bytes(ours.model(name).to_bytes())
        build_fmu(same_model, target, **ours.options(name))
    else:
        ours.write(name, target)

    assert target.read_bytes() == expected


BUILD_PROGRAM = """
import sys
from fe.runtime.reduced import ReducedModel
from fmu_asset.packing.structure_fmu import build_fmu
build_fmu(ReducedModel.load(sys.argv[1]), sys.argv[2])
"""


def test_the_environment_does_not_show_in_the_bytes(ours, model, tmp_path):
    (tmp_path / "model.npz").write_bytes(model.to_bytes())
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "LC_ALL": "C"}

    run_python(BUILD_PROGRAM, tmp_path / "model.npz", tmp_path / "other.fmu", env=environment)

    assert (tmp_path / "other.fmu").read_bytes() == ours("python").read_bytes()


@pytest.fixture
def stiffer(model, tmp_path):
    """The FMU of a model with more damping."""
    return build_fmu(replace(model, damping=2.0 * model.damping), tmp_path / "stiffer.fmu")


def test_another_model_or_state_has_another_identity(ours, model, stiffer, tmp_path):
    tailored = build_fmu(model, tmp_path / "e.fmu", state=DigitalState(young_modulus_factor=1.02))

    assert len({read_fmu(ours("python")).guid, stiffer.guid, tailored.guid}) == 3


def names_of_modules(path: Path) -> set[str]:
    return {name for name in members(path) if name.endswith(".py")}


def test_modules_of_two_fmus_have_names_of_their_own(ours, stiffer):
    """So that both can be loaded in one process."""
    assert not names_of_modules(ours("python")) & names_of_modules(stiffer.path)


def test_another_script_has_another_identity(ours, tmp_path):
    script = tmp_path / "gear_pump.py"
    text = PUMP_SCRIPT.read_text("utf-8")
    script.write_text(text.replace("AMBIENT = 40.0", "AMBIENT = 41.0"))

    built = build_script_fmu(script, tmp_path / "pump.fmu")

    assert built.guid != read_fmu(ours("gear_pump")).guid
    assert not list(tmp_path.glob("__pycache__"))


@pytest.mark.parametrize(
    ("kind", "ending", "old", "new"),
    [
        ("python", "design.json", b'_hash": "', b'_hash": "x'),
        ("python", "slavemodule.txt", b"", b"\xff"),
        ("compiled", "sources/structure_static.c", b"", b" "),
        ("compiled", "resources/reduced_model.bin", b"", b" "),
    ],
)
def test_a_changed_part_is_noticed(ours, kind, ending, old, new, tmp_path):
    """A text is exchanged, or one is appended."""
    contents = members(ours(kind))
    name = next(name for name in contents if name.endswith(ending))
    content = contents[name].replace(old, new) if old else contents[name] + new
    changed = archive_of(tmp_path / "changed.fmu", contents | {name: content})

    (text,) = (finding.text for finding in findings_of(changed) if finding.check == "content")

    assert text.endswith("the file was changed after its build.")


# ---------------------------------------------------------------------- what cannot be packed


@pytest.mark.parametrize(("name", "text", "sentence"), REFUSED["scripts"])
def test_a_script_that_is_no_slave_is_refused(tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)

    with pytest.raises(errors.FmuBuildError, match=sentence):
        build_script_fmu(tmp_path / name, tmp_path / "x.fmu")

    assert not (tmp_path / "x.fmu").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"state": DigitalState(young_modulus_factor=2.0)},
            r"start value .* of young_modulus_factor",
        ),
        ({"resources": {"a/b.json": b"x"}}, "cannot have the name"),
        *REFUSED["builds"],
    ],
)
def test_impossible_options_are_refused(model, tmp_path, options, sentence):
    with pytest.raises(errors.FmuBuildError, match=sentence):
        build_fmu(model, tmp_path / "x.fmu", **options)

    assert not (tmp_path / "x.fmu").exists()


def test_another_suffix_is_refused(model, tmp_path):
    with pytest.raises(errors.FmuBuildError, match=r"suffix \.fmu"):
        build_fmu(model, tmp_path / "wing.zip")


def test_an_fmu_is_not_overwritten(model, ours):
    with pytest.raises(errors.FmuBuildError, match="exists"):
        build_fmu(model, ours("python"))


def test_an_fmu_of_a_script_is_not_overwritten(ours):
    with pytest.raises(errors.FmuBuildError, match="exists"):
        build_script_fmu(PUMP_SCRIPT, ours("gear_pump"))


def test_a_missing_script_is_refused(tmp_path):
    with pytest.raises(errors.FmuBuildError, match="cannot be read"):
        build_script_fmu(tmp_path / "missing.py", tmp_path / "x.fmu")

    assert not (tmp_path / "x.fmu").exists()


# ---------------------------------------------------------------------- what is declared


@pytest.mark.parametrize(
    ("name", "variable"),
    [(name, variable) for name, variables in DECLARED.items() for variable in variables],
)
def test_variables_are_declared_as_listed(ours, name, variable):
    expected = DECLARED[name][variable]
    variables = {each.name: each for each in read_model_description(str(ours(name))).modelVariables}

    declared = {}
    for key, value in expected.items():
        attribute = getattr(variables[variable], key)
        declared[key] = float(attribute) if isinstance(value, float) else attribute

    assert declared == expected


@pytest.fixture(scope="module")
def python_description(ours):
    return read_model_description(str(ours("python")))


@pytest.fixture(scope="module")
def compiled_description(ours):
    return read_model_description(str(ours("compiled")))


VARIABLE_FACTS = attrgetter(
    "name", "valueReference", "type", "causality", "unit", "displayUnit", "min", "max", "start"
)


def test_the_compiled_fmu_declares_the_variables_of_the_one_in_python(
    python_description, compiled_description
):
    python_facts = [VARIABLE_FACTS(each) for each in python_description.modelVariables]
    compiled_facts = [VARIABLE_FACTS(each) for each in compiled_description.modelVariables]

    assert compiled_facts == python_facts


def test_names_of_variables_are_structured(python_description):
    assert python_description.variableNamingConvention == "structured"


def test_strains_can_be_shown_in_microstrain(python_description):
    units = {unit.name: unit for unit in python_description.unitDefinitions}
    factors = {unit.name: float(unit.factor) for unit in units["1"].displayUnits}

    assert factors["microstrain"] == 1e6


@pytest.mark.parametrize("kind", ["python_description", "compiled_description"])
def test_steps_may_vary_and_instances_may_be_many(request, kind):
    co_simulation = request.getfixturevalue(kind).coSimulation

    assert co_simulation.canHandleVariableCommunicationStepSize
    assert not co_simulation.canBeInstantiatedOnlyOncePerProcess


def test_the_compiled_fmu_lists_all_of_its_sources(ours, compiled_description):
    (configuration,) = compiled_description.buildConfigurations
    (sources,) = configuration.sourceFileSets

    c_files = [name for name in members(ours("compiled")) if name.endswith(".c")]

    assert set(sources.sourceFiles) == {name.removeprefix("sources/") for name in c_files}


@pytest.mark.parametrize("name", ["strain", "health"])
def test_fmi_3_declares_arrays(ours, name):
    description = members(ours("source3_beam"))[DESCRIPTION].decode()

    assert f'<Float64 name="{name}" ' in description


def test_a_structure_of_the_wings_name_is_no_wing(ours):
    model = ours.model("beam")

    table, roles = structure_table(replace(model, name=WING_MODEL_NAME), {})

    expected_table, _ = structure_table(model, {})
    assert roles.displacement_bound == "displacement_error_bound"
    assert [row.name for row in table] == [row.name for row in expected_table]


NOTE = 'Calibrated for "Wing <7> & é".'
FURTHER_FILE = b'{"asset": "Wing <7>"}\n'


@pytest.fixture(scope="module")
def noted_fmu(model, tmp_path_factory):
    """An FMU with a note and a further file."""
    path = tmp_path_factory.mktemp("noted") / "a.fmu"
    return build_fmu(model, path, note=NOTE, resources={"calibration.json": FURTHER_FILE}).path


def test_an_fmu_with_a_note_and_a_further_file_is_sound(noted_fmu):
    assert {finding.verdict for finding in findings_of(noted_fmu)} == {"ok"}


def test_a_note_stands_in_the_description_and_in_the_documentation(noted_fmu):
    documentation = members(noted_fmu)["documentation/index.html"].decode()

    assert read_model_description(str(noted_fmu)).description.endswith(NOTE)
    assert "Wing &lt;7&gt; &amp; é" in documentation


def test_a_further_file_lies_in_the_resources(noted_fmu):
    assert members(noted_fmu)["resources/calibration.json"] == FURTHER_FILE


def test_an_fmu_with_a_note_has_another_identity(noted_fmu, python_description):
    assert read_model_description(str(noted_fmu)).guid != python_description.guid


# ---------------------------------------------------------------------- the kind in Python

RUN_ALONE = """
name = open("resources/slavemodule.txt").read()
Wing = getattr(__import__(name), "Structure_" + name.rpartition("_")[2])
wing = Wing(instance_name="a", resources="resources")
wing.enter_initialization_mode(); wing.exit_initialization_mode()
assert wing.do_step(0.0, 1.0) is True, wing.log_queue
assert wing.get_real([12])[0] != 0.0
"""
IMPORT_OF_PROJECT = re.compile(rb"^\s*(?:from|import) (?:fe|fmu_asset|reporting)\b", re.MULTILINE)


@pytest.mark.parametrize("name", ["python", "sensing", "patched"])
def test_an_fmu_in_python_imports_nothing_of_the_project(ours, name):
    contents = members(ours(name))

    importing = [
        entry
        for entry, text in contents.items()
        if entry.endswith(".py") and IMPORT_OF_PROJECT.search(text)
    ]

    assert importing == []


def test_an_fmu_in_python_needs_numpy_alone(ours, tmp_path):
    """Its code runs where there is nothing of the project and no other package."""
    shutil.unpack_archive(ours("python"), tmp_path, "zip")
    for folder in Path(np.__file__).parents[1].glob("numpy*"):
        (tmp_path / "resources" / folder.name).symlink_to(folder)
    environment = {"PYTHONPATH": str(tmp_path / "resources")}

    done = run([sys.executable, "-S", "-c", RUN_ALONE], cwd=tmp_path, env=environment)

    assert done.returncode == 0, done.stderr


def test_an_fmu_in_python_has_binaries_of_two_platforms(ours):
    binaries = [name for name in members(ours("python")) if name.startswith("binaries/")]

    assert {Path(name).parts[1] for name in binaries} == {"linux64", "win64"}


# ---------------------------------------------------------------------- the compiled kind


@pytest.fixture(scope="module")
def source_fmu(model, tmp_path_factory):
    """The FMU of sources alone, which is packed without a compiler."""
    folder = tmp_path_factory.mktemp("source")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(folder))
        return build_fmu(model, folder / "source.fmu", kind="source")


def test_the_sources_alone_are_the_compiled_fmu_without_its_binary(ours, source_fmu):
    compiled = members(ours("compiled"))
    sources = members(source_fmu.path)

    assert sources == without_binaries(compiled)
    assert len(compiled) == len(sources) + 1


def test_the_sources_alone_have_the_identity_of_the_compiled_fmu(source_fmu, compiled_description):
    assert source_fmu.guid == compiled_description.guid


def test_the_sources_alone_cannot_be_flown(source_fmu):
    with pytest.raises(errors.FmuUnsupportedError, match="no binary for this platform"):
        FmiAsset(source_fmu.path, WING_BINDING)


def test_the_compiled_fmu_has_the_hash_of_its_design(ours, model):
    design = json.loads(members(ours("compiled"))["resources/design.json"])

    assert design == {"design_hash": model.design_hash}


@pytest.mark.long
def test_fmpy_compiles_the_sources(ours, tmp_path):
    """As a user of another platform does: the sources alone, through fmpy's own CMake project."""
    find_program("cmake")
    path = archive_of(tmp_path / "wing.fmu", without_binaries(members(ours("compiled"))))
    search_path = f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}"

    run(
        [PROGRAMS / "fmpy", "compile", path, "--all-warnings", "--warning-as-error"],
        check=True,
        env={**os.environ, "PATH": search_path},
    )

    assert check_fmu(path).passed
    with FmiAsset(path, WING_BINDING) as theirs, FmiAsset(ours("compiled"), WING_BINDING) as mine:
        for z1 in (0.0, 0.5):
            their_step = theirs.step({"load_factor": 3.0}, {"z1": z1})
            my_step = mine.step({"load_factor": 3.0}, {"z1": z1})
            np.testing.assert_allclose(their_step.values, my_step.values, rtol=1e-12)


def test_cmake_builds_the_sources(model, compiler, tmp_path):
    """As on another platform: the project among the sources puts the binary in its place."""
    cmake = find_program("cmake")
    wing = tmp_path / "wing"
    build_folder = tmp_path / "build"
    packed = build_fmu(model, tmp_path / "wing.fmu", kind="source", fmi=3)
    shutil.unpack_archive(packed.path, wing, "zip")

    folders = ["-S", wing / "sources", "-B", build_folder]
    flags = ["-DCMAKE_C_FLAGS=-O0 -Werror", "-DCMAKE_BUILD_TYPE=Debug"]
    run([cmake, *folders, *flags], check=True)
    run([cmake, "--build", build_folder], check=True)

    identifier = read_model_description(str(wing)).coSimulation.modelIdentifier
    binaries = [path.name for path in (wing / "binaries" / "x86_64-linux").iterdir()]
    assert binaries == [f"{identifier}.so"]


# ---------------------------------------------------------------------- compilers


def test_an_error_of_the_compiler_is_shown_with_its_line(compiler):
    with pytest.raises(errors.FmuBuildError, match=r"failed with exit code 1.*(?s:.*)wing\.c:1"):
        compile_library({"wing.c": b"this is not a C;\n"})


def test_a_compiler_is_chosen_with_its_options(compiler, monkeypatch):
    monkeypatch.setenv("CC", f"{compiler[0]} -DANSWER=fmi2_answer")
    source = b'__attribute__((visibility("default"))) int ANSWER(void) { return 42; }\n'

    assert find_compiler()[1:] == ["-DANSWER=fmi2_answer"]
    assert b"fmi2_answer" in compile_library({"answer.c": source})


def test_a_compiler_that_writes_nothing_has_failed(compiler, monkeypatch):
    monkeypatch.setenv("CC", shutil.which("true") or "true")

    with pytest.raises(errors.FmuBuildError, match="failed with exit code 0"):
        compile_library({"wing.c": b"int wing;\n"})


def test_object_code_that_fmus_share_is_compiled_once(compiler, tmp_path, monkeypatch):
    """Until the compiler's options or one of its files changes, and of the same bytes."""
    calls = tmp_path / "calls"
    program = tmp_path / "cc"
    program.write_text(
        f'#!/bin/sh\necho "$*" >> "{calls}"\nexec {compiler[0]} "$@"\n', encoding="utf-8"
    )
    program.chmod(0o755)
    monkeypatch.setenv("CC", str(program))
    exported = '__attribute__((visibility("default")))'

    def answer_and_whether_compiled(
        cache: str, own: int, shared: int = 40
    ) -> tuple[bytes, int, bool]:
        texts = {
            "shared.c": '#include "shared.h"\nint shared(void) { return SHARED; }\n',
            "shared.h": f"#define SHARED {shared}\nint shared(void);\n",
            "caller.c": f'#include "caller.h"\n{exported} int answer(void) {{ return OWN; }}\n',
            "caller.h": '#include "shared.h"\n#include "own.h"\n',
            "own.h": f"#define OWN (shared() + {own})\n",
        }
        sources = {name: text.encode() for name, text in texts.items()}
        calls.write_text("", encoding="utf-8")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / cache))
        library = compile_library(sources, generated=["own.h"])
        file = tmp_path / f"{cache}-{own}-{shared}.so"
        file.write_bytes(library)
        compiled = "shared.c" in calls.read_text("utf-8")
        assert "caller.c" in calls.read_text("utf-8")
        return library, ctypes.CDLL(str(file)).answer(), compiled

    library, *first = answer_and_whether_compiled("cache", 2)
    assert first == [42, True]
    assert answer_and_whether_compiled("cache", 3)[1:] == (43, False)
    assert answer_and_whether_compiled("cache", 2, shared=50)[1:] == (52, True)
    monkeypatch.setenv("CC", f"{program} -DOTHER")
    assert answer_and_whether_compiled("cache", 4)[1:] == (44, True)
    monkeypatch.setenv("CC", str(program))
    assert answer_and_whether_compiled("another cache", 2) == (library, 42, True)


def test_a_chosen_compiler_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler -m64")

    with pytest.raises(errors.FmuBuildError, match="looked for: CC=no-such-compiler -m64"):
        find_compiler()


def test_without_a_compiler_the_sources_can_be_packed(model, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    sentence = r"looked for: cc, gcc, clang\); install one .* --kind source"

    with pytest.raises(errors.FmuBuildError, match=sentence):
        build_fmu(model, tmp_path / "wing.fmu", kind="compiled")

    assert not (tmp_path / "wing.fmu").exists()


# ---------------------------------------------------------------------- another host

SIMULATE_WITH_REFUSED_STEP = """
import sys
import numpy as np
from fmpy import simulate_fmu

types = [("time", "f8"), ("load_factor", "f8")]
load_factor = np.array([(0.0, 1.0), (3.0, 99.0)], dtype=types)
result = simulate_fmu(
    sys.argv[1], stop_time=5.0, step_size=1.0, output_interval=1.0, input=load_factor,
    output=["strain[1]"],
)
print(result["time"].tolist())
"""


@pytest.mark.parametrize("kind", ["compiled", "python"])
def test_fmpy_ends_a_simulation_at_a_refused_step(ours, kind):
    """In a process with a time limit.

    A host that is not told to end repeats the refused step for ever.
    """
    output = run_python(SIMULATE_WITH_REFUSED_STEP, ours(kind), timeout=HANGS)

    assert output.splitlines()[-1] == "[0.0, 1.0, 1.0]"
    assert kind == "python" or "load_factor = 33.6" in output
