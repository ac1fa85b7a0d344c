"""Laws at a joint whose flexibility the modes leave out, against a general integrator of all of it."""

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from discrepancy.campaign.records import Release
from discrepancy.models.acting import Acting, Course, Load, Shown
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.motion import Motion, motion_of
from fe.compilation import compiled_kernel
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import laws_of
from fe.runtime.patch import BoucWen, FreePlay, MicroSlip, ModelPatch, PowerDamping, PowerStiffness, Primitive
from tests.fe.runtime.stepping import simulate

FloatArray = NDArray[np.float64]

LIGHT = 1e-9
"""Mass of the joint's own node [kg], as good as none: the mode that it makes is left out."""
BETA = 1e-3
ROOT = 6000.0
"""Spring of the joint [N/m]: a seventh of the compliance of the tip."""
TIP = np.array([0.0, 0.0, 0.0, 1.0])
ROWS = np.vstack((TIP, [1.0, 0.0, 0.0, 0.0]))
"""Of the tip and of the joint."""
RELEASE = Release(displacement=0.02, deviation=0.0, at_rest=True, mode_count=1, time_zero_deviation=0.0)
TIME = np.linspace(0.0, 2.796, 700)
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


def ringdown(beta: float, *items: Primitive, refinement: int = 1) -> Motion:
    system = chain(3, beta)
    laws = laws_of(ModelPatch(items), list(system.ports))
    acting = Acting(TIME, TIME, initial=np.zeros((0, 2)), release=(TIP, RELEASE))
    return motion_of(system, acting, laws, refinement)


def values(motion: Motion, rows: FloatArray = TIP[None]) -> FloatArray:
    return motion.seen([Shown.of(row) for row in rows]).values


LAWS = {
    "coulomb": (PowerDamping("joint", 0.2 * ROOT * A, 0.0, 0.0, 1.0, 1.0),),
    "strong coulomb": (PowerDamping("joint", 0.8 * ROOT * A, 0.0, 0.0, 1.0, 1.0),),
    "structural": (PowerDamping("joint", 0.3 * ROOT * A, 0.0, 1.0, 1.0, A),),
    "slow damping": (PowerDamping("joint", 0.3 * ROOT * A, 0.4, 0.3, 15.0 * A, A),),
    "viscous": (PowerDamping("joint", 0.3 * ROOT * A, 1.0, 0.0, 15.0 * A, A),),
    "quadratic": (PowerDamping("joint", 0.3 * ROOT * A, 2.0, 0.0, 15.0 * A, A),),
    "crack": (PowerStiffness("joint", -0.5 * ROOT * A, 1.0, 1, A),),
    "cubic": (PowerStiffness("joint", 0.5 * ROOT * A, 3.0, 0, A),),
    "softening": (PowerStiffness("joint", -0.2 * ROOT * A, 2.0, 0, A),),
    "steep": (PowerStiffness("joint", 0.3 * ROOT * A, 0.6, -1, A),),
    "play": (FreePlay("joint", 0.7 * ROOT, 0.2 * A),),
    "micro-slip": (MicroSlip("joint", 0.3 * ROOT * A, 0.7 * ROOT, -0.5),),
    "bouc-wen": (BoucWen("joint", 0.7 * ROOT, 0.5 * A, 1.0),),
    "sharp bouc-wen": (BoucWen("joint", 0.7 * ROOT, 0.5 * A, 4.0),),
    "two": (
        PowerDamping("joint", 0.15 * ROOT * A, 0.0, 0.0, 1.0, 1.0),
        MicroSlip("joint", 0.3 * ROOT * A, 0.7 * ROOT, -0.5),
    ),
    "three": (
        PowerDamping("joint", 0.2 * ROOT * A, 0.5, 0.0, 15.0 * A, A),
        FreePlay("joint", 0.4 * ROOT, 0.2 * A),
        PowerStiffness("joint", 0.3 * ROOT * A, 3.0, 0, A),
    ),
    "elsewhere": (
        PowerDamping("joint", 0.2 * ROOT * A, 0.0, 0.0, 1.0, 1.0),
        PowerStiffness("tip", 2.0, 3.0, 0, 0.02),
    ),
}


def test_the_modes_leave_out_nearly_all_of_the_joint() -> None:
    system = chain(3, 0.0)
    row = system.ports["joint"]
    assert float(row @ system.residual(row)) > 0.7 * float(row @ system.flexibility(row))


slips = cache(MicroSlip.elements)


def states(item: Primitive) -> int:
    """How many states a law of the joint has."""
    return item.element_count if isinstance(item, MicroSlip) else int(isinstance(item, BoucWen))


def force_of(item: Primitive, x: float, z: FloatArray) -> float:
    """Force of a law of the joint without damping, at a position and the law's states."""
    if isinstance(item, PowerStiffness) and item.port == "joint":
        size = item.coefficient * abs(x / item.reference_displacement) ** item.exponent
        return float(size * np.sign(x) * (item.side * x >= 0.0))
    if isinstance(item, FreePlay):
        return float(-item.stiffness * np.clip(x, -item.half_width, item.half_width))
    return float(item.stiffness * (z.mean() - x)) if isinstance(item, BoucWen | MicroSlip) else 0.0


def rates_of(item: Primitive, z: FloatArray, v: float) -> FloatArray:
    """Rates of the states of a law at a speed."""
    if isinstance(item, BoucWen):
        return np.where(z * v > 0.0, v * (1.0 - np.abs(z / item.yield_displacement) ** item.order), v)
    if isinstance(item, MicroSlip):
        return np.where((np.abs(z) >= slips(item)) & (z * v > 0.0), 0.0, v)
    return np.zeros(0)


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


def integrated(items: tuple[Primitive, ...], time: FloatArray) -> FloatArray:
    """Displacements (N, 2) of tip and joint after the release, by a general integrator; no mass there."""
    system, cuts = chain(3, BETA), np.cumsum([states(item) for item in items])
    stiffness, damping = system.stiffness, BETA * system.stiffness + 0.3 * system.mass
    inverse = np.linalg.inv(stiffness)
    at_tip = [item for item in items if item.port == "tip"]

    def force(x: float, z: FloatArray) -> float:
        return sum(force_of(item, x, own) for item, own in zip(items, np.split(z, cuts), strict=False))

    def rates(z: FloatArray, v: float) -> FloatArray:
        parts = zip(items, np.split(z, cuts), strict=False)
        return np.concatenate([rates_of(item, own, v) for item, own in parts])

    def held(x: float) -> tuple[FloatArray, FloatArray]:
        """Displacements with the joint at x, and its elements, led there in one go."""
        z = np.zeros(cuts[-1])
        if len(z) and x != 0.0:
            limits = {"rtol": 1e-9, "atol": 1e-14, "max_step": 0.01}
            z = solve_ivp(lambda s, z: rates(z, x), (0.0, 1.0), z, **limits).y[:, -1]
        inner = force(x, z)
        pull = (0.02 + inverse[3, 0] * inner) / inverse[3, 3]
        return inverse[:, 3] * pull - inverse[:, 0] * inner, z

    def derivative(t: float, y: FloatArray) -> FloatArray:
        u, v, x, z = y[:3], y[3:6], y[6], y[7:]
        place = np.concatenate(([x], u))
        push = -stiffness[0] @ place - damping[0, 1:] @ v - force(x, z)
        speed = joint_speed(push, damping[0, 0] - 0.3 * LIGHT, x, items)
        a = -(stiffness @ place)[1:] - damping[1:] @ np.concatenate(([speed], v))
        for item in at_tip:  # a cubic spring
            a[2] -= item.coefficient * (u[2] / item.reference_displacement) ** 3
        return np.concatenate((v, a, [speed], rates(z, speed)))

    x = brentq(lambda x: held(x)[0][0] - x, 0.0, 3.0 * A, xtol=1e-14)
    u, z = held(x)
    begin = np.concatenate((u[1:], np.zeros(3), [x], z))
    found = solve_ivp(derivative, (0.0, time[-1]), begin, t_eval=time, rtol=1e-6, atol=1e-9, max_step=2e-3)
    return np.asarray(found.y[[2, 6]].T)


@pytest.mark.parametrize("name", LAWS)
def test_a_ring_down_is_that_of_the_whole_structure(name: str) -> None:
    count = 250
    true = integrated(LAWS[name], TIME[:count])
    effect, usual, fine = (
        np.abs(values(motion, ROWS)[:count] - true).max(axis=0)
        for motion in (ringdown(BETA), ringdown(BETA, *LAWS[name]), ringdown(BETA, *LAWS[name], refinement=8))
    )
    assert np.all(fine < 0.01 * effect + 1e-3 * np.array([0.02, A]))
    assert fine[0] < 1e-3 * 0.02
    assert np.all(usual < np.array([0.03, 0.08]) * effect + 1e-3 * np.array([0.02, A]))


@pytest.mark.parametrize("name", ["crack", "micro-slip", "bouc-wen", "cubic"])
def test_without_lag_the_order_is_two(name: str) -> None:
    one, two, fine = (values(ringdown(0.0, *LAWS[name], refinement=n)) for n in (1, 2, 16))
    assert np.mean((one - fine) ** 2) > 9.0 * np.mean((two - fine) ** 2)


BEGIN = {"q": np.array([0.02, 0.001, 0.0]), "v": np.zeros(3), "interval": 0.004}


def joint(stiffness: float, flexibility: float, beta: float = 0.0) -> ModalSystem:
    """One mass of 1 kg on a spring; its port has a flexibility behind it."""
    w = np.array([np.sqrt(stiffness)])
    return ModalSystem(w, np.zeros((1, 1)), {"mass": np.ones(1)}, np.array([flexibility]), beta)


def move(system: ModalSystem, *items: Primitive, q: float = 1.0, v: float = 0.0, **options: Any) -> Any:
    laws = laws_of(ModelPatch(items), ["mass"])
    return simulate(
        system, laws, q=np.array([q]), v=np.array([v]), force=np.zeros(801), interval=0.005,
        kernel=compiled_kernel(), **options,  # type: ignore[arg-type]
    )  # fmt: skip


def test_friction_that_holds_is_a_spring_of_the_flexibility() -> None:
    # it sticks at the release, where the spring 1/R is without force: about that place, k + 1/R
    k, r = 40.0, 1.0 / 60.0
    moved = move(joint(k, r), PowerDamping("mass", 1e4, 0.0, 0.0, 1.0, 1.0), substeps=20)
    time = 0.005 * np.arange(801)
    rest = 60.0 / 100.0
    assert moved.q[:, 0] == pytest.approx(rest + (1.0 - rest) * np.cos(10.0 * time), abs=2e-4)
    assert moved.port_forces[:, 0] == pytest.approx((moved.q[:, 0] - 1.0) / r, abs=1e-9)


def test_friction_that_slips_loses_the_area_of_its_loop() -> None:
    # Jenkins: in a cycle from -X to X the loop takes 4 F (X - R F); the mass loses that energy
    k, r, level = 40.0, 1.0 / 60.0, 1.5
    moved = move(joint(k, r), PowerDamping("mass", level, 0.0, 0.0, 1.0, 1.0), substeps=20)
    x, energy = moved.q[:, 0], 0.5 * (k * moved.q[:, 0] ** 2 + moved.v[:, 0] ** 2)
    energy = energy + 0.5 * r * moved.port_forces[:, 0] ** 2
    turns = np.flatnonzero(np.diff(np.sign(moved.v[1:, 0]))) + 1
    for begin, end in itertools.pairwise(turns):
        loss = level * (abs(x[begin] - x[end]) - 2.0 * r * level)
        assert energy[begin] - energy[end] == pytest.approx(loss, rel=0.02)
    assert np.abs(moved.port_forces).max() <= level * (1.0 + 1e-12)


def test_the_shape_family_is_continuous_at_dry_friction() -> None:
    system = joint(40.0, 1.0 / 60.0, 1e-3)
    laws = (PowerDamping("mass", 1.5, p, p, 6.0, 1.0) for p in (0.0, 1e-5))
    dry, nearly = (move(system, law) for law in laws)
    assert np.abs(dry.q - nearly.q).max() < 1e-3
    sides = [move(system, PowerDamping("mass", 1.5, p, 0.0, 6.0, 1.0)).q for p in (0.49, 0.5, 0.51)]
    assert np.abs(sides[2] - 2.0 * sides[1] + sides[0]).max() < 1e-3


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0])
def test_less_and_less_flexibility_tends_to_none(exponent: float) -> None:
    item = PowerDamping("mass", 1.5, exponent, 0.0, 6.0, 1.0)
    # with large steps a port with little flexibility is one without (`port_flexibility`)
    rigid = move(joint(40.0, 0.0), item, substeps=40).q
    errors = [np.abs(move(joint(40.0, r), item, substeps=40).q - rigid).max() for r in (1.2e-2, 6e-3, 3e-3)]
    assert errors[2] < 0.6 * errors[0]
    assert np.array_equal(move(joint(40.0, 2e-3), item, substeps=40).q, rigid)


@pytest.mark.parametrize(
    "name", ["coulomb", "structural", "quadratic", "cubic", "play", "micro-slip", "bouc-wen"]
)
def test_no_flexibility_changes_no_bit(name: str) -> None:
    modal = chain(3, 0.0).modal
    laws = laws_of(ModelPatch(LAWS[name]), list(modal.ports))
    given: dict[str, Any] = BEGIN | {"force": np.zeros(300)}
    none, zero = (
        simulate(replace(modal, flexibility=f, relaxation=b), laws, kernel=compiled_kernel(), **given)
        for f, b in ((None, 0.0), (np.zeros(2), 1e-3))
    )
    assert np.array_equal(none.q, zero.q)
    assert np.array_equal(none.port_forces, zero.port_forces)
    assert np.array_equal(none.lagged, none.port_forces)


@pytest.mark.parametrize("name", ["cubic", "crack", "play", "micro-slip", "bouc-wen"])
def test_a_slow_force_leads_through_the_static_states(name: str) -> None:
    system = chain(3, 1e-3)
    system = replace(system, damping=system.damping + 4.0 * system.mass)
    laws = laws_of(ModelPatch(LAWS[name]), list(system.ports))
    time = np.linspace(0.0, 90.0, 3001)
    force = np.asarray(15.0 * np.sin(2.0 * np.pi * time / 90.0))
    acting = Acting(time, time, [Load(TIP, Course(time, force))])
    moved = values(motion_of(system, acting, laws), ROWS)
    still = system.static(np.outer(force, TIP), laws)[0] @ ROWS.T
    assert np.abs(moved - still).max(axis=0) == pytest.approx(np.zeros(2), abs=7e-3 * np.abs(still).max())


@pytest.mark.parametrize("name", LAWS)
def test_a_release_goes_on_from_its_static_state(name: str) -> None:
    assert np.abs(values(ringdown(BETA, *LAWS[name]))).max() <= 0.02 * 1.001  # no law adds energy
    motion = ringdown(1e-3, *LAWS[name])
    first = values(motion, ROWS)[0]
    assert first[0] == pytest.approx(0.02, rel=1e-9)
    system = motion.system
    at_rest = system.static(np.stack((0.0 * TIP, motion.holding)), motion.laws)[0][-1]
    assert first[1] == pytest.approx(at_rest[0], rel=1e-4)


@pytest.mark.parametrize("name", LAWS)
def test_plain_python_gives_the_same(name: str) -> None:
    modal = chain(3, 1e-3).modal
    laws = laws_of(ModelPatch(LAWS[name]), list(modal.ports))
    given: dict[str, Any] = BEGIN | {"v": np.array([0.1, 0.0, 0.2]), "force": np.zeros(30)}
    plain, compiled = (simulate(modal, laws, kernel=kernel, **given) for kernel in (None, compiled_kernel()))
    assert plain.q == pytest.approx(compiled.q, abs=1e-12)
    assert plain.memory == pytest.approx(compiled.memory, abs=1e-9)
