"""A structure in motion, a wing's and a beam's, against general integrators, closed forms and full models."""

import numpy as np
import pytest
from scipy.linalg import expm

from fe.runtime.arrays import PLACE
from fe.runtime.errors import InvalidStateError, OutsideModelError
from fe.runtime.patch import ModelPatch, PowerStiffness
from fe.runtime.patched_wing import PatchedState
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from tests.fe.runtime.stepping import exact, second_order
from tests.wings import wing_integrator

ALPHA, BETA = 1.0735, 7.3124e-4  # Kapteyn et al. 2021, fitted to the ring-down of the real wing
HEALTHY = {"servo_mass": 0.169, "pitot_mass": 0.134, "damping_alpha": ALPHA, "damping_beta": BETA}
HOLDING = PatchedState.holding


@pytest.fixture(scope="module")
def integrator(model: ReducedModel) -> ModalIntegrator:
    return wing_integrator(model, **HEALTHY)


@pytest.mark.parametrize("beta", [0.0, BETA, 0.05])  # with 0.05 s all but the first mode are overdamped
def test_loads_that_are_held_are_integrated_exactly(model, beta):
    integrator = wing_integrator(model, **{**HEALTHY, "damping_beta": beta})
    assert (integrator.damping_ratio[1:] > 1).all() == (beta == 0.05)
    omega = 2.0 * np.pi * integrator.modes.frequency
    matrix = second_order(np.diag(omega**2), np.diag(2.0 * integrator.damping_ratio * omega))
    into = np.concatenate((0.0 * integrator.modes.participation.T, integrator.modes.participation.T))
    time = np.array((0.0, 0.05, 0.3, 0.31, 0.6))
    loads = np.array(((3.0, 0.0), (2.0, 5.0), (2.0, -5.0), (2.5, 0.0), (0.0, 0.0)))
    state = integrator.at_rest((1.0, 0.0))
    first = np.concatenate((state.displacement, state.velocity))
    wanted = exact(matrix, into, time, loads, held=True, first=first)
    for k, duration in enumerate(np.diff(time)):
        state = integrator.advance(state, duration, loads[k])
        found, y = np.concatenate((state.displacement, state.velocity / omega)), wanted[k + 1]
        y[model.mode_count :] /= omega
        np.testing.assert_allclose(found, y, atol=1e-9 * np.abs(y).max())


@pytest.mark.parametrize("kind", ["wing", "beam"])
def test_rest_is_the_static_response_and_stays(kind, model, beam_reduction, integrator):
    values, motion = {"load_factor": 3.0, "tip_force": 5.0}, integrator
    if kind == "beam":
        model, values = beam_reduction.model, {"z1": 0.3, "pump": 0.07, "load_factor": 3.0, "push": 50.0}
        motion = ModalIntegrator(model, model.vector(values), 5.0, 2e-5)
    load, static = model.load_coefficients(model.vector(values)), model.static_response(values)
    state, wanted = motion.at_rest(load), np.append(static.strain, static.displacement)
    for _ in range(5):
        np.testing.assert_allclose(motion.outputs(state)[: len(wanted)], wanted, rtol=1e-9)
        assert motion.modes.output[-1] @ state.velocity == pytest.approx(0.0, abs=1e-9)
        state = motion.advance(state, 0.7, load)


def test_a_released_beam_moves_as_the_full_model(beam, beam_reduction):
    """Once the high modes have died away, strain, position and acceleration agree."""
    model, values = beam_reduction.model, {"e": 1.05, "z1": 0.6, "z2": 0.3, "pump": 0.07, "load_factor": 0.0}
    vector, let_go = (model.vector({**values, "push": push}) for push in (100.0, 0.0))
    motion = ModalIntegrator(model, vector, *model.damping)
    state = motion.at_rest(model.load_coefficients(vector))
    for _ in range(3):
        state = motion.advance(state, 2e-3, model.load_coefficients(let_go))
    stiffness, mass, load = beam.at({**values, "push": 100.0})
    stiffness, inverse, n = stiffness.toarray(), np.linalg.inv(mass.toarray()), len(load)
    start = np.linalg.solve(stiffness, load)
    damping = model.damping[0] * np.eye(n) + model.damping[1] * inverse @ stiffness
    generator = second_order(inverse @ stiffness, damping)
    moved = expm(generator * 6e-3) @ np.concatenate((start, np.zeros(n)))
    rows = np.vstack((beam.gauge_output.toarray(), beam.displacement_output.toarray()))
    acceleration = beam.acceleration_output @ (generator @ moved)[n:]
    wanted = np.concatenate((rows @ moved[:n], acceleration))
    size = np.concatenate((np.abs(rows @ start), np.abs(acceleration)))
    assert np.all(np.abs(motion.outputs(state) - wanted) < 5e-3 * size)
    same = ModalIntegrator(model, vector, *model.damping)
    taken = motion.outputs(same.take_over(state, motion))
    np.testing.assert_allclose(taken, motion.outputs(state), rtol=1e-6, atol=1e-9 * float(size.max()))


def test_a_released_wing_for_patches_moves_as_all_its_unknowns(coarse_patched_wing):
    """What its modes leave out fades as the damping has it, for a law as well."""
    vector = np.array((1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0))
    weak = PowerStiffness("tip", 1e-6, 1.0, 0, 1.0)  # which only tells where the tip is
    motion = ModalIntegrator(coarse_patched_wing, vector, ALPHA, BETA, ModelPatch((weak,)))
    structure, load = motion.structure, motion.structure.acting(vector)
    answers, tip = structure.answers, coarse_patched_wing.port_rows["tip"]
    held = 0.03 / (structure.outputs[-1] @ answers[:, HOLDING]) * answers[:, HOLDING]
    rest, n = answers[:, :4] @ load, len(held)
    state = motion.advance(motion.released(0.03, load, HOLDING), 5e-4, load)
    ratio = np.linalg.solve(structure.mass, structure.stiffness)
    generator = second_order(ratio, ALPHA * np.eye(n) + BETA * ratio)
    wanted = rest + (expm(5e-4 * generator) @ np.concatenate((held, np.zeros(n))))[:n]
    assert state.memory[0, PLACE] == pytest.approx(tip @ wanted, rel=1e-4)
    assert motion.point_displacement(state, HOLDING) == pytest.approx(tip @ wanted, rel=1e-4)
    error = np.abs(motion.outputs(state) - structure.outputs @ wanted)
    assert np.all(error < 5e-3 * np.abs(structure.outputs @ held))


def test_damage_in_flight_keeps_motion_and_changes_strain(model, integrator):
    damaged = wing_integrator(model, **{**HEALTHY, "stiffness_loss": (0.4, 0.2)})
    for duration in (0.003, 0.05, 0.11):
        before = integrator.advance(integrator.released(0.03, (3.0, 0.0), TIP_FORCE), duration, (3.0, 0.0))
        after = damaged.take_over(before, integrator)
        assert damaged.outputs(after)[-1] == pytest.approx(integrator.outputs(before)[-1], abs=2e-3 * 0.1)
        kept = damaged.modes.shape.T @ damaged.modes.mass @ integrator.modes.shape @ before.velocity
        np.testing.assert_allclose(after.velocity, kept, atol=1e-9 * np.abs(kept).max())
        was = integrator.modes.output[-1] @ before.velocity
        assert damaged.modes.output[-1] @ after.velocity == pytest.approx(was, abs=2e-2 * 1.0)
    # long after, it rests where the damaged wing rests
    late = damaged.advance(after, 60.0, (3.0, 0.0))
    static = model.static_response({"z1": 0.4, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(damaged.outputs(late)[:-1], static.strain, rtol=1e-6)
    # 5 cm inboard of the tip, which is released at 3 cm, the load point moves less and in time with it
    released = integrator.released(0.03, (0.0, 0.0), TIP_FORCE)
    assert 0.9 * 0.03 < integrator.point_displacement(released, TIP_FORCE) < 0.03
    # from rest, damage sets the wing moving about its new, lower-stiffness equilibrium
    taken = damaged.take_over(integrator.at_rest((3.0, 0.0)), integrator)
    kept = damaged.structure.to_modes @ integrator.structure.answers[:, :2] @ (3.0, 0.0)
    np.testing.assert_allclose(taken.displacement, kept, atol=1e-9 * np.abs(kept).max())


def test_bad_input_is_refused(model, integrator):
    for duration, load in ((0.0, 1.0), (-1.0, 1.0), (np.nan, 1.0), (np.inf, 1.0), (0.1, np.nan)):
        with pytest.raises(InvalidStateError, match="needs a positive duration and a finite load"):
            integrator.advance(integrator.at_rest((1.0, 0.0)), duration, (load, 0.0))
    for name, value, kind in (
        ("damping_alpha", -1.0, InvalidStateError),
        ("damping_beta", np.nan, InvalidStateError),
        ("servo_mass", 5.0, OutsideModelError),
    ):
        with pytest.raises(kind, match=name):
            wing_integrator(model, **{**HEALTHY, name: value})
