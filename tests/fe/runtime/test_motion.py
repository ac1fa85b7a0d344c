"""Motion with internal forces against closed forms, general integrators and energy; compiled and plain."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.special import ellipk

from discrepancy.models.compiled_motion import compiled_kernel
from fe.runtime.errors import InvalidPatchError, SolutionError
from fe.runtime.laws.micro_slip import slip_displacements
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import NO_LAWS, Laws, laws_of, static_solution
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    MicroSlip,
    ModelPatch,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    StiffnessDrift,
)
from fe.runtime.stepwise import ModalMotion, substeps
from tests.fe.runtime.stepping import simulate

W = 2.0 * np.pi  # one second for a period
ONE = ModalSystem(np.array([W]), np.zeros((1, 1)), {"mass": np.array([1.0])})
STIFFNESS = W**2  # mass 1 kg


def laws(*items: Primitive) -> Laws:
    return laws_of(ModelPatch(items), ["mass", "tip", "root"])


def ring(
    *items: Primitive, duration: float = 10.0, count: int = 1001, start: float = 1.0, **options: Any
) -> ModalMotion:
    """Ring-down of one mass from `start` at rest."""
    return simulate(
        options.pop("system", ONE), laws(*items), q=np.array([start]), v=np.zeros(1), force=np.zeros(count),
        interval=duration / (count - 1), kernel=compiled_kernel(), **options,
    )  # fmt: skip


def crossings(x: np.ndarray[Any, Any], interval: float) -> np.ndarray[Any, Any]:
    """Times of rising zero crossings, from the parabola through three samples."""
    times = []
    for i in np.flatnonzero((x[:-1] < 0.0) & (x[1:] >= 0.0)):
        cubic = np.polyfit(np.arange(-1.0, 3.0), x[i - 1 : i + 3], 3)
        times.append((i + brentq(lambda u, c=cubic: np.polyval(c, u), 0.0, 1.0)) * interval)
    return np.array(times)


# ---------------------------------------------------------------- linear


def test_a_random_linear_system_is_the_matrix_exponential() -> None:
    random = np.random.default_rng(3)
    w = np.array([3.0, 11.0, 40.0, 150.0])
    root = random.normal(size=(4, 4))
    damping = root @ root.T * 0.3
    system = ModalSystem(w, damping)
    q, v = random.normal(size=4), random.normal(size=4)
    matrix = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.diag(w**2), -damping]])
    moved = simulate(system, NO_LAWS, q=q, v=v, force=np.zeros(50), interval=0.02)
    for sample in (1, 17, 49):
        expected = expm(matrix * 0.02 * sample) @ np.concatenate((q, v))
        np.testing.assert_allclose(moved.q[sample], expected[:4], atol=1e-11)
        np.testing.assert_allclose(moved.v[sample], expected[4:], atol=1e-9)


def test_a_force_that_is_linear_between_samples_is_exact() -> None:
    random = np.random.default_rng(5)
    w, zeta = 7.0, 0.05
    system = ModalSystem(np.array([w]), np.array([[2 * zeta * w]]))
    force = random.normal(size=40)
    dt = 0.11
    moved = simulate(
        system, NO_LAWS, q=np.zeros(1), v=np.zeros(1), force=force, interval=dt,
        shape=np.array([0.7]), constant=np.array([0.3]), kernel=compiled_kernel(),
    )  # fmt: skip
    time = dt * np.arange(40)
    wd = w * np.sqrt(1 - zeta**2)

    def integrand(tau: float) -> float:
        load = 0.7 * np.interp(tau, time, force) + 0.3
        return float(load * np.exp(-zeta * w * (time[-1] - tau)) * np.sin(wd * (time[-1] - tau)) / wd)

    duhamel = sum(quad(integrand, a, b, epsabs=1e-13)[0] for a, b in itertools.pairwise(time))
    assert moved.q[-1, 0] == pytest.approx(duhamel, abs=1e-12)


@given(w=st.floats(0.0, 500.0), damping=st.floats(0.0, 2000.0), h=st.floats(1e-6, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_linear_step_of_any_oscillator_is_the_exponential(w: float, damping: float, h: float) -> None:
    steps, _, _ = ModalSystem(np.array([w]), np.array([[damping]])).exact_steps(np.array([h]))
    unit = max(w, 1.0)
    matrix = np.array([[0.0, unit], [-w * w / unit, -damping]])
    expected = expm(matrix * h)
    scale = np.array([1.0, unit])
    np.testing.assert_allclose(steps[0] * scale / scale[:, None], expected, atol=1e-9)


# ---------------------------------------------------------------- damping


@pytest.mark.parametrize("ratio", [0.01, 0.05, 0.13])
def test_coulomb_friction_takes_the_same_from_each_half_cycle_and_stops_the_mass(ratio: float) -> None:
    # x'' + w^2 x + Fc sgn x' = 0: half cycles about +-Fc/k, Den Hartog 1931
    offset = ratio
    friction = PowerDamping("mass", ratio * STIFFNESS, 0.0, 0.0, 1.0, 1.0)
    half_cycles = int(np.ceil((1.0 - offset) / (2.0 * offset)))
    moved = ring(friction, duration=0.5 * half_cycles + 2.0, count=100 * half_cycles + 401)
    time = np.arange(len(moved.q)) * 0.005
    amplitude, expected = 1.0, np.empty_like(time)
    done = np.zeros(len(time), dtype=bool)
    for number in range(half_cycles):
        sign = (-1.0) ** number
        inside = (time >= 0.5 * number - 1e-12) & ~(time > 0.5 * (number + 1) + 1e-12)
        centre = sign * offset
        expected[inside] = centre + (sign * amplitude - centre) * np.cos(W * (time[inside] - 0.5 * number))
        done |= inside
        amplitude -= 2.0 * offset
    rest = (-1.0) ** half_cycles * amplitude
    expected[~done] = rest
    np.testing.assert_allclose(moved.q[:, 0], expected, atol=2e-4)
    stopped = moved.q[time > 0.5 * half_cycles + 0.05, 0]
    assert np.ptp(stopped) < 1e-12
    assert stopped[-1] == pytest.approx(rest, abs=1e-4)
    assert np.all(np.abs(moved.v[time > 0.5 * half_cycles + 0.05, 0]) < 1e-12)
    # at rest friction holds the spring
    assert moved.port_forces[-1, 0] == pytest.approx(-STIFFNESS * rest, abs=1e-3)


def test_a_mass_within_the_friction_never_moves_and_leaves_under_a_larger_force() -> None:
    friction = laws(PowerDamping("mass", 1.0, 0.0, 0.0, 1.0, 1.0))
    force = np.concatenate((np.linspace(0.0, 0.999, 400), np.full(100, 0.999)))
    rest = {"q": np.zeros(1), "v": np.zeros(1), "shape": np.ones(1), "interval": 0.01}
    held = simulate(ONE, friction, force=force, **rest)
    assert np.max(np.abs(held.q)) < 1e-12
    np.testing.assert_allclose(held.port_forces[1:, 0], force[1:], atol=1e-9)
    assert simulate(ONE, friction, force=2.0 * force, **rest).q[-1, 0] > 0.5 / STIFFNESS


@pytest.mark.parametrize("ratio", [0.35, 0.4, 0.49, 0.55, 0.75, 0.9])
@pytest.mark.parametrize("steps", [11, 17, 31])
def test_friction_stops_a_mass_where_it_stops_to_the_fourth_order_of_the_step(
    ratio: float, steps: int
) -> None:
    # Half kicks at both ends of a step move about an equilibrium that is nearer by friction h^2 / 12. A mass
    # that begins nearer by as much moves as the exact one does, always nearer, and stops where that stops:
    # before the spring is free of load (2 ratio > 1) as well as beyond.
    strength, duration = ratio * STIFFNESS, 0.8
    shift = strength * (duration / steps) ** 2 / 12.0
    moved = simulate(
        ONE, laws(PowerDamping("mass", strength, 0.0, 0.0, 1.0, 1.0)), q=np.array([1.0 - shift]),
        v=np.zeros(1), force=np.zeros(2), interval=duration, substeps=steps,
    )  # fmt: skip
    assert moved.v[-1, 0] == pytest.approx(0.0, abs=1e-12)
    assert moved.q[-1, 0] == pytest.approx(2.0 * ratio - 1.0, abs=0.03 * shift)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5, 2.0, 3.0])
def test_power_damping_takes_the_energy_that_averaging_says(exponent: float) -> None:
    # equivalent viscous damping: dA/dt = -c A^p w^(p-1) / pi int_0^pi sin^(p+1)
    strength = 0.02 * W
    damper = PowerDamping("mass", strength * W, exponent, 0.0, W, 1.0)
    moved = ring(damper, duration=5.0)
    energy = 0.5 * (moved.q[:, 0] ** 2 + (moved.v[:, 0] / W) ** 2)
    integral = quad(lambda u: np.sin(u) ** (exponent + 1.0), 0.0, np.pi)[0] / np.pi
    slope = strength * integral
    less = 1.0 - exponent
    final = np.exp(-slope * 5.0) if exponent == 1.0 else (1.0 - less * slope * 5.0) ** (1.0 / less)
    assert np.sqrt(2.0 * energy[-1]) == pytest.approx(final, rel=3e-3)  # averaging errs by order zeta^2


def test_structural_damping_is_alike_at_all_amplitudes() -> None:
    # k g |x| sgn v: each half cycle ends at (1 - g) / (1 + g) of the amplitude, exactly
    g = 0.03
    damper = PowerDamping("mass", g * STIFFNESS, 0.0, 1.0, 1.0, 1.0)
    moved = ring(damper, duration=6.0, count=6001)
    turns = np.abs(moved.q[np.flatnonzero(np.diff(np.sign(moved.v[:, 0]))), 0])[1:]
    # quarter cycles have frequencies w sqrt(1 +- g): outwards stiffer
    np.testing.assert_allclose(turns[1:] / turns[:-1], np.sqrt((1 - g) / (1 + g)), atol=3e-4)


# ---------------------------------------------------------------- stiffness


@pytest.mark.parametrize("share", [-0.3, 0.05, 0.3, 2.0])
def test_a_cubic_spring_has_the_period_of_the_elliptic_integral(share: float) -> None:
    spring = PowerStiffness("mass", share * STIFFNESS, 3.0, 0, 1.0)
    moved = ring(spring, duration=20.0, count=4001, substeps=40)
    measured = np.mean(np.diff(crossings(moved.q[:, 0], 0.005)))
    period = 4.0 * ellipk(-(share / 2.0) / (1.0 + share / 2.0) * 1.0) / (W * np.sqrt(1.0 + share / 2.0))
    # x'' + w^2 (x + s x^3): from the first integral, T = 4/w int_0^1 dx / sqrt((1 - x^2)(1 + s/2 (1 + x^2)))
    integral = quad(
        lambda u: 1.0 / np.sqrt(1.0 + share / 2.0 * (1.0 + np.sin(u) ** 2)), 0.0, np.pi / 2, epsabs=1e-13
    )[0]
    assert period == pytest.approx(4.0 / W * integral, rel=1e-10)
    assert measured == pytest.approx(period, rel=2e-6)


def test_a_breathing_crack_has_half_a_period_of_each_spring() -> None:
    crack = PowerStiffness("mass", -0.4 * STIFFNESS, 1.0, -1, 1.0)
    moved = ring(crack, duration=20.0, count=4001, substeps=20)
    measured = np.mean(np.diff(crossings(moved.q[:, 0], 0.005)))
    assert measured == pytest.approx(np.pi / W + np.pi / (W * np.sqrt(0.6)), rel=2e-6)
    assert moved.q.min() == pytest.approx(-1.0 / np.sqrt(0.6), rel=1e-4)


def test_free_play_has_the_period_of_its_first_integral() -> None:
    gap, part = 0.2, 0.5  # half the spring is absent within +-gap
    moved = ring(FreePlay("mass", part * STIFFNESS, gap), duration=20.0, count=4001, substeps=20)

    def potential(x: float) -> float:
        return 0.5 * STIFFNESS * ((1 - part) * x * x + part * max(abs(x) - gap, 0.0) ** 2)

    quarter = quad(
        lambda u: np.cos(u) / np.sqrt(2.0 * (potential(1.0) - potential(np.sin(u)))),
        0.0, np.pi / 2, points=[np.arcsin(gap)], epsabs=1e-12, limit=400,
    )[0]  # fmt: skip
    assert np.mean(np.diff(crossings(moved.q[:, 0], 0.005))) == pytest.approx(4.0 * quarter, rel=1e-5)


@pytest.mark.parametrize(
    "law",
    [
        PowerStiffness("mass", 0.2 * STIFFNESS, 3.0, 0, 1.0),
        PowerStiffness("mass", -0.3 * STIFFNESS, 1.0, -1, 1.0),
        FreePlay("mass", 0.5 * STIFFNESS, 0.2),
    ],
)
def test_energy_does_not_drift_without_damping(law: Primitive) -> None:
    moved = ring(law, duration=200.0, count=4001)

    def energy(q: float, v: float) -> float:
        if isinstance(law, FreePlay):
            inner = min(abs(q), law.half_width)
            lost = law.stiffness * (0.5 * inner**2 + law.half_width * (abs(q) - inner))
            return 0.5 * v * v + 0.5 * STIFFNESS * q * q - lost
        assert isinstance(law, PowerStiffness)
        extra = law.coefficient * abs(q) ** (law.exponent + 1.0) / (law.exponent + 1.0)
        return 0.5 * v * v + 0.5 * STIFFNESS * q * q + (0.0 if law.side * q < 0.0 else extra)

    energies = [energy(*pair) for pair in zip(moved.q[:, 0], moved.v[:, 0], strict=True)]
    half = len(energies) // 2
    assert np.ptp(energies) < 2e-3 * energies[0]
    assert np.mean(energies[half:]) == pytest.approx(np.mean(energies[:half]), rel=1e-4)


def test_stiffness_drift_is_the_equation_with_growing_stiffness() -> None:
    moved = ring(StiffnessDrift(0.02), duration=10.0)
    exact = solve_ivp(
        lambda t, y: (y[1], -STIFFNESS * (1 + 0.02 * t) * y[0]), (0, 10), (1.0, 0.0),
        t_eval=np.linspace(0, 10, 1001), rtol=1e-11, atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(moved.q[:, 0], exact.y[0], atol=5e-5)


# ---------------------------------------------------------------- hysteresis


def forced_path(law: Primitive, path: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Force of a law along a prescribed path: a static solution of a structure without compliance."""
    return static_solution(laws(law), path[:, None], np.zeros((1, 1))).forces[:, 0]


def test_a_jenkins_element_slips_at_its_force_and_takes_the_area_of_its_loop() -> None:
    law = MicroSlip("mass", slip_force=3.0, stiffness=10.0, chi=0.0, element_count=1)
    loop = np.concatenate((np.linspace(0, 1, 101), np.linspace(1, -1, 201), np.linspace(-1, 1, 201)))
    whole = forced_path(law, loop) + 10.0 * loop
    assert whole.max() == pytest.approx(3.0)
    assert whole.min() == pytest.approx(-3.0)
    cycle = slice(101, None)
    area = np.trapezoid(whole[cycle], loop[cycle])
    assert area == pytest.approx(4.0 * 3.0 * (1.0 - 0.3), rel=2e-3)  # 4 F (A - F/k)


@pytest.mark.parametrize("chi", [0.0, -0.5])
def test_an_iwan_joint_loses_the_energy_of_its_density_and_obeys_masing(chi: float) -> None:
    law = MicroSlip("mass", slip_force=1.0, stiffness=4.0, chi=chi, element_count=400)
    amplitude = 0.2
    up = np.linspace(0, amplitude, 401)
    loop = np.concatenate((up, up[::-1], -up, -up[::-1], up))
    whole = forced_path(law, loop) + 4.0 * loop
    most = 1.0 * (2 + chi) / ((1 + chi) * 4.0)
    # each element that slips takes 4 k d (A - d), d of the density (1 + chi) d^chi / most^(1 + chi)
    loss = quad(
        lambda d: 16.0 * d * (amplitude - d) * (1 + chi) * d**chi / most ** (1 + chi), 0.0, amplitude
    )[0]
    last = slice(401, None)
    assert np.trapezoid(whole[last], loop[last]) == pytest.approx(loss, rel=5e-3)
    # Masing 1926: unloading from the turn is the first loading, twice as large
    backbone, unloading = whole[:401], whole[401 : 3 * 401]
    down = loop[401 : 3 * 401]
    np.testing.assert_allclose(
        whole[400] - unloading, 2.0 * np.interp(0.5 * (amplitude - down), up, backbone), atol=2e-5
    )


def test_elements_of_a_joint_slip_together_at_the_slip_force() -> None:
    for chi in (0.0, -0.4, -0.9):
        law = MicroSlip("mass", slip_force=2.0, stiffness=8.0, chi=chi)
        assert slip_displacements(law).mean() == pytest.approx(0.25)
        assert forced_path(law, np.array([50.0]))[0] == pytest.approx(2.0 - 8.0 * 50.0)


@pytest.mark.parametrize(("order", "width"), [(1.0, 0.3), (2.0, 0.5), (6.0, 0.2)])
def test_bouc_wen_is_its_differential_equation(order: float, width: float) -> None:
    stiffness = 0.3 * STIFFNESS
    law = BoucWen("mass", stiffness, width, order)
    moved = ring(law, duration=6.0, count=1201, memory=None, substeps=20)
    z0 = moved_start(law)

    def slope(t: float, y: Any) -> tuple[float, float, float]:
        x, v, z = y
        rate = v * (1.0 - (0.5 + 0.5 * np.sign(v * z)) * abs(z / width) ** order)
        return v, -STIFFNESS * x - stiffness * (z - x), rate

    exact = solve_ivp(
        slope, (0, 6), (1.0, 0.0, z0), t_eval=np.linspace(0, 6, 1201), rtol=1e-9, atol=1e-11, max_step=2e-3
    )
    np.testing.assert_allclose(moved.q[:, 0], exact.y[0], atol=2e-5)


def test_a_bouc_wen_law_that_yields_at_once_is_dry_friction_in_position() -> None:
    path = np.array([0.3, 0.4, -0.2, 0.0])
    for order in (0.1, 1.0, 30.0):
        force = forced_path(BoucWen("mass", 5.0, 1e-9, order), path)
        np.testing.assert_allclose(force, -5.0 * path, atol=1e-8)


def test_motions_of_almost_nothing_stay_finite() -> None:
    both = laws(PowerDamping("mass", 1.0, 2.5, 0.0, 1.0, 1.0), PowerStiffness("mass", 1.0, 3.0, 0, 1.0))
    q, v = np.array([1e-300]), np.array([1e-290])
    assert np.all(np.isfinite(simulate(ONE, both, q=q, v=v, force=np.zeros(5), interval=0.01).q))


def moved_start(law: BoucWen) -> float:
    """z after loading from zero to one, from dx = dz / (1 - |z|^n)."""
    path = solve_ivp(
        lambda x, z: 1.0 - abs(z / law.yield_displacement) ** law.order, (0, 1), [0.0], rtol=1e-11, atol=1e-12
    )
    return float(path.y[0, -1])


@given(
    path=st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=12),
    chi=st.floats(-0.9, 0.0),
    slip=st.floats(0.01, 5.0),
)
@settings(max_examples=60, deadline=None)
def test_a_joint_never_gives_energy_and_never_exceeds_its_slip_force(
    path: list[float], chi: float, slip: float
) -> None:
    law = MicroSlip("mass", slip_force=slip, stiffness=4.0, chi=chi)
    fine = np.concatenate([np.linspace(a, b, 60) for a, b in zip([0.0, *path], [*path, 0.0], strict=True)])
    whole = forced_path(law, fine) + 4.0 * fine
    assert np.all(np.abs(whole) <= slip * (1.0 + 1e-9))
    assert np.trapezoid(whole, fine) >= -1e-3 * slip  # from rest without load, so nothing can be given back


# ---------------------------------------------------------------- static


@pytest.mark.parametrize(
    "law",
    [
        PowerStiffness("tip", 300.0, 3.0, 0, 0.1),
        PowerStiffness("tip", -20.0, 3.0, 0, 0.1),
        PowerStiffness("tip", -40.0, 1.0, -1, 0.1),
        FreePlay("tip", 500.0, 0.02),
        MicroSlip("tip", 10.0, 500.0, -0.5),
        BoucWen("tip", 500.0, 0.03, 1.7),
        BoucWen("tip", 900.0, 0.001, 12.0),
    ],
)
def test_static_levels_are_in_equilibrium_and_follow_the_path(law: Primitive) -> None:
    compliance = np.array([[1e-3]])  # the structure has 1000 N/m there
    load = np.array([0.0, 20.0, 60.0, 60.0, 10.0, -50.0, -50.1, 0.0])
    linear = load[:, None] * 1e-3
    solution = static_solution(laws(law), linear, compliance, kernel=compiled_kernel())
    plain = static_solution(laws(law), linear, compliance)
    np.testing.assert_allclose(solution.positions + solution.forces * 1e-3, linear, atol=1e-12)
    np.testing.assert_allclose(solution.positions, plain.positions, atol=1e-14)
    assert solution.positions[2] == pytest.approx(solution.positions[3], abs=1e-12)
    fine = np.interp(np.linspace(0, 7, 7 * 64 + 1), np.arange(8), linear[:, 0])[:, None]
    followed = static_solution(laws(law), fine, compliance, kernel=compiled_kernel())
    np.testing.assert_allclose(followed.positions[::64], solution.positions, atol=3e-6)


@given(
    load=st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=6),
    share=st.floats(0.0, 0.95),
    width=st.floats(1e-4, 0.2),
    order=st.floats(0.5, 10.0),
)
@settings(max_examples=80, deadline=None)
def test_static_solutions_exist_for_every_softening_that_leaves_stiffness(
    load: list[float], share: float, width: float, order: float
) -> None:
    both = laws(
        BoucWen("tip", 0.5 * share * 1000.0, width, order),
        MicroSlip("root", 500.0 * share * width, 0.5 * share * 1000.0, -0.3),
        FreePlay("tip", 0.04 * 1000.0, width),
    )
    compliance = 1e-3 * np.array([[1.0, 0.6, 1.0], [0.6, 1.0, 0.6], [1.0, 0.6, 1.0]])
    if len(both) < 3:  # a share of zero leaves the gap only
        compliance = np.full((1, 1), 1e-3)
    linear = np.outer(load, compliance[0])
    solution = static_solution(both, linear, compliance, kernel=compiled_kernel())
    np.testing.assert_allclose(solution.positions + solution.forces @ compliance.T, linear, atol=1e-9)


def test_a_structure_that_softens_away_is_refused() -> None:
    spring = laws(PowerStiffness("tip", -500.0, 3.0, 0, 0.1))
    with pytest.raises(SolutionError, match="level 2 was not found: an internal force at tip"):
        static_solution(spring, np.array([[0.01], [0.5]]), np.array([[1e-3]]))


# ---------------------------------------------------------------- order, kernels, memory

WING = ModalSystem(
    2 * np.pi * np.array([5.6, 20.0, 35.0, 60.0]),
    np.diag(2 * 0.02 * 2 * np.pi * np.array([5.6, 20.0, 35.0, 60.0])),
    {"tip": np.array([1.3, -1.1, 0.2, 1.2]), "root": np.array([0.8, 2.0, -0.3, 3.0])},
)
A = 0.05
K1 = float(WING.angular_frequency[0] ** 2 / 1.3**2)
START = np.array([A / 1.3, 0.002, 0.0, 0.001])
TYPICAL: dict[str, tuple[Primitive, float, float]] = {
    # law, least observed order, largest error of the default steps in shares of the release
    "coulomb": (PowerDamping("tip", 0.02 * K1 * A, 0, 0, 1, 1), 1.7, 5e-5),
    "quadratic": (PowerDamping("tip", 0.05 * K1 * A, 2, 0, WING.angular_frequency[0] * A, 1), 1.9, 5e-5),
    "structural": (PowerDamping("tip", 0.03 * K1 * A, 0, 1, 1, A), 1.5, 5e-5),
    "cubic": (PowerStiffness("tip", 0.05 * K1 * A, 3, 0, A), 1.9, 3e-5),
    "crack": (PowerStiffness("tip", -0.05 * K1 * A, 1, -1, A), 1.5, 5e-5),
    "free play": (FreePlay("tip", 0.1 * K1, 0.1 * A), 1.2, 5e-5),
    "micro-slip": (MicroSlip("tip", 0.05 * K1 * A, 0.1 * K1, -0.3), 1.3, 1e-4),
    "Bouc-Wen": (BoucWen("tip", 0.1 * K1, 0.5 * A, 2.0), 1.3, 1e-4),
    "drift": (StiffnessDrift(0.02), 1.9, 1e-5),
}


def wing_ring(items: tuple[Primitive, ...], refinement: int = 1, **options: Any) -> np.ndarray[Any, Any]:
    moved = simulate(
        WING, laws(*items), q=START, v=np.zeros(4), force=np.zeros(1000), interval=0.005,
        refinement=refinement, kernel=compiled_kernel(), **options,
    )  # fmt: skip
    return np.asarray(moved.q @ WING.ports["tip"] / A)


@pytest.mark.parametrize("name", TYPICAL)
def test_default_steps_are_fine_and_the_order_is_two(name: str) -> None:
    law, least_order, largest = TYPICAL[name]
    exact = wing_ring((law,), 128)
    errors = np.array([np.max(np.abs(wing_ring((law,), n) - exact)) for n in (1, 2, 4, 8)])
    assert errors[0] < largest
    # events fall differently into the steps of each refinement, so the order is that over a factor of eight
    assert np.log2(errors[0] / errors[-1]) / 3.0 > least_order


def random_laws() -> Iterator[Primitive]:
    yield PowerDamping("tip", 0.03 * K1 * A, 0.0, 0.0, 1.0, 1.0)
    yield PowerDamping("root", 0.01 * K1 * A, 0.4, 0.5, 2.0, A)
    yield PowerStiffness("root", 0.02 * K1 * A, 2.5, 1, A)
    yield MicroSlip("root", 0.02 * K1 * A, 0.05 * K1, -0.2, 5)
    yield BoucWen("tip", 0.05 * K1, 0.3 * A, 1.5)
    yield FreePlay("tip", 0.05 * K1, 0.1 * A)
    yield StiffnessDrift(0.01)


def test_plain_and_compiled_loops_agree() -> None:
    everything = laws(*random_laws())
    coupled = ModalSystem(WING.angular_frequency, WING.damping + 0.3, WING.ports)
    force = 0.1 * K1 * A * np.sin(np.arange(60) * 0.3)
    for system in (WING, coupled):
        one, other = (
            simulate(
                system, everything, q=START, v=np.zeros(4), force=force, shape=WING.ports["tip"],
                interval=0.005, kernel=kernel,
            )
            for kernel in (None, compiled_kernel())
        )  # fmt: skip
        np.testing.assert_allclose(one.q, other.q, atol=1e-12)
        np.testing.assert_allclose(one.port_forces, other.port_forces, atol=1e-8)


def test_a_run_can_be_stopped_and_taken_further() -> None:
    everything = laws(*random_laws())
    common: dict[str, Any] = {"interval": 0.005, "shape": WING.ports["tip"], "kernel": compiled_kernel()}
    force = 0.1 * K1 * A * np.sin(np.arange(101) * 0.3)
    whole = simulate(WING, everything, q=START, v=np.zeros(4), force=force, **common)
    first = simulate(WING, everything, q=START, v=np.zeros(4), force=force[:41], **common)
    common |= {"q": first.q[-1], "v": first.v[-1], "memory": first.memory, "start": 0.2}
    rest = simulate(WING, everything, force=force[40:], **common)
    np.testing.assert_allclose(rest.q, whole.q[40:], atol=1e-13)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_damping_never_feeds_energy(seed: int) -> None:
    random = np.random.default_rng(seed)
    system = ModalSystem(WING.angular_frequency, np.zeros((4, 4)), WING.ports)
    law = PowerDamping("tip", random.uniform(0, 0.3) * K1 * A, random.choice([0.0, 0.3, 1.0, 2.2]),
                       random.choice([0.0, 1.0]), 2.0, A)  # fmt: skip
    moved = simulate(
        system, laws(law), q=random.normal(size=4) * 0.02, v=random.normal(size=4) * 0.5,
        force=np.zeros(400), interval=0.005, kernel=compiled_kernel(),
    )  # fmt: skip
    energy = np.sum((moved.q * system.angular_frequency) ** 2 + moved.v**2, axis=1)
    assert np.all(np.diff(energy) <= 2e-3 * energy[0])
    assert energy[-1] <= energy[0]


# ---------------------------------------------------------------- patch


def test_laws_without_magnitude_leave_the_linear_structure() -> None:
    damping, play = PowerDamping("tip", 0.0, 0, 0, 1, 1), FreePlay("tip", 10.0, 0.0)
    nothing = laws(damping, play, StiffnessDrift(0.0), PointMass(1.0, 0.5))
    assert nothing is NO_LAWS
    assert len(substeps(WING, nothing, np.array([0.0, 0.005])).lengths) == 1


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (PowerDamping("nose", 1, 0, 0, 1, 1), "port 'nose', which this model does not have; it has mass"),
        (PowerDamping("tip", -1, 0, 0, 1, 1), "coefficient of 'power_damping' must not be negative"),
        (PowerDamping("tip", 1, 0, 0, 0, 1), "reference_velocity of 'power_damping' must be positive"),
        (PowerStiffness("tip", 1, 0, 0, 1), "exponent of 'power_stiffness' must be positive"),
        (PowerStiffness("tip", 1, 1, 2, 1), "side"),
        (MicroSlip("tip", 1, 1, 0.5), "-chi of 'micro_slip' must not be negative"),
        (MicroSlip("tip", 1, 1, 0.0, 0), "element_count of 'micro_slip' must be positive"),
        (BoucWen("tip", 1, 0, 1), "yield_displacement of 'bouc_wen' must be positive"),
    ],
)
def test_a_law_that_cannot_be_is_refused_in_a_sentence(law: Primitive, sentence: str) -> None:
    with pytest.raises(InvalidPatchError, match=sentence):
        laws(law)
