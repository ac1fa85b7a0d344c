"""Structures in motion, patched or not: a wing and a beam against full models and closed forms."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from fe.runtime import patch
from fe.runtime.arrays import POSITION, FloatArray
from fe.runtime.errors import InvalidStateError, OutsideModelError
from fe.runtime.patch import ModelPatch
from fe.runtime.patched_wing import PatchedStructure
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from tests.fe.runtime.stepping import second_order
from tests.wings import wing_integrator

HOLDING = PatchedStructure.holding_load
# Kapteyn et al. 2021, fitted to the ring-down of the real wing
ALPHA = 1.0735
BETA = 7.3124e-4
HEALTHY = {
    "servo_mass": 0.169,
    "pitot_mass": 0.134,
    "damping_alpha": ALPHA,
    "damping_beta": BETA,
}


@pytest.fixture(scope="module")
def integrator(model: ReducedModel) -> ModalIntegrator:
    """The healthy wing in motion."""
    return wing_integrator(model, **HEALTHY)


# ---------------------------------------------------------------- at rest


@dataclass(frozen=True)
class RestingStructure:
    """A structure in motion, its reduced model, and values that load it."""

    model: ReducedModel
    values: dict[str, float]
    integrator: ModalIntegrator


@pytest.fixture(params=["wing", "beam"])
def resting(request, model, beam_reduction, integrator):
    if request.param == "wing":
        return RestingStructure(model, {"load_factor": 3.0, "tip_force": 5.0}, integrator)
    beam_model = beam_reduction.model
    values = {"z1": 0.3, "pump": 0.07, "load_factor": 3.0, "push": 50.0}
    structure = beam_model.structure_at(beam_model.vector(values))
    return RestingStructure(beam_model, values, ModalIntegrator(structure, 5.0, 2e-5))


def test_rest_is_the_static_response_and_stays(resting):
    load = resting.model.load_coefficients(resting.model.vector(resting.values))
    static = resting.model.static_response(resting.values)
    expected = np.append(static.strain, static.displacement)
    last_output = resting.integrator.modes.output[-1]
    state = resting.integrator.state_at_rest(load)

    for _ in range(5):
        outputs = resting.integrator.outputs(state)[: len(expected)]
        np.testing.assert_allclose(outputs, expected, rtol=1e-9)
        assert last_output @ state.velocity == pytest.approx(0.0, abs=1e-9)
        state = resting.integrator.advance(state, 0.7, load)


# ---------------------------------------------------------------- a released beam

BEAM_VALUES = {"e": 1.05, "z1": 0.6, "z2": 0.3, "pump": 0.07, "load_factor": 0.0}
PUSH = 100.0
"""The force that the beam is released from [N]."""


@dataclass(frozen=True)
class ReleasedBeam:
    """The reduced beam 6 ms after its release."""

    integrator: ModalIntegrator
    vector: FloatArray
    state: Any


@pytest.fixture(scope="module")
def released_beam(beam_reduction):
    """Once the high modes have died away."""
    model = beam_reduction.model
    pushed = model.vector({**BEAM_VALUES, "push": PUSH})
    free_load = model.load_coefficients(model.vector({**BEAM_VALUES, "push": 0.0}))
    integrator = ModalIntegrator(model.structure_at(pushed), *model.damping)
    state = integrator.state_at_rest(model.load_coefficients(pushed))
    for _ in range(3):
        state = integrator.advance(state, 2e-3, free_load)
    return ReleasedBeam(integrator=integrator, vector=pushed, state=state)


@dataclass(frozen=True)
class FullBeamOutputs:
    """Strains, displacements and accelerations of the full beam.

    Attributes
    ----------
    expected : (C,) array
        The outputs 6 ms after the release.
    size : (C,) array
        The size of each: that before the release, or of the acceleration itself.
    """

    expected: FloatArray
    size: FloatArray


@pytest.fixture(scope="module")
def full_beam_outputs(beam, beam_reduction):
    """The same release by the matrix exponential of all unknowns."""
    alpha, beta = beam_reduction.model.damping
    stiffness, mass, load = beam.system_at({**BEAM_VALUES, "push": PUSH})
    stiffness = stiffness.toarray()
    inverse_mass = np.linalg.inv(mass.toarray())
    n = len(load)
    ratio = inverse_mass @ stiffness
    generator = second_order(ratio, alpha * np.eye(n) + beta * ratio)
    start = np.linalg.solve(stiffness, load)
    moved = expm(generator * 6e-3) @ np.concatenate((start, np.zeros(n)))
    rows = np.vstack((beam.gauge_output.toarray(), beam.displacement_output.toarray()))
    acceleration = beam.acceleration_output @ (generator @ moved)[n:]
    return FullBeamOutputs(
        expected=np.concatenate((rows @ moved[:n], acceleration)),
        size=np.concatenate((np.abs(rows @ start), np.abs(acceleration))),
    )


def test_a_released_beam_moves_as_the_full_model(released_beam, full_beam_outputs):
    outputs = released_beam.integrator.outputs(released_beam.state)

    error = np.abs(outputs - full_beam_outputs.expected)
    assert np.all(error < 5e-3 * full_beam_outputs.size)


def test_another_integrator_of_the_same_beam_takes_its_motion_over(
    released_beam, full_beam_outputs, beam_reduction
):
    model = beam_reduction.model
    same = ModalIntegrator(model.structure_at(released_beam.vector), *model.damping)

    taken_over = same.take_over(released_beam.state, released_beam.integrator)

    outputs = released_beam.integrator.outputs(released_beam.state)
    tolerance = 1e-9 * float(full_beam_outputs.size.max())
    np.testing.assert_allclose(same.outputs(taken_over), outputs, rtol=1e-6, atol=tolerance)


# ---------------------------------------------------------------- a released wing for patches

RELEASE = 0.03
"""Displacement of the load point before its release [m]."""


@dataclass(frozen=True)
class ReleasedWing:
    """The patched wing 0.5 ms after its release, and the motion of all its unknowns.

    Attributes
    ----------
    integrator : ModalIntegrator
    state
        The state after 0.5 ms.
    expected : (n,) array
        The unknowns by the matrix exponential.
    held : (n,) array
        The unknowns that the release lets go.
    tip : (n,) array
        The row of the port at the tip.
    """

    integrator: ModalIntegrator
    state: Any
    expected: FloatArray
    held: FloatArray
    tip: FloatArray


@pytest.fixture(scope="module")
def released_wing(wings):
    """What its modes leave out fades as the damping has it."""
    vector = np.array((1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0))
    weak_law = patch.PowerStiffness("tip", 1e-6, 1.0, 0, 1.0)  # which only tells where the tip is
    patched = wings.wing.structure_at(vector, ModelPatch((weak_law,)))
    integrator = ModalIntegrator(patched, ALPHA, BETA)
    structure = integrator.structure
    load = structure.load_coefficients(vector)
    released = integrator.state_after_release(RELEASE, load, HOLDING)
    state = integrator.advance(released, 5e-4, load)

    # the same by all unknowns of the structure
    responses = structure.unit_responses
    holding_response = responses[:, HOLDING]
    held = RELEASE / (structure.output_rows[-1] @ holding_response) * holding_response
    rest = responses[:, : len(load)] @ load
    n = len(held)
    ratio = np.linalg.solve(structure.mass, structure.stiffness)
    generator = second_order(ratio, ALPHA * np.eye(n) + BETA * ratio)
    moved = expm(5e-4 * generator) @ np.concatenate((held, np.zeros(n)))
    return ReleasedWing(
        integrator=integrator,
        state=state,
        expected=rest + moved[:n],
        held=held,
        tip=wings.wing.port_rows["tip"],
    )


def test_a_law_on_a_released_wing_sees_where_the_tip_is(released_wing):
    position = released_wing.state.memory[0, POSITION]

    assert position == pytest.approx(released_wing.tip @ released_wing.expected, rel=1e-4)


def test_the_load_point_of_a_released_wing_moves_as_all_its_unknowns(released_wing):
    displacement = released_wing.integrator.point_displacement(released_wing.state, HOLDING)

    assert displacement == pytest.approx(released_wing.tip @ released_wing.expected, rel=1e-4)


def test_outputs_of_a_released_wing_move_as_all_its_unknowns(released_wing):
    rows = released_wing.integrator.structure.output_rows

    outputs = released_wing.integrator.outputs(released_wing.state)

    error = np.abs(outputs - rows @ released_wing.expected)
    assert np.all(error < 5e-3 * np.abs(rows @ released_wing.held))


# ---------------------------------------------------------------- damage in flight

MANOEUVRE = (3.0, 0.0)
"""Load factor and force at the tip [N]."""


@pytest.fixture(scope="module")
def damaged(model: ReducedModel) -> ModalIntegrator:
    """The wing in motion with losses of stiffness."""
    return wing_integrator(model, **{**HEALTHY, "stiffness_loss": (0.4, 0.2)})


@dataclass(frozen=True)
class Damage:
    """The states of a moving wing before and after damage."""

    before: Any
    after: Any


@pytest.fixture(scope="module", params=[0.003, 0.05, 0.11])
def damage(request, integrator, damaged):
    """Damage at some time [s] after a release."""
    released = integrator.state_after_release(RELEASE, MANOEUVRE, TIP_FORCE)
    before = integrator.advance(released, request.param, MANOEUVRE)
    return Damage(before=before, after=damaged.take_over(before, integrator))


def test_damage_in_flight_keeps_the_tip_where_it_is(integrator, damaged, damage):
    before = integrator.outputs(damage.before)[-1]

    assert damaged.outputs(damage.after)[-1] == pytest.approx(before, abs=2e-3 * 0.1)


def test_damage_in_flight_keeps_the_velocity(integrator, damaged, damage):
    """Modal velocities are those of the motion before, projected with the mass."""
    velocity = integrator.modes.shape @ damage.before.velocity
    projected = damaged.modes.shape.T @ damaged.modes.mass @ velocity
    tip_velocity = integrator.modes.output[-1] @ damage.before.velocity

    tolerance = 1e-9 * np.abs(projected).max()
    np.testing.assert_allclose(damage.after.velocity, projected, atol=tolerance)
    damaged_tip_velocity = damaged.modes.output[-1] @ damage.after.velocity
    assert damaged_tip_velocity == pytest.approx(tip_velocity, abs=2e-2 * 1.0)


def test_long_after_damage_the_wing_rests_where_the_damaged_wing_rests(model, damaged, damage):
    late = damaged.advance(damage.after, 60.0, MANOEUVRE)

    static = model.static_response({"z1": 0.4, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(damaged.outputs(late)[:-1], static.strain, rtol=1e-6)


def test_the_load_point_inboard_of_a_released_tip_moves_less(integrator):
    """It lies 5 cm inboard of the tip, which is released at 3 cm, and moves in time with it."""
    released = integrator.state_after_release(RELEASE, (0.0, 0.0), TIP_FORCE)

    assert 0.9 * RELEASE < integrator.point_displacement(released, TIP_FORCE) < RELEASE


def test_damage_at_rest_sets_the_wing_moving_about_its_new_equilibrium(integrator, damaged):
    taken_over = damaged.take_over(integrator.state_at_rest(MANOEUVRE), integrator)

    healthy_rest = integrator.structure.unit_responses[:, : len(MANOEUVRE)] @ MANOEUVRE
    projected = damaged.structure.modal_projection @ healthy_rest
    tolerance = 1e-9 * np.abs(projected).max()
    np.testing.assert_allclose(taken_over.displacement, projected, atol=tolerance)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("duration", "load_factor"),
    [(0.0, 1.0), (-1.0, 1.0), (np.nan, 1.0), (np.inf, 1.0), (0.1, np.nan)],
)
def test_a_step_needs_a_positive_duration_and_a_finite_load(integrator, duration, load_factor):
    state = integrator.state_at_rest((1.0, 0.0))

    with pytest.raises(InvalidStateError, match="needs a positive duration and a finite load"):
        integrator.advance(state, duration, (load_factor, 0.0))


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("damping_alpha", -1.0, InvalidStateError),
        ("damping_beta", np.nan, InvalidStateError),
        ("servo_mass", 5.0, OutsideModelError),
    ],
)
def test_impossible_values_are_refused_by_name(model, name, value, error):
    with pytest.raises(error, match=name):
        wing_integrator(model, **{**HEALTHY, name: value})
