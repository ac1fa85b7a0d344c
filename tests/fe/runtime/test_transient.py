"""Modal integration against general integrators, closed forms and the full model step by step."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fe.full.statics import Factorisation
from fe.runtime.errors import InvalidStateError, OutsideModelError
from fe.runtime.modal_system import exact_step, rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator, TransientState
from fe.wing.operators import AffineOperators
from tests.wings import wing_integrator

ALPHA, BETA = 1.0735, 7.3124e-4  # Kapteyn et al. 2021, fitted to the ring-down of the real wing
HEALTHY = {
    "young_modulus_factor": 1.0,
    "stiffness_loss": (0.0, 0.0),
    "servo_mass": 0.169,
    "pitot_mass": 0.134,
    "damping_alpha": ALPHA,
    "damping_beta": BETA,
}


@pytest.fixture(scope="module")
def integrator(model: ReducedModel) -> ModalIntegrator:
    return wing_integrator(model, **HEALTHY)


def transition(omega: float, zeta: float, duration: float) -> np.ndarray:
    found, _, _ = exact_step(np.array([omega**2]), np.array([[2.0 * zeta * omega]]), np.array([duration]))
    return np.asarray(found[0])


@pytest.mark.parametrize("zeta", [0.0, 0.03, 0.7, 1 - 1e-9, 1.0, 1 + 1e-9, 1 + 1e-4, 1.5, 20.0, 1e4])
@pytest.mark.parametrize("duration", [1e-5, 0.01, 0.3, 2.0])
def test_a_step_is_the_matrix_exponential(zeta: float, duration: float) -> None:
    omega = 9.0
    wanted = expm(np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]]) * duration)
    np.testing.assert_allclose(transition(omega, zeta, duration), wanted, rtol=1e-7, atol=1e-10 * omega)


@given(
    omega=st.floats(0.1, 1e4),
    zeta=st.floats(0.0, 0.99) | st.floats(0.99, 1.01) | st.floats(1.01, 1e3),
    duration=st.floats(1e-6, 10.0),
)
def test_two_half_steps_are_one_step(omega: float, zeta: float, duration: float) -> None:
    # displacements times omega, so that all entries are of order one
    unit = np.array([omega, 1.0])
    half, whole = (transition(omega, zeta, d) * unit[:, None] / unit for d in (duration / 2, duration))
    np.testing.assert_allclose(half @ half, whole, atol=1e-9 * (1 + zeta))
    assert np.isfinite(whole).all()
    assert np.abs(whole).max() <= 1.0 + 1e-9 + 2 * zeta


@pytest.mark.parametrize("beta", [BETA, 0.05])  # with 0.05 s all but the first mode are overdamped
def test_loads_that_are_held_are_integrated_exactly(model: ReducedModel, beta: float) -> None:
    integrator = wing_integrator(model, **{**HEALTHY, "damping_beta": beta})
    assert (integrator.damping_ratio[1:] > 1).all() == (beta == 0.05)
    omega = 2 * np.pi * integrator.modes.frequency
    participation = integrator.modes.participation.T
    times = [0.0, 0.05, 0.30, 0.31, 0.60]
    loads = np.array([(3.0, 0.0), (2.0, 5.0), (2.0, -5.0), (2.5, 0.0)])

    count = len(omega)
    rate = np.zeros((2 * count + 1, 2 * count + 1))  # of displacement, velocity over omega, and one
    rate[:count, count:-1] = np.diag(omega)
    rate[count:-1, :count] = -np.diag(omega)
    rate[count:-1, count:-1] = -np.diag(2 * integrator.damping_ratio * omega)

    state = integrator.at_rest((1.0, 0.0))
    y = np.concatenate((state.displacement, state.velocity / omega, [1.0]))
    for duration, load in zip(np.diff(times), loads, strict=True):
        rate[count:-1, -1] = participation @ load / omega
        y = expm(duration * rate) @ y
        state = integrator.advance(state, duration, load)
        found = np.concatenate((state.displacement, state.velocity / omega))
        np.testing.assert_allclose(found, y[:-1], atol=1e-9 * np.abs(y[:-1]).max())


def test_rest_is_the_static_response_and_stays(integrator: ModalIntegrator, model: ReducedModel) -> None:
    state = integrator.at_rest((3.0, 5.0))
    static = model.static_response({"load_factor": 3.0, "tip_force": 5.0})
    for _ in range(5):
        outputs = integrator.outputs(state)
        np.testing.assert_allclose(outputs, np.append(static.strain, static.displacement), rtol=1e-9)
        assert integrator.modes.output[-1] @ state.velocity == pytest.approx(0.0, abs=1e-9)
        state = integrator.advance(state, 0.7, (3.0, 5.0))


def test_the_load_point_rests_where_its_compliance_puts_it(
    integrator: ModalIntegrator, model: ReducedModel
) -> None:
    rest = integrator.point_displacement(integrator.at_rest((0.0, 7.0)), TIP_FORCE)
    stiffness = model.tip_stiffness(1.0)
    assert rest == pytest.approx(7.0 / stiffness, rel=1e-10)
    # 5 cm inboard of the tip, it moves less than the tip and in time with it
    released = integrator.released(0.03, (0.0, 0.0), TIP_FORCE)
    assert 0.9 * 0.03 < integrator.point_displacement(released, TIP_FORCE) < 0.03


def test_released_tip_starts_where_it_was_held_and_rings_down(integrator: ModalIntegrator) -> None:
    state = integrator.released(0.02, (0.0, 0.0), TIP_FORCE)
    held = integrator.outputs(state)
    # the static correction belongs to the load, which is gone: what is left is what six modes can hold
    assert held[-1] == pytest.approx(0.02, rel=5e-3)
    assert not state.velocity.any()
    first = integrator.modes.followed[0]
    zeta, omega = integrator.damping_ratio[first], 2 * np.pi * integrator.modes.frequency[first]
    period = 2 * np.pi / (omega * np.sqrt(1 - zeta**2))
    swings = [state]
    for _ in range(8):
        swings.append(integrator.advance(swings[-1], period, (0.0, 0.0)))
    amplitude = [abs(swing.displacement[first]) for swing in swings]
    decrement = np.log(np.array(amplitude[:-1]) / np.array(amplitude[1:]))
    np.testing.assert_allclose(decrement, 2 * np.pi * zeta / np.sqrt(1 - zeta**2), rtol=1e-6)
    np.testing.assert_allclose(
        zeta, rayleigh_damping_ratio(ALPHA, BETA, integrator.modes.frequency[first]), rtol=1e-14
    )


def test_released_under_load_returns_to_the_static_shape(integrator: ModalIntegrator) -> None:
    state = integrator.released(-0.01, (2.0, 0.0), TIP_FORCE)
    rest = integrator.outputs(integrator.at_rest((2.0, 0.0)))
    assert integrator.outputs(state)[-1] == pytest.approx(rest[-1] - 0.01, rel=5e-3)
    later = integrator.outputs(integrator.advance(state, 60.0, (2.0, 0.0)))
    np.testing.assert_allclose(later[:-1], rest[:-1], rtol=1e-6)


def energy_of(integrator: ModalIntegrator, state: TransientState) -> float:
    """Kinetic plus strain energy of the kept modes about the equilibrium under the load [J]."""
    omega, structure = 2.0 * np.pi * integrator.modes.frequency, integrator.structure
    rest = structure.shapes.T @ structure.loads @ state.load / omega**2
    deviation = omega * (state.displacement - rest)
    return float(0.5 * (state.velocity @ state.velocity + deviation @ deviation))


@given(
    durations=st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=20),
    tip=st.floats(-0.05, 0.05),
    beta=st.sampled_from((0.0, BETA, 0.05)),
)
def test_energy_never_grows_under_constant_load(
    model: ReducedModel, durations: list[float], tip: float, beta: float
) -> None:
    integrator = wing_integrator(model, **{**HEALTHY, "damping_alpha": 0.0, "damping_beta": beta})
    state = integrator.released(tip, (2.0, 0.0), TIP_FORCE)
    energy = begin = energy_of(integrator, state)
    for duration in durations:
        state = integrator.advance(state, duration, (2.0, 0.0))
        assert energy_of(integrator, state) <= energy * (1 + 1e-12) + 1e-15
        energy = energy_of(integrator, state)
    if beta == 0.0:
        assert energy == pytest.approx(begin, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(("ramp", "tolerance"), [(0.05, 4e-3), (0.005, 1.5e-2)])
def test_full_model_step_by_step_agrees(
    coarse_operators: AffineOperators, integrator: ModalIntegrator, ramp: float, tolerance: float
) -> None:
    # the trapezoidal rule on all unknowns, from rest at 2 g, ramp to 3 g
    step, count = ramp / 25, 60
    K = coarse_operators.stiffness()
    M = coarse_operators.mass()
    V = ALPHA * M + BETA * K
    factors = Factorisation((4 / step**2 * M + 2 / step * V + K).tocsr())
    u = Factorisation(K).solve(2.0 * coarse_operators.load_lift)
    v = a = np.zeros_like(u)
    state, load = integrator.at_rest((2.0, 0.0)), 2.0
    worst = scale = 0.0
    for k in range(count):
        after = min(3.0, 2.0 + (k + 1) * step / ramp)
        right = after * coarse_operators.load_lift
        right = right + M @ (4 / step**2 * u + 4 / step * v + a) + V @ (2 / step * u + v)
        new = factors.riesz(right)
        new_v = 2 / step * (new - u) - v
        a = 4 / step**2 * (new - u) - 4 / step * v - a
        u, v = new, new_v
        # the mean load of the step is held: of second order, as the rule itself
        state = integrator.advance(state, step, (0.5 * (load + after), 0.0))
        state = replace(state, load=np.array((after, 0.0)))
        load = after
        strain = coarse_operators.gauge_output @ u
        worst = max(worst, float(np.abs(integrator.outputs(state)[:-1] - strain).max()))
        scale = max(scale, float(np.abs(strain).max()))
    assert worst < tolerance * scale


def test_state_is_plain_floats_and_goes_on_to_the_last_bit(
    model: ReducedModel, integrator: ModalIntegrator
) -> None:
    state = integrator.advance(integrator.released(0.03, (2.0, 0.0), TIP_FORCE), 0.013, (2.7, 1.0))
    values = state.to_list()
    assert all(type(value) is float for value in values)
    assert len(values) == 2 * model.mode_count + 2
    restored = TransientState.from_list(values, model.mode_count)
    other = wing_integrator(ReducedModel.from_bytes(model.to_bytes()), **HEALTHY)
    one = integrator.advance(state, 0.02, (3.0, 0.0))
    two = other.advance(restored, 0.02, (3.0, 0.0))
    assert one.to_list() == two.to_list()
    np.testing.assert_array_equal(integrator.outputs(one)[:-1], other.outputs(two)[:-1])


@pytest.mark.parametrize("values", [[], [1.0, 2.0, 3.0], [0.0, 0.0, float("nan"), 0.0]])
def test_state_that_cannot_be_is_refused(values: list[float]) -> None:
    with pytest.raises(InvalidStateError, match="transient state of 2 modes needs"):
        TransientState.from_list(values, 2)


def test_taking_over_an_unchanged_wing_changes_nothing(
    model: ReducedModel, integrator: ModalIntegrator
) -> None:
    state = integrator.advance(integrator.released(0.03, (2.0, 0.0), TIP_FORCE), 0.013, (2.7, 1.0))
    taken = wing_integrator(model, **HEALTHY).take_over(state, integrator)
    moved = state.displacement
    np.testing.assert_allclose(taken.displacement, moved, atol=1e-4 * np.abs(moved).max())
    np.testing.assert_allclose(taken.velocity, state.velocity, rtol=1e-9)
    assert taken.load is state.load


def test_damage_in_flight_keeps_motion_and_changes_strain(
    model: ReducedModel, integrator: ModalIntegrator
) -> None:
    damaged = wing_integrator(model, **{**HEALTHY, "stiffness_loss": (0.4, 0.2)})
    for duration in (0.003, 0.05, 0.11):
        before = integrator.advance(integrator.released(0.03, (3.0, 0.0), TIP_FORCE), duration, (3.0, 0.0))
        after = damaged.take_over(before, integrator)
        was, now = integrator.outputs(before)[-1], damaged.outputs(after)[-1]
        assert now == pytest.approx(was, abs=2e-3 * 0.1)
        was = integrator.modes.output[-1] @ before.velocity
        assert damaged.modes.output[-1] @ after.velocity == pytest.approx(was, abs=2e-2 * 1.0)
    # long after, it rests where the damaged wing rests
    late = damaged.advance(after, 60.0, (3.0, 0.0))
    static = model.static_response({"z1": 0.4, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(damaged.outputs(late)[:-1], static.strain, rtol=1e-6)
    # from rest, damage sets the wing moving about its new, lower-stiffness equilibrium
    jolted = damaged.take_over(integrator.at_rest((3.0, 0.0)), integrator)
    assert energy_of(damaged, jolted) > 0.0


def test_no_change_of_health_creates_energy_in_free_vibration(
    model: ReducedModel, integrator: ModalIntegrator
) -> None:
    damaged = wing_integrator(model, **{**HEALTHY, "stiffness_loss": (0.6, 0.6)})
    state = integrator.advance(integrator.released(0.03, (0.0, 0.0), TIP_FORCE), 0.02, (0.0, 0.0))
    assert energy_of(damaged, damaged.take_over(state, integrator)) <= energy_of(integrator, state)


def test_bad_input_is_refused(model: ReducedModel, integrator: ModalIntegrator) -> None:
    rest = integrator.at_rest((1.0, 0.0))
    nan, inf = float("nan"), float("inf")
    for duration, load, sentence in (
        *((duration, 1.0, "positive duration") for duration in (0.0, -1.0, nan, inf)),
        (0.1, nan, "finite load"),
    ):
        with pytest.raises(InvalidStateError, match=sentence):
            integrator.advance(rest, duration, (load, 0.0))
    for name, value, kind in (
        ("damping_alpha", -1.0, InvalidStateError),
        ("damping_beta", nan, InvalidStateError),
        ("servo_mass", 5.0, OutsideModelError),
    ):
        with pytest.raises(kind, match=name):
            wing_integrator(model, **{**HEALTHY, name: value})
