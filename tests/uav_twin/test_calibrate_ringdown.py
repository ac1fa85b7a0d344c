"""`uav-twin calibrate ringdown` on the command line."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import refused, said


def figures(file: Path) -> dict[str, float]:
    with file.open(encoding="utf-8", newline="") as stream:
        return {row["figure"]: float(row["found"]) for row in csv.DictReader(stream)}


@pytest.fixture
def plots(tmp_path: Path) -> Path:
    """Three records read off a plot, in the authors' layout."""
    folder = tmp_path / "data" / "step3"
    folder.mkdir(parents=True)
    width = 0.0081
    fine = np.arange(0.0, 6.4, width / 32.0)
    signal = sum(
        amplitude * np.exp(-rate * fine) * np.cos(2.0 * math.pi * frequency * fine + 1.0)
        for frequency, rate, amplitude in ((5.65, 1.0, 0.0115), (29.9, 13.0, 0.018))
    )
    columns = fine.size // 32
    table = np.asarray(signal)[: 32 * columns].reshape(columns, 32)
    time = width * (np.arange(columns) + 0.5)
    low, high = table.min(axis=1) - 2e-4, table.max(axis=1) + 2e-4
    for trial in (1, 2, 3):
        np.savetxt(
            folder / f"ringdown_trial{trial}_digitised.csv",
            np.column_stack([time, low, 0.5 * (low + high), high]),
            delimiter=",",
            header="t_s,V_low,V_mid,V_high  (drawn)",
        )
    return tmp_path / "data"


@pytest.mark.parametrize("options", [(), ("--extremes",), ("--fitted",)])
def test_ringdown(plots: Path, tmp_path: Path, options: tuple[str, ...]) -> None:
    out = tmp_path / "out"
    said("calibrate", "ringdown", "--data", str(plots), "--out", str(out), *options)
    found = figures(out / "ringdown.csv")
    assert all(len(str(value)) > 8 for value in found.values())  # the console has five digits
    assert found["mode 1, natural frequency"] == pytest.approx(5.65, rel=5e-3)
    assert found["mode 2, natural frequency"] == pytest.approx(29.9, rel=2e-2)
    assert (out / "figures" / "ringdown.svg").is_file()
    assert (out / "figures" / "ringdown.png").is_file()


def test_what_is_wrong_is_said_in_one_sentence(tmp_path: Path) -> None:
    assert "does not exist" in refused("calibrate", "ringdown", "--data", str(tmp_path / "nothing"))
