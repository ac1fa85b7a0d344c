"""Motion under laws of ports, against integration by SciPy and closed forms."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fe.compilation import compiled_kernel
from fe.runtime import patch
from fe.runtime.arrays import FloatArray
from fe.runtime.modal_system import ModalSystem, rayleigh_coefficients, rayleigh_damping_ratio
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    MicroSlip,
    ModelPatch,
    PowerDamping,
    PowerStiffness,
    Primitive,
)
from fe.runtime.port_laws import NO_LAWS, port_flexibility, port_laws
from tests.fe.runtime.stepping import (
    exact,
    force_of,
    make_laws,
    rates_of,
    second_order,
    simulate,
    states_of,
)

AMPLITUDE = 0.05
"""Displacement of the tip at its release [m]."""
OMEGA = 2.0 * np.pi * np.array([5.6, 20.0, 35.0, 60.0])
PORTS = {"tip": np.array([1.3, -1.1, 0.2, 1.2]), "root": np.array([0.8, 2.0, -0.3, 3.0])}
WING = ModalSystem(OMEGA, np.diag(0.04 * OMEGA), PORTS)
TIP_STIFFNESS = float(OMEGA[0] ** 2 / 1.3**2)
"""Stiffness of the first mode, seen at the tip."""
RELEASE = np.array([AMPLITUDE / 1.3, 0.002, 0.0, 0.001])
"""Modal displacements at the release of the tip."""


def release(*primitives: Primitive, system: ModalSystem = WING, **options: Any) -> ModalMotion:
    """Return the motion of the wing's modes after a release, with laws at its ports."""
    arguments = {"q": RELEASE, "v": np.zeros(4), "kernel": compiled_kernel()}
    return simulate(system, make_laws(*primitives), interval=0.005, **arguments | options)


# ---------------------------------------------------------------- steps and their order


@dataclass(frozen=True)
class TypicalLaw:
    """A law of typical size, and how exact the motion is.

    Attributes
    ----------
    law : Primitive
    least_order : float
        The least order of the steps that is observed.
    largest_error : float
        The largest error of the default steps, in fractions of the release.
    """

    law: Primitive
    least_order: float
    largest_error: float


TIP_FORCE = TIP_STIFFNESS * AMPLITUDE
TIP_VELOCITY = OMEGA[0] * AMPLITUDE
TYPICAL_LAWS = {
    "coulomb": TypicalLaw(PowerDamping("tip", 0.02 * TIP_FORCE, 0, 0, 1, 1), 1.7, 5e-5),
    "quadratic": TypicalLaw(
        PowerDamping("tip", 0.05 * TIP_FORCE, 2, 0, TIP_VELOCITY, 1), 1.9, 5e-5
    ),
    "viscous": TypicalLaw(PowerDamping("tip", 0.05 * TIP_FORCE, 1, 0, TIP_VELOCITY, 1), 1.9, 5e-5),
    "structural": TypicalLaw(PowerDamping("tip", 0.03 * TIP_FORCE, 0, 1, 1, AMPLITUDE), 1.5, 5e-5),
    "cubic": TypicalLaw(PowerStiffness("tip", 0.05 * TIP_FORCE, 3, 0, AMPLITUDE), 1.9, 3e-5),
    "crack": TypicalLaw(PowerStiffness("tip", -0.05 * TIP_FORCE, 1, -1, AMPLITUDE), 1.5, 5e-5),
    "free play": TypicalLaw(FreePlay("tip", 0.1 * TIP_STIFFNESS, 0.1 * AMPLITUDE), 1.2, 5e-5),
    "micro-slip": TypicalLaw(
        MicroSlip("tip", 0.05 * TIP_FORCE, 0.1 * TIP_STIFFNESS, -0.3, 5), 1.3, 1e-4
    ),
    "Bouc-Wen": TypicalLaw(BoucWen("tip", 0.1 * TIP_STIFFNESS, 0.5 * AMPLITUDE, 2.0), 1.3, 1e-4),
    "sharp Bouc-Wen": TypicalLaw(
        BoucWen("tip", 0.1 * TIP_STIFFNESS, 0.3 * AMPLITUDE, 6.0), 1.3, 1e-4
    ),
    "softening": TypicalLaw(PowerStiffness("tip", -0.1 * TIP_FORCE, 3, 0, AMPLITUDE), 1.9, 5e-5),
    "drift": TypicalLaw(patch.StiffnessDrift(0.02), 1.9, 1e-5),
}
TIME = 0.005 * np.arange(100)


def integrate_by_scipy(law: Any) -> FloatArray:
    """Return the displacement (N,) of the tip after its release, by a general integrator."""
    accuracy: dict[str, Any] = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
    row = PORTS["tip"]
    stiffness_rate = getattr(law, "rate", 0.0)
    held_displacement = float(row @ RELEASE)

    def rate_while_loading(_: float, z: FloatArray) -> FloatArray:
        return rates_of(law, held_displacement, z)

    # the tip is brought to its release in a second, which loads the elements of the law
    unloaded = np.zeros(states_of(law))
    loading = solve_ivp(rate_while_loading, (0.0, 1.0), unloaded, max_step=0.01, **accuracy)

    def rate_in_motion(t: float, y: FloatArray) -> FloatArray:
        q, v, z = np.split(y, (4, 8))
        velocity = float(row @ v)
        force = force_of(law, float(row @ q), velocity, z)
        stiffness = OMEGA**2 * (1.0 + stiffness_rate * t)
        acceleration = -stiffness * q - WING.damping @ v - row * force
        return np.concatenate((v, acceleration, rates_of(law, velocity, z)))

    start = np.concatenate((RELEASE, np.zeros(4), loading.y[:, -1]))
    motion = solve_ivp(
        rate_in_motion, (0.0, TIME[-1]), start, t_eval=TIME, max_step=2e-3, **accuracy
    )
    return np.asarray(row @ motion.y[:4])


def tip_motion(law: Primitive, refinement: int) -> FloatArray:
    """Return the displacement (N,) of the tip after its release, by steps of the product."""
    motion = release(law, force=np.zeros(100), refinement=refinement)
    return np.asarray(motion.q @ PORTS["tip"])


@dataclass(frozen=True)
class StepErrors:
    """The largest errors of default and of eight times finer steps, in fractions of the release."""

    default: float
    finer: float


@pytest.fixture(scope="module", params=TYPICAL_LAWS)
def typical_law(request):
    return TYPICAL_LAWS[request.param]


@pytest.fixture(scope="module")
def step_errors(typical_law):
    law = typical_law.law
    if typical_law is TYPICAL_LAWS["coulomb"]:  # which has a closed form below
        expected = tip_motion(law, refinement=128)
    else:
        expected = integrate_by_scipy(law)

    def largest_error(refinement: int) -> float:
        return float(np.max(np.abs(tip_motion(law, refinement) - expected))) / AMPLITUDE

    return StepErrors(default=largest_error(1), finer=largest_error(8))


def test_default_steps_are_fine(typical_law, step_errors):
    assert step_errors.default < typical_law.largest_error


def test_the_order_of_the_steps_is_two(typical_law, step_errors):
    # events fall differently into the steps of each refinement, so the order is that over a
    # factor of eight, of three halvings
    order = np.log2(step_errors.default / step_errors.finer) / 3.0

    assert order > typical_law.least_order


# ---------------------------------------------------------------- several laws at once

SEVERAL_LAWS = (
    PowerDamping("tip", 0.03 * TIP_FORCE, 0.0, 0.0, 1.0, 1.0),
    PowerDamping("root", 0.01 * TIP_FORCE, 0.4, 0.5, 2.0, AMPLITUDE),
    PowerStiffness("root", 0.02 * TIP_FORCE, 2.5, 1, AMPLITUDE),
    MicroSlip("root", 0.02 * TIP_FORCE, 0.05 * TIP_STIFFNESS, -0.2, 5),
    BoucWen("tip", 0.05 * TIP_STIFFNESS, 0.3 * AMPLITUDE, 1.5),
    FreePlay("tip", 0.05 * TIP_STIFFNESS, 0.1 * AMPLITUDE),
    patch.StiffnessDrift(0.01),
)
PUSH = 0.1 * TIP_FORCE * np.sin(np.arange(101) * 0.3)
"""A force at the tip, at 101 samples."""


@pytest.mark.parametrize("coupling", [0.0, 0.3])
def test_plain_and_compiled_loops_agree(coupling):
    system = ModalSystem(OMEGA, WING.damping + coupling, PORTS, coupling * np.full(2, 5e-4), 1e-3)

    def push(kernel: Any) -> ModalMotion:
        return release(*SEVERAL_LAWS, system=system, force=PUSH, shape=PORTS["tip"], kernel=kernel)

    plain = push(None)
    compiled = push(compiled_kernel())
    np.testing.assert_allclose(plain.q, compiled.q, atol=1e-12)
    np.testing.assert_allclose(plain.port_forces, compiled.port_forces, atol=1e-8)


def test_a_run_can_be_stopped_and_taken_further():
    whole = release(*SEVERAL_LAWS, force=PUSH, shape=PORTS["tip"])

    until_stop = release(*SEVERAL_LAWS, force=PUSH[:41], shape=PORTS["tip"])
    after_stop = release(
        *SEVERAL_LAWS,
        force=PUSH[40:],
        shape=PORTS["tip"],
        q=until_stop.q[-1],
        v=until_stop.v[-1],
        memory=until_stop.memory,
        start=0.2,
    )

    np.testing.assert_allclose(after_stop.q, whole.q[40:], atol=1e-13)


# ---------------------------------------------------------------- linear systems


@pytest.mark.parametrize("loop", ["plain", "compiled"])
@pytest.mark.parametrize("coupled", [False, True])
def test_a_linear_system_under_a_force_is_the_matrix_exponential(coupled, loop):
    """Free, overdamped and hardly damped modes, at stamps of several distances.

    All but rounding is exact.
    """
    random = np.random.default_rng(3)
    omega = np.array([0.0, 7.0, 60.0, 150.0])
    damping = np.diag([0.3, 1.0, 200.0, 3.0]) + coupled * random.normal(size=(4, 4))
    shape = random.normal(size=4)
    constant = random.normal(size=4)
    first_state = random.normal(size=8)
    force = random.normal(size=50)
    interval = np.resize([0.01, 0.0104, 0.01, 0.04], 49)

    motion = simulate(
        ModalSystem(omega, damping),
        NO_LAWS,
        q=first_state[:4],
        v=first_state[4:],
        force=force,
        interval=interval,
        shape=shape,
        constant=constant,
        kernel=compiled_kernel() if loop == "compiled" else None,
    )

    time = np.append(0.0, np.cumsum(interval))
    input_matrix = np.concatenate((np.zeros((4, 2)), np.stack((shape, constant), axis=1)))
    inputs = np.stack((force, np.ones(50)), axis=1)
    matrix = second_order(np.diag(omega**2), damping)
    states = exact(matrix, input_matrix, time, inputs, first=first_state)
    displacements, velocities = np.split(states, 2, axis=1)
    np.testing.assert_allclose(motion.q, displacements, atol=1e-11)
    np.testing.assert_allclose(motion.v, velocities, atol=1e-9)


@pytest.mark.parametrize("duration", [1e-5, 0.01, 0.3, 2.0])
@pytest.mark.parametrize("omega", [0.0, 9.0, 500.0])
@pytest.mark.parametrize(
    "zeta", [0.0, 0.03, 0.7, 1 - 1e-9, 1.0, 1 + 1e-9, 1 + 1e-4, 1.5, 20.0, 1e4]
)
def test_the_step_of_any_oscillator_is_the_exponential(omega, zeta, duration):
    """Of displacements times the frequency and of velocities, all of which are of order one."""
    unit = max(omega, 1.0)
    system = ModalSystem(np.array([omega]), np.array([[2.0 * zeta * unit]]))

    (step,), *_ = system.exact_steps(np.array([duration]))

    generator = np.array([[0.0, unit], [-omega * omega / unit, -2.0 * zeta * unit]])
    scaled = step * [[1.0, unit], [1.0 / unit, 1.0]]
    np.testing.assert_allclose(scaled, expm(generator * duration), rtol=1e-7, atol=9e-10)


@pytest.mark.parametrize(("alpha", "beta"), [(1.0735, 7.3124e-4), (0.0, 1.0), (100.0, 0.0)])
@pytest.mark.parametrize("frequencies", [(5.6492, 29.9699), (0.1, 10.0)])
def test_rayleigh_coefficients_are_the_inverse_of_the_ratios(alpha, beta, frequencies):
    low, high = rayleigh_damping_ratio(alpha, beta, frequencies)

    coefficients = rayleigh_coefficients(frequencies, (float(low), float(high)))

    np.testing.assert_allclose(coefficients, (alpha, beta), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("frequencies", [(1.0, 1.0), (0.0, 1.0), (-1.0, 2.0)])
def test_rayleigh_coefficients_need_two_different_positive_frequencies(frequencies):
    with pytest.raises(ValueError, match="Two different positive frequencies"):
        rayleigh_coefficients(frequencies, (0.1, 0.1))


# ---------------------------------------------------------------- one mass, by closed forms

PERIOD_OMEGA = 2.0 * np.pi  # one second for a period
ONE_MASS = ModalSystem(np.array([PERIOD_OMEGA]), np.zeros((1, 1)), {"mass": np.array([1.0])})
STIFFNESS = PERIOD_OMEGA**2  # mass 1 kg


def ring(
    *primitives: Primitive,
    duration: float = 10.0,
    count: int = 1001,
    start: float = 1.0,
    **options: Any,
) -> ModalMotion:
    """Return the ring-down of one mass, which is let go at `start`."""
    arguments = {
        "q": np.array([start]),
        "v": np.zeros(1),
        "force": np.zeros(count),
        "kernel": compiled_kernel(),
    }
    interval = duration / (count - 1)
    return simulate(ONE_MASS, make_laws(*primitives), interval=interval, **arguments | options)


def coulomb_friction(strength: float) -> PowerDamping:
    return PowerDamping("mass", strength, 0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class FrictionRing:
    """A ring-down of one mass under Coulomb friction.

    Attributes
    ----------
    motion : ModalMotion
    time : (N,) array
    stop : float
        When the mass stops, by the closed form [s].
    expected : (N,) array
        The displacement by the closed form.
    """

    motion: ModalMotion
    time: FloatArray
    stop: float
    expected: FloatArray

    @property
    def displacement(self) -> FloatArray:
        (displacement,) = self.motion.q.T
        return displacement

    @property
    def is_stopped(self) -> np.ndarray[Any, Any]:
        return self.time > self.stop + 0.05


@pytest.fixture(scope="module", params=[0.01, 0.05, 0.13])
def friction_ring(request):
    """x'' + w^2 x + Fc sgn x' = 0: half cycles about +-Fc/k, Den Hartog 1931."""
    ratio = request.param  # Fc/k over the first amplitude
    half_cycles = int(np.ceil((1.0 - ratio) / (2.0 * ratio)))
    motion = ring(
        coulomb_friction(ratio * STIFFNESS),
        duration=0.5 * half_cycles + 2.0,
        count=100 * half_cycles + 401,
    )
    time = np.arange(len(motion.q)) * 0.005
    number = np.minimum(np.floor(2.0 * time + 1e-9), half_cycles)
    sign = (-1.0) ** number
    amplitude = 1.0 - 2.0 * ratio * number
    phase = PERIOD_OMEGA * (time - 0.5 * number)
    swing = sign * ratio + sign * (amplitude - ratio) * np.cos(phase)
    expected = np.where(number < half_cycles, swing, sign * amplitude)
    return FrictionRing(motion=motion, time=time, stop=0.5 * half_cycles, expected=expected)


def test_coulomb_friction_takes_the_same_from_each_half_cycle(friction_ring):
    np.testing.assert_allclose(friction_ring.displacement, friction_ring.expected, atol=2e-4)


def test_coulomb_friction_stops_the_mass(friction_ring):
    (velocity,) = friction_ring.motion.v.T

    assert np.ptp(friction_ring.displacement[friction_ring.is_stopped]) < 1e-12
    assert np.all(np.abs(velocity[friction_ring.is_stopped]) < 1e-12)
    assert friction_ring.displacement[-1] == pytest.approx(friction_ring.expected[-1], abs=1e-4)


def test_friction_holds_the_spring_of_a_mass_at_rest(friction_ring):
    (force,) = friction_ring.motion.port_forces.T

    assert force[-1] == pytest.approx(-STIFFNESS * friction_ring.expected[-1], abs=1e-3)


FRICTION = 1.0
RISING_FORCE = np.concatenate((np.linspace(0.0, 0.999, 400), np.full(100, 0.999)))
"""A force that rises in 3.99 s to just below the friction of 1 N, and stays."""


def push_mass(force: FloatArray) -> ModalMotion:
    """Return the motion of one mass with friction from rest under a force of 500 samples."""
    return ring(
        coulomb_friction(FRICTION),
        start=0.0,
        duration=4.99,
        count=500,
        force=force,
        shape=np.ones(1),
        kernel=None,
    )


def test_a_mass_within_the_friction_never_moves():
    motion = push_mass(RISING_FORCE)

    (friction_force,) = motion.port_forces.T
    assert np.max(np.abs(motion.q)) < 1e-12
    np.testing.assert_allclose(friction_force[1:], RISING_FORCE[1:], atol=1e-9)


def test_a_mass_leaves_its_friction_under_a_larger_force():
    motion = push_mass(2.0 * RISING_FORCE)

    rise = 2.0 * 0.999 / 3.99  # [N/s]
    time = 0.01 * np.arange(390)
    since_departure = np.maximum(time - FRICTION / rise, 0.0)
    sine = np.sin(PERIOD_OMEGA * since_departure) / PERIOD_OMEGA
    expected = rise / STIFFNESS * (since_departure - sine)
    (displacement,) = motion.q.T
    np.testing.assert_allclose(displacement[:390], expected, atol=1e-5)


@pytest.mark.parametrize("ratio", [0.35, 0.4, 0.49, 0.55, 0.75, 0.9])
@pytest.mark.parametrize("steps", [11, 17, 31])
def test_friction_stops_a_mass_where_it_stops_to_the_fourth_order_of_the_step(ratio, steps):
    # Half kicks at both ends of a step move about an equilibrium that is nearer by friction
    # h^2 / 12. A mass that begins nearer by as much moves as the exact one does, always nearer,
    # and stops where that stops: before the spring is free of load (2 ratio > 1) and beyond.
    strength = ratio * STIFFNESS
    duration = 0.8
    shift = strength * (duration / steps) ** 2 / 12.0

    motion = ring(
        coulomb_friction(strength),
        start=1.0 - shift,
        duration=duration,
        count=2,
        substeps=steps,
        kernel=None,
    )

    (last_velocity,) = motion.v[-1]
    (last_displacement,) = motion.q[-1]
    assert last_velocity == pytest.approx(0.0, abs=1e-12)
    assert last_displacement == pytest.approx(2.0 * ratio - 1.0, abs=0.03 * shift)


@pytest.mark.parametrize(("fraction", "acts_on_modes"), [(0.095, True), (0.105, False)])
def test_damping_acts_on_modes_that_hold_nearly_all_of_a_ports_flexibility(fraction, acts_on_modes):
    """`fraction` is left out by the modes, and up to a tenth may be.

    What damping does elsewhere is compared with an integrator in `test_lumped.py`.
    """
    damping = port_laws(ModelPatch((PowerDamping("mass", 1.5, 0.5, 0.0, 6.0, 1.0),)), ["mass"])
    left_out = np.array([fraction / (1.0 - fraction) / 40.0])
    system = ModalSystem(np.sqrt([40.0]), np.zeros((1, 1)), {"mass": np.ones(1)}, left_out)

    flexibility = port_flexibility(system, damping)

    assert flexibility.tolist() == [0.0 if acts_on_modes else left_out[0]]


def test_motions_of_almost_nothing_stay_finite():
    damping = PowerDamping("mass", 1.0, 2.5, 0.0, 1.0, 1.0)
    stiffness = PowerStiffness("mass", 1.0, 3.0, 0, 1.0)

    motion = ring(
        damping,
        stiffness,
        start=1e-300,
        v=np.array([1e-290]),
        duration=0.04,
        count=5,
        kernel=None,
    )

    assert np.all(np.isfinite(motion.q))
