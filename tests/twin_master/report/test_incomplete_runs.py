"""Runs that lack something are reported as far as they go, and damaged ones refused with one sentence."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_array_equal

from reporting.errors import DiskFullError
from tests.twin_master.report import synthetic_run
from tests.twin_master.report.drawn import line, panel
from twin_master.errors import RunFolderError
from twin_master.report import check as report_check
from twin_master.report import mission as report_mission
from twin_master.report import page as report
from twin_master.report import reading as report_reading
from twin_master.report.text import (
    lost_ranges,
)


def without(tree: xr.DataTree, missing: str) -> xr.DataTree:
    """A run without a group, or without a variable: GROUP/VARIABLE."""
    part = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in tree.children})
    group, _, variable = missing.partition("/")
    if variable:
        part[group] = xr.DataTree(part[group].to_dataset().drop_vars(variable))
    else:
        del part[group]
    return part


@pytest.mark.parametrize(
    "missing",
    [
        "truth", "smoothed", "policy", "calibration",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in (
                "predicted", "policy/action_value", "observed/strain", "truth/strain",
                "filtered/quantity_mean", "filtered/reward_mean", "predicted/quantity_mean",
                "predicted/control_probability", "filtered/log_evidence",
                "filtered/quantity_standard_deviation", "filtered/quantity_lower",
                "predicted/reward_standard_deviation",
            )
        ),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("no_drawing")
def test_a_missing_part_is_left_out(tmp_path: Path, tree: xr.DataTree, missing: str) -> None:
    text = report.write_report(synthetic_run.write_run(tmp_path / "run", without(tree, missing))).read_text(
        encoding="utf-8"
    )
    assert text.count("<figure") >= 4
    if missing == "truth":
        assert "truth" not in text.replace("the truth, which", "")
    if missing == "observed/strain":
        assert "holds no observations" in text


@pytest.mark.usefixtures("no_drawing")
def test_a_run_without_any_json_is_reported(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    for path in place.glob("*.json"):
        path.unlink()
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "<h1>level_turns</h1>" in text


@pytest.mark.long
@pytest.mark.parametrize(("steps", "horizon"), [(1, 10), (2, 0)])
def test_short_missions(tmp_path: Path, steps: int, horizon: int) -> None:
    short = synthetic_run.build_tree(steps=steps, horizon=horizon, sensors=5)
    text = report.write_report(synthetic_run.write_run(tmp_path / "run", short)).read_text(encoding="utf-8")
    assert f"{steps} turns" in text


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    ("steps", "horizon"),
    [(12, 10), *(pytest.param(*row, marks=pytest.mark.long) for row in ((2, 3), (3, 1), (4, 0)))],
)
def test_other_short_missions(tmp_path: Path, steps: int, horizon: int) -> None:
    test_short_missions(tmp_path, steps, horizon)


@pytest.mark.usefixtures("no_drawing")
def test_lost_gauges_are_told_and_marked(tmp_path: Path) -> None:
    place = synthetic_run.write_run(tmp_path / "run", synthetic_run.build_tree(lost=True))
    record = report_reading.read_run(place)
    assert lost_ranges(record) == "gauges 17, 18, 19, 20 at turns 12–18; all gauges at turns 3–4"
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "the belief followed the dynamics alone" in text
    axes = panel(report_mission.mission_figure(record, 49, [16]), "Gauge 17")
    assert_array_equal(line(axes, "lost")[:, 0], [3, 4, *range(12, 19)])
    check = report_check.predictive_check(record)
    assert check is not None
    assert check.count[16] == 50 - 2 - 7


@pytest.mark.usefixtures("no_drawing")
def test_a_gauge_that_never_reports_and_a_run_without_any_observation(
    tmp_path: Path, tree: xr.DataTree
) -> None:
    for name, sensors in (("one", slice(4, 5)), ("all", slice(None))):
        changed = tree.copy(deep=True)
        changed["observed/strain"].values[:, sensors] = np.nan
        place = synthetic_run.write_run(tmp_path / name, changed)
        text = report.write_report(place).read_text(encoding="utf-8")
        assert "Observations lost" in text


@pytest.mark.parametrize("content", [b"", b"not a run", b"\x89HDF\r\n\x1a\n" + bytes(100), None])
def test_a_damaged_run_gives_one_sentence(folder: Path, tmp_path: Path, content: bytes | None) -> None:
    whole = (folder / "run.nc").read_bytes()
    (tmp_path / "run.nc").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(RunFolderError, match=r"damaged.* cannot be read") as caught:
        report.write_report(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.html").exists()


def test_a_folder_without_a_run_gives_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
        report.write_report(tmp_path)


@pytest.mark.parametrize(
    "missing", ["filtered", "filtered/probability", "observed", "observed/control_index"]
)
@pytest.mark.usefixtures("no_drawing")
def test_another_layout_gives_one_sentence(tmp_path: Path, tree: xr.DataTree, missing: str) -> None:
    with pytest.raises(RunFolderError, match="layout of a run"):
        report.write_report(synthetic_run.write_run(tmp_path / "run", without(tree, missing)))


def test_other_axes_give_one_sentence(tmp_path: Path, tree: xr.DataTree) -> None:
    changed = tree.copy()
    renamed = tree["filtered"].to_dataset().rename({"step": "time"})
    del changed["filtered"]
    changed["filtered"] = xr.DataTree(renamed)
    with pytest.raises(RunFolderError, match="probability has the axes"):
        report.write_report(synthetic_run.write_run(tmp_path / "run", changed))


def test_a_damaged_configuration_gives_one_sentence(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    for content in ('{"half": ', "[1]"):
        (place / "config.json").write_text(content)
        with pytest.raises(RunFolderError, match=r"config\.json"):
            report.write_report(place)


@pytest.mark.parametrize("now", [-1, 50])
def test_the_present_must_be_a_turn_of_the_run(folder: Path, now: int) -> None:
    with pytest.raises(RunFolderError, match=r"must lie in 0\.\.49"):
        report.write_report(folder, now=now)


@pytest.mark.usefixtures("no_drawing")
def test_a_full_disk_keeps_the_old_report(
    tmp_path: Path, tree: xr.DataTree, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    (place / "report.html").write_text("old")

    def fail(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DiskFullError):
        report.write_report(place)
    assert (place / "report.html").read_text() == "old"
    assert list((place / "figures").iterdir()) == []


def test_a_run_that_was_cut_off_anywhere_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "run.nc").read_bytes()
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    for length in (1, 100, 2_000, len(whole) // 3, len(whole) - 10):
        (tmp_path / "run.nc").write_bytes(whole[:length])
        with pytest.raises(RunFolderError, match=r"damaged.*: resume the run or fly it again\.$"):
            report_reading.read_run(tmp_path)
