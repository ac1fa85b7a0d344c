"""What several packages' tests share."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

LEVELS = (0, 20, 40, 60, 80)


def synthetic_library() -> dict[str, object]:
    """A strain library in the published format, of a wing that never was: 24 gauges, 5 draws of e."""
    row = np.linspace(2910.0, 450.0, 16)
    healthy = np.concatenate([row, 1.06 * row[4:12] + 400.0])
    place = np.concatenate([np.linspace(0.0, 1.0, 16), np.linspace(0.27, 0.73, 8)])
    first = 0.12 + 0.32 * np.exp(-(((place - 0.27) / 0.12) ** 2))
    second = 0.02 + 0.33 * np.exp(-(((place - 0.62) / 0.12) ** 2))
    factors = (0.994, 1.0, 1.004, 1.008, 1.014)
    observations: dict[str, object] = {}
    for z1 in LEVELS:
        observations[str(z1)] = {}
        for z2 in LEVELS:
            strain = healthy / ((1.0 - first * z1 / 100.0) * (1.0 - second * z2 / 100.0))
            entry = {}
            for control, load in (("2g", 2.0), ("3g", 3.0)):
                draws = {"mean": (load / 3.0 * strain / 1.0**0.85).tolist()}
                draws |= {str(e): (load / 3.0 * strain / e**0.85).tolist() for e in factors}
                entry[control] = draws
            observations[str(z1)][str(z2)] = entry  # type: ignore[index]
    return {
        "states": [list(LEVELS), list(LEVELS)],
        "controls": ["2g", "3g"],
        "gamma": 0.6,
        "transition_probabilities": {"2g": 0.05, "3g": 0.1},
        "observations": observations,
    }


@pytest.fixture(scope="session")
def library_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of a synthetic strain library."""
    path = tmp_path_factory.mktemp("library") / "UAVconfig.json"
    path.write_text(json.dumps(synthetic_library()), encoding="utf-8")
    return path


REFERENCE = Path(__file__).parents[1].parent / "shared" / "reference"


@pytest.fixture(scope="session")
def published_library() -> Path:
    """Path of the authors' published strain library; skips where it is not at hand."""
    path = REFERENCE / "uav_digital_twin" / "UAVconfig.json"
    if not path.is_file():
        pytest.skip(f"the published strain library is not at {path}")
    return path


@pytest.fixture(scope="session")
def foreign_fmu(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Build FMUs of other conventions and misbehaviours from C: `foreign_fmu("ball2")` is a path."""
    path = Path(__file__).parent / "fmu_asset" / "foreign" / "workshop.py"
    specification = importlib.util.spec_from_file_location("foreign_workshop", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.Workshop(tmp_path_factory.mktemp("foreign"))
