"""Files that are no FMU, broken, dangerous or of another kind: a clear sentence each; what checks say."""

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
from tests.fmu_asset.making import DESCRIPTION, MODELS, archive_of, bound, edited, members, tables

REFUSED = tables(__file__)["refused"]


def in_utf_16(contents: dict[str, bytes]) -> dict[str, bytes]:
    text = contents[DESCRIPTION].decode().replace("encoding='UTF-8'", "encoding='UTF-16'")
    return contents | {DESCRIPTION: text.encode("utf-16")}


@pytest.mark.parametrize("row", REFUSED, ids=lambda row: row["sentence"])
def test_what_is_wrong_with_a_file_is_one_sentence(fmu, tmp_path, row) -> None:
    path = edited(fmu, tmp_path / "changed.fmu", *row.get("change", ()))
    contents = {
        n: c for n, c in members(path).items() if not n.startswith(row.get("without", "\0"))
    }
    contents |= {row[key]: b"x" for key in row.keys() & {"add"}}
    with pytest.raises(getattr(errors, row["error"]), match=row["sentence"]):
        read_fmu(archive_of(path, in_utf_16(contents) if "utf_16" in row else contents))


def test_a_display_unit_that_is_one_over_the_value_is_none(ours, tmp_path) -> None:
    inverse = ('<DisplayUnit name="microstrain"', '<DisplayUnit inverse="true" name="microstrain"')
    changed = edited(ours("fmi3"), tmp_path / "changed.fmu", inverse)
    shown = [
        {u.name: u.displays for u in read_fmu(path).units}["1"] for path in (ours("fmi3"), changed)
    ]
    assert [("microstrain", 1e6, 0.0) in displays for displays in shown] == [True, False]


def test_what_is_no_fmu_or_dangerous_is_one_sentence(fmu, tmp_path) -> None:
    """Among them archives that would fill the disk."""
    link, contents, text = tmp_path / "link.fmu", members(fmu), tmp_path / "a.fmu"
    text.write_text("hello", encoding="utf-8")
    link.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(link, "a") as archive:
        entry = zipfile.ZipInfo("resources/link")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    large = archive_of(tmp_path / "large.fmu", contents | {"resources/zeros": bytes(300 * 1024**2)})
    deep = archive_of(tmp_path / "deep.fmu", contents | {f"{3000 * 'd/'}x": b"x"})
    for path, words in (
        (tmp_path, "is a folder"),
        (text, r"not a sound FMU archive .* fetch or build it again"),
        (link, "outside its folder; it was refused"),
        (large, r"would extract to 30\d MiB, which looks like an archive"),
        (deep, r"an entry 3001 folders deep; no tool exports that .*refused"),
    ):
        with pytest.raises(errors.FmuFileError, match=words):
            read_fmu(path)
    words = r"offers co-simulation only, but .* asks for model-exchange"
    with pytest.raises(errors.FmuUnsupportedError, match=words):
        read_fmu(fmu, "model-exchange")


def test_what_is_seen_when_it_is_loaded_is_one_sentence(
    foreign_fmu, fmu, tmp_path, scratch
) -> None:
    strange = edited(fmu, tmp_path / "strange.fmu", ('start="1.0"', 'start="abc"'))
    with pytest.raises(errors.FmuFileError, match=r"start value that is no number .*'abc'"):
        FmiAsset(strange, WING_BINDING).reset()
    contents = members(foreign_fmu("hostile2"))
    library = bytearray(contents["binaries/linux64/hostile2.so"])
    struct.pack_into("<H", library, 18, 183)  # ELF e_machine: AArch64
    arm = archive_of(
        tmp_path / "arm.fmu", contents | {"binaries/linux64/hostile2.so": bytes(library)}
    )
    words = r"binary cannot be loaded on this machine .*another processor"
    with pytest.raises(errors.FmuCallError, match=words):
        FmiAsset(arm, HOSTILE).reset()
    needing = ("<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')
    tool = edited(foreign_fmu("hostile2", "NO_INSTANCE"), tmp_path / "tool.fmu", needing)
    with pytest.raises(
        errors.FmuCallError, match=r"could not be instantiated .*needs its authoring tool"
    ):
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
    with pytest.raises(
        errors.FmuFileError, match=r"'modelDescription\.xml' twice with different content"
    ):
        read_fmu(path)
    with pytest.raises(errors.FmuFileError, match="has changed since it was checked"):
        extract_fmu(description)


def renamed(fmu: Path, target: Path, rename: Callable[[str], str]) -> Path:
    """Write a copy of an FMU whose entries have other names."""
    return archive_of(target, {rename(name): content for name, content in members(fmu).items()})


def test_names_that_begin_with_a_dot_are_told(foreign_fmu, tmp_path) -> None:
    dotted = renamed(foreign_fmu("room2"), tmp_path / "dotted.fmu", lambda name: f"./{name}")
    with pytest.raises(
        errors.FmuFileError, match=r"but with '\./modelDescription\.xml': FMI has the names"
    ):
        read_fmu(dotted)


def test_a_binary_whose_name_begins_with_a_dot_is_told(foreign_fmu, tmp_path) -> None:
    half = renamed(
        foreign_fmu("room2"),
        tmp_path / "half.fmu",
        lambda name: name.replace("binaries", "./binaries"),
    )
    with pytest.raises(
        errors.FmuUnsupportedError, match=r"one named '\./binaries/linux64/room2\.so'"
    ):
        read_fmu(half)


def test_a_folder_that_was_packed_instead_of_its_content_is_told(foreign_fmu, tmp_path) -> None:
    nested = renamed(foreign_fmu("room2"), tmp_path / "nested.fmu", lambda name: f"room/{name}")
    with pytest.raises(
        errors.FmuFileError, match=r"it has 'room/modelDescription\.xml'\. Pack the content"
    ):
        read_fmu(nested)


def test_a_binary_of_another_name_is_told_by_its_name(foreign_fmu, tmp_path) -> None:
    other = renamed(
        foreign_fmu("room2"), tmp_path / "x.fmu", lambda name: name.replace("room2.so", "Room.so")
    )
    words = r"has the binary binaries/linux64/Room\.so, but .* asks for binaries/linux64/room2\.so"
    with pytest.raises(errors.FmuUnsupportedError, match=words):
        read_fmu(other)


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
    odd = st.sampled_from(
        ["", "-1", "1e999", "nan", "x", "0", "99999999999999999999", "true", "1 2", "&lt;"]
    )
    if data.draw(st.booleans()):
        text = text[: place.start()] + text[place.end() :]
    else:
        text = text[: place.start(1)] + data.draw(odd) + text[place.end(1) :]
    path = archive_of(
        tmp_path_factory.mktemp("odd") / "odd.fmu", contents | {DESCRIPTION: text.encode()}
    )
    try:
        draft_binding(read_fmu(path))
    except errors.FmuError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either of the two may be


# ---------------------------------------------------------------- checks

FAULTS = tables(__file__, "faults")
QUICK = ("array3", "ball2")


def verdicts(check: FmuCheck) -> dict[str, str]:
    return {finding.check: finding.verdict for finding in check.findings}


def texts(check: FmuCheck, name: str) -> str:
    return " ".join(finding.text for finding in check.findings if finding.check == name)


@pytest.mark.parametrize(
    "model",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in MODELS],
)
def test_sound_fmus_of_all_kinds_have_no_problem(foreign_fmu, model) -> None:
    check = check_fmu(foreign_fmu(model), step_size=0.01 if model == "fixed2" else 0.1)
    assert check.passed, check.problems
    found = verdicts(check)
    assert found["determinism"] == "ok"
    assert found["state"] == ("ok" if model in ("fixed2", "array3", "hostile2") else "warning")
    # FMI 1.0 model exchange has no reset.
    assert found["reset"] == ("warning" if model == "decay1" else "ok")


@pytest.mark.parametrize(("what", "check", "sentence"), FAULTS["fault"])
def test_one_fault_is_one_problem(foreign_fmu, what, check, sentence) -> None:
    result = check_fmu(foreign_fmu("hostile2", what), step_timeout=5.0 if what == "HANG" else None)
    assert not result.passed
    assert verdicts(result)[check] == "problem"
    assert sentence in texts(result, check)
    if check == "first flight":
        assert len(result.problems) == 1
        assert verdicts(result)["state"] == "skipped"


@pytest.mark.long
@pytest.mark.slow
def test_eighty_instances_in_one_process(foreign_fmu) -> None:
    """Create, run and free: the process does not grow, and one that leaks 256 KiB each is found out."""
    for what, cycles, verdict, sentence in (
        ((), 80, "ok", ""),
        (("LEAK_IN_FREE",), 60, "problem", "it leaks"),
        (("CRASH_IN_FREE",), 3, "problem", "Instance 1 of 3 in one process"),
    ):
        check = check_fmu(foreign_fmu("hostile2", *what), cycles=cycles)
        assert verdicts(check)["instances"] == verdict, texts(check, "instances")
        assert sentence in texts(check, "instances")


def test_step_sizes_and_units_that_contradict(foreign_fmu) -> None:
    for number, (model, options, changes, check, sentence) in enumerate(FAULTS["told"]):
        path = foreign_fmu.changed(model, f"told{number}", *changes)
        findings = check_file(inspect_fmu(path)[0])
        of_file = " ".join(finding.text for finding in findings if finding.check == check)
        assert sentence in (of_file or texts(check_fmu(path, **options), check))
    broken = foreign_fmu.changed("fixed2", "schema", ('<Real start="0"/>', "<Real/>"))
    assert any("start value" in finding.text for finding in check_file(inspect_fmu(broken)[0]))


def test_a_range_that_the_fmu_does_not_keep(foreign_fmu) -> None:
    check = check_fmu(foreign_fmu("hostile2", "REFUSE", "AFTER=0"))
    assert check.passed
    assert "1 of 4 ends of ranges fail, such as u = 10 m/s" in texts(check, "range edges")
    assert "u is too large" in texts(check, "range edges")


def test_a_binding_with_other_sizes_is_checked_with_them(foreign_fmu) -> None:
    """Three inputs, for which the FMU has two start values."""
    sized = bound(
        1.0,
        {"y": ("y", "1")},
        control={"u": ("u", "1")},
        header={"structural_parameters": {"n": 3}},
    )
    check = check_fmu(foreign_fmu("resize3"), sized, cycles=2)
    assert "3 finite outputs" in texts(check, "first flight")
    found = verdicts(check)
    names = ("binding", "first flight", "determinism", "step size", "reset", "instances")
    assert [found[name] for name in names] == ["ok"] * 6
    assert found["state"] == "warning"
    (problem,) = check_fmu(foreign_fmu("ball2"), bound(1.0, {"z": ("z", "1")})).problems
    assert "'z'" in problem  # which is no variable
