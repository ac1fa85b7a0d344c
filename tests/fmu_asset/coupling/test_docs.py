"""The example of the docs does what it says."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.binding import Binding
from fmu_asset.session import FmiAsset


def test_the_example_of_the_docs(
    fmu: Path, binding: Binding, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parents[3] / "docs" / "coupling.md").read_text(encoding="utf-8")
    (example,) = [
        block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "CoupledAsset(" in block
    ]
    shutil.copy(fmu, tmp_path / "wing.fmu")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example, names)
    with FmiAsset(fmu, binding, isolated=False) as wing:
        true = 1e6 * wing.step({"load_factor": 3.0}, {"z1": 0.2}).values
    noise = names["seen"].values - true
    assert np.abs(noise).min() > 0.0
    assert 50.0 < noise.std() < 300.0  # 24 readings with 150 microstrain
