"""Laws at a joint whose flexibility the modes leave out, against a general integrator of all of it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from discrepancy.campaign.protocol import Release
from discrepancy.models.acting import Acting, Shown
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.motion import Motion, motion_of
from fe.runtime.motion import laws_of
from fe.runtime.patch import ModelPatch, PowerDamping, Primitive
from tests.discrepancy.rigs import laws
from tests.fe.runtime.stepping import force_of, rates_of, states_of

FloatArray = NDArray[np.float64]

LIGHT = 1e-9
"""Mass of the joint's own node [kg], as good as none: the mode that it makes is left out."""
BETA = 1e-3
ROOT = 6000.0
"""Spring of the joint [N/m]: a seventh of the compliance of the tip."""
TIP = np.array([0.0, 0.0, 0.0, 1.0])
ROWS = np.vstack((TIP, [1.0, 0.0, 0.0, 0.0]))
"""Of the tip and of the joint."""
RELEASE = Release(displacement=0.02, deviation=0.01, at_rest=True, mode_count=1, time_zero_deviation=0.0)
TIME, EARLY = np.linspace(0.0, 2.796, 700), np.linspace(0.0, 0.01, 101)
A = 0.02 * 0.135
"""About the motion of the joint [m]."""


def chain(modes: int, beta: float) -> LinearSystem:
    """Three masses of 1 kg in a row on a joint whose node weighs next to nothing."""
    springs = np.array([ROOT, 2000.0, 4000.0, 5000.0])
    stretch = np.eye(4) - np.eye(4, k=-1)
    stiffness = stretch.T @ np.diag(springs) @ stretch
    mass = np.diag([LIGHT, 1.0, 1.0, 1.0])
    ports = {"joint": np.array([1.0, 0.0, 0.0, 0.0]), "tip": TIP}
    return LinearSystem(mass, 0.3 * mass + beta * stiffness, stiffness, ports, modes, beta)


def ringdown(beta: float, *items: Primitive, time: Any = TIME, row: Any = TIP, **how: int) -> Motion:
    system = chain(how.pop("modes", 3), beta)
    acts = laws_of(ModelPatch(items), list(system.ports))
    acting = Acting(time, time, initial=np.zeros((0, 2)), release=(row, RELEASE))
    return motion_of(system, acting, acts, **how)


def values(motion: Motion, rows: FloatArray = TIP[None]) -> FloatArray:
    return motion.seen([Shown.of(row) for row in rows]).values


LAWS = laws("joint", ROOT, A, 15.0 * A)


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


def integrated(items: tuple[Primitive, ...], time: FloatArray, at: int) -> FloatArray:
    """Displacements (N, 2) of tip and joint, that has no mass, released `at` a node, by an integrator."""
    system, cuts = chain(3, BETA), np.cumsum([states_of(item) for item in items])
    stiffness, damping = system.stiffness, BETA * system.stiffness + 0.3 * system.mass
    inverse = np.linalg.inv(stiffness)
    at_tip = [item for item in items if item.port == "tip"]

    def parts(z: FloatArray) -> Iterator[tuple[Primitive, FloatArray]]:
        """Laws of the joint, and the states of each; damping is in its speed."""
        return (
            (item, own) for item, own in zip(items, np.split(z, cuts), strict=False) if item.port != "tip"
        )

    def force(x: float, z: FloatArray) -> float:
        return sum(force_of(item, x, 0.0, own) for item, own in parts(z))

    def rates(z: FloatArray, v: float) -> FloatArray:
        return np.concatenate([rates_of(item, v, own) for item, own in parts(z)])

    def held(x: float) -> tuple[FloatArray, FloatArray]:
        """Displacements with the joint at x, and its elements, led there in one go."""
        z = np.zeros(cuts[-1])
        if len(z) and x != 0.0:
            limits = {"rtol": 1e-9, "atol": 1e-14, "max_step": 0.01}
            z = solve_ivp(lambda s, z: rates(z, x), (0.0, 1.0), z, **limits).y[:, -1]
        inner = force(x, z)
        pull = (0.02 + inverse[at, 0] * inner) / inverse[at, at]
        return inverse[:, at] * pull - inverse[:, 0] * inner, z

    def derivative(t: float, y: FloatArray) -> FloatArray:
        u, v, x, z = y[:3], y[3:6], y[6], y[7:]
        place = np.concatenate(([x], u))
        push = -stiffness[0] @ place - damping[0, 1:] @ v - force(x, z)
        speed = joint_speed(push, damping[0, 0] - 0.3 * LIGHT, x, items)
        a = -(stiffness @ place)[1:] - damping[1:] @ np.concatenate(([speed], v))
        for item in at_tip:
            a[2] -= force_of(item, u[2], v[2], z)
        return np.concatenate((v, a, [speed], rates(z, speed)))

    x = brentq(lambda x: held(x)[0][0] - x, 0.0, 3.0 * A if at else 0.03, xtol=1e-14)
    u, z = held(x)
    begin = np.concatenate((u[1:], np.zeros(3), [x], z))
    found = solve_ivp(derivative, (0.0, time[-1]), begin, t_eval=time, rtol=1e-6, atol=1e-9, max_step=2e-3)
    return np.asarray(found.y[[2, 6]].T)


@pytest.mark.parametrize(
    ("name", "time", "at"),
    [
        *((n, TIME[:250], 3) for n in LAWS),
        ("cubic", EARLY, 3),
        ("play", EARLY, 3),
        ("crack", EARLY, 0),
        ("viscous", EARLY, 0),
    ],
)
def test_a_ring_down_is_that_of_the_whole_structure(name: str, time: FloatArray, at: int) -> None:
    """Released at the tip, or at the joint itself."""
    true = integrated(LAWS[name], time, at)
    effect, usual, fine = (
        np.abs(values(ringdown(BETA, *items, time=time, row=np.eye(4)[at], refinement=n), ROWS) - true).max(
            axis=0
        )
        for items, n in (((), 1), (LAWS[name], 1), (LAWS[name], 8))
    )
    assert np.all(fine < 0.01 * effect + 1e-3 * np.array([0.02, A]))
    assert fine[0] < 1e-3 * 0.02
    assert np.all(usual < np.array([0.03, 0.08]) * effect + 1e-3 * np.array([0.02, A]))
