"""The C sources: clean under strict warnings and sanitizers; no damaged data file gets past their reader."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fmu_asset.compiled.package import MAGIC, NAME_BYTES, data_file_bytes, pack_arrays

DRIVER = Path(__file__).with_name("driver.c")
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


def arrays_of(content: bytes) -> dict[str, np.ndarray]:
    """Read a data file as its description says, independently of the C reader."""
    assert content[:8] == MAGIC
    assert struct.unpack("<I", content[-4:])[0] == zlib.crc32(content[:-4])
    version, count = struct.unpack_from("<II", content, 8)
    assert version == 2
    at, arrays = 16, {}
    for _ in range(count):
        name = content[at : at + NAME_BYTES].rstrip(b"\0").decode()
        dimensions, zero = struct.unpack_from("<II", content, at + NAME_BYTES)
        assert zero == 0
        at += NAME_BYTES + 8
        shape = struct.unpack_from(f"<{dimensions}Q", content, at)
        at += 8 * dimensions
        size = int(np.prod(shape))
        arrays[name] = np.frombuffer(content, "<f8", size, at).reshape(shape)
        at += 8 * size
    assert at == len(content) - 4
    return arrays


def test_the_data_file_holds_the_arrays_of_the_model(model: ReducedModel) -> None:
    content = data_file_bytes(model)
    assert data_file_bytes(ReducedModel.from_bytes(model.to_bytes())) == content
    arrays = arrays_of(content)
    for name in ("static_stiffness", "dual_correction", "cross_mass", "dual_split", "dual_counts"):
        np.testing.assert_array_equal(arrays[name], getattr(model, name))
    assert arrays["mode_count"] == model.mode_count
    assert pack_arrays(arrays) == content


def damaged(content: bytes) -> dict[str, bytes]:
    """Return data files that are wrong, most of them with a right checksum."""

    def sealed(body: bytes) -> bytes:
        return body + struct.pack("<I", zlib.crc32(body))

    def without(name: str) -> bytes:
        return pack_arrays({key: array for key, array in arrays.items() if key != name})

    def with_array(name: str, array: np.ndarray) -> bytes:
        return pack_arrays(arrays | {name: array})

    arrays = arrays_of(content)
    body = content[:-4]
    files = {
        "empty": b"",
        "short": content[:20],
        "flipped": content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
        "magic": sealed(b"X" + body[1:]),
        "version": sealed(body[:8] + struct.pack("<I", 1) + body[12:]),
        "longer": sealed(body + b"\0" * 8),
        "no_arrays": sealed(body[:12] + struct.pack("<I", 0) + body[16:]),
        "many_arrays": sealed(body[:12] + struct.pack("<I", 2**32 - 1) + body[16:]),
        "name": sealed(body[:16] + b"x" * NAME_BYTES + body[16 + NAME_BYTES :]),
        "dimensions": sealed(body[:48] + struct.pack("<I", 99) + body[52:]),
        "extent": sealed(body[:56] + struct.pack("<Q", 2**63) + body[64:]),
        "nan": with_array("static_load", np.full_like(arrays["static_load"], np.nan)),
        "modes": with_array("mode_count", np.array(1e300)),
        "fewer_modes": with_array("mode_count", np.array(2.0)),
        "gauges": with_array("static_output", arrays["static_output"][:-1]),
        "regions": with_array("chosen_counts", np.array([1.0, 9.0, 2.0, 2.0])),
        "no_regions": with_array("chosen_counts", np.array([3.0, 0.0, 2.0, 2.0])),
        "counts": with_array("chosen_counts", np.array([1e300, 2.0, 2.0, 2.0])),
        "other_counts": with_array("chosen_counts", np.array([2.0, 2.0, 1.0, 2.0])),
        "dual_counts": with_array("dual_counts", np.ones((1, 1))),
        "stiffness_factors": with_array("stiffness_factors", np.full((4, 2), 3.0)),
        "half_a_factor": with_array("load_factors", np.full((2, 2), 0.5)),
        "last_term": with_array("stiffness_factors", np.ones((4, 2))),
        "more_gauges": with_array("gauge_count", np.array(26.0)),
        "anchors": with_array("dual_counts", np.array([2.0, 1e300])),
        "functions": with_array("dual_output", np.ones((25, 3))),
        "splits": with_array("dual_split", np.zeros(1)),
        "overflow": with_array("dual_residual", np.zeros((1, 25, 4, 4))),
    }
    files |= {f"without_{name}": without(name) for name in arrays}
    files |= {f"cut_{length}": sealed(body[:length]) for length in range(16, len(body), len(body) // 40)}
    return files


def test_driven_in_c_under_sanitizers(
    compiler: list[str], extracted: Path, model: ReducedModel, tmp_path: Path
) -> None:
    """Every FMI function, garbage as states, damaged files: no error of memory, no undefined behaviour."""
    driver = tmp_path / "driver"
    sanitized = "-fsanitize=address,undefined"
    done = compile_driver(compiler, extracted, driver, "-O1", "-g", sanitized, "-fno-sanitize-recover=all")
    if done.returncode != 0 and ("sanitize" in done.stderr or "asan" in done.stderr):
        pytest.skip(f"{compiler[0]} has no sanitizers: {done.stderr.splitlines()[0]}")
    assert done.returncode == 0, done.stderr
    folders = []
    for name, content in damaged(data_file_bytes(model)).items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "reduced_model.bin").write_bytes(content)
        folders.append(folder.as_uri())
    words = [driver, (extracted / "resources").as_uri(), *folders]
    options = {**os.environ, "ASAN_OPTIONS": "detect_leaks=1:allocator_may_return_null=1"}
    run = subprocess.run(words, capture_output=True, text=True, check=False, env=options)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.long
@pytest.mark.parametrize("which", ["compiled_fmu", "compiled_beam"])
def test_driven_in_c_without_a_lost_byte(
    compiler: list[str], which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Optimised and warned of as much as the compiler can; valgrind watches, where it is installed."""
    shutil.unpack_archive(request.getfixturevalue(which), tmp_path, "zip")
    driver = tmp_path / "driver"
    done = compile_driver(compiler, tmp_path, driver, "-O2", "-g", *WARNINGS)
    assert done.returncode == 0, done.stderr
    valgrind = shutil.which("valgrind")
    watched = [] if valgrind is None else [valgrind, "--error-exitcode=9", "--leak-check=full", "--quiet"]
    words = [*watched, driver, (tmp_path / "resources").as_uri()]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def test_nothing_but_the_fmi_functions_is_exported(compiled_fmu: Path, extracted: Path) -> None:
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("nm is not installed")
    library = next((extracted / "binaries" / "linux64").glob("*.so"))
    listed = subprocess.run([nm, "-D", "--defined-only", library], capture_output=True, text=True, check=True)
    names = {line.split()[-1] for line in listed.stdout.splitlines()}
    assert {"fmi2DoStep", "fmi2Instantiate"} <= names
    assert not {name for name in names if not name.startswith("fmi2")}
