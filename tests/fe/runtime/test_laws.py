"""Laws of ports by their contract: slopes, static levels, hysteresis, and over the planform."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicHermiteSpline

from fe.compilation import compiled_kernel
from fe.runtime import laws, patch
from fe.runtime.arrays import FORCE, FloatArray
from fe.runtime.errors import InvalidPatchError, SolutionError
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.laws.speed import speed_after
from fe.runtime.motion import static_solution
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    MicroSlip,
    ModelPatch,
    PointMass,
    PowerStiffness,
    Primitive,
    TableDamping,
    TableStiffness,
)
from fe.runtime.port_laws import STATION_PORTS, PortLaws, port_laws, spread_over_stations
from fe.runtime.static_path import solve_port_position
from fe.runtime.wing_rows import planform_stations
from tests.fe.runtime.stepping import force_of, make_laws
from tests.refusals import Inputs

INPUTS = Inputs(__file__)


def read_laws(table: str) -> list[Primitive]:
    """Return the laws of a table of `laws.toml`, which has a row of kind and values for each."""
    laws_of_table = []
    for kind, *values in INPUTS.table("laws.toml")[table]:
        fields = [tuple(value) if isinstance(value, list) else value for value in values]
        laws_of_table.append(patch.PRIMITIVES[kind](*fields))
    return laws_of_table


LAW_OF_KIND = {law.kind: law for law in read_laws("each")}
"""One law of each kind, over the planform."""
CONSERVATIVE_OR_DAMPING = ("power_damping", "power_stiffness", "free_play")
"""Kinds whose force follows from displacement and velocity alone."""


# ---------------------------------------------------------------- force and slope

DISPLACEMENTS = (-0.03, 0.0013, 0.021)
STEP_LENGTH = 0.02
"""Time since the law was unloaded [s]: a displacement x means the velocity x / STEP_LENGTH."""


def force_and_slope(law: PortLaws, memory: FloatArray, displacement: float) -> tuple[float, float]:
    """Return force and slope of the one law of a patch, after one step from the memory."""
    force, slope = laws.force_and_slope(
        law.law_numbers[0], law.parameters[0], memory[0], displacement, STEP_LENGTH
    )
    return float(force), float(slope)


def test_each_law_stands_in_the_table_of_these_tests():
    assert {type(law) for law in LAW_OF_KIND.values()} == set(laws.LAWS)


@pytest.mark.parametrize("displacement", DISPLACEMENTS)
@pytest.mark.parametrize("kind", LAW_OF_KIND)
def test_the_slope_is_that_of_the_force(kind, displacement):
    law = make_laws(LAW_OF_KIND[kind])
    memory = law.unloaded_memory()

    force_before, _ = force_and_slope(law, memory, displacement - 1e-7)
    _, slope = force_and_slope(law, memory, displacement)
    force_after, _ = force_and_slope(law, memory, displacement + 1e-7)

    assert slope == pytest.approx((force_after - force_before) / 2e-7, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("displacement", DISPLACEMENTS)
@pytest.mark.parametrize("kind", CONSERVATIVE_OR_DAMPING)
def test_the_force_is_that_of_the_equation(kind, displacement):
    law = make_laws(LAW_OF_KIND[kind])
    memory = law.unloaded_memory()

    force, _ = force_and_slope(law, memory, displacement)

    expected = force_of(LAW_OF_KIND[kind], displacement, displacement / STEP_LENGTH, memory)
    assert force == pytest.approx(expected, rel=1e-12)


@given(
    points=st.lists(st.tuples(st.floats(0.001, 0.02), st.floats(0.1, 9.0)), min_size=2, max_size=6),
    share=st.floats(0.0, 1.0),
)
def test_a_table_is_a_cubic_hermite_curve_that_goes_straight_on(points, share):
    widths, forces = zip(*points, strict=True)
    displacements = np.cumsum(widths) - 0.02
    law = make_laws(TableStiffness("planform", tuple(displacements), forces))
    memory = law.unloaded_memory()
    slopes = np.gradient(forces, displacements)
    curve = CubicHermiteSpline(displacements, forces, slopes)

    inside = displacements[0] + share * (displacements[-1] - displacements[0])
    beyond = displacements[-1] + share
    force_inside, _ = force_and_slope(law, memory, inside)
    force_beyond, _ = force_and_slope(law, memory, beyond)

    assert force_inside == pytest.approx(float(curve(inside)), rel=1e-9, abs=1e-9)
    assert force_beyond == pytest.approx(forces[-1] + slopes[-1] * share, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("displacements", "forces"), [((0.0,), (1.0,)), ((0.0, 0.0), (1.0, 2.0)), ((0.0, 1.0), (1.0,))]
)
def test_a_table_without_rising_points_is_refused(displacements, forces):
    for kind in (TableStiffness, TableDamping):
        with pytest.raises(InvalidPatchError, match="two or more rising numbers"):
            make_laws(kind("planform", displacements, forces))


@given(
    points=st.lists(st.tuples(st.floats(0.05, 0.5), st.floats(-3.0, 3.0)), min_size=2, max_size=6),
    begin=st.floats(-2.0, 2.0),
    duration=st.floats(0.01, 2.0),
)
@settings(deadline=None, max_examples=25)
def test_a_table_of_speeds_decelerates_as_its_equation(points, begin, duration):
    widths, forces = zip(*points, strict=True)
    speeds = np.cumsum(widths) - 1.0
    law = make_laws(TableDamping("planform", tuple(speeds), (*forces[:-1], 1.5)))
    row = law.parameters[0]
    inverse_mass = 0.7

    end = speed_after(row, begin, inverse_mass * row[0], duration, True)

    solution = solve_ivp(
        lambda t, v: [-inverse_mass * np.interp(v[0], speeds, (*forces[:-1], 1.5))],
        (0.0, duration),
        [begin],
        method="LSODA",
        rtol=1e-9,
        atol=1e-10,
        max_step=0.01,
    )
    assert end == pytest.approx(solution.y[0, -1], abs=2e-6)


@pytest.mark.parametrize("kind", LAW_OF_KIND)
def test_the_memory_stays_when_a_force_is_evaluated(kind):
    law = make_laws(LAW_OF_KIND[kind])
    memory = law.unloaded_memory()

    for displacement in DISPLACEMENTS:
        force_and_slope(law, memory, displacement)

    assert not memory.any()


# ---------------------------------------------------------------- at rest

COMPLIANCE = np.array([[1e-3]])
"""The structure has 1000 N/m at its port."""
LOADS = np.array([0.0, 20.0, 60.0, 60.0, 10.0, -50.0, -50.1, 0.0])
LINEAR_POSITIONS = LOADS[:, None] * 1e-3
"""Displacements of the structure without the law, at each level of load."""


@pytest.fixture(scope="module", params=read_laws("at rest"), ids=lambda law: law.kind)
def static_law(request):
    """A law beside a structure of 1000 N/m."""
    return make_laws(request.param)


@pytest.fixture(scope="module")
def static_levels(static_law):
    """Positions and forces of the law at the levels of load."""
    return static_solution(static_law, LINEAR_POSITIONS, COMPLIANCE, kernel=compiled_kernel())


def test_static_levels_are_in_equilibrium(static_levels):
    balance = static_levels.positions + static_levels.forces * 1e-3

    np.testing.assert_allclose(balance, LINEAR_POSITIONS, atol=1e-12)


def test_static_levels_are_those_of_the_plain_kernel(static_law, static_levels):
    plain = static_solution(static_law, LINEAR_POSITIONS, COMPLIANCE)

    np.testing.assert_allclose(static_levels.positions, plain.positions, atol=1e-14)


def test_a_repeated_load_has_the_same_position(static_levels):
    assert LOADS[2] == LOADS[3]
    assert static_levels.positions[2] == pytest.approx(static_levels.positions[3], abs=1e-12)


def test_static_levels_follow_the_path(static_law, static_levels):
    levels = np.arange(8)
    fine_levels = np.linspace(0, 7, 7 * 64 + 1)
    path = np.interp(fine_levels, levels, LINEAR_POSITIONS[:, 0])[:, None]

    followed = static_solution(static_law, path, COMPLIANCE, kernel=compiled_kernel())

    np.testing.assert_allclose(followed.positions[::64], static_levels.positions, atol=3e-6)


@given(
    loads=st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=6),
    softened=st.floats(0.0, 0.95),
    width=st.floats(1e-4, 0.2),
    order=st.floats(0.5, 10.0),
)
@settings(max_examples=80, deadline=None)
def test_static_solutions_exist_for_every_softening_that_leaves_stiffness(
    loads, softened, width, order
):
    """`softened` is the fraction of the 1000 N/m that Bouc-Wen and micro-slip take together."""
    softening = make_laws(
        BoucWen("tip", 0.5 * softened * 1000.0, width, order),
        MicroSlip("root", 500.0 * softened * width, 0.5 * softened * 1000.0, -0.3),
        FreePlay("tip", 0.04 * 1000.0, width),
    )
    compliance = 1e-3 * np.array([[1.0, 0.6, 1.0], [0.6, 1.0, 0.6], [1.0, 0.6, 1.0]])
    if len(softening) < 3:  # laws without stiffness are left out: the gap remains
        compliance = np.full((1, 1), 1e-3)
    linear = np.outer(loads, compliance[0])

    solution = static_solution(softening, linear, compliance, kernel=compiled_kernel())

    balance = solution.positions + solution.forces @ compliance.T
    np.testing.assert_allclose(balance, linear, atol=1e-9)


def test_a_structure_that_softens_away_is_refused():
    spring = make_laws(PowerStiffness("tip", -500.0, 3.0, 0, 0.1))

    with pytest.raises(SolutionError, match="level 2 was not found: an internal force at tip"):
        static_solution(spring, np.array([[0.01], [0.5]]), np.array([[1e-3]]))


@pytest.mark.parametrize("flexibility", [0.1, 0.16])  # from 1/6 m/N on there are several roots
def test_a_sine_on_flexibility_is_settled(flexibility):
    sine = make_laws(patch.SineForce("tip", 2.0, 3.0, 0.4))
    ports = sine.port_arrays_at_rest()._replace(leader=np.zeros(1, dtype=np.int64))

    for free_position in np.linspace(-9.0, 9.0, 91):
        memory = sine.unloaded_memory()
        position = solve_port_position(0, ports, memory, free_position, flexibility, 1.0)

        force = memory[0, FORCE]
        tolerance = 1e-11 * (abs(position) + abs(free_position))
        assert abs(position + flexibility * force - free_position) <= tolerance
        assert flexibility * abs(force - 2.0 * np.sin(3.0 * position + 0.4)) <= tolerance


# ---------------------------------------------------------------- over the planform

MASS_BEFORE = PointMass(0.1, 1.0)
GAP_AFTER = FreePlay("root", 2.0, 1e-3)
AREA_FRACTIONS = planform_stations(1.8, 0.4, 0.25)[1]
"""The fraction of the planform's area that each station stands for."""


@pytest.fixture(scope="module", params=LAW_OF_KIND)
def planform_law(request):
    """A law over the planform."""
    return LAW_OF_KIND[request.param]


@pytest.fixture(scope="module")
def spread_patch(planform_law):
    """The primitives of a patch with the law between two others, after it was spread."""
    return spread_over_stations(ModelPatch((MASS_BEFORE, planform_law, GAP_AFTER)), AREA_FRACTIONS)


@pytest.fixture(scope="module")
def parameters_at_stations(spread_patch):
    """The parameters of the law, a row for each station."""
    _, *at_stations, _ = spread_patch
    return port_laws(ModelPatch(tuple(at_stations)), STATION_PORTS).parameters


def test_a_law_over_the_planform_acts_at_each_station(spread_patch):
    _, *at_stations, _ = spread_patch

    ports = [force.port for force in at_stations if isinstance(force, PortForce)]

    assert ports == list(STATION_PORTS)


def test_what_is_elsewhere_in_a_patch_stays_as_it_is(spread_patch):
    first, *_, last = spread_patch
    elsewhere = ModelPatch((MASS_BEFORE, GAP_AFTER))

    assert (first, last) == (MASS_BEFORE, GAP_AFTER)
    assert spread_over_stations(elsewhere, AREA_FRACTIONS) == elsewhere


def test_where_all_stations_move_alike_the_forces_add_up_to_the_law(
    planform_law, parameters_at_stations
):
    """The first parameter is the size of the force, and each station takes its fraction of it."""
    size, *others = make_laws(planform_law).parameters[0, :PARAMETERS]
    sizes_at_stations, *others_at_stations = parameters_at_stations.T[:PARAMETERS]

    np.testing.assert_allclose(sizes_at_stations, AREA_FRACTIONS * size, rtol=1e-12)
    for value, at_stations in zip(others, others_at_stations, strict=True):
        assert np.all(at_stations == value)


def test_each_station_slips_where_the_whole_does(planform_law, parameters_at_stations):
    limits = make_laws(planform_law).parameters[:, PARAMETERS:]

    assert np.allclose(parameters_at_stations[:, PARAMETERS:], limits)


# ---------------------------------------------------------------- hysteresis


def force_with_lost_spring(law: Primitive, path: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the force along a prescribed path with the spring that the law takes away.

    It is a static solution of a structure without compliance.
    """
    without_compliance = np.zeros((1, 1))
    solution = static_solution(
        make_laws(law), path[:, None], without_compliance, kernel=compiled_kernel()
    )
    (force,) = solution.forces.T
    return force + law.stiffness * path


AMPLITUDE = 0.2
LOADING = np.linspace(0, AMPLITUDE, 401)
LOOP = np.concatenate((LOADING, LOADING[::-1], -LOADING, -LOADING[::-1], LOADING))
"""A first loading, and then a closed loop."""


@pytest.fixture(scope="module", params=[0.0, -0.5, -0.9])
def iwan_joint(request):
    """A joint of many elements, whose distribution of slip displacements has the exponent chi."""
    return MicroSlip("mass", slip_force=1.0, stiffness=4.0, chi=request.param, element_count=400)


@pytest.fixture(scope="module")
def loop_force(iwan_joint):
    """The force along `LOOP`."""
    return force_with_lost_spring(iwan_joint, LOOP)


def test_an_iwan_joint_loses_the_energy_of_its_density(iwan_joint, loop_force):
    chi = iwan_joint.chi
    largest_slip = (2 + chi) / ((1 + chi) * 4.0)

    def lost_energy(slip: float) -> float:
        """Return what the elements that slip at d lose: 4 k d (A - d) times their density."""
        density = (1 + chi) * slip**chi / largest_slip ** (1 + chi)
        return float(16.0 * slip * (AMPLITUDE - slip) * density)

    expected, _ = quad(lost_energy, 0.0, AMPLITUDE)
    assert np.trapezoid(loop_force[401:], LOOP[401:]) == pytest.approx(expected, rel=5e-4)


def test_an_iwan_joint_obeys_masing(iwan_joint, loop_force):
    """Masing 1926: unloading from the turn is the first loading, twice as large."""
    turn = 400
    unloading = slice(401, 3 * 401)

    first_loading = force_with_lost_spring(iwan_joint, 0.5 * (AMPLITUDE - LOOP[unloading]))

    change = loop_force[turn] - loop_force[unloading]
    np.testing.assert_allclose(change, 2.0 * first_loading, atol=1e-12)


def test_all_elements_of_an_iwan_joint_slip_at_the_slip_force(iwan_joint):
    far_beyond = np.array([50.0])

    (force,) = force_with_lost_spring(iwan_joint, far_beyond)

    assert iwan_joint.slip_displacements().mean() == pytest.approx(0.25)
    assert force == pytest.approx(1.0)
