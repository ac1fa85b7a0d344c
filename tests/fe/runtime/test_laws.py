"""Laws of ports, by their contract and over the planform, and motion under them against closed forms."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm

from fe.compilation import compiled_kernel
from fe.runtime import laws as functions
from fe.runtime import patch
from fe.runtime.arrays import FORCE
from fe.runtime.errors import SolutionError
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.modal_system import ModalSystem, rayleigh_coefficients, rayleigh_damping_ratio
from fe.runtime.motion import static_solution
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.patch import BoucWen, FreePlay, MicroSlip, ModelPatch, PowerDamping, PowerStiffness, Primitive
from fe.runtime.port_laws import (
    NO_LAWS,
    PLANFORM,
    STATION_PORTS,
    PortLaws,
    port_flexibility,
    port_laws,
    spread_over_stations,
)
from fe.runtime.static_path import solve_port_position
from fe.runtime.wing_rows import planform_stations
from tests.fe.runtime.stepping import exact, force_of, rates_of, second_order, simulate, states_of
from tests.refusals import Inputs

A, W = 0.05, 2.0 * np.pi * np.array([5.6, 20.0, 35.0, 60.0])
PORTS = {"tip": np.array([1.3, -1.1, 0.2, 1.2]), "root": np.array([0.8, 2.0, -0.3, 3.0])}
WING = ModalSystem(W, np.diag(0.04 * W), PORTS)
K1 = float(W[0] ** 2 / 1.3**2)
INPUTS = Inputs(__file__)


def named(table: str) -> list[Primitive]:
    """Laws by their kinds and values, of a table of `laws.toml`."""
    return [patch.PRIMITIVES[kind](*values) for kind, *values in INPUTS.table("laws.toml")[table]]


AT_EACH = {law.kind: law for law in named("each")}
"""One of each law, over the planform."""


def laws(*items: Primitive) -> PortLaws:
    return port_laws(ModelPatch(items), ["tip", "root", "mass", PLANFORM])


def moved(*items: Primitive, system: ModalSystem = WING, **options: Any) -> Any:
    start = {"q": np.array([A / 1.3, 0.002, 0.0, 0.001]), "v": np.zeros(4), "kernel": compiled_kernel()}
    return simulate(system, laws(*items), interval=0.005, **start | options)


@pytest.mark.parametrize("kind", AT_EACH)
def test_the_slope_is_that_of_the_force(kind):
    """On ways to both sides from a place where it was never loaded, whose memory stays."""
    law = laws(AT_EACH[kind])
    memory = law.unloaded_memory()
    for x in (-0.03, 0.0013, 0.021):
        force = [
            functions.force_and_slope(law.law_numbers[0], law.parameters[0], memory[0], x + way, 0.02)
            for way in (-1e-7, 0.0, 1e-7)
        ]
        assert force[1][1] == pytest.approx((force[2][0] - force[0][0]) / 2e-7, rel=2e-3, abs=1e-6)
        if kind in ("power_damping", "power_stiffness", "free_play"):
            wanted = force_of(AT_EACH[kind], x, x / 0.02, memory)
            assert force[1][0] == pytest.approx(wanted, rel=1e-12)
    assert not memory.any()
    assert {type(item) for item in AT_EACH.values()} == set(functions.LAWS)


# ---------------------------------------------------------------- at rest


@pytest.mark.parametrize("law", named("at rest"))
def test_static_levels_are_in_equilibrium_and_follow_the_path(law):
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
def test_static_solutions_exist_for_every_softening_that_leaves_stiffness(load, share, width, order):
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


def test_a_structure_that_softens_away_is_refused():
    spring = laws(PowerStiffness("tip", -500.0, 3.0, 0, 0.1))
    with pytest.raises(SolutionError, match="level 2 was not found: an internal force at tip"):
        static_solution(spring, np.array([[0.01], [0.5]]), np.array([[1e-3]]))


@pytest.mark.parametrize("flexibility", [0.1, 0.16])  # from 1/6 m/N on there is more than one root
def test_a_sine_on_flexibility_is_settled(flexibility):
    sine = laws(patch.SineForce("tip", 2.0, 3.0, 0.4))
    ports = sine.port_arrays_at_rest()._replace(leader=np.zeros(1, dtype=np.int64))
    for y in np.linspace(-9.0, 9.0, 91):
        memory = sine.unloaded_memory()
        x = solve_port_position(0, ports, memory, y, flexibility, 1.0)
        near = 1e-11 * (abs(x) + abs(y))
        assert abs(x + flexibility * memory[0, FORCE] - y) <= near
        assert flexibility * abs(memory[0, FORCE] - 2.0 * np.sin(3.0 * x + 0.4)) <= near


# ---------------------------------------------------------------- in motion

TYPICAL: dict[str, tuple[Primitive, float, float]] = {
    # law, least observed order, largest error of the default steps in shares of the release
    "coulomb": (PowerDamping("tip", 0.02 * K1 * A, 0, 0, 1, 1), 1.7, 5e-5),
    "quadratic": (PowerDamping("tip", 0.05 * K1 * A, 2, 0, W[0] * A, 1), 1.9, 5e-5),
    "viscous": (PowerDamping("tip", 0.05 * K1 * A, 1, 0, W[0] * A, 1), 1.9, 5e-5),
    "structural": (PowerDamping("tip", 0.03 * K1 * A, 0, 1, 1, A), 1.5, 5e-5),
    "cubic": (PowerStiffness("tip", 0.05 * K1 * A, 3, 0, A), 1.9, 3e-5),
    "crack": (PowerStiffness("tip", -0.05 * K1 * A, 1, -1, A), 1.5, 5e-5),
    "free play": (FreePlay("tip", 0.1 * K1, 0.1 * A), 1.2, 5e-5),
    "micro-slip": (MicroSlip("tip", 0.05 * K1 * A, 0.1 * K1, -0.3, 5), 1.3, 1e-4),
    "Bouc-Wen": (BoucWen("tip", 0.1 * K1, 0.5 * A, 2.0), 1.3, 1e-4),
    "sharp Bouc-Wen": (BoucWen("tip", 0.1 * K1, 0.3 * A, 6.0), 1.3, 1e-4),
    "softening": (PowerStiffness("tip", -0.1 * K1 * A, 3, 0, A), 1.9, 5e-5),
    "drift": (patch.StiffnessDrift(0.02), 1.9, 1e-5),
}


TIME = 0.005 * np.arange(100)


def integrated(law: Any) -> Any:
    """Displacement (N,) of the tip after its release, by a general integrator."""
    given: dict[str, Any] = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
    row, rate, z = PORTS["tip"], getattr(law, "rate", 0.0), np.zeros(states_of(law))
    first = np.array([A / 1.3, 0.002, 0.0, 0.001, *np.zeros(4)])
    x = float(row @ first[:4])
    z = solve_ivp(lambda s, z: rates_of(law, x, z), (0.0, 1.0), z, max_step=0.01, **given).y[:, -1]

    def slope(t: float, y: Any) -> Any:
        q, v, z = np.split(y, (4, 8))
        force = force_of(law, float(row @ q), float(row @ v), z)
        a = -(W**2) * (1.0 + rate * t) * q - WING.damping @ v - row * force
        return np.concatenate((v, a, rates_of(law, float(row @ v), z)))

    begin = np.concatenate((first, z))
    return row @ solve_ivp(slope, (0.0, TIME[-1]), begin, t_eval=TIME, max_step=2e-3, **given).y[:4]


@pytest.mark.parametrize("name", TYPICAL)
def test_default_steps_are_fine_and_the_order_is_two(name):
    law, least_order, largest = TYPICAL[name]

    def found(refinement: int) -> Any:
        return moved(law, force=np.zeros(100), refinement=refinement).q @ PORTS["tip"]

    exact = found(128) if name == "coulomb" else integrated(law)  # coulomb's closed form is below
    errors = [np.max(np.abs(found(refinement) - exact)) / A for refinement in (1, 8)]
    assert errors[0] < largest
    # events fall differently into the steps of each refinement, so the order is that over a factor of eight
    assert np.log2(errors[0] / errors[1]) / 3.0 > least_order


SEVERAL = (
    PowerDamping("tip", 0.03 * K1 * A, 0.0, 0.0, 1.0, 1.0),
    PowerDamping("root", 0.01 * K1 * A, 0.4, 0.5, 2.0, A),
    PowerStiffness("root", 0.02 * K1 * A, 2.5, 1, A),
    MicroSlip("root", 0.02 * K1 * A, 0.05 * K1, -0.2, 5),
    BoucWen("tip", 0.05 * K1, 0.3 * A, 1.5),
    FreePlay("tip", 0.05 * K1, 0.1 * A),
    patch.StiffnessDrift(0.01),
)
PUSHED = {"force": 0.1 * K1 * A * np.sin(np.arange(101) * 0.3), "shape": PORTS["tip"]}


@pytest.mark.parametrize("coupling", [0.0, 0.3])
def test_plain_and_compiled_loops_agree(coupling):
    system = ModalSystem(W, WING.damping + coupling, PORTS, coupling * np.full(2, 5e-4), 1e-3)
    one, other = (moved(*SEVERAL, system=system, **PUSHED, kernel=k) for k in (None, compiled_kernel()))
    np.testing.assert_allclose(one.q, other.q, atol=1e-12)
    np.testing.assert_allclose(one.port_forces, other.port_forces, atol=1e-8)


def test_a_run_can_be_stopped_and_taken_further():
    whole, first = moved(*SEVERAL, **PUSHED), moved(*SEVERAL, **PUSHED | {"force": PUSHED["force"][:41]})
    left = {"q": first.q[-1], "v": first.v[-1], "memory": first.memory, "start": 0.2}
    rest = moved(*SEVERAL, **PUSHED | {"force": PUSHED["force"][40:]}, **left)
    np.testing.assert_allclose(rest.q, whole.q[40:], atol=1e-13)


# ---------------------------------------------------------------- over the planform


@pytest.mark.parametrize("kind", AT_EACH)
def test_where_all_places_move_alike_the_forces_add_up_to_the_law(kind):
    """What is elsewhere in a patch stays as it is."""
    share, item = planform_stations(1.8, 0.4, 0.25)[1], AT_EACH[kind]
    before, after = patch.PointMass(0.1, 1.0), FreePlay("root", 2.0, 1e-3)
    first, *spread, last = spread_over_stations(ModelPatch((before, item, after)), share)
    assert (first, last) == (before, after)
    assert spread_over_stations(ModelPatch((before, after)), share) == ModelPatch((before, after))
    assert [force.port for force in spread if isinstance(force, PortForce)] == list(STATION_PORTS)
    one, parts = laws(item), port_laws(ModelPatch(tuple(spread)), STATION_PORTS)
    np.testing.assert_allclose(parts.parameters[:, 0], share * one.parameters[0, 0], rtol=1e-12)
    assert np.all(parts.parameters[:, 1:PARAMETERS] == one.parameters[0, 1:PARAMETERS])
    assert np.allclose(
        parts.parameters[:, PARAMETERS:], one.parameters[:, PARAMETERS:]
    )  # each slips where the whole does


# ---------------------------------------------------------------- one mass, by closed forms

OMEGA = 2.0 * np.pi  # one second for a period
ONE = ModalSystem(np.array([OMEGA]), np.zeros((1, 1)), {"mass": np.array([1.0])})
STIFFNESS = OMEGA**2  # mass 1 kg


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
def test_a_linear_system_under_a_force_is_the_matrix_exponential(coupled):
    """Free, overdamped and hardly damped modes, at stamps of several distances: all but rounding is exact."""
    random, w = np.random.default_rng(3), np.array([0.0, 7.0, 60.0, 150.0])
    damping = np.diag([0.3, 1.0, 200.0, 3.0]) + coupled * random.normal(size=(4, 4))
    shape, constant, first, force = (random.normal(size=size) for size in (4, 4, 8, 50))
    interval = np.resize([0.01, 0.0104, 0.01, 0.04], 49)
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
def test_coulomb_friction_takes_the_same_from_each_half_cycle_and_stops_the_mass(ratio):
    # x'' + w^2 x + Fc sgn x' = 0: half cycles about +-Fc/k, Den Hartog 1931
    half_cycles = int(np.ceil((1.0 - ratio) / (2.0 * ratio)))
    moved = ring(coulomb(ratio * STIFFNESS), duration=0.5 * half_cycles + 2.0, count=100 * half_cycles + 401)
    time = np.arange(len(moved.q)) * 0.005
    number = np.minimum(np.floor(2.0 * time + 1e-9), half_cycles)
    sign, amplitude = (-1.0) ** number, 1.0 - 2.0 * ratio * number
    swing = sign * ratio + sign * (amplitude - ratio) * np.cos(OMEGA * (time - 0.5 * number))
    expected = np.where(number < half_cycles, swing, sign * amplitude)
    np.testing.assert_allclose(moved.q[:, 0], expected, atol=2e-4)
    stopped, rest = time > 0.5 * half_cycles + 0.05, expected[-1]
    assert np.ptp(moved.q[stopped, 0]) < 1e-12
    assert moved.q[-1, 0] == pytest.approx(rest, abs=1e-4)
    assert np.all(np.abs(moved.v[stopped, 0]) < 1e-12)
    # at rest friction holds the spring
    assert moved.port_forces[-1, 0] == pytest.approx(-STIFFNESS * rest, abs=1e-3)


def test_a_mass_within_the_friction_never_moves_and_leaves_under_a_larger_force():
    force = np.concatenate((np.linspace(0.0, 0.999, 400), np.full(100, 0.999)))
    held, moved = (
        ring(
            coulomb(1.0), start=0.0, duration=4.99, count=500, force=f * force, shape=np.ones(1), kernel=None
        )
        for f in (1.0, 2.0)
    )
    assert np.max(np.abs(held.q)) < 1e-12
    np.testing.assert_allclose(held.port_forces[1:, 0], force[1:], atol=1e-9)
    rise = 2.0 * 0.999 / 3.99
    since = np.maximum(0.01 * np.arange(390) - 1.0 / rise, 0.0)
    wanted = rise / STIFFNESS * (since - np.sin(OMEGA * since) / OMEGA)
    np.testing.assert_allclose(moved.q[:390, 0], wanted, atol=1e-5)


@pytest.mark.parametrize("ratio", [0.35, 0.4, 0.49, 0.55, 0.75, 0.9])
@pytest.mark.parametrize("steps", [11, 17, 31])
def test_friction_stops_a_mass_where_it_stops_to_the_fourth_order_of_the_step(ratio, steps):
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


def test_damping_acts_on_modes_that_hold_nearly_all_of_a_ports_flexibility():
    """All but a tenth; what it does elsewhere is compared with an integrator in `test_lumped.py`."""
    acts = port_laws(ModelPatch((PowerDamping("mass", 1.5, 0.5, 0.0, 6.0, 1.0),)), ["mass"])
    for share, on_modes in ((0.095, True), (0.105, False)):
        left_out = np.array([share / (1.0 - share) / 40.0])
        system = ModalSystem(np.sqrt([40.0]), np.zeros((1, 1)), {"mass": np.ones(1)}, left_out)
        assert port_flexibility(system, acts).tolist() == [0.0 if on_modes else left_out[0]]


# ---------------------------------------------------------------- hysteresis


def whole_force(law: Primitive, path: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Force along a prescribed path with the spring that the law takes away.

    It is a static solution of a structure without compliance.
    """
    found = static_solution(laws(law), path[:, None], np.zeros((1, 1)), kernel=compiled_kernel())
    return found.forces[:, 0] + law.stiffness * path


@pytest.mark.parametrize("chi", [0.0, -0.5, -0.9])
def test_an_iwan_joint_loses_the_energy_of_its_density_and_obeys_masing(chi):
    law = MicroSlip("mass", slip_force=1.0, stiffness=4.0, chi=chi, element_count=400)
    amplitude, most = 0.2, (2 + chi) / ((1 + chi) * 4.0)
    up = np.linspace(0, amplitude, 401)
    loop = np.concatenate((up, up[::-1], -up, -up[::-1], up))
    whole = whole_force(law, loop)

    def lost(d: float) -> float:
        """An element that slips takes 4 k d (A - d), d of the density (1 + chi) d^chi / most^(1 + chi)."""
        return float(16.0 * d * (amplitude - d) * (1 + chi) * d**chi / most ** (1 + chi))

    loss = quad(lost, 0.0, amplitude)[0]
    assert np.trapezoid(whole[401:], loop[401:]) == pytest.approx(loss, rel=5e-4)
    # Masing 1926: unloading from the turn is the first loading, twice as large
    down = slice(401, 3 * 401)
    first = whole_force(law, 0.5 * (amplitude - loop[down]))
    np.testing.assert_allclose(whole[400] - whole[down], 2.0 * first, atol=1e-12)
    # all slip at the slip force
    assert law.slip_displacements().mean() == pytest.approx(0.25)
    assert whole_force(law, np.array([50.0]))[0] == pytest.approx(1.0)


def test_motions_of_almost_nothing_stay_finite():
    both = PowerDamping("mass", 1.0, 2.5, 0.0, 1.0, 1.0), PowerStiffness("mass", 1.0, 3.0, 0, 1.0)
    moved = ring(*both, start=1e-300, v=np.array([1e-290]), duration=0.04, count=5, kernel=None)
    assert np.all(np.isfinite(moved.q))


# ---------------------------------------------------------------- steps of modes, and their damping


@pytest.mark.parametrize("omega", [0.0, 9.0, 500.0])
@pytest.mark.parametrize("zeta", [0.0, 0.03, 0.7, 1 - 1e-9, 1.0, 1 + 1e-9, 1 + 1e-4, 1.5, 20.0, 1e4])
def test_the_step_of_any_oscillator_is_the_exponential(omega, zeta):
    """Of displacements times the frequency and of speeds, all of which are of order one."""
    unit = max(omega, 1.0)
    system = ModalSystem(np.array([omega]), np.array([[2.0 * zeta * unit]]))
    for duration in (1e-5, 0.01, 0.3, 2.0):
        (found,), *_ = system.exact_steps(np.array([duration]))
        wanted = expm(np.array([[0.0, unit], [-omega * omega / unit, -2.0 * zeta * unit]]) * duration)
        scaled = found * [[1.0, unit], [1.0 / unit, 1.0]]
        np.testing.assert_allclose(scaled, wanted, rtol=1e-7, atol=9e-10)


@pytest.mark.parametrize(("alpha", "beta"), [(1.0735, 7.3124e-4), (0.0, 1.0), (100.0, 0.0)])
@pytest.mark.parametrize("frequency", [(5.6492, 29.9699), (0.1, 10.0)])
def test_rayleigh_coefficients_are_the_inverse_of_the_ratios(alpha, beta, frequency):
    low, high = rayleigh_damping_ratio(alpha, beta, frequency)
    found = rayleigh_coefficients(frequency, (float(low), float(high)))
    np.testing.assert_allclose(found, (alpha, beta), rtol=1e-9, atol=1e-9)
    for wrong in ((1.0, 1.0), (0.0, 1.0), (-1.0, 2.0)):
        with pytest.raises(ValueError, match="Two different positive frequencies"):
            rayleigh_coefficients(wrong, (0.1, 0.1))
