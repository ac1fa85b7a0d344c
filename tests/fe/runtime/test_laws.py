"""The contract of a law of a port, each law: slopes, rest, order of steps, both loops, over the planform."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from fe.compilation import compiled_kernel
from fe.runtime import laws as functions
from fe.runtime import patch
from fe.runtime.arrays import FORCE
from fe.runtime.errors import SolutionError
from fe.runtime.laws import speed
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import (
    NO_LAWS,
    PLANFORM,
    STATION_COUNT,
    STATION_PORTS,
    Laws,
    at_stations,
    laws_of,
    static_solution,
)
from fe.runtime.patch import BoucWen, FreePlay, MicroSlip, ModelPatch, PowerDamping, PowerStiffness, Primitive
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.static_path import settle_port
from fe.runtime.stepwise import substeps
from fe.runtime.wing_rows import planform_stations
from tests.fe.runtime.stepping import force_of, rates_of, simulate, states_of

A, W = 0.05, 2.0 * np.pi * np.array([5.6, 20.0, 35.0, 60.0])
PORTS = {"tip": np.array([1.3, -1.1, 0.2, 1.2]), "root": np.array([0.8, 2.0, -0.3, 3.0])}
WING = ModalSystem(W, np.diag(0.04 * W), PORTS)
K1 = float(W[0] ** 2 / 1.3**2)
AT_EACH = {  # one of each law
    law.kind: law
    for law in (
        PowerDamping(PLANFORM, 2.0, 2.0, 0.5, 0.3, 0.1),
        PowerStiffness(PLANFORM, 40.0, 3.0, 0, 0.02),
        FreePlay(PLANFORM, 90.0, 0.004),
        MicroSlip(PLANFORM, 12.0, 1500.0, -0.3, 8),
        BoucWen(PLANFORM, 800.0, 0.01, 2.0),
        patch.SineForce(PLANFORM, 3.0, 2.0, 0.1),
        patch.Overflow(PLANFORM, 5.0, 1.4, 0.2, 0.1),
    )
}


def laws(*items: Primitive) -> Laws:
    return laws_of(ModelPatch(items), ["tip", "root", "mass", PLANFORM])


def moved(*items: Primitive, system: ModalSystem = WING, **options: Any) -> Any:
    start = {"q": np.array([A / 1.3, 0.002, 0.0, 0.001]), "v": np.zeros(4), "kernel": compiled_kernel()}
    return simulate(system, laws(*items), interval=0.005, **start | options)


def test_there_is_an_example_of_each_law() -> None:
    assert {type(item) for item in AT_EACH.values()} == set(functions.LAWS)


@pytest.mark.parametrize("kind", AT_EACH)
def test_the_slope_is_that_of_the_force(kind: str) -> None:
    """On ways to both sides from a place where it was never loaded, whose memory stays."""
    law = laws(AT_EACH[kind])
    memory = law.memory()
    for x in (-0.03, 0.0013, 0.021):
        force = [
            functions.pull(law.numbers[0], law.values[0], memory[0], x + way, 0.02)
            for way in (-1e-7, 0.0, 1e-7)
        ]
        assert force[1][1] == pytest.approx((force[2][0] - force[0][0]) / 2e-7, rel=2e-3, abs=1e-6)
    assert not memory.any()


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5, 2.0])
@pytest.mark.parametrize(
    ("law", "lowest"),
    [(patch.Overflow("tip", 0.7, 1.0, 2.0, 1.3), 2.0), (PowerDamping("tip", 0.7, 1.0, 0.5, 1.3, 0.1), 0.0)],
)
def test_what_a_law_of_speed_takes_is_its_equation(law: Any, lowest: float, exponent: float) -> None:
    """A kick is s' = -w F(x, s), to the level where the law ends and no further."""
    changed = type(law)(**vars(law) | {"exponent" if lowest else "velocity_exponent": exponent})
    given = laws(changed)
    values, x = given.values[0], 0.03
    strength = speed.strength(values, x, 0.4)

    def slope(t: float, s: Any) -> float:
        return -0.4 * speed.steady(values, x, s[0])

    exact = solve_ivp(slope, (0.0, 2.0), [3.5], rtol=1e-10, atol=1e-12)
    kicked = [speed.kick(values, 3.5, strength, duration, False) for duration in (2.0, 1e4)]
    assert kicked[0] == pytest.approx(exact.y[0, -1], abs=1e-6)
    assert kicked[1] == pytest.approx(lowest, abs=1e-2)
    if lowest:
        assert speed.kick(values, 1.9, strength, 2.0, False) == 1.9
        assert speed.steady(values, 0.0, 1.9) == 0.0


# ---------------------------------------------------------------- at rest


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
        patch.SineForce("tip", 40.0, 15.0, 0.4),
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
    if isinstance(law, patch.SineForce):
        np.testing.assert_allclose(
            solution.forces, 40.0 * np.sin(15.0 * solution.positions + 0.4), atol=1e-10
        )


@given(
    load=st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=6),
    share=st.floats(0.0, 0.95),
    width=st.floats(1e-4, 0.2),
    order=st.floats(0.5, 10.0),
)
@settings(max_examples=80, deadline=None)
def test_static_solutions_exist_for_every_softening_that_leaves_stiffness(load, share, width, order) -> None:
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


@pytest.mark.parametrize("flexibility", [0.1, 0.16])  # from 1/6 m/N on there is more than one root
def test_a_sine_on_flexibility_is_settled(flexibility: float) -> None:
    sine = laws(patch.SineForce("tip", 2.0, 3.0, 0.4))
    ports = sine.at_rest()._replace(leader=np.zeros(1, dtype=np.int64))
    for y in np.linspace(-9.0, 9.0, 91):
        memory = sine.memory()
        x = settle_port(0, ports, memory, y, flexibility, 1.0)
        near = 1e-11 * (abs(x) + abs(y))
        assert abs(x + flexibility * memory[0, FORCE] - y) <= near
        assert flexibility * abs(memory[0, FORCE] - 2.0 * np.sin(3.0 * x + 0.4)) <= near


# ---------------------------------------------------------------- in motion

TYPICAL: dict[str, tuple[Primitive, float, float]] = {
    # law, least observed order, largest error of the default steps in shares of the release
    "coulomb": (PowerDamping("tip", 0.02 * K1 * A, 0, 0, 1, 1), 1.7, 5e-5),
    "quadratic": (PowerDamping("tip", 0.05 * K1 * A, 2, 0, W[0] * A, 1), 1.9, 5e-5),
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


def integrated(law: Any, time: NDArray[np.float64]) -> Any:
    """Displacement (N,) of the tip after its release, by a general integrator."""
    given: dict[str, Any] = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
    row, rate = PORTS["tip"], getattr(law, "rate", 0.0)
    first = np.array([A / 1.3, 0.002, 0.0, 0.001, *np.zeros(4)])
    z = np.zeros(states_of(law))
    x = float(row @ first[:4])
    z = solve_ivp(lambda s, z: rates_of(law, x, z), (0.0, 1.0), z, max_step=0.01, **given).y[:, -1]

    def slope(t: float, y: Any) -> Any:
        q, v, z = np.split(y, (4, 8))
        force = force_of(law, float(row @ q), float(row @ v), z)
        a = -(W**2) * (1.0 + rate * t) * q - WING.damping @ v - row * force
        return np.concatenate((v, a, rates_of(law, float(row @ v), z)))

    begin = np.concatenate((first, z))
    return row @ solve_ivp(slope, (0.0, time[-1]), begin, t_eval=time, max_step=2e-3, **given).y[:4]


@pytest.mark.parametrize("name", TYPICAL)
def test_default_steps_are_fine_and_the_order_is_two(name: str) -> None:
    law, least_order, largest = TYPICAL[name]
    runs = (moved(law, force=np.zeros(len(TIME)), refinement=n).q @ PORTS["tip"] for n in (1, 2, 4, 8, 128))
    *coarse, exact = runs  # of dry friction, whose closed form is that of `test_motion`
    if name != "coulomb":
        exact = integrated(law, TIME)
    errors = [np.max(np.abs(one - exact)) / A for one in coarse]
    assert errors[0] < largest
    # events fall differently into the steps of each refinement, so the order is that over a factor of eight
    assert np.log2(errors[0] / errors[-1]) / 3.0 > least_order


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
def test_plain_and_compiled_loops_agree(coupling: float) -> None:
    system = ModalSystem(W, WING.damping + coupling, PORTS, coupling * np.full(2, 5e-4), 1e-3)
    one, other = (moved(*SEVERAL, system=system, **PUSHED, kernel=k) for k in (None, compiled_kernel()))
    np.testing.assert_allclose(one.q, other.q, atol=1e-12)
    np.testing.assert_allclose(one.port_forces, other.port_forces, atol=1e-8)


def test_a_run_can_be_stopped_and_taken_further() -> None:
    whole, first = moved(*SEVERAL, **PUSHED), moved(*SEVERAL, **PUSHED | {"force": PUSHED["force"][:41]})
    left = {"q": first.q[-1], "v": first.v[-1], "memory": first.memory, "start": 0.2}
    rest = moved(*SEVERAL, **PUSHED | {"force": PUSHED["force"][40:]}, **left)
    np.testing.assert_allclose(rest.q, whole.q[40:], atol=1e-13)


# ---------------------------------------------------------------- of a patch


def test_laws_without_magnitude_leave_the_linear_structure() -> None:
    damping, play = PowerDamping("tip", 0.0, 0, 0, 1, 1), FreePlay("tip", 10.0, 0.0)
    nothing = laws(damping, play, patch.StiffnessDrift(0.0), patch.PointMass(1.0, 0.5))
    assert nothing is NO_LAWS
    assert len(substeps(WING, nothing, np.array([0.0, 0.005])).lengths) == 1


# ---------------------------------------------------------------- over the planform

SPAN, ROOT, TIP = 1.8, 0.4, 0.25


@given(st.floats(0.05, 5.0), st.floats(0.05, 5.0), st.integers(0, 2 * STATION_COUNT - 2))
def test_powers_of_the_distance_have_the_mean_over_the_area(root: float, tip: float, power: int) -> None:
    distance, share = planform_stations(SPAN, root, tip)
    chord = Polynomial((root, (tip - root) / SPAN))
    moment = (chord * Polynomial((0.0, 1.0)) ** power).integ()(SPAN) / chord.integ()(SPAN)
    assert share.sum() == pytest.approx(1.0)
    assert float(share @ distance**power) == pytest.approx(moment, rel=1e-12)


@pytest.mark.parametrize("kind", AT_EACH)
def test_where_all_places_move_alike_the_forces_add_up_to_the_law(kind: str) -> None:
    """What is elsewhere in a patch stays as it is."""
    share, item = planform_stations(SPAN, ROOT, TIP)[1], AT_EACH[kind]
    before, after = patch.PointMass(0.1, 1.0), FreePlay("root", 2.0, 1e-3)
    first, *spread, last = at_stations(ModelPatch((before, item, after)), share)
    assert (first, last) == (before, after)
    assert at_stations(ModelPatch((before, after)), share) == ModelPatch((before, after))
    assert [force.port for force in spread if isinstance(force, PortForce)] == list(STATION_PORTS)
    one, parts = laws(item), laws_of(ModelPatch(tuple(spread)), STATION_PORTS)
    np.testing.assert_allclose(parts.values[:, 0], share * one.values[0, 0], rtol=1e-12)
    assert np.all(parts.values[:, 1:PARAMETERS] == one.values[0, 1:PARAMETERS])
    assert np.allclose(
        parts.values[:, PARAMETERS:], one.values[:, PARAMETERS:]
    )  # each slips where the whole does


def test_rows_of_the_stations_are_displacements_of_the_elastic_line(coarse_patched_wing: PatchedWing) -> None:
    wing = coarse_patched_wing
    bent = np.linalg.solve(
        wing.at(np.array([1.0, 0.0, 0.0, 0.17, 0.13, 1.0, 0.0])).stiffness, wing.arrays.load_tip
    )
    along = wing.arrays.line_rows[2] @ bent
    seen = np.array([wing.port_rows[port] @ bent for port in STATION_PORTS])
    between = CubicSpline(wing.arrays.stations, along)(wing.planform[0])
    assert seen == pytest.approx(between, rel=1e-2)
    # the mean over the area is that of the port "span"
    assert float(wing.planform[1] @ seen) == pytest.approx(float(wing.port_rows["span"] @ bent), rel=1e-2)
