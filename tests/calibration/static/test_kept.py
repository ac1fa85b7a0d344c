"""The calibration by the published static test is kept between runs, and is the same to the bit."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from calibration.static import kept, stiffness

FEW = partial(stiffness.calibrate_static, particle_count=2_000)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(stiffness, "calibrate_static", FEW)
    kept._record.cache_clear()
    yield tmp_path / "uav-twin"
    kept._record.cache_clear()


def test_what_is_kept_is_the_record_to_the_bit(own_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = kept.static_record(None, 3)
    assert json.loads(json.dumps(first)) == json.loads(json.dumps(FEW(seed=3).to_dict()))
    kept._record.cache_clear()
    monkeypatch.delattr(stiffness, "calibrate_static")  # nothing is calibrated again
    assert json.dumps(kept.static_record(None, 3)) == json.dumps(first)


def test_a_damaged_record_is_made_anew(own_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = kept.static_record(None, 3)
    (path,) = own_folder.glob("static-*.json")
    content = path.read_bytes()
    path.write_bytes(content.replace(b"1", b"2", 200))
    kept._record.cache_clear()
    assert kept.static_record(None, 3) == first
    assert "does not match its hash" in caplog.text
    assert path.read_bytes() == content


def test_the_oldest_make_way(own_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "MOST_KEPT", 2)
    paths = []
    for seed in range(3):
        kept.static_record(None, seed)
        paths += [path for path in own_folder.glob("static-*.json") if path not in paths]
    assert sorted(own_folder.glob("static-*.json")) == sorted(paths[1:])
    assert len(list(own_folder.iterdir())) == 4  # each with its lock
