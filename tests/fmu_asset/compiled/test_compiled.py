"""The compiled kind: its sources under warnings and sanitizers, and in other hosts."""

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
from fmu_asset.compiled.package import data_file_bytes, pack_arrays
from tests.fmu_asset.making import ROOT, members, run_python, run_well, tables
from tests.test_documented_python import blocks

DRIVER = Path(__file__).with_name("driver.c")
HOST = Path(__file__).with_name("host.c")
REFUSED = tables(__file__)
USE_THE_WING = ROOT / "docs" / "how_to" / "use_the_wing_in.md"
WARNINGS = (
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wshadow",
    "-Wcast-qual",
    "-Wstrict-prototypes",
    "-Werror",
)


@pytest.fixture(scope="module")
def extracted(compiled_fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the extracted compiled FMU."""
    folder = tmp_path_factory.mktemp("sources")
    shutil.unpack_archive(compiled_fmu, folder, "zip")
    return folder


def compile_driver(
    compiler: list[str], folder: Path, target: Path, *flags: str
) -> subprocess.CompletedProcess[str]:
    """Compile the sources of an extracted FMU together with a driver that calls them."""
    sources = sorted((folder / "sources").glob("*.c"))
    include = f"-I{folder / 'sources'}"
    words = [*compiler, "-std=c11", *flags, include, *sources, DRIVER, "-o", target, "-lm"]
    return subprocess.run(words, capture_output=True, text=True, check=False)


# ---------------------------------------------------------------------- warnings and sanitizers


@pytest.mark.parametrize("name", ["compiled", "fmi3", "exchange", "exchange3"])
def test_the_sources_are_clean(compiler, ours, name, tmp_path):
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    sources = sorted((tmp_path / "sources").glob("*.c"))
    # The headers of FMI 3.0 have functions without prototypes.
    exceptions = ["-Wno-strict-prototypes"] if "3" in name else []

    words = [*compiler, "-std=c11", *WARNINGS, *exceptions, "-fsyntax-only", *sources]
    subprocess.run(words, check=True)


def with_checksum(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def damaged_bytes(content: bytes) -> dict[str, bytes]:
    """Return data files whose bytes were changed, most of them with a right checksum."""
    body = content[:-4]
    files = {
        "empty": b"",
        "short": content[:20],
        "flipped": content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
        "longer": with_checksum(body + b"\0" * 8),
    }
    for name, position, form, value in REFUSED["places"]:
        piece = struct.pack(form, value if isinstance(value, int) else value.encode())
        files[name] = with_checksum(body[:position] + piece + body[position + len(piece) :])
    for length in range(16, len(body), len(body) // 40):
        files[f"cut_{length}"] = with_checksum(body[:length])
    return files


def damaged_arrays(arrays: dict[str, Any]) -> dict[str, bytes]:
    """Return data files with arrays that are wrong or missing, and a right checksum."""
    files = {}
    for name, array, value in REFUSED["arrays"]:
        files[name] = pack_arrays(arrays | {array: np.array(value)})
    for name, array, value, shape in REFUSED["filled"]:
        files[name] = pack_arrays(arrays | {array: np.full(shape, value)})
    fewer_gauges = arrays["static_output"][:-1]
    files["gauges"] = pack_arrays(arrays | {"static_output": fewer_gauges})
    files["nan"] = pack_arrays(arrays | {"static_load": np.nan * arrays["static_load"]})
    for name in arrays:
        others = {key: array for key, array in arrays.items() if key != name}
        files[f"without_{name}"] = pack_arrays(others)
    return files


def damaged_files(model: ReducedModel, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Return data files of a model that are wrong, by name."""
    with monkeypatch.context() as patch:
        patch.setattr(package, "pack_arrays", dict)
        arrays: dict[str, Any] = data_file_bytes(model)  # type: ignore[assignment]
    return damaged_bytes(data_file_bytes(model)) | damaged_arrays(arrays)


@pytest.fixture
def sanitized_driver(compiler, extracted, tmp_path) -> Path:
    """The driver, which ends with an error at the first fault of memory or undefined behaviour."""
    driver = tmp_path / "driver"
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    done = compile_driver(compiler, extracted, driver, *flags)
    if done.returncode != 0 and ("sanitize" in done.stderr or "asan" in done.stderr):
        pytest.skip(f"{compiler[0]} has no sanitizers: {done.stderr.splitlines()[0]}")
    assert done.returncode == 0, done.stderr
    return driver


def test_driven_in_c_under_sanitizers(sanitized_driver, extracted, model, tmp_path, monkeypatch):
    """Every FMI function, garbage as states, damaged files."""
    folders = []
    for name, content in damaged_files(model, monkeypatch).items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "reduced_model.bin").write_bytes(content)
        folders.append(folder.as_uri())
    sanitizer_options = "detect_leaks=1:allocator_may_return_null=1"

    run_well(
        [sanitized_driver, (extracted / "resources").as_uri(), *folders],
        env={**os.environ, "ASAN_OPTIONS": sanitizer_options},
    )


@pytest.mark.long
@pytest.mark.parametrize("name", ["compiled", "compiled_beam"])
def test_driven_in_c_without_a_lost_byte(compiler, ours, name, tmp_path):
    """Optimised and with all warnings; valgrind watches, if it is installed."""
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    driver = tmp_path / "driver"
    done = compile_driver(compiler, tmp_path, driver, "-O2", "-g", *WARNINGS)
    assert done.returncode == 0, done.stderr
    valgrind = shutil.which("valgrind")
    watched = []
    if valgrind is not None:
        watched = [valgrind, "--error-exitcode=9", "--leak-check=full", "--quiet"]

    run_well([*watched, driver, (tmp_path / "resources").as_uri()])


# ---------------------------------------------------------------------- exported functions

VERSIONS = [("compiled", 2), ("fmi3", 3)]


@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_the_fmi_functions_of_the_header_are_exported_and_no_others(ours, name, version, tmp_path):
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("nm is not installed")
    shutil.unpack_archive(ours(name), tmp_path, "zip")
    header = (tmp_path / "sources" / f"fmi{version}Functions.h").read_text()
    declared = re.findall(rf"^ *FMI{version}_Export .*?(\w+);", header, re.MULTILINE)

    symbols = run_well([nm, "-D", "--defined-only", *(tmp_path / "binaries").rglob("*.so")])

    exported = [line.split()[-1] for line in symbols.splitlines()]
    assert sorted(exported) == sorted(declared)
    assert f"fmi{version}DoStep" in exported


@pytest.mark.parametrize(("name", "version"), VERSIONS)
def test_an_fmu_has_the_sources_of_its_version_alone(ours, name, version):
    interfaces = [entry for entry in members(ours(name)) if re.search(r"structure_fmi.\.c$", entry)]

    assert interfaces == [f"sources/structure_fmi{version}.c"]


# ---------------------------------------------------------------------- a host without Python

STRAIN_REFERENCES = range(11, 35)


def test_a_host_without_python_needs_nothing_else(
    extracted, compiled_fmu, compiler, model, tmp_path
):
    host = tmp_path / "host"
    include = f"-I{extracted / 'sources'}"
    flags = ["-Wall", "-Wextra", "-Werror", include]
    subprocess.run([*compiler, *flags, HOST, "-o", host, "-ldl"], check=True)
    library = next((extracted / "binaries" / "linux64").glob("*.so"))
    # In a folder whose name must be encoded in the URI.
    resources = shutil.copytree(extracted / "resources", tmp_path / "resources of é 100%")

    identity = read_fmu(compiled_fmu).guid
    references = map(str, STRAIN_REFERENCES)
    output = run_well([host, library, identity, resources.as_uri(), "3", *references], env={})

    expected = model.static_response({"load_factor": 1.0}).strain
    np.testing.assert_allclose([float(line) for line in output.split()], expected, rtol=1e-12)


# ---------------------------------------------------------------------- libcosim


@pytest.mark.parametrize("kind", ["compiled", "python"])
def test_libcosim_flies_it_as_the_page_says(ours, model, kind, tmp_path):
    """In a process of its own.

    libcosim is native code with threads, and writes its log to the terminal.
    """
    if importlib.util.find_spec("libcosimpy") is None:
        pytest.skip("libcosimpy is not installed")
    (block,) = (text for text in blocks(USE_THE_WING, "python") if "libcosimpy" in text)
    shutil.copy(ours(kind), tmp_path / "wing.fmu")

    output = run_python(f"import os\nos.chdir({str(tmp_path)!r})\n{block}\nprint('STRAIN', strain)")

    strain = json.loads(output.split("STRAIN", 1)[1].splitlines()[0])
    expected = model.static_response({"load_factor": 3.0, "z1": 0.2}).strain
    np.testing.assert_allclose(strain, expected, rtol=1e-9)
