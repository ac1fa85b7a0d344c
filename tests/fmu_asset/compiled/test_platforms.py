"""The compiled kind on other platforms than this host: names, folders, libraries, and flights."""

import importlib.util
import os
import re
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.compiled.cross_compiler import (
    cross_compile_library,
    fat_library,
    find_cross_compiler,
    zig_environment,
)
from fmu_asset.compiled.platforms import targets_by_folder
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import check_form, recorded_content_hash
from tests.fmu_asset.compiled.exports import exported_names, mach_o_parts
from tests.fmu_asset.making import DESCRIPTION, HANGS, members, run_well
from tests.kept import compiled_wing

HOST = Path(__file__).with_name("host.c")

BINARIES = {
    2: {"linux64": ".so", "win64": ".dll", "darwin64": ".dylib"},
    3: {
        "x86_64-linux": ".so",
        "x86_64-windows": ".dll",
        "x86_64-darwin": ".dylib",
        "aarch64-darwin": ".dylib",
        "aarch64-linux": ".so",
    },
}
"""Folders of an FMU for all platforms and the suffixes of their libraries, by version of FMI."""

# ---------------------------------------------------------------------- names and folders


@pytest.mark.parametrize(
    ("platforms", "fmi", "folders"),
    [
        (["linux64", "x86_64-linux"], 2, {"linux64": ("x86_64-linux",)}),
        (["linux64"], 3, {"x86_64-linux": ("x86_64-linux",)}),
        (["x86_64-windows"], 2, {"win64": ("x86_64-windows",)}),
        (["darwin64"], 2, {"darwin64": ("x86_64-darwin", "aarch64-darwin")}),
        (["aarch64-darwin"], 2, {"darwin64": ("aarch64-darwin",)}),
        (
            ["darwin64"],
            3,
            {"x86_64-darwin": ("x86_64-darwin",), "aarch64-darwin": ("aarch64-darwin",)},
        ),
    ],
)
def test_the_names_of_both_versions_lead_to_the_folders_of_one(platforms, fmi, folders):
    assert targets_by_folder(platforms, fmi) == folders


@pytest.mark.parametrize("fmi", [2, 3])
def test_all_platforms_are_those_that_the_version_has_folders_for(fmi):
    assert list(targets_by_folder(["all"], fmi)) == list(BINARIES[fmi])


@pytest.mark.parametrize(
    ("platforms", "sentence"),
    [
        ([], "A platform is expected, but none was given: name one of linux64, win64"),
        (["aarch64-linux"], "FMI 2.0 has no folder .* of aarch64-linux: build with FMI 3, or"),
    ],
)
def test_platforms_without_a_folder_are_refused(platforms, sentence):
    with pytest.raises(FmuBuildError, match=sentence):
        check_form("compiled", platforms=platforms)


def test_without_zig_the_extra_that_brings_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ziglang", None)

    with pytest.raises(FmuBuildError, match=r"zig, .* pip install 'uav-twin\[cross\]'"):
        check_form("compiled", platforms=["win64"])


# ---------------------------------------------------------------------- libraries for macOS


def thin_library(processor: int, size: int) -> bytes:
    """Return the header of a 64-bit Mach-O library, and further bytes."""
    return struct.pack("<Iii", 0xFEEDFACF, processor, 3) + bytes(range(1, size + 1))


MACOS_LIBRARIES = [thin_library(0x01000007, 40), thin_library(0x0100000C, 8)]


def test_libraries_for_macos_are_joined_at_multiples_of_its_pages():
    magic_and_count = struct.pack(">II", 0xCAFEBABE, 2)
    intel = struct.pack(">5I", 0x01000007, 3, 2**14, 52, 14)
    arm = struct.pack(">5I", 0x0100000C, 3, 2**15, 20, 14)

    assert fat_library(MACOS_LIBRARIES)[:48] == magic_and_count + intel + arm


def test_joined_libraries_are_parted_again():
    assert mach_o_parts(fat_library(MACOS_LIBRARIES)) == MACOS_LIBRARIES


def test_a_library_of_another_system_is_not_joined():
    with pytest.raises(FmuBuildError, match=r"Mach-O library was expected .* begins with 7f454c46"):
        fat_library([b"\x7fELF\x02\x01\x01"])


# ---------------------------------------------------------------------- the cache of zig


def test_zig_keeps_its_own_libraries_in_our_cache_and_no_objects(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    with zig_environment() as environment:
        kept, objects = environment["ZIG_GLOBAL_CACHE_DIR"], environment["ZIG_LOCAL_CACHE_DIR"]

    assert kept == str(tmp_path / "uav-twin" / "zig")
    assert not Path(objects).parent.exists()


def test_zig_compiles_where_the_cache_cannot_be_written(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))

    with zig_environment() as environment:
        Path(environment["ZIG_GLOBAL_CACHE_DIR"]).mkdir()

    assert "cannot be written" in caplog.text
    assert not Path(environment["ZIG_GLOBAL_CACHE_DIR"]).exists()


# ---------------------------------------------------------------------- compiled by zig


@pytest.fixture(scope="module")
def zig() -> list[str]:
    """The command of zig's C compiler; skips if it is not installed."""
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("ziglang, which comes with uav-twin[cross], is not installed")
    return find_cross_compiler()


@pytest.fixture(scope="module")
def fmus_for_all(zig, model, tmp_path_factory) -> Callable[[int], Path]:
    """A function that returns the compiled wing of a version of FMI, for all platforms."""
    folder = tmp_path_factory.mktemp("all_platforms")

    def fmu_for_all(fmi: int) -> Path:
        path = folder / f"wing{fmi}.fmu"
        if path.exists():
            return path
        return compiled_wing(model, path, fmi=fmi, platforms=["all"])

    return fmu_for_all


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_each_platform_has_a_library_that_exports_the_fmi_functions_and_no_others(
    fmus_for_all, fmi
):
    content = members(fmus_for_all(fmi))
    header = content[f"sources/fmi{fmi}Functions.h"].decode()
    declared = set(re.findall(rf"^ *FMI{fmi}_Export .*?(\w+);", header, re.MULTILINE))

    binaries = {name: data for name, data in content.items() if name.startswith("binaries/")}

    identifier = read_fmu(fmus_for_all(fmi)).model_identifier
    assert sorted(binaries) == sorted(
        f"binaries/{folder}/{identifier}{suffix}" for folder, suffix in BINARIES[fmi].items()
    )
    for name, library in binaries.items():
        libraries = exported_names(library)
        assert libraries == [declared] * (2 if "darwin64" in name else 1), name


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_for_all_platforms_is_valid_and_differs_by_its_binaries_alone(
    fmus_for_all, ours, fmi
):
    fmu = fmus_for_all(fmi)

    declared, actual = recorded_content_hash(fmu)
    for_this_host = members(ours("compiled" if fmi == 2 else "fmi3"))

    assert validate_fmu(str(fmu)) == []
    assert declared == actual
    assert members(fmu)[DESCRIPTION] == for_this_host[DESCRIPTION]


@pytest.mark.slow
def test_the_library_for_linux_needs_a_c_library_of_2012_at_most(fmus_for_all):
    library = next(data for name, data in members(fmus_for_all(2)).items() if "linux64" in name)

    versions = {
        tuple(map(int, version.split(b".")))
        for version in re.findall(rb"GLIBC_([0-9.]+)\0", library)
    }

    assert versions
    assert max(versions) <= (2, 17)


@pytest.mark.slow
def test_the_library_for_windows_needs_only_libraries_of_windows_itself(fmus_for_all):
    library = next(data for name, data in members(fmus_for_all(2)).items() if "win64" in name)

    needed = {name.lower() for name in re.findall(rb"([\w.-]+\.dll)\0", library, re.IGNORECASE)}

    others = {name for name in needed if not name.startswith(b"api-ms-win-crt-")}
    assert others <= {b"kernel32.dll", b"library.dll"}


@pytest.mark.slow
def test_zig_gives_equal_bytes_each_time(zig):
    source = b'__attribute__((visibility("default"))) int answer(void) { return 42; }\n'
    sources = {"answer.c": source}
    targets = ["x86_64-darwin", "aarch64-darwin"]

    assert cross_compile_library(sources, targets) == cross_compile_library(sources, targets)


# ---------------------------------------------------------------------- flights elsewhere


def compile_host(zig: list[str], zig_target: str, include: Path, program: Path) -> None:
    """Compile the host for another platform; zig writes files of plain names only."""
    with zig_environment() as environment:
        run_well(
            [*zig, "-target", zig_target, "-O3", f"-I{include}", HOST, "-o", program],
            env=environment,
        )


def outputs_elsewhere(
    fmu: Path, folder: Path, host: Path, run: Callable[[list[str]], str], binary: str
) -> list[float]:
    """Return the strains, displacements and modes of an FMU that a program in C flies.

    Parameters
    ----------
    fmu : Path
        The FMU, which is extracted into the folder.
    folder : Path
        The folder in which the program runs.
    host : Path
        The program; see `host.c`.
    run : callable
        Runs a command and returns what it prints.
    binary : str
        The name of the library in the FMU, with a pattern for the identifier.
    """
    library = next((folder / "binaries").glob(binary)).relative_to(folder)
    references = map(str, (*range(11, 37), *range(38, 51)))
    resources = (folder / "resources").as_uri()
    # By a relative path: loading the library is the host's work, and this host speaks no UTF-8.
    printed = run([str(host), f"./{library}", read_fmu(fmu).guid, resources, "3", *references])
    return [float(line) for line in printed.split()]


@pytest.mark.slow
@pytest.mark.parametrize("folder_name", ["plain", "Flügel Ω 100%"])
def test_the_library_for_windows_gives_the_same_under_wine(
    fmus_for_all, zig, compiler, tmp_path, folder_name
):
    if shutil.which("wine") is None:
        pytest.skip("wine is not installed")
    fmu, folder = fmus_for_all(2), tmp_path / folder_name
    shutil.unpack_archive(fmu, folder, "zip")
    run_well([*compiler, f"-I{folder / 'sources'}", HOST, "-o", folder / "host", "-ldl"])
    compile_host(zig, "x86_64-windows-gnu", folder / "sources", tmp_path / "host.exe")
    shutil.copy(tmp_path / "host.exe", folder)
    wine = {
        **os.environ,
        "WINEPREFIX": str(tmp_path / "wine"),
        "WINEDEBUG": "-all",
        "LC_ALL": "C.UTF-8",
    }

    on_linux = outputs_elsewhere(
        fmu, folder, folder / "host", lambda words: run_well(words, cwd=folder), "linux64/*.so"
    )
    on_windows = outputs_elsewhere(
        fmu,
        folder,
        Path("host.exe"),
        lambda words: run_well(["wine", *words], cwd=folder, env=wine, timeout=HANGS),
        "win64/*.dll",
    )

    assert len(on_linux) == 39
    np.testing.assert_allclose(on_windows, on_linux, rtol=1e-9)


ARM_LIBRARIES = "/usr/aarch64-linux-gnu"
"""Where Debian's package libc6-arm64-cross has the C library for aarch64."""


@pytest.mark.long
def test_the_library_for_arm_gives_the_same_under_qemu(fmus_for_all, zig, compiler, tmp_path):
    """The FMU of FMI 2 has no folder for it, so its sources are compiled here."""
    if shutil.which("qemu-aarch64") is None or not Path(ARM_LIBRARIES).is_dir():
        pytest.skip("qemu-user or libc6-arm64-cross is not installed")
    fmu = fmus_for_all(2)
    shutil.unpack_archive(fmu, tmp_path, "zip")
    sources = {path.name: path.read_bytes() for path in (tmp_path / "sources").iterdir()}
    arm_folder = tmp_path / "binaries" / "aarch64-linux"
    arm_folder.mkdir()
    (arm_folder / "wing.so").write_bytes(cross_compile_library(sources, ["aarch64-linux"]))
    include = tmp_path / "sources"
    run_well([*compiler, f"-I{include}", HOST, "-o", tmp_path / "host", "-ldl"])
    compile_host(zig, "aarch64-linux-gnu.2.17", include, tmp_path / "host_of_arm")

    on_x86 = outputs_elsewhere(
        fmu, tmp_path, tmp_path / "host", lambda words: run_well(words, cwd=tmp_path), "linux64/*"
    )
    on_arm = outputs_elsewhere(
        fmu,
        tmp_path,
        tmp_path / "host_of_arm",
        lambda words: run_well(["qemu-aarch64", "-L", ARM_LIBRARIES, *words], cwd=tmp_path),
        "aarch64-linux/*",
    )

    np.testing.assert_allclose(on_arm, on_x86, rtol=1e-9)
