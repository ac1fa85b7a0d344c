"""A virtual wing: a design on a coarse mesh whose outputs stand for the published ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evidence.identification.comparison import outputs
from evidence.identification.local_model import LocalModel, build_local_model
from evidence.identification.parameters import FreeParameter, wing_parameters
from evidence.identification.targets import LEVELS, MASS_TOTAL, REFERENCE_PITOT, Targets
from fe.wing.design import WingDesign, load_design
from tests.kept import FE, ROOT, kept

ROWS = 12
SLOPES = "frequency_at_one", "frequency_slope", "mass_slope"
HEADER = (
    "e_sample,target_freq_1,target_freq_2,zeta_1,zeta_2,mass_servo_1,mass_servo_2,mass_pitot,freq_1,freq_2"
)


@pytest.fixture(scope="session")
def virtual_design() -> WingDesign:
    return load_design().changed(mesh={"refinement": 0.25, "span_size": 0.06, "chord_size": 0.2})


@pytest.fixture(scope="session")
def some_parameters(virtual_design: WingDesign) -> tuple[FreeParameter, ...]:
    """One of each kind: skin, inside, root, mass, place, load, edge, gauges."""
    chosen = {
        "skin modulus at 0", "skin shear ratio", "web shear modulus", "flap root spring", "skin density",
        "inner servo station", "net lift at 3g", "defect 1 span end", "defect 2 chord end", "row A first",
        "cluster 1 chord",
    }  # fmt: skip
    found = tuple(p for p in wing_parameters(virtual_design) if p.name in chosen)
    assert len(found) == len(chosen)
    return found


@pytest.fixture(scope="session")
def virtual_model(virtual_design: WingDesign, some_parameters: tuple[FreeParameter, ...]) -> LocalModel:
    made_from = (*FE, ROOT / "calibration", ROOT / "evidence", Path(__file__))
    return kept("local-model", lambda: build_local_model(virtual_design, some_parameters), made_from)


def rows() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    pitot = random.uniform(0.11, 0.15, ROWS)
    return random.uniform(0.96, 1.06, ROWS), 0.5 * (MASS_TOTAL - pitot), pitot


def targets_of(model: LocalModel) -> Targets:
    """Targets that this model meets exactly."""
    factor, servo, pitot = rows()
    blank = Targets(
        strain=np.ones((len(LEVELS), len(LEVELS), 24)),
        strain_slope=np.zeros(24),
        young_modulus_factor=factor,
        servo_mass=servo,
        pitot_mass=pitot,
        frequency=np.ones((ROWS, 2)),
        fitted_row=np.arange(ROWS) % 2 == 0,
        frequency_at_one=np.ones(2),
        frequency_slope=np.ones(2),
        mass_slope=np.ones(2),
        all_frequency_at_one=np.ones(2),
        all_frequency_slope=np.ones(2),
        all_mass_slope=np.ones(2),
        sources={},
    )
    found = outputs(model, blank)
    own = ("strain", "tip_stiffness", "tip_stiffness_slope", "strain_slope", "frequency", *SLOPES)
    met = {name: getattr(found, name) for name in own}
    return replace(blank, **met, **{f"all_{name}": met[name] for name in SLOPES})


def write_results(folder: Path) -> Path:
    """Write a file of step 3 in the published format: power laws in e and exponentials in the mass."""
    factor, servo, pitot = rows()
    first = 5.632 * factor**0.41 * np.exp(-0.5 * (pitot - REFERENCE_PITOT))
    second = 28.5 * factor**0.32 * np.exp(-0.3 * (pitot - REFERENCE_PITOT))
    step = folder / "calibration" / "step3"
    step.mkdir(parents=True, exist_ok=True)
    path = step / "massoptimizationresults.csv"
    targets = np.tile([5.6492, 29.9699, 0.0281, 0.0717], (ROWS, 1))
    table = np.column_stack((factor, targets, servo, servo, pitot, first, second))
    np.savetxt(path, table, "%.17g", ",", header=HEADER, comments="")
    return path


@pytest.fixture
def published_folder(tmp_path: Path, library_file: Path) -> Path:
    """A folder laid out as the two published ones, of a wing that never was."""
    write_results(tmp_path)
    library = tmp_path / "library" / "UAVconfig.json"
    library.parent.mkdir()
    library.write_bytes(library_file.read_bytes())
    return tmp_path


@pytest.fixture(scope="session")
def virtual_targets(virtual_model: LocalModel) -> Targets:
    return targets_of(virtual_model)
