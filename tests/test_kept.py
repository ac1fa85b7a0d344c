from pathlib import Path

import pytest

from tests import kept as shared


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(shared, "FOLDER", tmp_path / "kept")
    (tmp_path / "room" / "deeper").mkdir(parents=True)
    file = tmp_path / "room" / "deeper" / "made.txt"
    file.write_text("one", encoding="utf-8")
    return file


def once(source: Path, inputs: object = None) -> tuple[str, bool]:
    """What is kept of a file, and whether it was made now."""
    made = []

    def build() -> str:
        made.append(True)
        return source.read_text(encoding="utf-8")

    return shared.kept("text", build, (source.parents[1],), inputs), bool(made)


def moved(source, monkeypatch):
    source.rename(source.with_name("other.txt"))
    source.write_text("", encoding="utf-8")


def torn(source, monkeypatch):
    for file in shared.FOLDER.glob("*.pickle"):
        file.write_bytes(file.read_bytes()[:5])


CHANGES = [
    lambda source, _: source.write_text("two", encoding="utf-8"),
    lambda source, _: (source.parent / "further.txt").touch(),
    moved,
    torn,
    lambda _, monkeypatch: monkeypatch.setattr(shared, "_surroundings", lambda: b"another numpy"),
]


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_kept_is_met_until_something_changes(source, monkeypatch, change):
    assert once(source) == ("one", True)
    assert once(source) == ("one", False)
    assert once(source, inputs=1.5) == ("one", True)
    change(source, monkeypatch)
    assert once(source) == (source.read_text(encoding="utf-8"), True)
