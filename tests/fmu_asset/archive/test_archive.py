"""Files that are no FMU, broken, dangerous or of another kind: one clear sentence each."""

import re
import stat
import struct
import zipfile
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset import errors
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.door.draft import draft_binding
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import HOSTILE, WING_BINDING
from tests.fmu_asset.making import DESCRIPTION, archive_of, edited, members, tables

REFUSED = tables(__file__)["refused"]


def in_utf_16(contents: dict[str, bytes]) -> dict[str, bytes]:
    text = contents[DESCRIPTION].decode().replace("encoding='UTF-8'", "encoding='UTF-16'")
    return contents | {DESCRIPTION: text.encode("utf-16")}


@pytest.mark.parametrize("row", REFUSED, ids=lambda row: row["sentence"])
def test_what_is_wrong_with_a_file_is_one_sentence(fmu, tmp_path, row) -> None:
    path = edited(fmu, tmp_path / "changed.fmu", *row.get("change", ()))
    contents = {n: c for n, c in members(path).items() if not n.startswith(row.get("without", "\0"))}
    contents |= {row[key]: b"x" for key in row.keys() & {"add"}}
    with pytest.raises(getattr(errors, row["error"]), match=row["sentence"]):
        read_fmu(archive_of(path, in_utf_16(contents) if "utf_16" in row else contents))


def test_an_archive_that_would_fill_the_disk_is_refused(fmu, tmp_path) -> None:
    for name, size, words in (
        ("resources/zeros", 300 * 1024**2, r"would extract to 30\d MiB, which looks like an archive"),
        (f"{3000 * 'd/'}x", 1, r"an entry 3001 folders deep; no tool exports that .*refused"),
    ):
        with pytest.raises(errors.FmuFileError, match=words):
            read_fmu(archive_of(tmp_path / "changed.fmu", members(fmu) | {name: bytes(size)}))


def test_what_is_no_fmu_is_one_sentence(fmu, tmp_path) -> None:
    (tmp_path / "a.fmu").write_text("hello", encoding="utf-8")
    for path, words in (
        (tmp_path, "is a folder"),
        (tmp_path / "a.fmu", r"not a sound FMU archive .* fetch or build it again"),
    ):
        with pytest.raises(errors.FmuFileError, match=words):
            read_fmu(path)
    words = r"offers co-simulation only, but .* asks for model-exchange"
    with pytest.raises(errors.FmuUnsupportedError, match=words):
        read_fmu(fmu, "model-exchange")
    path = tmp_path / "link.fmu"
    path.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        link = zipfile.ZipInfo("resources/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(errors.FmuFileError, match="outside its folder; it was refused"):
        read_fmu(path)


def test_what_is_seen_when_it_is_loaded_is_one_sentence(foreign_fmu, fmu, tmp_path, scratch) -> None:
    strange = edited(fmu, tmp_path / "strange.fmu", ('start="1.0"', 'start="abc"'))
    with pytest.raises(errors.FmuFileError, match=r"start value that is no number .*'abc'"):
        FmiAsset(strange, WING_BINDING).reset()
    contents = members(foreign_fmu("hostile2"))
    library = bytearray(contents["binaries/linux64/hostile2.so"])
    struct.pack_into("<H", library, 18, 183)  # ELF e_machine: AArch64
    arm = archive_of(tmp_path / "arm.fmu", contents | {"binaries/linux64/hostile2.so": bytes(library)})
    words = r"binary cannot be loaded on this machine .*another processor"
    with pytest.raises(errors.FmuCallError, match=words):
        FmiAsset(arm, HOSTILE).reset()
    needing = ("<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')
    tool = edited(foreign_fmu("hostile2", "NO_INSTANCE"), tmp_path / "tool.fmu", needing)
    with pytest.raises(errors.FmuCallError, match=r"could not be instantiated .*needs its authoring tool"):
        FmiAsset(tool, HOSTILE).reset()
    assert not list(scratch.iterdir())


def test_odd_files_that_are_sound(fmu, tmp_path) -> None:
    """An official Reference FMU holds one of its files twice, equal."""
    path = archive_of(tmp_path / "utf16.fmu", in_utf_16(members(fmu)))
    assert read_fmu(path).model_name == "uav_wing"
    path = tmp_path / "twice.fmu"
    path.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr(DESCRIPTION, archive.read(DESCRIPTION))
    description = read_fmu(path)
    assert description.variables == read_fmu(fmu).variables
    assert (extract_fmu(description) / DESCRIPTION).is_file()
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr(DESCRIPTION, b"another")
    with pytest.raises(errors.FmuFileError, match=r"'modelDescription\.xml' twice with different content"):
        read_fmu(path)
    with pytest.raises(errors.FmuFileError, match="has changed since it was checked"):
        extract_fmu(description)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_read(fmu, tmp_path_factory, data) -> None:
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
    with suppress(errors.FmuError):
        assert read_fmu(path).model_name == "uav_wing"


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_description_with_one_odd_attribute(foreign_fmu, tmp_path_factory, data) -> None:
    """Whatever one attribute says, or if it is missing: a description and a draft, or one sentence."""
    model = data.draw(st.sampled_from(["lag1", "room2", "array3", "swing3", "ball2"]))
    contents = members(foreign_fmu(model))
    text = contents[DESCRIPTION].decode()
    place = data.draw(st.sampled_from(list(re.finditer(r'\s[A-Za-z]+="([^"]*)"', text))))
    odd = st.sampled_from(["", "-1", "1e999", "nan", "x", "0", "99999999999999999999", "true", "1 2", "&lt;"])
    if data.draw(st.booleans()):
        text = text[: place.start()] + text[place.end() :]
    else:
        text = text[: place.start(1)] + data.draw(odd) + text[place.end(1) :]
    path = archive_of(tmp_path_factory.mktemp("odd") / "odd.fmu", contents | {DESCRIPTION: text.encode()})
    try:
        draft_binding(read_fmu(path))
    except errors.FmuError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either of the two may be
