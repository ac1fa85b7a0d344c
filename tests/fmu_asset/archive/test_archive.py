"""Files that are no FMU, broken, dangerous or of another kind: one clear sentence each."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuError, FmuFileError, FmuUnsupportedError

Repack = Callable[[Callable[[str, bytes], tuple[str, bytes] | None]], Path]


@pytest.fixture
def repack(fmu: Path, tmp_path: Path) -> Repack:
    """Return a function that writes a changed copy of the FMU."""

    def write(change: Callable[[str, bytes], tuple[str, bytes] | None]) -> Path:
        path = tmp_path / "changed.fmu"
        with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(path, "w") as target:
            for name in source.namelist():
                entry = change(name, source.read(name))
                if entry is not None:
                    target.writestr(*entry)
        return path

    return write


def without(prefix: str) -> Callable[[str, bytes], tuple[str, bytes] | None]:
    return lambda name, data: None if name.startswith(prefix) else (name, data)


def in_description(old: bytes, new: bytes) -> Callable[[str, bytes], tuple[str, bytes] | None]:
    return lambda name, data: (name, data.replace(old, new) if name == "modelDescription.xml" else data)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FmuFileError, match="There is no FMU"):
        read_fmu(tmp_path / "none.fmu")
    with pytest.raises(FmuFileError, match="is a folder"):
        read_fmu(tmp_path)


def test_not_an_archive(tmp_path: Path) -> None:
    (tmp_path / "a.fmu").write_text("hello", encoding="utf-8")
    with pytest.raises(FmuFileError, match=r"not a sound FMU archive .* fetch or build it again"):
        read_fmu(tmp_path / "a.fmu")


def test_no_description(repack: Repack) -> None:
    with pytest.raises(FmuFileError, match=r"without modelDescription\.xml"):
        read_fmu(repack(without("modelDescription.xml")))


def test_broken_description(repack: Repack) -> None:
    with pytest.raises(FmuFileError, match=r"The model description of .* cannot be read"):
        read_fmu(repack(in_description(b"</ModelVariables>", b"")))


def test_numbers_that_are_none(repack: Repack, binding: Binding) -> None:
    with pytest.raises(FmuFileError, match=r"The model description of .* cannot be read .*'abc'"):
        read_fmu(repack(in_description(b'min="0.0"', b'min="abc"')))
    strange = repack(in_description(b'start="1.0"', b'start="abc"'))
    with pytest.raises(FmuFileError, match=r"start value that is no number .*'abc'"):
        FmiAsset(strange, binding).reset()


def test_another_version(repack: Repack, binding: Binding) -> None:
    with pytest.raises(FmuUnsupportedError, match=r"FMI 4\.0; FMI 1\.0, 2\.0 or 3\.0 is needed"):
        read_fmu(repack(in_description(b'fmiVersion="2.0"', b'fmiVersion="4.0"')))
    # What only pretends to be of another version cannot be read as such.
    with pytest.raises(FmuFileError, match=r"The model description of .* cannot be read"):
        read_fmu(repack(in_description(b'fmiVersion="2.0"', b'fmiVersion="3.0"')))


def test_no_interface_that_could_be_flown(repack: Repack, fmu: Path) -> None:
    with pytest.raises(FmuUnsupportedError, match="offers neither co-simulation nor model exchange"):
        read_fmu(repack(in_description(b"<CoSimulation ", b"<ScheduledExecution ")))
    with pytest.raises(
        FmuUnsupportedError, match=r"offers co-simulation only, but .* asks for model-exchange"
    ):
        read_fmu(fmu, "model-exchange")


def test_another_platform(repack: Repack) -> None:
    with pytest.raises(FmuUnsupportedError, match=r"no binary for this platform .*binaries there: win64"):
        read_fmu(repack(without("binaries/linux64")))


@pytest.mark.parametrize(
    "name", ["../outside.txt", "resources/../../outside.txt", "/etc/outside", "a\\..\\b", "C:/outside"]
)
def test_paths_that_lead_outside(fmu: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / "evil.fmu"
    path.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, "x")
    with pytest.raises(FmuFileError, match="outside its folder; it was refused"):
        read_fmu(path)


def test_an_entry_that_is_there_twice_is_harmless_where_both_are_equal(fmu: Path, tmp_path: Path) -> None:
    """An official Reference FMU holds one of its files twice."""
    path = tmp_path / "twice.fmu"
    path.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("modelDescription.xml", archive.read("modelDescription.xml"))
    described = read_fmu(path)
    assert described.variables == read_fmu(fmu).variables
    assert (extract_fmu(described) / "modelDescription.xml").is_file()
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("modelDescription.xml", b"another")
    with pytest.raises(FmuFileError, match=r"'modelDescription\.xml' twice with different content"):
        read_fmu(path)


def test_links_are_refused(fmu: Path, tmp_path: Path) -> None:
    path = tmp_path / "evil.fmu"
    path.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        link = zipfile.ZipInfo("resources/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(FmuFileError, match="outside its folder; it was refused"):
        read_fmu(path)


def test_a_file_that_changes_after_its_check_is_not_extracted(fmu: Path, tmp_path: Path) -> None:
    path = tmp_path / "wing.fmu"
    path.write_bytes(fmu.read_bytes())
    description = read_fmu(path)
    path.write_bytes(fmu.read_bytes() + b"x")
    with pytest.raises(FmuFileError, match="has changed since it was checked"):
        extract_fmu(description)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_read(
    fmu: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Cut anywhere or with any byte changed, the file gives an FmuError or a description, nothing else."""
    content = bytearray(fmu.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        # The directory at the end of the archive is where a changed byte has odd effects.
        position = data.draw(st.integers(max(len(content) - 6000, 0), len(content) - 1))
        content[position] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("damaged") / "wing.fmu"
    path.write_bytes(content)
    with suppress(FmuError):
        assert read_fmu(path).model_name == "uav_wing"
