"""Lumped models against matrices inverted by hand and general integrators of their equations of motion."""

import tomllib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm
from scipy.optimize import brentq

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation, ReleasePoint
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.lumped_file import SHIPPED_MODELS, LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.motion import Motion, simulate_motion
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.system_state import SystemState
from fe.runtime import patch as patches
from fe.runtime.patch import MicroSlip, ModelPatch, PowerDamping, Primitive
from fe.runtime.port_laws import port_laws
from tests.discrepancy.rigs import INPUTS, FloatArray, asked, laws, model_of, seen
from tests.fe.runtime.stepping import force_of, second_order, states_of

pytestmark = pytest.mark.xdist_group("compiling")

MASS = np.diag([1.5, 1.2, 0.8])
STIFFNESS = np.array([[5200.0, -2600.0, 0.0], [-2600.0, 4800.0, -2200.0], [0.0, -2200.0, 2200.0]])
JOINT = np.array([0.0, -1.0, 1.0])
END = np.linalg.solve(STIFFNESS, [0, 0, 1])
SQUARE, SHAPES = eigh(STIFFNESS, MASS)
VISCOUS = MASS @ SHAPES @ np.diag(np.array([0.016, 0.012, 0.012]) * np.sqrt(SQUARE)) @ (MASS @ SHAPES).T
MOTION = second_order(*(np.linalg.solve(MASS, part) for part in (STIFFNESS, VISCOUS)))
DISPLACEMENTS = {f"x{k}": Quantity.DISPLACEMENT for k in (1, 2, 3)}
X3, VELOCITY, ACCELERATION = (("x3", quantity) for quantity in Quantity.DISPLACEMENT.motion_chain)


CHAIN = LumpedModel.load("three_mass_chain")


def trial(kind: TrialKind, time: Any = 400, **said: Any) -> Trial:
    return asked(kind, time, **{"load_place": "end", **said})


def ringdown(time: Any = 400, **said: Any) -> Trial:
    return trial(TrialKind.RINGDOWN, time, **{"release": Release(0.02), **said})


def static(force: list[float], **said: Any) -> Trial:
    return trial(TrialKind.STATIC, len(force), force=np.array(force), **said)


def shown(model: LumpedModel, what: Trial, *items: Any, outputs: Any = DISPLACEMENTS, **given: Any) -> Any:
    return seen(model, what, outputs, *items, **given)


# ---------------------------------------------------------------- static

SCALED = 1.1 * (STIFFNESS - 0.2 * 2200.0 * np.outer(JOINT, JOINT))
ROOT = np.linalg.inv(STIFFNESS) + 3e-4 * np.outer([0.2, 0.4, 0.6], [0.2, 0.4, 0.6])
TWO_GAINS = patches.LoadGain(0.2, 0.5), patches.LoadGain(0.1, 0.0)  # one upon the other
WARM, SOFTER = np.array([0.0, 10.0, 0.0, -20.0]), patches.ModulusTemperature(2e-3)


@pytest.mark.parametrize(
    ("items", "force", "wanted", "said"),
    [
        ((), [0.0, 1.0, -3.0], np.outer([0, 1, -3], END), {}),
        ((), [1.0], [np.linalg.solve(SCALED, [0, 0, 1])], {"parameters": np.array([1.1, 0.8, 2.0])}),
        ((patches.SupportCompliance("root", "rx", 3e-4),), [2.0], [2.0 * ROOT[:, 2]], {}),  # in series
        ((patches.LoadGain(0.05, 0.5),), [0.0, 4.0], np.outer([0.0, 4.7], END), {}),
        (TWO_GAINS, [0.0, 4.0], np.outer([0.0, 5.83], END), {}),
        ((patches.LoadPlace(-0.05, 0.0),), [3.0], [np.linalg.solve(STIFFNESS, [0, 0.75, 2.25])], {}),
        ((patches.PointMass(0.3, 0.55),), [1.0], [END], {}),
        ((SOFTER,), [1.0] * 4, np.outer(1.0 / (1 - 2e-3 * WARM), END), {"temperature": WARM}),
    ],
)
def test_static_rows_are_those_of_the_matrices(items, force, wanted, said) -> None:
    given = {"parameters": np.ones(3)} | said
    parameters = given.pop("parameters")
    found = shown(CHAIN, static(force, **given), *items, parameters=parameters)
    np.testing.assert_allclose(found, wanted, rtol=1e-10)


# ---------------------------------------------------------------- motion


def test_a_record_that_begins_under_load_begins_at_rest() -> None:
    what = trial(TrialKind.FORCED, 100, force=np.full(100, 3.0))
    for items in ((), (MicroSlip("joint", 0.5, 800.0, -0.3),)):
        still = shown(CHAIN, static([3.0] * 100), *items)
        np.testing.assert_allclose(shown(CHAIN, what, *items), still, rtol=1e-3 if items else 1e-11)


def test_hysteresis_remembers_its_path_also_while_it_warms() -> None:
    """A temperature that does nothing does not change the path, though every level is solved by itself."""
    path, slip = [2.0, 4.0, 10.0, 6.0, 0.0], MicroSlip("joint", 2.5, 800.0, -0.3)
    values = shown(CHAIN, static(path), slip)
    assert values[-1, 2] > 1e-5  # unloaded, it does not come back
    warm = shown(CHAIN, static(path, temperature=np.arange(5.0)), slip, patches.ModulusTemperature(1e-12))
    assert warm == pytest.approx(values, rel=1e-6, abs=1e-10)


SECOND_MODE = SHAPES[:, 1] / SHAPES[2, 1]
"""The second mode over its value at the place of the release."""


def test_initial_displacements_are_shares_of_the_release() -> None:
    """A tenth more of the released shape, and a twentieth of it in the second mode."""
    first = shown(CHAIN, ringdown(), initial=np.array([[0.1, 0.0], [0.05, 0.0]]))[0]
    expected = 0.02 * (1.1 * END / END[2] + 0.05 * SECOND_MODE)
    np.testing.assert_allclose(first, expected, atol=1e-12)


def test_initial_displacements_and_speeds_of_a_mode_are_shares_of_the_release() -> None:
    """The chain moves before its record begins, too: its clock stands at -0.02 s."""
    moving = ringdown(release=Release(0.02, at_rest=False))
    initial = np.array([[0.0, 0.0], [0.3, -0.4]])
    response = shown(CHAIN, moving, outputs=(X3, VELOCITY), initial=initial, clock=(0.0, -0.02))
    displacement_and_speed = [0.3, -0.4 * np.sqrt(SQUARE[1])]
    initial_state = 0.02 * np.outer(displacement_and_speed, SECOND_MODE).ravel()
    states = np.array([expm(MOTION * t) @ initial_state for t in moving.time - 0.02])
    np.testing.assert_allclose(response, states[:, [2, 5]], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("items", [(), (PowerDamping("joint", 0.2, 2.0, 0.0, 0.1, 1.0),)])
def test_a_clock_shows_the_motion_at_other_times(items: tuple[Primitive, ...]) -> None:
    stamps, time = np.arange(40001) * 1e-4, ringdown(200).time
    fine = shown(CHAIN, ringdown(stamps), *items)
    for clock in ((0.02, 0.013), (-0.01, -0.0333), (0.0, -0.02)):
        values, times = shown(CHAIN, ringdown(200), *items, clock=clock), (1 + clock[0]) * time + clock[1]
        expected = np.stack([np.interp(times, stamps, column) for column in fine.T], axis=1)
        np.testing.assert_allclose(values, expected, atol=0.02 * 2e-4)
        assert np.all(values[times < 0.0] == values[0])  # held until the release


def test_a_point_mass_sits_between_places() -> None:
    row = np.array([0.0, 0.25, 0.75])
    wanted = np.sqrt(eigh(STIFFNESS, MASS + 0.3 * np.outer(row, row), eigvals_only=True))
    state = SystemState((1.0,) * 3, structure=patches.ModelPatch((patches.PointMass(0.3, 0.55),)))
    np.testing.assert_allclose(CHAIN.system_in_state(state).angular_frequency, wanted, rtol=1e-10)


@given(ratios=st.tuples(*[st.floats(0.0, 3.0)] * 3), clock=st.floats(0.0, 0.01))
@settings(max_examples=30, deadline=None)
def test_closed_form_and_stepped_ringdown_agree_for_any_damping(ratios: Any, clock: float) -> None:
    content = tomllib.loads((SHIPPED_MODELS / "three_mass_chain.toml").read_text())
    closed = LumpedModel(LumpedDescription.parse(content | {"damping": {"ratios": list(ratios)}}))
    # a drift of nothing that counts makes the kernel step
    drift = patches.StiffnessDrift(1e-14)
    values, stepped = (shown(closed, ringdown(200), *items, clock=(0.0, clock)) for items in ((), (drift,)))
    np.testing.assert_allclose(values, stepped, atol=1e-8 * 0.02)


# ---------------------------------------------------------------- at uneven stamps


# ---------------------------------------------------------------- what it says of itself


@pytest.mark.parametrize(("name", "whole", "parts"), INPUTS.table("parts.toml")["row"])
def test_a_matrix_may_be_given_by_parts_alone(name: str, whole: str, parts: str) -> None:
    one, other = (
        model_of(text).description.scaled_matrices({})
        for text in (INPUTS.text(f"{name}.toml"), INPUTS.text(f"{name}.toml", (whole, "")) + parts)
    )
    for kind in ("mass", "stiffness", "capacity", "conductance"):
        np.testing.assert_array_equal(one[kind], other[kind])


# ---------------------------------------------------------------- a joint that the modes leave out


LIGHT = 1e-5
"""Mass of the joint's own node [kg], as good as none: the mode that it makes is left out."""
BETA = 1e-3
HOLD = 6000.0
"""Spring of the joint [N/m]: a seventh of the compliance of the tip."""
TIP = np.array([0.0, 0.0, 0.0, 1.0])
ROWS = np.vstack((TIP, [1.0, 0.0, 0.0, 0.0]))
"""Of the tip and of the joint."""
RELEASE = Release(displacement=0.02, deviation=0.01, at_rest=True, mode_count=1, time_zero_deviation=0.0)
TIME, EARLY = np.linspace(0.0, 2.796, 700), np.linspace(0.0, 0.01, 101)
A = 0.02 * 0.135
"""About the motion of the joint [m]."""


def on_joint(modes: int, beta: float) -> LinearSystem:
    """Three masses of 1 kg in a row on a joint whose node weighs next to nothing."""
    springs = np.array([HOLD, 2000.0, 4000.0, 5000.0])
    stretch = np.eye(4) - np.eye(4, k=-1)
    stiffness = stretch.T @ np.diag(springs) @ stretch
    mass = np.diag([LIGHT, 1.0, 1.0, 1.0])
    ports = {"joint": np.array([1.0, 0.0, 0.0, 0.0]), "tip": TIP}
    return LinearSystem(mass, 0.3 * mass + beta * stiffness, stiffness, ports, modes, beta)


def let_go(beta: float, *items: Primitive, time: Any = TIME, row: Any = TIP, **how: int) -> Motion:
    system = on_joint(how.pop("modes", 3), beta)
    acts = port_laws(ModelPatch(items), list(system.ports))
    excitation = Excitation(time, time, initial=np.zeros((0, 2)), release=ReleasePoint(row, row, RELEASE))
    return simulate_motion(system, excitation, acts, **how)


def values(motion: Motion, rows: FloatArray = TIP[None]) -> FloatArray:
    return motion.response([OutputEquation.from_row(row) for row in rows]).values


LAWS = laws("joint", HOLD, A, 15.0 * A)


def joint_speed(push: float, damper: float, x: float, items: tuple[Primitive, ...]) -> float:
    """Speed v of a joint without mass: damper v + sum F(x, v) = push."""
    drags = [
        (d.coefficient * abs(x / d.reference_displacement) ** d.displacement_exponent, d)
        for d in items
        if isinstance(d, PowerDamping)
    ]
    rest = max(abs(push) - sum(size for size, d in drags if d.velocity_exponent == 0.0), 0.0)
    moving = [(size, d) for size, d in drags if d.velocity_exponent > 0.0]

    def left(v: float) -> float:
        drag = sum(size * (v / d.reference_velocity) ** d.velocity_exponent for size, d in moving)
        return float(damper * v - rest + drag)

    size = brentq(left, 0.0, rest / damper, xtol=1e-15) if moving and rest > 0.0 else rest / damper
    return float(np.sign(push) * size)


def integrated(laws: tuple[Primitive, ...], time: FloatArray, node: int) -> FloatArray:
    """Displacements (N, 2) of tip and joint, which has no mass, released at a node, by an integrator.

    The joint is node 0. Its displacement is a state of its own: its speed follows from the balance of forces.
    """
    system = on_joint(3, BETA)
    stiffness = system.stiffness
    damping = BETA * stiffness + 0.3 * system.mass
    flexibility = np.linalg.inv(stiffness)
    laws_at_joint = [law for law in laws if law.port == "joint"]
    laws_at_tip = [law for law in laws if law.port == "tip"]

    def force_at_joint(displacement: float) -> float:
        """Return the force of springs; damping is in the speed of the joint."""
        return sum(force_of(law, displacement, 0.0, np.zeros(0)) for law in laws_at_joint)

    def held_shape(joint: float) -> FloatArray:
        """Return the displacements that hold the node at 0.02 m."""
        force = force_at_joint(joint)
        pull = (0.02 + flexibility[node, 0] * force) / flexibility[node, node]
        return flexibility[:, node] * pull - flexibility[:, 0] * force

    def rate(t: float, state: FloatArray) -> FloatArray:
        masses, speeds, joint = state[:3], state[3:6], state[6]
        displacements = np.concatenate(([joint], masses))
        force_on_joint = -stiffness[0] @ displacements - damping[0, 1:] @ speeds - force_at_joint(joint)
        speed_of_joint = joint_speed(force_on_joint, damping[0, 0] - 0.3 * LIGHT, joint, laws)
        all_speeds = np.concatenate(([speed_of_joint], speeds))
        accelerations = -(stiffness @ displacements)[1:] - damping[1:] @ all_speeds
        accelerations[2] -= sum(force_of(law, masses[2], speeds[2], np.zeros(0)) for law in laws_at_tip)
        return np.concatenate((speeds, accelerations, [speed_of_joint]))

    highest = 3.0 * A if node else 0.03
    joint = brentq(lambda displacement: held_shape(displacement)[0] - displacement, 0.0, highest, xtol=1e-14)
    initial = np.concatenate((held_shape(joint)[1:], np.zeros(3), [joint]))
    solution = solve_ivp(rate, (0.0, time[-1]), initial, t_eval=time, rtol=1e-6, atol=1e-9, max_step=2e-3)
    return np.asarray(solution.y[[2, 6]].T)


NODE_OF_JOINT, NODE_OF_TIP = 0, 3


@pytest.mark.parametrize(
    ("name", "time", "node"),
    [
        *((name, TIME[:250], NODE_OF_TIP) for name in LAWS),
        ("cubic", EARLY, NODE_OF_TIP),
        ("play", EARLY, NODE_OF_TIP),
        ("crack", EARLY, NODE_OF_JOINT),
        ("viscous", EARLY, NODE_OF_JOINT),
    ],
)
def test_a_ring_down_is_that_of_the_whole_structure(name: str, time: FloatArray, node: int) -> None:
    """Released at the tip, or at the joint itself; what remembers is beside four modes, which are all."""
    laws = LAWS[name]

    def released(laws: tuple[Primitive, ...], **options: int) -> FloatArray:
        return values(let_go(BETA, *laws, time=time, row=np.eye(4)[node], **options), ROWS)

    if any(states_of(law) for law in laws):
        whole = released(laws, modes=4, refinement=16)
    else:
        whole = integrated(laws, time, node)

    def largest_error(response: FloatArray) -> FloatArray:
        """Return the largest error of tip and joint."""
        return np.abs(response - whole).max(axis=0)

    effect_of_laws = largest_error(released((), refinement=1))
    error = largest_error(released(laws, refinement=1))
    error_of_fine_steps = largest_error(released(laws, refinement=8))
    smallest = 1e-3 * np.array([0.02, A])
    assert np.all(error_of_fine_steps < 0.01 * effect_of_laws + smallest)
    assert error_of_fine_steps[0] < 1e-3 * 0.02
    assert np.all(error < np.array([0.03, 0.08]) * effect_of_laws + smallest)


WITHOUT_INPUT = """format = 1
name = "rings down by itself"
mass = 1.0
stiffness = 400.0
damping = { matrix = 1.0 }
[[output]]
name = "x"
vector = 1.0
[[parameter]]
name = "loss"
terms = "damping"
mean = 1.0
deviation = 0.5
low = 0.0
high = 4.0
"""


def test_a_rig_without_an_input_and_a_damping_down_to_zero_is_a_model():
    model = model_of(WITHOUT_INPUT)
    assert TrialKind.DRIVEN in model.kinds
    assert model.parameters[0].low == 0.0


def test_a_low_of_zero_that_would_leave_no_stiffness_is_refused():
    with pytest.raises(ModelError, match="low = 0, which would leave no stiffness at some unknown"):
        model_of(WITHOUT_INPUT.replace('terms = "damping"', 'terms = "stiffness"'))


def test_a_mass_parameter_of_the_shipped_rig_leaves_its_force_as_it_is():
    parameter = """
[[parameter]]
name = "mass_factor"
terms = "mass"
deviation = 0.02
low = 0.5
high = 2.0
"""
    rig = model_of((SHIPPED_MODELS / "single_mass_rig.toml").read_text(encoding="utf-8") + parameter)

    displacement = seen(
        rig,
        asked(TrialKind.STATIC, 1, force=np.array([19.74])),
        {"displacement": Quantity.DISPLACEMENT},
        parameters=np.array([1.0, 1.0, 1.5]),
    )

    assert displacement[0, 0] == pytest.approx(0.01, rel=1e-12)
