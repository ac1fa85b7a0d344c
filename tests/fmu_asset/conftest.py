"""A small wing of springs and masses with the interface of the real one, packed as an FMU once."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from fe.reduced import ReducedModel
from fmu_asset.binding import Binding, load_binding, parse_binding
from fmu_asset.build import build_fmu

ROOT = Path(__file__).parents[2]
NODES = 16
GAUGES = 24


def chain_model(stiffness: float = 9.0e4) -> ReducedModel:
    """Return a chain of 16 springs and masses as a reduced model: exact, so its error bound is zero."""
    difference = np.eye(NODES) - np.eye(NODES, k=-1)
    region = np.zeros((4, NODES))
    region[1, 3:6] = region[2, 9:12] = 1.0
    region[0] = 1.0 - region[1] - region[2]
    region[3] = 0.05
    terms = np.stack([difference.T @ np.diag(stiffness * row) @ difference for row in region])
    mass = np.stack([0.06 * np.eye(NODES), np.zeros((NODES, NODES)), np.zeros((NODES, NODES))])
    mass[1, 10, 10] = mass[1, 14, 14] = mass[2, 15, 15] = 1.0
    load = np.stack([np.linspace(12.0, 2.0, NODES), np.eye(NODES)[-2]])
    gauge = difference[np.arange(GAUGES) % NODES] * np.linspace(0.3, 0.6, GAUGES)[:, np.newaxis]
    output = np.vstack((gauge, np.eye(NODES)[-1]))
    outputs = GAUGES + 1
    _, shapes = np.linalg.eigh(terms.sum(axis=0))
    # The chain is exact: whatever the model allows for rounding and truncation is zero.
    allowances = {item.name: 0.0 for item in fields(ReducedModel) if item.name.endswith("_allowance")}
    return ReducedModel(
        design_hash="chain",
        validity_box=np.array(
            [[0.85, 1.15], [0.0, 0.85], [0.0, 0.85], [-1.0, 4.0], [-20.0, 20.0], [0.1, 0.25], [0.1, 0.2]]
        ),
        static_stiffness=terms,
        static_load=load,
        static_output=output,
        bound_reference=np.ones(3),
        residual_load=np.zeros((32, 2)),
        residual_stiffness=np.zeros((32, 4, NODES)),
        dual_split_1=np.array([0.4]),
        dual_split_2=np.array([0.4]),
        dual_correction=np.zeros((2, 2, outputs, 32)),
        dual_residual=np.zeros((2, 2, outputs, 4, 4)),
        modal_stiffness=terms,
        modal_mass=mass,
        modal_load=load,
        modal_output=output,
        cross_mass=mass,
        flapwise_reference=shapes[:, :2].T.copy(),
        mode_count=8,
        **allowances,
    )


@pytest.fixture(scope="session")
def make_model() -> Callable[[float], ReducedModel]:
    return chain_model


@pytest.fixture(scope="session")
def model() -> ReducedModel:
    return chain_model()


@pytest.fixture(scope="session")
def fmu(model: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(model, tmp_path_factory.mktemp("fmu") / "wing.fmu").path


@pytest.fixture(scope="session")
def binding() -> Binding:
    return load_binding(ROOT / "scenarios" / "bindings" / "uav_wing.toml")


SPRING_MASS = {
    "binding": {"name": "spring_mass", "step_size": 0.1, "start_time": 2.0},
    "control": {"push": {"variable": "force", "unit": "N"}},
    "health": {"spring": {"variable": "stiffness", "unit": "N/m"}},
    "load": {
        "lock": {"variable": "locked", "unit": "1"},
        "misbehaviour": {"variable": "misbehaviour", "unit": "1"},
    },
    "observation": {"motion": {"variables": ["velocity", "position"], "unit": "m"}},
    "monitor": {"steps": {"variable": "steps", "unit": "1"}},
}


@pytest.fixture(scope="session")
def spring_mass(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU of another maker, as pythonfmu's own builder exports it."""
    folder = tmp_path_factory.mktemp("spring_mass")
    shutil.copy(Path(__file__).with_name("spring_mass.py"), folder / "SpringMass.py")
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", "SpringMass.py"],
        cwd=folder,
        check=True,
        capture_output=True,
    )
    return folder / "SpringMass.fmu"


@pytest.fixture(scope="session")
def spring_binding() -> Binding:
    return parse_binding(SPRING_MASS)
