"""The wing as a model, against matrices and closed forms of the same reduced wing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.optimize import brentq

from calibration.result.file import save_calibration
from calibration.result.record import Calibration
from discrepancy.campaign.records import Campaign, Hold, Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.wing import SHIPPED_PRIOR, WingModel
from fe.reduction.built_once import cache_folder
from fe.reduction.model_cache import entry
from fe.runtime.patch import (
    PRIMITIVES,
    LoadGain,
    LoadPlace,
    LocalStiffnessLoss,
    MicroSlip,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PowerDamping,
    PowerStiffness,
    RootCompliance,
    SensorGain,
    Washout,
)
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.planform_forces import STATION_PORTS
from fe.runtime.wing_rows import strain_gauge
from fe.wing.design import load_design

NONE = ModelPatch()
OUTPUTS = (
    *((f"strain[{gauge}]", Quantity.STRAIN) for gauge in (1, 9, 21)),
    ("tip_displacement", Quantity.DISPLACEMENT),
    ("load_point_displacement", Quantity.DISPLACEMENT),
    ("displacement[1.1, 0.6]", Quantity.DISPLACEMENT),
)


def make_trial(kind: TrialKind, size: int, **values: Any) -> Trial:
    time = values.pop("time", np.arange(size, dtype=np.float64))
    return Trial.plain(kind.value, kind, (), time, run="A", **values)


STATIC = make_trial(TrialKind.STATIC, 5, force=np.array([4.0, 8.0, 20.0, 12.0, 0.0]))
FLIGHT = make_trial(TrialKind.FLIGHT, 3, load_factor=np.array([1.0, 2.0, 3.0]))
RING = make_trial(TrialKind.RINGDOWN, 400, time=np.arange(400) / 200.0, release=Release(displacement=0.03))


@pytest.fixture(scope="module")
def model(coarse_patch_arrays: PatchArrays) -> WingModel:
    return WingModel(coarse_patch_arrays)


@pytest.fixture(scope="module")
def conditions(model: WingModel) -> Conditions:
    return Conditions(np.array([parameter.mean for parameter in model.parameters]))


def matrices(model: WingModel, conditions: Conditions, patch: ModelPatch = NONE) -> tuple[Any, Any, Any]:
    e, servo, pitot, alpha, beta = conditions.parameters
    structure = model.wing.structure(e, tuple(conditions.health[0]), servo, pitot, patch)
    return structure.stiffness, structure.mass, alpha * structure.mass + beta * structure.stiffness


def lift_at(model: WingModel, load_factor: float, patch: ModelPatch = NONE) -> Any:
    return np.array((load_factor, load_factor**2)) @ model.wing.load_parts(patch)


def output_rows(model: WingModel, patch: ModelPatch = NONE) -> Any:
    factors = model.wing.strain_factors(patch)
    rows = np.array([model.wing.output_row(name) for name, _ in OUTPUTS])
    gauges = [strain_gauge(name) for name, _ in OUTPUTS]
    return rows if factors is None else rows * np.where(np.array(gauges) < 0, 1.0, factors[gauges])[:, None]


def test_it_is_a_model(model: WingModel) -> None:
    as_model: Model = model
    assert as_model.ports() == ("root", "tip", "span")
    assert as_model.stations() == (0.0, pytest.approx(1.828))
    assert [item.name for item in as_model.parameters] == list(SHIPPED_PRIOR)
    assert all(item.low < item.mean < item.high for item in as_model.parameters)
    assert as_model.output_quantity("strain[3]") is Quantity.STRAIN
    assert as_model.output_quantity("displacement[0.5, 0.3]") is Quantity.DISPLACEMENT
    assert as_model.output_quantity("strain[77]") is None
    assert [kind for kind in PRIMITIVES if not as_model.supports(PRIMITIVES[kind])] == ["port_load"]


# ---------------------------------------------------------------- at rest


def test_at_rest_it_is_the_solution_of_the_matrices(model: WingModel, conditions: Conditions) -> None:
    patch = ModelPatch((RootCompliance(3e-5), LoadPlace(0.02, 0.01), LocalStiffnessLoss(0.3, 0.5, 0.2)))
    lift = ModelPatch((Washout(0.1, 2.0), PointMass(0.1, 1.0)))
    row = model.wing.force_row("tip_load", patch)
    for trial, changes, structure, loads in (
        (STATIC, patch, patch, [force * row for force in STATIC.force]),
        (FLIGHT, lift, NONE, [lift_at(model, n, lift) for n in FLIGHT.load_factor]),
    ):
        u = np.linalg.solve(matrices(model, conditions, structure)[0], np.transpose(loads))
        response = model.respond(trial, OUTPUTS, changes, conditions)
        assert response.values == pytest.approx((output_rows(model, structure) @ u).T, rel=1e-9)


def test_load_gain_and_tare_act_while_a_force_is_applied(model: WingModel, conditions: Conditions) -> None:
    plain = model.respond(STATIC, OUTPUTS, NONE, conditions).values
    values = model.respond(STATIC, OUTPUTS, ModelPatch((LoadGain(0.05, 0.4),)), conditions).values
    per_newton = plain[0] / STATIC.force[0]
    wanted = np.outer(1.05 * STATIC.force + 0.4 * (STATIC.force != 0.0), per_newton)
    assert values == pytest.approx(wanted, rel=1e-12)
    assert not values[-1].any()


def test_each_row_has_its_own_health_and_temperature(model: WingModel, conditions: Conditions) -> None:
    patch = ModelPatch((ModulusTemperature(1e-3),))
    warm = replace(FLIGHT, temperature=np.array([0.0, 20.0, 20.0]))
    health = np.array([[0.0, 0.0], [0.3, 0.1], [0.3, 0.4]])
    values = model.respond(warm, OUTPUTS, patch, replace(conditions, health=health)).values
    for row, (temperature, losses, n) in enumerate(
        zip(warm.temperature, health, warm.load_factor, strict=True)
    ):
        parameters = conditions.parameters.copy()
        parameters[0] *= 1.0 - 1e-3 * temperature
        stiffness = matrices(model, Conditions(parameters, health=losses[None]))[0]
        wanted = output_rows(model) @ np.linalg.solve(stiffness, lift_at(model, n))
        assert values[row] == pytest.approx(wanted, rel=1e-9)


def test_a_cubic_spring_at_the_tip_solves_its_scalar_equation(
    model: WingModel, conditions: Conditions
) -> None:
    patch = ModelPatch((PowerStiffness("tip", 5.0, 3.0, 0, 0.02),))
    row = model.wing.force_row("tip_load")
    u = np.linalg.solve(matrices(model, conditions)[0], row)
    compliance = float(row @ u)
    values = model.respond(STATIC, OUTPUTS, patch, conditions).values
    for level, force in enumerate(STATIC.force):

        def residual(x: float, force: float = force) -> float:
            return x - compliance * (force - 5.0 * (x / 0.02) ** 3)

        x = brentq(residual, -1.0, 1.0, xtol=1e-14)
        acting = force - 5.0 * (x / 0.02) ** 3
        assert values[level] == pytest.approx(acting * (output_rows(model) @ u), rel=1e-7, abs=1e-12)


def test_a_cubic_spring_over_the_planform_solves_the_equations_of_all_unknowns(
    model: WingModel, conditions: Conditions
) -> None:
    patch = ModelPatch((PowerStiffness("planform", 60.0, 3.0, 0, 0.02),))
    stiffness, *_ = matrices(model, conditions)
    row, rows = (
        model.wing.force_row("tip_load"),
        np.stack([model.wing.port_rows[port] for port in STATION_PORTS]),
    )
    share = model.wing.planform.share
    values = model.respond(STATIC, OUTPUTS, patch, conditions).values
    for level, force in enumerate(STATIC.force):
        u = np.linalg.solve(stiffness, force * row)
        for _ in range(60):  # Newton's method
            moved = rows @ u / 0.02
            residual = stiffness @ u - force * row + (60.0 * share * moved**3) @ rows
            tangent = stiffness + (rows.T * (180.0 * share * moved**2 / 0.02)) @ rows
            u = u - np.linalg.solve(tangent, residual)
        assert values[level] == pytest.approx(output_rows(model) @ u, rel=1e-6, abs=1e-12)
    plain = model.respond(STATIC, OUTPUTS, NONE, conditions).values
    assert np.abs(values - plain).max() > 0.05 * np.abs(plain).max()


def test_a_law_elsewhere_leaves_no_trace(model: WingModel, conditions: Conditions) -> None:
    def drag(port: str) -> ModelPatch:
        return ModelPatch((PowerDamping(port, 3.0, 2.0, 0.0, 1.0, 1.0),))

    fresh = WingModel(model.wing.arrays).respond(RING, OUTPUTS, drag("span"), conditions).values
    model.respond(RING, OUTPUTS, drag("planform"), conditions)
    assert np.array_equal(model.respond(RING, OUTPUTS, drag("span"), conditions).values, fresh)


def test_hysteresis_remembers_the_path_also_while_the_structure_warms(
    model: WingModel, conditions: Conditions
) -> None:
    slip = MicroSlip("root", 8.0, 3e4, -0.3)
    values = model.respond(STATIC, OUTPUTS, ModelPatch((slip,)), conditions).values
    assert values[-1, 3] > 1e-5  # unloaded, it does not come back
    # a temperature that does nothing must not change the path, though every row is solved by itself
    warm = replace(STATIC, temperature=np.arange(5.0))
    patch = ModelPatch((slip, ModulusTemperature(1e-12)))
    again = model.respond(warm, OUTPUTS, patch, conditions).values
    assert again == pytest.approx(values, rel=1e-6, abs=1e-10)


def test_components_are_the_rows_of_transverse_and_shear_strain(
    model: WingModel, conditions: Conditions
) -> None:
    response = model.respond(STATIC, OUTPUTS, NONE, replace(conditions, components=True))
    u = np.linalg.solve(matrices(model, conditions)[0], model.wing.force_row("tip_load"))
    for part, component in ((response.transverse, 1), (response.shear, 2)):
        rows = np.array([model.wing.output_row(name, component) for name, _ in OUTPUTS])
        assert part == pytest.approx(np.outer(STATIC.force, rows @ u), rel=1e-9)
        assert not part[:, 3:].any()
    moving = model.respond(RING, OUTPUTS, NONE, replace(conditions, components=True))
    assert moving.shear.shape == (len(RING.time), len(OUTPUTS))
    assert np.abs(moving.shear[:, :3]).max() > 0.0


# ---------------------------------------------------------------- in motion


@pytest.mark.parametrize(
    "patch",
    [NONE, ModelPatch((PointMass(0.08, 1.3), RootCompliance(4e-5), LocalStiffnessLoss(0.4, 0.45, 0.3)))],
)
def test_ring_down_is_the_modal_sum_of_all_unknowns(
    model: WingModel, conditions: Conditions, patch: ModelPatch
) -> None:
    stiffness, mass, _ = matrices(model, conditions, patch)
    square, shapes = eigh(stiffness, mass)
    alpha, beta = conditions.parameters[3:]
    row = model.wing.force_row("tip_load")
    held = np.linalg.solve(stiffness, row)
    q = shapes.T @ mass @ (0.03 / float(row @ held) * held)
    half = 0.5 * (alpha + beta * square)
    root = np.sqrt((half**2 - square).astype(complex))
    time = RING.time[:, None]
    motion = q * (
        ((root + half) * np.exp((root - half) * time) + (root - half) * np.exp(-(root + half) * time))
        / (2.0 * root)
    )
    wanted = motion.real @ (output_rows(model, patch) @ shapes).T
    values = model.respond(RING, OUTPUTS, patch, conditions).values
    scale = np.abs(wanted).max(axis=0)
    late = RING.time > 0.03  # what more than six modes do has died out
    assert np.abs((values - wanted)[late] / scale).max() < 1e-3
    assert np.abs(values - wanted)[:, 3:5].max() < 3e-3 * scale[3]


def test_drag_over_the_planform_is_the_integral_over_the_area(
    model: WingModel, conditions: Conditions
) -> None:
    """Against the modes with drag at every station of the mesh, by a general integrator."""
    drag = 4.0  # N at 1 m/s everywhere
    stiffness, mass, _ = matrices(model, conditions)
    square, shapes = eigh(stiffness, mass, subset_by_index=[0, 5])
    alpha, beta = conditions.parameters[3:]
    arrays = model.wing.arrays
    rows = arrays.line_rows[2] @ shapes

    def rates(_: float, state: Any) -> Any:
        q, v = state[:6], state[6:]
        speed = rows @ v
        push = (
            -(alpha + beta * square) * v
            - square * q
            - drag * (arrays.station_weights * np.abs(speed) * speed) @ rows
        )
        return np.concatenate((v, push))

    held = np.linalg.solve(stiffness, model.wing.force_row("tip_load"))
    start = shapes.T @ mass @ (0.03 / float(model.wing.force_row("tip_load") @ held) * held)
    moved = solve_ivp(
        rates, (0.0, float(RING.time[-1])), np.concatenate((start, np.zeros(6))), t_eval=RING.time, rtol=1e-9,
        atol=1e-12,
    )  # fmt: skip
    wanted = moved.y[:6].T @ (output_rows(model) @ shapes).T

    def off(port: str, size: float) -> float:
        patch = ModelPatch((PowerDamping(port, size, 2.0, 0.0, 1.0, 1.0),))
        values = model.respond(RING, OUTPUTS, patch, conditions).values
        late = RING.time > 0.03  # what more than six modes do has died out
        return float(np.abs((values - wanted)[late] / np.abs(wanted).max(axis=0)).max())

    assert off("planform", drag) < 2e-3
    assert off("planform", 0.0) > 0.1


def test_a_force_over_the_planform_has_its_share_in_the_first_mode(
    model: WingModel, conditions: Conditions
) -> None:
    campaign = Campaign("lab", {}, (STATIC, replace(RING, start=10.0)), None, {}, "")
    scale = model.scales(campaign).ports["planform"]
    stiffness, mass, _ = matrices(model, conditions)
    _, shapes = eigh(stiffness, mass, subset_by_index=[0, 0])
    arrays = model.wing.arrays
    motion = arrays.line_rows[2] @ shapes[:, 0]
    mean = float(arrays.station_weights @ motion)
    wanted = float(arrays.station_weights @ np.abs(motion / mean) ** 3)
    assert scale.mean_power(1.0) == pytest.approx(1.0)
    assert scale.mean_power(3.0) == pytest.approx(wanted, rel=1e-2)
    assert model.scales(campaign).ports["tip"].mean_power(3.0) == 1.0


def test_a_harmonic_force_reaches_the_frequency_response(model: WingModel, conditions: Conditions) -> None:
    stiffness, mass, damping = matrices(model, conditions)
    omega = 2.0 * np.pi * 9.0
    time = np.arange(12000) / 1000.0
    trial = make_trial(TrialKind.FORCED, 12000, time=time, force=3.0 * np.sin(omega * time))
    values = model.respond(trial, OUTPUTS, NONE, conditions).values[-1000:]
    dynamic = stiffness - omega**2 * mass + 1j * omega * damping
    amplitude = output_rows(model) @ np.linalg.solve(dynamic, 3.0 * model.wing.force_row("tip_load"))
    wanted = (amplitude[:, None] * np.exp(1j * omega * time[-1000:])).imag.T
    assert np.abs((values - wanted) / np.abs(amplitude)).max() < 2e-3


@pytest.mark.parametrize("hold", list(Hold))
def test_a_coarse_force_does_between_its_samples_what_is_said(
    model: WingModel, conditions: Conditions, hold: Hold
) -> None:
    """At nine samples a period, against the same force recorded a hundred times as fast."""
    time, fine = np.arange(120) / 81.0, np.arange(119 * 100 + 1) / 8100.0
    force = 3.0 * np.sin(2.0 * np.pi * 9.0 * time)
    coarse = make_trial(TrialKind.FORCED, 120, time=time, force=force, hold=hold)
    between = {
        Hold.LINEAR: np.interp(fine, time, force),
        Hold.SMOOTH: CubicSpline(time, force)(fine),
        Hold.ZERO_ORDER: force[np.maximum(np.arange(len(fine)) - 1, 0) // 100],
    }[hold]
    known = make_trial(TrialKind.FORCED, len(fine), time=fine, force=between)
    found = model.respond(coarse, OUTPUTS, NONE, conditions).values
    wanted = model.respond(known, OUTPUTS, NONE, conditions).values[::100]
    largest = np.abs(wanted).max()
    # the fine record of what is held goes up within its first interval
    assert np.abs(found - wanted).max() < (2e-2 if hold is Hold.ZERO_ORDER else 1e-4) * largest
    straight = model.respond(replace(coarse, hold=None), OUTPUTS, NONE, conditions).values
    differ = np.abs(straight - wanted).max() > 2e-2 * largest
    assert differ == (hold is not Hold.LINEAR)


def test_a_small_mass_lowers_the_frequency_as_rayleigh_says(model: WingModel, conditions: Conditions) -> None:
    stiffness, mass, _ = matrices(model, conditions)
    # M x = x / omega^2 in the norm of K, which is well conditioned in this basis where M is not
    last = [len(mass) - 1] * 2
    inverse, shapes = eigh(mass, stiffness, subset_by_index=last)
    shapes = shapes / np.sqrt(inverse)
    station, added = 1.6, 1e-4
    rows = [model.wing._along(station) @ part for part in model.wing.arrays.line_rows[:3]]
    share = sum(float(row @ shapes[:, 0]) ** 2 for row in rows)
    heavy = matrices(model, conditions, ModelPatch((PointMass(added, station),)))[1]
    lower = eigh(heavy, stiffness, subset_by_index=last, eigvals_only=True)
    assert inverse[0] / lower[0] == pytest.approx(1.0 / (1.0 + added * share), rel=1e-9)
    assert inverse[0] / lower[0] < 1.0 / (1.0 + added * share)  # Rayleigh's quotient is an upper bound


def test_scales(model: WingModel, conditions: Conditions) -> None:
    campaign = Campaign("lab", {}, (STATIC, replace(RING, start=10.0)), None, {}, "")
    scales = model.scales(campaign)
    stiffness, mass, _ = matrices(model, conditions)
    row = model.wing.force_row("tip_load")
    assert scales.tip_stiffness == pytest.approx(1.0 / float(row @ np.linalg.solve(stiffness, row)))
    square, shapes = eigh(stiffness, mass, subset_by_index=[0, 0])
    assert scales.angular_frequency == pytest.approx(float(np.sqrt(square[0])), rel=1e-6)
    assert scales.modal_mass == pytest.approx(float(row @ shapes[:, 0]) ** -2, rel=1e-5)
    assert scales.force == 20.0
    assert scales.duration == pytest.approx(RING.time[-1])
    assert scales.campaign_time == pytest.approx(10.0 + RING.time[-1])
    tip = scales.ports["tip"]
    assert tip.displacement == pytest.approx(max(0.03, 20.0 / scales.tip_stiffness))
    assert tip.stiffness == pytest.approx(scales.modal_mass * scales.angular_frequency**2)


def test_sensors_are_passed_over_and_answers_are_repeatable(model: WingModel, conditions: Conditions) -> None:
    once = model.respond(RING, OUTPUTS, NONE, conditions).values
    again = model.respond(RING, OUTPUTS, ModelPatch((SensorGain("*", 0.5),)), conditions).values
    assert np.array_equal(once, again)
    fresh = WingModel(model.wing.arrays).respond(RING, OUTPUTS, NONE, conditions).values
    assert np.array_equal(once, fresh)


# ---------------------------------------------------------------- where it comes from, what it refuses


def test_the_posterior_of_a_calibration_is_the_prior(
    make_calibration: Callable[..., Calibration],
    coarse_patch_arrays: PatchArrays,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    design = load_design().changed(mesh={"refinement": 0.25})
    cache_folder().mkdir()
    coarse_patch_arrays.save(entry("patches", design.hash, None))
    result = replace(make_calibration(), design=design, design_hash=design.hash)
    save_calibration(result, tmp_path / "wing.nc")
    model = WingModel.of_calibration(tmp_path / "wing.nc")
    assert model.name == result.asset
    assert [item.mean for item in model.parameters] == pytest.approx(result.samples.mean(axis=0)[:5])
    assert [item.deviation for item in model.parameters] == pytest.approx(result.samples.std(axis=0)[:5])
    with pytest.raises(ModelError, match="cannot be used"):
        WingModel.of_calibration(tmp_path / "absent.nc")
    with pytest.raises(ModelError, match="cannot be read"):
        WingModel.of_design(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("trial", "outputs", "patch", "count", "message"),
    [
        (STATIC, OUTPUTS, NONE, 2, "5 parameters, but 2 came"),
        (STATIC, (("strain[99]", Quantity.STRAIN),), NONE, 5, "no output 'strain\\[99\\]'"),
        (STATIC, (("strain[1]", Quantity.DISPLACEMENT),), NONE, 5, "is a strain"),
        (STATIC, (("tip_displacement", Quantity.VELOCITY),), NONE, 5, "is at rest"),
        (STATIC, OUTPUTS, ModelPatch((PowerStiffness("nose", 1.0, 3.0, 0, 1.0),)), 5, "nose"),
        (STATIC, OUTPUTS, ModelPatch((LocalStiffnessLoss(1.2, 0.2, 0.5),)), 5, "leave some stiffness"),
        (replace(STATIC, load_place="nose"), OUTPUTS, NONE, 5, "place 'nose' is not known"),
        (replace(RING, release=None), OUTPUTS, NONE, 5, "how it was released"),
    ],
)
def test_what_cannot_be_is_refused(
    model: WingModel, trial: Trial, outputs: Any, patch: ModelPatch, count: int, message: str
) -> None:
    means = np.array([parameter.mean for parameter in model.parameters])
    with pytest.raises(ModelError, match=message):
        model.respond(trial, outputs, patch, Conditions(means[:count]))
