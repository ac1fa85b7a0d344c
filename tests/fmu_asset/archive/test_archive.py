"""Files that are no FMU, broken, dangerous or of another kind: one clear sentence each."""

import re
import stat
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset import errors
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.door.draft import draft_binding
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import HOSTILE
from tests.fmu_asset.making import DESCRIPTION, archive_of, edited, members

Change = Callable[[dict[str, bytes]], dict[str, bytes]]


def without(prefix: str) -> Change:
    return lambda contents: {n: c for n, c in contents.items() if not n.startswith(prefix)}


def described(*changes: tuple[str, str]) -> Change:
    def change(contents: dict[str, bytes]) -> dict[str, bytes]:
        text = contents[DESCRIPTION].decode()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        return contents | {DESCRIPTION: text.encode()}

    return change


def added(name: str, content: bytes = b"x") -> Change:
    return lambda contents: contents | {name: content}


def in_utf_16(contents: dict[str, bytes]) -> dict[str, bytes]:
    text = contents[DESCRIPTION].decode().replace("encoding='UTF-8'", "encoding='UTF-16'")
    return contents | {DESCRIPTION: text.encode("utf-16")}


def misnamed(contents: dict[str, bytes]) -> dict[str, bytes]:
    identifier = re.search(r'modelIdentifier="(\w+)"', contents[DESCRIPTION].decode())[1]
    return described((identifier, "../../x"))(contents)


ENTITIES = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'
with_entities = described(("encoding='UTF-8'?>", f"encoding='UTF-8'?>{ENTITIES}"))
UNREADABLE = r"The model description of .* cannot be read"
OUTSIDE = "outside its folder; it was refused"
VERSION = 'fmiVersion="2.0"'
DAMAGED: list[tuple[Change, str]] = [
    (without(DESCRIPTION), r"without modelDescription\.xml"),
    (described(("</ModelVariables>", "")), UNREADABLE),
    (described(('min="0.0"', 'min="abc"')), rf"{UNREADABLE} .*'abc'"),
    # What only pretends to be of another version cannot be read as such.
    (described((VERSION, 'fmiVersion="3.0"')), UNREADABLE),
    (added("../outside.txt"), OUTSIDE),
    (added("resources/../../outside.txt"), OUTSIDE),
    (added("/etc/outside"), OUTSIDE),
    (added("a\\..\\b"), OUTSIDE),
    (added("C:/outside"), OUTSIDE),
    (
        added("resources/zeros", bytes(300 * 1024**2)),
        r"would extract to 30\d MiB, which looks like an archive",
    ),
    (added(f"{3000 * 'd/'}x"), r"an entry 3001 folders deep; no tool exports that .*refused"),
    (with_entities, "defines a document type or entities"),
    (lambda contents: in_utf_16(with_entities(contents)), "defines a document type or entities"),
    (misnamed, "is no name of a C function"),
]
SCHEDULED = described(("<CoSimulation ", "<ScheduledExecution "))
UNSUPPORTED: list[tuple[Change, str]] = [
    (described((VERSION, 'fmiVersion="4.0"')), r"FMI 4\.0; FMI 1\.0, 2\.0 or 3\.0 is needed"),
    (SCHEDULED, "offers neither co-simulation nor model exchange"),
    (without("binaries/linux64"), r"no binary for this platform .*binaries there: win64"),
]
REFUSED = [
    (*row, kind)
    for kind, rows in ((errors.FmuFileError, DAMAGED), (errors.FmuUnsupportedError, UNSUPPORTED))
    for row in rows
]


@pytest.mark.parametrize(("change", "words", "kind"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_wrong_with_a_file_is_one_sentence(fmu, tmp_path, change, words, kind) -> None:
    with pytest.raises(kind, match=words):
        read_fmu(archive_of(tmp_path / "changed.fmu", change(members(fmu))))


def test_what_is_no_fmu_is_one_sentence(fmu, tmp_path) -> None:
    (tmp_path / "a.fmu").write_text("hello", encoding="utf-8")
    for path, words in (
        (tmp_path / "none.fmu", "There is no FMU"),
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
    with pytest.raises(errors.FmuFileError, match=OUTSIDE):
        read_fmu(path)


def test_what_is_seen_when_it_is_loaded_is_one_sentence(foreign_fmu, fmu, binding, tmp_path, scratch) -> None:
    strange = edited(fmu, tmp_path / "strange.fmu", ('start="1.0"', 'start="abc"'))
    with pytest.raises(errors.FmuFileError, match=r"start value that is no number .*'abc'"):
        FmiAsset(strange, binding).reset()
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
    sentence = ""
    try:
        draft_binding(read_fmu(path))
    except errors.FmuError as error:
        sentence = str(error)
    assert "\n" not in sentence
