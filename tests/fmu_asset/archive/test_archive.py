"""Files that are no FMU, broken, dangerous or of another kind; what checks say."""

import re
import stat
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset import errors
from fmu_asset.archive.fmu_file import extract_fmu, inspect_fmu, read_fmu
from fmu_asset.checks.file_checks import check_file
from fmu_asset.checks.fmu_check import FmuCheck, check_fmu
from fmu_asset.client.draft import draft_binding
from fmu_asset.client.session import FmiAsset
from tests.fmu_asset.client.kinds import HOSTILE, WING_BINDING
from tests.fmu_asset.making import (
    DESCRIPTION,
    MODELS,
    archive_of,
    bound,
    edited,
    limit_call_without_answer,
    members,
    tables,
)

REFUSED = tables(__file__)["refused"]


def with_utf_16(contents: dict[str, bytes]) -> dict[str, bytes]:
    """Return the members of an FMU with its model description in UTF-16."""
    text = contents[DESCRIPTION].decode().replace("encoding='UTF-8'", "encoding='UTF-16'")
    return contents | {DESCRIPTION: text.encode("utf-16")}


def append_member(path: Path, name: str | zipfile.ZipInfo, content: bytes | str) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, content)


# ---------------------------------------------------------------- descriptions


@pytest.mark.parametrize("row", REFUSED, ids=lambda row: row["sentence"])
def test_what_is_wrong_with_a_file_is_one_sentence(fmu, tmp_path, row):
    path = edited(fmu, tmp_path / "changed.fmu", *row.get("change", ()))
    left_out = row.get("without", "\0")
    contents = {
        name: content for name, content in members(path).items() if not name.startswith(left_out)
    }
    if "add" in row:
        contents[row["add"]] = b"x"
    if "utf_16" in row:
        contents = with_utf_16(contents)

    with pytest.raises(getattr(errors, row["error"]), match=row["sentence"]):
        read_fmu(archive_of(path, contents))


def displays_of_strain(path: Path):
    """Return the display units of the unit of strains."""
    units = {unit.name: unit for unit in read_fmu(path).units}
    return units["1"].displays


def test_a_display_unit_that_is_one_over_the_value_is_none(ours, tmp_path):
    inverse = ('<DisplayUnit name="microstrain"', '<DisplayUnit inverse="true" name="microstrain"')
    changed = edited(ours("fmi3"), tmp_path / "changed.fmu", inverse)

    assert ("microstrain", 1e6, 0.0) in displays_of_strain(ours("fmi3"))
    assert ("microstrain", 1e6, 0.0) not in displays_of_strain(changed)


def test_an_interface_that_an_fmu_does_not_offer_is_refused(fmu):
    sentence = r"offers co-simulation only, but .* asks for model-exchange"

    with pytest.raises(errors.FmuUnsupportedError, match=sentence):
        read_fmu(fmu, "model-exchange")


# ---------------------------------------------------------------- archives


def assert_file_refused(path: Path, sentence: str) -> None:
    with pytest.raises(errors.FmuFileError, match=sentence):
        read_fmu(path)


def test_a_folder_is_refused(tmp_path):
    assert_file_refused(tmp_path, "is a folder")


def test_a_text_is_refused(tmp_path):
    path = tmp_path / "a.fmu"
    path.write_text("hello", encoding="utf-8")

    assert_file_refused(path, r"not a valid FMU archive .* fetch or build it again")


def test_an_archive_with_a_link_out_of_its_folder_is_refused(fmu, tmp_path):
    path = tmp_path / "link.fmu"
    path.write_bytes(fmu.read_bytes())
    link = zipfile.ZipInfo("resources/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    append_member(path, link, "/etc/passwd")

    assert_file_refused(path, "outside its folder; it was refused")


def test_an_archive_that_would_fill_the_disk_is_refused(fmu, tmp_path):
    zeros = {"resources/zeros": bytes(300 * 1024**2)}
    path = archive_of(tmp_path / "large.fmu", members(fmu) | zeros)

    assert_file_refused(path, r"would extract to 30\d MiB, which looks like an archive")


def test_an_archive_of_deep_folders_is_refused(fmu, tmp_path):
    deep = {f"{3000 * 'd/'}x": b"x"}
    path = archive_of(tmp_path / "deep.fmu", members(fmu) | deep)

    assert_file_refused(path, r"an entry 3001 folders deep; no tool exports that .*refused")


# ---------------------------------------------------------------- seen at loading


def test_a_start_value_that_is_no_number_is_refused_at_loading(fmu, tmp_path, scratch):
    strange = edited(fmu, tmp_path / "strange.fmu", ('start="1.0"', 'start="abc"'))

    with pytest.raises(errors.FmuFileError, match=r"start value that is not a number .*'abc'"):
        FmiAsset(strange, WING_BINDING).reset()

    assert not list(scratch.iterdir())


def test_a_binary_for_another_processor_is_refused_at_loading(foreign_fmu, tmp_path, scratch):
    contents = members(foreign_fmu("hostile2"))
    name = "binaries/linux64/hostile2.so"
    library = bytearray(contents[name])
    offset_of_machine = 18  # e_machine of ELF
    aarch64 = 183
    struct.pack_into("<H", library, offset_of_machine, aarch64)
    other = archive_of(tmp_path / "arm.fmu", contents | {name: bytes(library)})

    sentence = r"binary cannot be loaded on this machine .*another processor"
    with pytest.raises(errors.FmuCallError, match=sentence):
        FmiAsset(other, HOSTILE).reset()

    assert not list(scratch.iterdir())


def test_an_fmu_that_needs_its_tool_is_refused_at_loading(foreign_fmu, tmp_path, scratch):
    needing_tool = ("<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')
    fmu = edited(foreign_fmu("hostile2", "NO_INSTANCE"), tmp_path / "tool.fmu", needing_tool)

    sentence = r"could not be instantiated .*needs its authoring tool"
    with pytest.raises(errors.FmuCallError, match=sentence):
        FmiAsset(fmu, HOSTILE).reset()

    assert not list(scratch.iterdir())


# ---------------------------------------------------------------- odd files that are sound


def test_a_description_in_utf_16_is_read(fmu, tmp_path):
    path = archive_of(tmp_path / "utf16.fmu", with_utf_16(members(fmu)))

    assert read_fmu(path).model_name == "uav_wing"


@pytest.fixture
def doubled(fmu, tmp_path) -> Path:
    """An FMU with its description twice, equal, as an official Reference FMU has a file."""
    path = tmp_path / "twice.fmu"
    path.write_bytes(fmu.read_bytes())
    with pytest.warns(UserWarning, match="Duplicate name"):
        append_member(path, DESCRIPTION, members(fmu)[DESCRIPTION])
    return path


def test_a_file_that_stands_twice_with_equal_content_is_read(fmu, doubled):
    description = read_fmu(doubled)

    assert description.variables == read_fmu(fmu).variables
    assert (extract_fmu(description) / DESCRIPTION).is_file()


def test_a_file_that_stands_twice_with_other_content_is_refused(doubled):
    with pytest.warns(UserWarning, match="Duplicate name"):
        append_member(doubled, DESCRIPTION, b"another")

    assert_file_refused(doubled, r"'modelDescription\.xml' twice with different content")


def test_a_file_that_changes_after_it_was_read_is_refused(doubled):
    description = read_fmu(doubled)
    with pytest.warns(UserWarning, match="Duplicate name"):
        append_member(doubled, DESCRIPTION, b"another")

    with pytest.raises(errors.FmuFileError, match="has changed since it was checked"):
        extract_fmu(description)


# ---------------------------------------------------------------- names of members


def rename_members(fmu: Path, target: Path, rename: Callable[[str], str]) -> Path:
    """Write a copy of an FMU whose members have other names."""
    return archive_of(target, {rename(name): content for name, content in members(fmu).items()})


def test_names_that_begin_with_a_dot_are_refused_by_name(foreign_fmu, tmp_path):
    dotted = rename_members(foreign_fmu("room2"), tmp_path / "dotted.fmu", lambda name: f"./{name}")

    assert_file_refused(dotted, r"but with '\./modelDescription\.xml': FMI has the names")


def test_a_binary_whose_name_begins_with_a_dot_is_refused_by_name(foreign_fmu, tmp_path):
    half_dotted = rename_members(
        foreign_fmu("room2"),
        tmp_path / "half.fmu",
        lambda name: name.replace("binaries", "./binaries"),
    )
    sentence = r"one named '\./binaries/linux64/room2\.so'"

    with pytest.raises(errors.FmuUnsupportedError, match=sentence):
        read_fmu(half_dotted)


def test_a_folder_that_was_packed_instead_of_its_content_is_refused(foreign_fmu, tmp_path):
    nested = rename_members(
        foreign_fmu("room2"), tmp_path / "nested.fmu", lambda name: f"room/{name}"
    )

    assert_file_refused(nested, r"it has 'room/modelDescription\.xml'\. Pack the content")


def test_a_binary_of_another_name_is_refused_by_its_name(foreign_fmu, tmp_path):
    other = rename_members(
        foreign_fmu("room2"),
        tmp_path / "x.fmu",
        lambda name: name.replace("room2.so", "Room.so"),
    )
    sentence = (
        r"has the binary binaries/linux64/Room\.so, but .* asks for binaries/linux64/room2\.so"
    )

    with pytest.raises(errors.FmuUnsupportedError, match=sentence):
        read_fmu(other)


# ---------------------------------------------------------------- damage at random


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_read(fmu, tmp_path_factory, data):
    """A file that is cut or has a changed byte gives an FmuError or a description, nothing else."""
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


ODD_VALUES = ["", "-1", "1e999", "nan", "x", "0", "99999999999999999999", "true", "1 2", "&lt;"]
ATTRIBUTE = re.compile(r'\s[A-Za-z]+="([^"]*)"')


def change_attribute(text: str, data: st.DataObject) -> str:
    """Return a description in which one attribute is missing or has an odd value."""
    attribute = data.draw(st.sampled_from(list(ATTRIBUTE.finditer(text))))
    if data.draw(st.booleans()):
        return text[: attribute.start()] + text[attribute.end() :]
    value = data.draw(st.sampled_from(ODD_VALUES))
    return text[: attribute.start(1)] + value + text[attribute.end(1) :]


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_description_with_one_odd_attribute_is_read_or_refused(
    foreign_fmu, tmp_path_factory, data
):
    """There is a description and a draft, or one sentence."""
    model = data.draw(st.sampled_from(["lag1", "room2", "array3", "swing3", "ball2"]))
    contents = members(foreign_fmu(model))
    text = change_attribute(contents[DESCRIPTION].decode(), data)
    folder = tmp_path_factory.mktemp("odd")
    path = archive_of(folder / "odd.fmu", contents | {DESCRIPTION: text.encode()})
    sentence = ""

    try:
        draft_binding(read_fmu(path))
    except errors.FmuError as error:
        sentence = str(error)

    assert "\n" not in sentence


# ---------------------------------------------------------------- checks

FAULTS = tables(__file__, "faults")
QUICK_MODELS = ("array3", "ball2")
MODELS_WITH_STATE = ("fixed2", "array3", "hostile2")


def verdicts_of(check: FmuCheck) -> dict[str, str]:
    return {finding.check: finding.verdict for finding in check.findings}


def text_of(check: FmuCheck, name: str) -> str:
    """Return all that a check says under one name."""
    return " ".join(finding.text for finding in check.findings if finding.check == name)


@pytest.mark.parametrize(
    "model",
    [
        name if name in QUICK_MODELS else pytest.param(name, marks=pytest.mark.long)
        for name in MODELS
    ],
)
def test_sound_fmus_of_all_kinds_have_no_problem(foreign_fmu, model):
    """FMI 1.0 model exchange has no reset."""
    check = check_fmu(foreign_fmu(model), step_size=0.01 if model == "fixed2" else 0.1)

    verdicts = verdicts_of(check)
    assert check.passed, check.problems
    assert {name: verdicts[name] for name in ("determinism", "state", "reset")} == {
        "determinism": "ok",
        "state": "ok" if model in MODELS_WITH_STATE else "warning",
        "reset": "warning" if model == "decay1" else "ok",
    }


@pytest.mark.parametrize(("fault", "check", "sentence"), FAULTS["fault"])
def test_one_fault_is_one_problem(foreign_fmu, monkeypatch, fault, check, sentence):
    if fault == "HANG":
        limit_call_without_answer(monkeypatch, "step", 3)

    result = check_fmu(foreign_fmu("hostile2", fault))

    verdicts = verdicts_of(result)
    assert (result.passed, verdicts[check]) == (False, "problem")
    assert sentence in text_of(result, check)
    if check == "first run":  # after which nothing more is tried
        assert (len(result.problems), verdicts["state"]) == (1, "skipped")


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "cycles", "verdict", "sentence"),
    [
        ((), 80, "ok", ""),
        (("LEAK_IN_FREE",), 60, "problem", "it leaks"),
        (("CRASH_IN_FREE",), 3, "problem", "Instance 1 of 3 in one process"),
    ],
    ids=["sound", "leak of 256 KiB", "crash"],
)
def test_many_instances_come_and_go_in_one_process(foreign_fmu, faults, cycles, verdict, sentence):
    check = check_fmu(foreign_fmu("hostile2", *faults), cycles=cycles)

    assert verdicts_of(check)["instances"] == verdict, text_of(check, "instances")
    assert sentence in text_of(check, "instances")


@pytest.mark.parametrize(
    ("number", "row"), list(enumerate(FAULTS["told"])), ids=lambda value: str(value)[:60]
)
def test_step_sizes_and_units_that_contradict_are_told(foreign_fmu, number, row):
    """By the check of the file, or by that of its flight."""
    model, options, changes, check, sentence = row
    path = foreign_fmu.changed(model, f"told{number}", *changes)

    inspection, *_ = inspect_fmu(path)
    findings = check_file(inspection)

    of_file = " ".join(finding.text for finding in findings if finding.check == check)
    assert sentence in (of_file or text_of(check_fmu(path, **options), check))


def test_an_input_without_a_start_value_is_told(foreign_fmu):
    without_start = ('<Real start="0"/>', "<Real/>")
    path = foreign_fmu.changed("fixed2", "schema", without_start)

    inspection, *_ = inspect_fmu(path)

    assert any("start value" in finding.text for finding in check_file(inspection))


def test_a_range_that_the_fmu_does_not_keep_is_told(foreign_fmu):
    check = check_fmu(foreign_fmu("hostile2", "REFUSE", "AFTER=0"))

    text = text_of(check, "range edges")
    assert check.passed
    assert "1 of 4 limits of input ranges make it fail, such as u = 10 m/s" in text
    assert "u is too large" in text


def test_a_binding_with_other_sizes_is_checked_with_them(foreign_fmu):
    """Three inputs, for which the FMU has two start values."""
    sized = bound(
        1.0,
        {"y": ("y", "1")},
        control={"u": ("u", "1")},
        header={"structural_parameters": {"n": 3}},
    )

    check = check_fmu(foreign_fmu("resize3"), sized, cycles=2)

    passed = {name for name, verdict in verdicts_of(check).items() if verdict == "ok"}
    assert "3 finite outputs" in text_of(check, "first run")
    assert passed >= {
        "binding",
        "first run",
        "determinism",
        "step size",
        "reset",
        "instances",
    }
    assert verdicts_of(check)["state"] == "warning"


def test_a_binding_of_an_unknown_variable_is_a_problem(foreign_fmu):
    (problem,) = check_fmu(foreign_fmu("ball2"), bound(1.0, {"z": ("z", "1")})).problems

    assert "'z'" in problem
