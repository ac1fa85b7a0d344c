"""Files, messages and options that use names of earlier versions."""

import warnings

import pytest

from reporting.errors import DamagedFileError
from reporting.formats import former_names
from reporting.formats.former_names import FormerNameWarning, with_present_names

PRESENT_NAMES = {
    "turn": "step",
    "group.inspections_a_turn": "inspections_per_step",
    "assets.*.turn": "step",
}


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(former_names, "_sources_told", set())


def test_former_names_are_replaced_where_they_stand_and_nowhere_else():
    former = {
        "name": "turn",
        "turn": 3,
        "group": [{"inspections_a_turn": 2}, {"count": 1}],
        "assets": {"turn": {"turn": 1}, "two": {"steps": 0}},
        "other": {"turn": 4},
    }
    sentence = (
        "^a.toml: `turn` is now called `step` and "
        "`inspections_a_turn` is now called `inspections_per_step`. "
        "The former names are still read.$"
    )
    with pytest.warns(FormerNameWarning, match=sentence):
        present = with_present_names(former, PRESENT_NAMES, "a.toml", DamagedFileError)
    assert present == {
        "name": "turn",
        "step": 3,
        "group": [{"inspections_per_step": 2}, {"count": 1}],
        "assets": {"turn": {"step": 1}, "two": {"steps": 0}},
        "other": {"turn": 4},
    }
    assert [*present] == ["name", "step", "group", "assets", "other"]
    assert former["turn"] == 3  # what was read stays as it was


def test_a_user_is_told_once_for_each_file():
    for source in ("a.toml", "b.toml"):
        with pytest.warns(FormerNameWarning, match=f"^{source}: "):
            with_present_names({"turn": 1}, PRESENT_NAMES, source, DamagedFileError)
    with warnings.catch_warnings(action="error"):
        with_present_names({"turn": 1}, PRESENT_NAMES, "a.toml", DamagedFileError)


def test_what_has_no_former_name_is_not_copied():
    record = {"step": 1, "group": [{"count": 1}]}
    with warnings.catch_warnings(action="error"):
        assert with_present_names(record, PRESENT_NAMES, "a.toml", DamagedFileError) is record


def test_a_key_under_both_names_is_refused():
    sentence = "^a.toml: `turn` is now called `step`, and both are given.$"
    with pytest.raises(DamagedFileError, match=sentence):
        with_present_names({"turn": 1, "step": 2}, PRESENT_NAMES, "a.toml", DamagedFileError)
