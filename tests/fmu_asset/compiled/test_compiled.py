"""The compiled kind: its sources under warnings, sanitizers and other hosts; derivatives, model exchange."""

import ctypes
import importlib.util
import json
import os
import re
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import simulate_fmu
from scipy.linalg import expm

from fe.runtime.reduced import ReducedModel
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.compiled import package
from fmu_asset.compiled.compiler import CROSS_COMPILER
from fmu_asset.compiled.package import STATES as STATE_NAMES
from fmu_asset.compiled.package import data_file_bytes, pack_arrays
from fmu_asset.packing.structure_fmu import build_fmu
from tests.fmu_asset.making import DESCRIPTION, ROOT, members, run_python, tables
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave
from tests.test_documented_python import blocks

DRIVER, HOST = (Path(__file__).with_name(name) for name in ("driver.c", "host.c"))
REFUSED = tables(__file__)
USE_THE_WING = ROOT / "docs" / "how_to" / "use_the_wing_in.md"
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


@pytest.fixture(scope="module")
def windows_fmu(compiler, model, tmp_path_factory) -> Path:
    """The compiled wing with binaries for Linux and Windows; skips where nothing compiles the latter."""
    if shutil.which(CROSS_COMPILER) is None:
        pytest.skip(f"{CROSS_COMPILER} is not installed")
    path = tmp_path_factory.mktemp("windows") / "wing.fmu"
    return build_fmu(model, path, kind="compiled", platforms=("linux64", "win64")).path


@pytest.fixture(scope="module")
def wine(tmp_path_factory) -> Callable[..., str]:
    """Return what runs a program for Windows and returns what it prints; skips where wine is absent."""
    if shutil.which("wine") is None:
        pytest.skip("wine is not installed")
    prefix = tmp_path_factory.mktemp("wine")
    environment = {**os.environ, "WINEPREFIX": str(prefix), "WINEDEBUG": "-all", "LC_ALL": "C.UTF-8"}
    return lambda *words, **options: run_well(["wine", *words], timeout=120, env=environment, **options)


def test_the_windows_binary_needs_only_libraries_of_every_windows(
    windows_fmu, compiled_fmu, tmp_path
) -> None:
    assert members(windows_fmu)[DESCRIPTION] == members(compiled_fmu)[DESCRIPTION]
    shutil.unpack_archive(windows_fmu, tmp_path, "zip")
    binary = next((tmp_path / "binaries" / "win64").glob("*.dll"))
    told = run_well([CROSS_COMPILER.replace("gcc", "objdump"), "-p", binary]).splitlines()
    libraries = sorted(line.split()[-1].lower() for line in told if "DLL Name" in line)
    assert libraries == ["kernel32.dll", "msvcrt.dll"]


@pytest.mark.parametrize("folder_name", ["plain", "Flügel Ω 100%"])
def test_the_windows_binary_gives_the_same_under_wine(
    windows_fmu, compiler, wine, tmp_path, folder_name
) -> None:
    """To the last bit: statics, bound and modes; also from a folder with letters of other scripts."""
    folder = tmp_path / folder_name
    shutil.unpack_archive(windows_fmu, folder, "zip")
    host = folder / "host"
    for program, target, flags in ((compiler, host, ["-ldl"]), ([CROSS_COMPILER], f"{host}.exe", [])):
        subprocess.run([*program, f"-I{folder / 'sources'}", HOST, "-o", target, *flags], check=True)
    shared, dll = (
        str(next((folder / "binaries").glob(pattern)).relative_to(folder))
        for pattern in ("linux64/*.so", "win64/*.dll")
    )
    places = [str(place) for place in (*range(11, 37), *range(38, 51))]
    given = [read_fmu(windows_fmu).guid, (folder / "resources").as_uri(), "3", *places]
    on_linux = run_well([host, f"./{shared}", *given], cwd=folder).split()
    # By a relative path: loading the library is the host's work, and this host speaks no UTF-8.
    on_windows = wine("host.exe", dll, *given, cwd=folder).split()
    assert len(on_linux) == len(places)
    assert on_windows == on_linux


@pytest.mark.parametrize("kind", ["compiled", "python"])
def test_libcosim_flies_it_as_the_page_says(ours, model, kind, tmp_path) -> None:
    """In a process of its own: libcosim is native code with threads, and writes its log to the terminal."""
    if importlib.util.find_spec("libcosimpy") is None:
        pytest.skip("libcosimpy is not installed")
    (block,) = (text for text in blocks(USE_THE_WING, "python") if "libcosimpy" in text)
    shutil.copy(ours(kind), tmp_path / "wing.fmu")
    said = run_python(f"import os\nos.chdir({str(tmp_path)!r})\n{block}\nprint('SEEN', strain)")
    seen = json.loads(said.split("SEEN", 1)[1].splitlines()[0])
    expected = model.static_response({"load_factor": 3.0, "z1": 0.2}).strain
    np.testing.assert_allclose(seen, expected, rtol=1e-9)


# ---------------------------------------------------------------------- derivatives

STRAINS = [f"strain[{gauge}]" for gauge in range(1, 25)]
FREQUENCIES, RATIOS = ([f"{name}[{mode}]" for mode in range(1, 7)] for name in ("frequency", "damping_ratio"))
TIP, LOAD_POINT = "tip_displacement", "load_point_displacement"
STATIC = [*STRAINS, TIP, LOAD_POINT]
AT = {
    "young_modulus_factor": 1.05,
    "health.z1": 0.3,
    "health.z2": 0.55,
    "load_factor": 2.5,
    "tip_force": -7.0,
}
"""Where the derivatives are taken."""
PARAMETERS = {"mass.servo": 0.2, "mass.pitot": 0.1, "damping.alpha": 2.0, "damping.beta": 3e-4}


@pytest.fixture(params=["compiled", "fmi3"])
def wing(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    with closing(Slave(ours(request.param))) as made:
        yield made


def flown(wing: Slave, response: int = 1, **given: float) -> Slave:
    factor = AT["young_modulus_factor"]
    assert wing.start(response=response, anew=False, young_modulus_factor=factor, **given) == OK
    inputs = [AT[name] for name in ("load_factor", "health.z1", "health.z2", "tip_force")]
    assert wing.step(inputs, 0.0, 1.0) == OK
    return wing


def test_derivatives_are_the_slopes_of_the_outputs(wing) -> None:
    """By differences over four neighbours, which are of fourth order."""
    inputs, seen = ("load_factor", "health.z1", "health.z2", "tip_force"), [*STATIC, *FREQUENCIES, *RATIOS]
    kinds, at = np.split(np.arange(len(seen)), [24, 26, 32]), AT | PARAMETERS

    def shown(values: dict[str, float]) -> np.ndarray:
        given = {name.replace(".", "__"): values[name] for name in values.keys() - inputs}
        assert wing.start(**given) == OK
        assert wing.step([values[name] for name in inputs], 0.0, 1.0) == OK
        return np.array(wing.get(*seen))

    slopes = {}
    for name, value in at.items():
        around = [shown(at | {name: value * (1.0 + share)}) for share in (-2e-3, -1e-3, 1e-3, 2e-3)]
        slopes[name] = np.array([1.0, -8.0, 8.0, -1.0]) @ around / (12e-3 * value)
    level = np.abs(shown(at))
    for name, slope in slopes.items():
        told, rounding = wing.derivative(seen, {name: 1.0}), 1e-12 * level / abs(at[name])
        for own in kinds:  # strains, displacements, frequencies, damping ratios
            within = 1e-8 * np.abs(slope[own]).max() + rounding[own].max()
            np.testing.assert_allclose(told[own], slope[own], rtol=0, atol=within, err_msg=name)
    together = wing.derivative(seen, {"health.z1": 0.7, "load_factor": -0.2})
    parts = [wing.derivative(seen, {name: 1.0}) for name in ("health.z1", "load_factor")]
    np.testing.assert_allclose(together, np.array([0.7, -0.2]) @ parts, rtol=1e-12)
    wing.fmu.reset()
    flown(wing, response=2)
    assert wing.status_of(wing.derivative, STRAINS, {"health.z1": 1.0}) == DISCARD
    assert "is not offered in motion" in wing.log[-1][1]


def test_the_adjoint_is_the_transpose_and_what_cannot_be_is_refused_in_a_sentence(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:

        def status(unknown: str, known: str, size: int) -> int:
            places = [wing.reference[unknown]], [wing.reference[known]]
            return wing.status_of(wing.fmu.getDirectionalDerivative, *places, [1.0], size)

        assert status("strain[1]", "load_factor", 24) == ERROR
        assert "not initialised" in wing.log[-1][1]
        flown(wing)
        for unknown, known, size, sentence in REFUSED["derivatives"]:
            assert status(unknown, known, size) == DISCARD
            assert sentence in wing.log[-1][1]
        rng = np.random.default_rng(3)
        unknowns, knowns = (
            [wing.reference[name] for name in names]
            for names in (
                (LOAD_POINT, "strain[1]", "frequency[1]", TIP),
                ("health.z1", "load_factor", "young_modulus_factor", "mass.servo"),
            )
        )
        v, w = rng.normal(size=5), rng.normal(size=1 + 24 + 6 + 1)
        forward = wing.fmu.getDirectionalDerivative(unknowns, knowns, v, len(w))
        backward = wing.fmu.getAdjointDerivative(unknowns, knowns, w, len(v))
        assert w @ forward == pytest.approx(np.array(backward) @ v, rel=1e-12)


# ---------------------------------------------------------------------- model exchange

STATES = [f"{name}[{mode}]" for name in STATE_NAMES for mode in range(1, 7)]
RATES = [f"der({name})" for name in STATES]
COUNT = len(STATES)
START = {
    "damping__alpha": 1.5, "damping__beta": 3e-4, "initial_tip_displacement": 0.05, "health__z1": 0.3,
}  # fmt: skip
LOADS, SEEN = ["load_factor", "tip_force"], ["strain[1]", "strain[13]", TIP, LOAD_POINT]


@pytest.fixture(params=["exchange", "exchange3"])
def moving(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    """An instance in continuous time, damped and released."""
    with closing(Slave(ours(request.param))) as made:
        assert made.start(anew=False, response=None, **START) == OK
        made.fmu.newDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        yield made


def jacobian(moving: Slave) -> np.ndarray:
    """Return derivatives of rates and outputs by states and loads."""
    return np.array([moving.derivative([*RATES, *SEEN], {known: 1.0}) for known in [*STATES, *LOADS]]).T


def test_fmpy_moves_both_interfaces_alike(ours) -> None:
    """By CVODE as in co-simulation: loads jump and health grows on the way; compared where nothing jumps."""
    start = {"load_factor": 1.0, "initial_tip_displacement": 0.05, "damping.alpha": 1.0, "damping.beta": 1e-4}
    times, losses, factors = (0.0, 0.1, 0.1, 0.2, 0.2, 1.0), (0, 0, 0, 0, 0.4, 0.4), (1, 1, 2, 2, 2, 2)
    columns = [(name, float) for name in ("time", "health.z1", "load_factor")]
    course = np.array([*zip(times, losses, factors, strict=True)], dtype=columns)
    given = {"stop_time": 0.4, "output_interval": 0.005, "output": SEEN, "input": course}
    moving = {"start_values": start | {"response": 2}, "step_size": 0.005}
    compiled = simulate_fmu(ours("compiled"), **given, **moving)
    exchanged = simulate_fmu(ours("exchange"), **given, start_values=start, relative_tolerance=1e-10)
    smooth = ~np.isin(np.round(compiled["time"], 6), [0.1, 0.2])
    assert np.ptp(compiled["tip_displacement"]) > 0.05
    for name in SEEN:
        shown, largest = (
            np.interp(compiled["time"], exchanged["time"], exchanged[name]),
            np.abs(compiled[name]).max(),
        )
        np.testing.assert_allclose(shown[smooth], compiled[name][smooth], rtol=0, atol=1e-6 * largest)


def test_loads_in_straight_lines_are_those_of_the_linear_system(moving, ours) -> None:
    """The co-simulation FMU along ramps, against the matrix exponential of what model exchange gives."""
    matrix, time = jacobian(moving), 0.0
    x, load = np.array(moving.get(*STATES)), np.array(moving.get(*LOADS))
    with closing(Slave(ours("compiled"))) as slave:
        assert slave.start(response=2, **START) == OK
        places = [slave.reference[name] for name in LOADS]
        for size, slope in ((0.02, (40.0, -100.0)), (0.3, (-5.0, 20.0)), (0.1, (0.0, 0.0))):
            block = np.zeros((COUNT + 4, COUNT + 4))
            block[:COUNT, : COUNT + 2] = matrix[:COUNT]
            block[COUNT : COUNT + 2, COUNT + 2 :] = np.eye(2)
            x = (expm(block * size) @ [*x, *load, *slope])[:COUNT]
            slave.fmu.setRealInputDerivatives(
                (ctypes.c_uint * 2)(*places), (ctypes.c_int * 2)(1, 1), (ctypes.c_double * 2)(*slope)
            )
            kept, shown = slave.saved(), []
            for _ in range(2):  # the slopes are part of the state
                assert slave.restore(kept) == OK
                assert slave.status_of(slave.fmu.doStep, time, size) == OK
                shown.append(slave.everything())
            assert shown[0] == shown[1]
            time, load = time + size, load + size * np.array(slope)
            expected = matrix[COUNT:] @ [*x, *load]
            np.testing.assert_allclose(
                slave.get(*SEEN), expected, rtol=0, atol=1e-11 * np.abs(expected).max()
            )
            np.testing.assert_allclose(slave.get(*LOADS), load, rtol=1e-14)


def test_health_is_discrete_and_wrong_calls_are_refused(moving) -> None:
    before = moving.get(*STRAINS)
    assert moving.status_of(moving.derivative, RATES, {"health.z1": 1.0}) != OK  # it changes the modes
    assert moving.status_of(moving.set, {"health.z1": 0.5}) == DISCARD
    assert moving.status_of(moving.set, {"load_factor": 99.0}) == OK
    assert moving.status_of(moving.get, *STRAINS) == DISCARD  # out of range
    moving.set({"load_factor": 1.0})
    assert moving.get(*STRAINS) == before
    moving.fmu.enterEventMode()
    moving.set({"health.z1": 0.5})
    assert moving.fmu.newDiscreteStates()[3]
    moving.fmu.enterContinuousTimeMode()
    assert moving.get(*STRAINS) != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert moving.get("tip_displacement") != [0.0]
    moving.fmu.enterEventMode()
    assert not moving.fmu.newDiscreteStates()[3]
