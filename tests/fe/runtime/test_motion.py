"""Motion with internal forces against closed forms, general integrators and energy."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipk

from fe.compilation import compiled_kernel
from fe.runtime import patch
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import NO_LAWS, Laws, laws_of, static_solution
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.patch import BoucWen, FreePlay, MicroSlip, PowerDamping, PowerStiffness, Primitive
from tests.fe.runtime.stepping import exact, second_order, simulate

W = 2.0 * np.pi  # one second for a period
ONE = ModalSystem(np.array([W]), np.zeros((1, 1)), {"mass": np.array([1.0])})
STIFFNESS = W**2  # mass 1 kg


def laws(*items: Primitive) -> Laws:
    return laws_of(patch.ModelPatch(items), ["mass"])


def ring(
    *items: Primitive, duration: float = 10.0, count: int = 1001, start: float = 1.0, **options: Any
) -> ModalMotion:
    """Ring-down of one mass from `start` at rest."""
    given = {"q": np.array([start]), "v": np.zeros(1), "force": np.zeros(count), "kernel": compiled_kernel()}
    return simulate(ONE, laws(*items), interval=duration / (count - 1), **given | options)


def coulomb(strength: float) -> PowerDamping:
    return PowerDamping("mass", strength, 0.0, 0.0, 1.0, 1.0)


# ---------------------------------------------------------------- linear


@pytest.mark.parametrize("coupled", [False, True])
def test_a_linear_system_under_a_force_is_the_matrix_exponential(coupled: bool) -> None:
    """Free, overdamped and hardly damped modes, at stamps of several distances: all but rounding is exact."""
    random, w = np.random.default_rng(3), np.array([0.0, 7.0, 60.0, 150.0])
    damping = np.diag([0.3, 1.0, 200.0, 3.0]) + coupled * random.normal(size=(4, 4))
    shape, constant, first, force = (random.normal(size=size) for size in (4, 4, 8, 50))
    interval = np.resize([0.01, 0.013, 0.01, 0.04], 49)
    into = np.concatenate((np.zeros((4, 2)), np.stack((shape, constant), axis=1)))
    time, inputs = np.append(0.0, np.cumsum(interval)), np.stack((force, np.ones(50)), axis=1)
    wanted = exact(second_order(np.diag(w**2), damping), into, time, inputs, first=first)
    for kernel in (None, compiled_kernel()):
        moved = simulate(
            ModalSystem(w, damping), NO_LAWS, q=first[:4], v=first[4:], force=force, interval=interval,
            shape=shape, constant=constant, kernel=kernel,
        )  # fmt: skip
        np.testing.assert_allclose(moved.q, wanted[:, :4], atol=1e-11)
        np.testing.assert_allclose(moved.v, wanted[:, 4:], atol=1e-9)


# ---------------------------------------------------------------- damping


@pytest.mark.parametrize("ratio", [0.01, 0.05, 0.13])
def test_coulomb_friction_takes_the_same_from_each_half_cycle_and_stops_the_mass(ratio: float) -> None:
    # x'' + w^2 x + Fc sgn x' = 0: half cycles about +-Fc/k, Den Hartog 1931
    half_cycles = int(np.ceil((1.0 - ratio) / (2.0 * ratio)))
    moved = ring(coulomb(ratio * STIFFNESS), duration=0.5 * half_cycles + 2.0, count=100 * half_cycles + 401)
    time = np.arange(len(moved.q)) * 0.005
    number = np.minimum(np.floor(2.0 * time + 1e-9), half_cycles)
    sign, amplitude = (-1.0) ** number, 1.0 - 2.0 * ratio * number
    swing = sign * ratio + sign * (amplitude - ratio) * np.cos(W * (time - 0.5 * number))
    expected = np.where(number < half_cycles, swing, sign * amplitude)
    np.testing.assert_allclose(moved.q[:, 0], expected, atol=2e-4)
    stopped, rest = time > 0.5 * half_cycles + 0.05, expected[-1]
    assert np.ptp(moved.q[stopped, 0]) < 1e-12
    assert moved.q[-1, 0] == pytest.approx(rest, abs=1e-4)
    assert np.all(np.abs(moved.v[stopped, 0]) < 1e-12)
    # at rest friction holds the spring
    assert moved.port_forces[-1, 0] == pytest.approx(-STIFFNESS * rest, abs=1e-3)


def test_a_mass_within_the_friction_never_moves_and_leaves_under_a_larger_force() -> None:
    force = np.concatenate((np.linspace(0.0, 0.999, 400), np.full(100, 0.999)))
    held, moved = (
        ring(
            coulomb(1.0), start=0.0, duration=4.99, count=500, force=f * force, shape=np.ones(1), kernel=None
        )
        for f in (1.0, 2.0)
    )
    assert np.max(np.abs(held.q)) < 1e-12
    np.testing.assert_allclose(held.port_forces[1:, 0], force[1:], atol=1e-9)
    assert moved.q[-1, 0] > 0.5 / STIFFNESS


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
    moved = ring(
        coulomb(strength), start=1.0 - shift, duration=duration, count=2, substeps=steps, kernel=None
    )
    assert moved.v[-1, 0] == pytest.approx(0.0, abs=1e-12)
    assert moved.q[-1, 0] == pytest.approx(2.0 * ratio - 1.0, abs=0.03 * shift)


def test_structural_damping_is_alike_at_all_amplitudes() -> None:
    # k g |x| sgn v: each half cycle ends at (1 - g) / (1 + g) of the amplitude, exactly
    g = 0.03
    moved = ring(PowerDamping("mass", g * STIFFNESS, 0.0, 1.0, 1.0, 1.0), duration=6.0, count=6001)
    turns = np.abs(moved.q[np.flatnonzero(np.diff(np.sign(moved.v[:, 0]))), 0])[1:]
    # quarter cycles have frequencies w sqrt(1 +- g): outwards stiffer
    np.testing.assert_allclose(turns[1:] / turns[:-1], np.sqrt((1 - g) / (1 + g)), atol=3e-4)


# ---------------------------------------------------------------- stiffness


def potential(law: Primitive, x: Any) -> Any:
    """Energy of spring and law at a displacement."""
    if isinstance(law, FreePlay):
        inner = np.minimum(np.abs(x), law.half_width)
        extra = -law.stiffness * (0.5 * inner**2 + law.half_width * (np.abs(x) - inner))
    else:
        size = law.coefficient * law.reference_displacement / (law.exponent + 1.0)
        extra = size * np.abs(x / law.reference_displacement) ** (law.exponent + 1.0) * (law.side * x >= 0.0)
    return 0.5 * STIFFNESS * x**2 + extra


def first_integral(law: Primitive) -> float:
    """Quarter [s] of the period of a law that is the same on both sides, released from 1 m."""
    return float(quad(
        lambda u: np.cos(u) / np.sqrt(2.0 * (potential(law, 1.0) - potential(law, np.sin(u)))),
        0.0, np.pi / 2, points=[np.arcsin(0.2)], epsabs=1e-12, limit=400,
    )[0])  # fmt: skip


CRACK, PLAY = PowerStiffness("mass", -0.4 * STIFFNESS, 1.0, -1, 1.0), FreePlay("mass", 0.5 * STIFFNESS, 0.2)
SOFT = 1.0 / np.sqrt(0.6)


@pytest.mark.parametrize(
    ("law", "period", "least", "tolerance"),
    [
        *(
            (PowerStiffness("mass", share * STIFFNESS, 3.0, 0, 1.0),
             4.0 * ellipk(-share / (2.0 + share)) / (W * np.sqrt(1.0 + share / 2.0)), -1.0, 2e-6)
            for share in (-0.3, 0.05, 0.3, 2.0)
        ),
        (CRACK, (1.0 + SOFT) * np.pi / W, -SOFT, 2e-6),  # half a period of each spring
        (PLAY, 4.0 * first_integral(PLAY), -1.0, 1e-5),
    ],
)  # fmt: skip
def test_a_nonlinear_spring_has_its_period_and_keeps_its_energy(law, period, least, tolerance) -> None:
    # in default steps it goes to and fro, and does not drift
    moved = ring(law, duration=200.0, count=4001)
    energies = 0.5 * moved.v[:, 0] ** 2 + potential(law, moved.q[:, 0])
    assert np.ptp(energies) < 2e-3 * energies[0]
    assert energies[2000:].mean() == pytest.approx(energies[:2000].mean(), rel=1e-4)
    x = ring(law, duration=20.0, count=4001, substeps=40).q[:, 0]
    times = []  # of rising zero crossings, from the cubic through four samples
    for i in np.flatnonzero((x[:-1] < 0.0) & (x[1:] >= 0.0)):
        cubic = np.polyfit(np.arange(-1.0, 3.0), x[i - 1 : i + 3], 3)
        times.append((i + brentq(lambda u, c=cubic: np.polyval(c, u), 0.0, 1.0)) * 0.005)
    assert np.mean(np.diff(times)) == pytest.approx(period, rel=tolerance)
    assert x.min() == pytest.approx(least, rel=1e-4)
    if law is not CRACK:
        assert 4.0 * first_integral(law) == pytest.approx(period, rel=1e-10)


# ---------------------------------------------------------------- hysteresis


def whole_force(law: Primitive, path: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Force along a prescribed path with the spring that the law takes away.

    It is a static solution of a structure without compliance.
    """
    found = static_solution(laws(law), path[:, None], np.zeros((1, 1)), kernel=compiled_kernel())
    return found.forces[:, 0] + law.stiffness * path


@pytest.mark.parametrize("chi", [0.0, -0.5])
def test_an_iwan_joint_loses_the_energy_of_its_density_and_obeys_masing(chi: float) -> None:
    law = MicroSlip("mass", slip_force=1.0, stiffness=4.0, chi=chi, element_count=400)
    amplitude, most = 0.2, (2 + chi) / ((1 + chi) * 4.0)
    up = np.linspace(0, amplitude, 401)
    loop = np.concatenate((up, up[::-1], -up, -up[::-1], up))
    whole = whole_force(law, loop)

    def lost(d: float) -> float:
        """An element that slips takes 4 k d (A - d), d of the density (1 + chi) d^chi / most^(1 + chi)."""
        return float(16.0 * d * (amplitude - d) * (1 + chi) * d**chi / most ** (1 + chi))

    loss = quad(lost, 0.0, amplitude)[0]
    assert np.trapezoid(whole[401:], loop[401:]) == pytest.approx(loss, rel=5e-3)
    # Masing 1926: unloading from the turn is the first loading, twice as large
    down = slice(401, 3 * 401)
    first = np.interp(0.5 * (amplitude - loop[down]), up, whole[:401])
    np.testing.assert_allclose(whole[400] - whole[down], 2.0 * first, atol=2e-5)


@pytest.mark.parametrize("chi", [0.0, -0.4, -0.9])
def test_elements_of_a_joint_slip_together_at_the_slip_force(chi: float) -> None:
    law = MicroSlip("mass", slip_force=2.0, stiffness=8.0, chi=chi)
    assert law.elements().mean() == pytest.approx(0.25)
    assert whole_force(law, np.array([50.0]))[0] == pytest.approx(2.0)


def test_a_bouc_wen_law_that_yields_at_once_is_dry_friction_in_position() -> None:
    path = np.array([0.3, 0.4, -0.2, 0.0])
    for order in (0.1, 1.0, 30.0):
        np.testing.assert_allclose(whole_force(BoucWen("mass", 5.0, 1e-9, order), path), 0.0, atol=1e-8)


def test_motions_of_almost_nothing_stay_finite() -> None:
    both = PowerDamping("mass", 1.0, 2.5, 0.0, 1.0, 1.0), PowerStiffness("mass", 1.0, 3.0, 0, 1.0)
    moved = ring(*both, start=1e-300, v=np.array([1e-290]), duration=0.04, count=5, kernel=None)
    assert np.all(np.isfinite(moved.q))
