"""The wing as a model, against matrices and closed forms of the same reduced wing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from calibration.result.file import save_calibration
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.models.interface import ACROSS, Conditions
from discrepancy.models.structures import WingModel
from fe.reduction.built_once import cache_folder
from fe.reduction.model_cache import entry
from fe.runtime import patch
from fe.runtime.patch import (
    LocalStiffnessLoss,
    ModelPatch,
    PointMass,
    PowerDamping,
    RootCompliance,
)
from fe.runtime.wing_rows import PatchArrays, strain_gauge
from fe.wing.design import load_design
from tests.discrepancy.asking import FloatArray, integrated, trial

OUTPUTS = (
    *((f"strain[{gauge}]", Quantity.STRAIN) for gauge in (1, 9, 21)),
    *(
        (name, Quantity.DISPLACEMENT)
        for name in ("tip_displacement", "load_point_displacement", "displacement[1.1, 0.6]")
    ),
)
STATIC = trial(TrialKind.STATIC, np.arange(5), force=np.array([4.0, 8.0, 20.0, 12.0, 0.0]), run="A")
FLIGHT = trial(TrialKind.FLIGHT, np.arange(3), load_factor=np.array([1.0, 2.0, 3.0]), run="A")
RING = trial(TrialKind.RINGDOWN, np.arange(400) / 200.0, release=Release(displacement=0.03), run="A")
LATE = RING.time > 0.03  # what more than six modes do has died out


class Wing:
    """The model at its nominal parameters, and the matrices of what it is reduced to."""

    def __init__(self, arrays: PatchArrays) -> None:
        self.model = WingModel(arrays)
        self.wing, self.arrays = self.model.wing, arrays
        self.means = np.array([parameter.mean for parameter in self.model.parameters])
        self.conditions = Conditions(self.means)
        self.tip = self.wing.force_row("tip_load")

    def respond(self, what: Trial, *items: Any, **given: Any) -> Any:
        return self.model.respond(what, OUTPUTS, ModelPatch(items), replace(self.conditions, **given))

    def seen(self, what: Trial, *items: Any, **given: Any) -> FloatArray:
        return self.respond(what, *items, **given).values

    def matrices(self, *items: Any, loss: Any = (0.0, 0.0), warm: float = 1.0) -> tuple[Any, Any, Any]:
        """Stiffness, mass and damping."""
        e, servo, pitot, alpha, beta = self.means
        structure = self.wing.at(np.array((warm * e, *loss, servo, pitot, 0.0, 0.0)), ModelPatch(items))
        return structure.stiffness, structure.mass, alpha * structure.mass + beta * structure.stiffness

    def static(self, loads: Any, *items: Any, **state: Any) -> FloatArray:
        return np.asarray(np.linalg.solve(self.matrices(*items, **state)[0], loads))

    def modes(self, *items: Any, count: int | None = None) -> tuple[Any, Any, Any]:
        """Squares, shapes and modal coordinates of the release of `RING`."""
        stiffness, mass, _ = self.matrices(*items)
        square, shapes = eigh(stiffness, mass, subset_by_index=None if count is None else [0, count - 1])
        held = np.linalg.solve(stiffness, self.tip)
        return square, shapes, shapes.T @ mass @ (0.03 / float(self.tip @ held) * held)

    def lift(self, load_factor: float, *items: Any) -> Any:
        return np.array((load_factor, load_factor**2)) @ self.wing.load_parts(ModelPatch(items))

    def rows(self, *items: Any) -> FloatArray:
        """What the outputs read of the displacements."""
        factors = self.wing.strain_factors(ModelPatch(items))
        rows = np.array([self.wing.output_row(name) for name, _ in OUTPUTS])
        gauges = np.array([strain_gauge(name) for name, _ in OUTPUTS])
        return rows if factors is None else rows * np.where(gauges < 0, 1.0, factors[gauges])[:, None]


@pytest.fixture(scope="module")
def wing(coarse_patch_arrays: PatchArrays) -> Wing:
    return Wing(coarse_patch_arrays)


# ---------------------------------------------------------------- at rest


def test_at_rest_it_is_the_solution_of_the_matrices(wing: Wing) -> None:
    items = RootCompliance(3e-5), patch.LoadPlace(0.02, 0.01), LocalStiffnessLoss(0.3, 0.5, 0.2)
    u = wing.static(np.outer(wing.wing.force_row("tip_load", ModelPatch(items)), STATIC.force), *items)
    assert wing.seen(STATIC, *items) == pytest.approx((wing.rows(*items) @ u).T, rel=1e-9)
    items = patch.Washout(0.1, 2.0), PointMass(0.1, 1.0)
    u = wing.static(np.transpose([wing.lift(n, *items) for n in FLIGHT.load_factor]))
    assert wing.seen(FLIGHT, *items) == pytest.approx((wing.rows() @ u).T, rel=1e-9)


def test_each_row_has_its_own_health_and_temperature(wing: Wing) -> None:
    warm = replace(FLIGHT, temperature=np.array([0.0, 20.0, 20.0]))
    health = np.array([[0.0, 0.0], [0.3, 0.1], [0.3, 0.4]])
    values = wing.seen(warm, patch.ModulusTemperature(1e-3), health=health)
    for row, n in enumerate(warm.load_factor):
        u = wing.static(wing.lift(n), loss=health[row], warm=1.0 - 1e-3 * warm.temperature[row])
        assert values[row] == pytest.approx(wing.rows() @ u, rel=1e-9)


def test_hysteresis_remembers_the_path_also_while_the_structure_warms(wing: Wing) -> None:
    slip = patch.MicroSlip("root", 8.0, 3e4, -0.3)
    values = wing.seen(STATIC, slip)
    assert values[-1, 3] > 1e-5  # unloaded, it does not come back
    # a temperature that does nothing must not change the path, though every row is solved by itself
    again = wing.seen(replace(STATIC, temperature=np.arange(5.0)), slip, patch.ModulusTemperature(1e-12))
    assert again == pytest.approx(values, rel=1e-6, abs=1e-10)


def test_components_are_the_rows_of_transverse_and_shear_strain(wing: Wing) -> None:
    u = wing.static(wing.tip)
    for number, part in enumerate(ACROSS, start=1):
        outputs = tuple((f"strain[{gauge}]{part}", Quantity.STRAIN) for gauge in (1, 9, 21))
        found = wing.model.respond(STATIC, outputs, ModelPatch(), wing.conditions).values
        rows = wing.arrays.strain_rows[number, [0, 8, 20]]
        assert found == pytest.approx(np.outer(STATIC.force, rows @ u), rel=1e-9)


# ---------------------------------------------------------------- in motion


@pytest.mark.parametrize(
    "items", [(), (PointMass(0.08, 1.3), RootCompliance(4e-5), LocalStiffnessLoss(0.4, 0.45, 0.3))]
)
def test_ring_down_is_the_modal_sum_of_all_unknowns(wing: Wing, items: Any) -> None:
    square, shapes, q = wing.modes(*items)
    alpha, beta = wing.means[3:]
    half, time = 0.5 * (alpha + beta * square), RING.time[:, None]
    root = np.sqrt((half**2 - square).astype(complex))
    fast, slow = (root - half) * np.exp(-(root + half) * time), (root + half) * np.exp((root - half) * time)
    wanted = (q * (slow + fast) / (2.0 * root)).real @ (wing.rows(*items) @ shapes).T
    values, scale = wing.seen(RING, *items), np.abs(wanted).max(axis=0)
    assert np.abs((values - wanted)[LATE] / scale).max() < 1e-3
    assert np.abs(values - wanted)[:, 3:5].max() < 3e-3 * scale[3]


def test_drag_over_the_planform_is_the_integral_over_the_area(wing: Wing) -> None:
    """Against the modes with drag at every station of the mesh, by a general integrator."""
    drag, (square, shapes, start) = 4.0, wing.modes(count=6)  # N at 1 m/s everywhere
    alpha, beta = wing.means[3:]
    rows, weights = wing.arrays.line_rows[2] @ shapes, wing.arrays.station_weights

    def rates(_: float, state: Any) -> Any:
        q, v = state[:6], state[6:]
        speed = rows @ v
        push = -(alpha + beta * square) * v - square * q - drag * (weights * np.abs(speed) * speed) @ rows
        return np.concatenate((v, push))

    moved = integrated(rates, RING.time, np.concatenate((start, np.zeros(6))), rtol=1e-9)
    wanted = moved[:, :6] @ (wing.rows() @ shapes).T

    def off(size: float) -> float:
        values = wing.seen(RING, PowerDamping("planform", size, 2.0, 0.0, 1.0, 1.0))
        return float(np.abs((values - wanted)[LATE] / np.abs(wanted).max(axis=0)).max())

    assert off(drag) < 2e-3
    assert off(0.0) > 0.1


def test_the_posterior_of_a_calibration_is_the_prior(
    make_calibration, coarse_patch_arrays, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    design = load_design().changed(mesh={"refinement": 0.25})
    cache_folder().mkdir()
    entry("patches", design.hash, None).write_bytes(coarse_patch_arrays.to_bytes())
    result = replace(make_calibration(), design=design, design_hash=design.hash)
    save_calibration(result, tmp_path / "wing.nc")
    model = WingModel.of_calibration(tmp_path / "wing.nc")
    assert model.name == result.asset
    assert [item.mean for item in model.parameters] == pytest.approx(result.samples.mean(axis=0)[:5])
    assert [item.deviation for item in model.parameters] == pytest.approx(result.samples.std(axis=0)[:5])
