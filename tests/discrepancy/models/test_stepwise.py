"""Motion at uneven time stamps against matrix exponentials, a general integrator, and the even stepper."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from discrepancy.campaign.records import Quantity, Release, Trial, TrialKind
from discrepancy.models.acting import Acting, Course
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.high_pass import filtered_record
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.second_order import SecondOrderSystem
from discrepancy.models.system_model import State
from fe.runtime.motion import NO_LAWS, laws_of
from fe.runtime.patch import HighPass, ModelPatch, PowerDamping, PowerStiffness, Primitive
from fe.runtime.sensors import SensorRecord, apply_sensors
from tests.fe.runtime.stepping import simulate

pytestmark = pytest.mark.xdist_group("compiling")

FloatArray = NDArray[np.float64]

OUTPUTS = (("x1", Quantity.DISPLACEMENT), ("x3", Quantity.VELOCITY), ("x3", Quantity.ACCELERATION))
COULOMB = PowerDamping("joint", 0.4, 0.0, 0.0, 1.0, 1.0)
QUADRATIC = PowerDamping("joint", 2.0, 2.0, 0.0, 0.2, 1.0)
CUBIC = PowerStiffness("joint", 4.0, 3.0, 0, 0.01)


@pytest.fixture(scope="module")
def chain() -> LumpedModel:
    return LumpedModel.load("three_mass_chain")


def jittered(count: int, interval: float, share: float, seed: int = 1) -> FloatArray:
    generator = np.random.default_rng(seed)
    time = interval * (np.arange(count) + share * generator.uniform(-0.5, 0.5, count))
    return np.asarray(np.delete(time - time[0], slice(count // 3, count // 3 + 7)))  # and a gap


def trial(kind: TrialKind, time: FloatArray, **changes: Any) -> Trial:
    return Trial.plain("a trial", kind, (), time, **{"load_place": "end", **changes})


def shown(model: LumpedModel, what: Trial, *items: Primitive, refinement: int = 1) -> FloatArray:
    return model.respond(
        what, OUTPUTS, ModelPatch(items), Conditions(np.ones(3), refinement=refinement)
    ).values


@pytest.mark.parametrize("laws", [(), (COULOMB,), (QUADRATIC, CUBIC)])
def test_even_stamps_are_those_of_the_even_stepper(laws: tuple[Primitive, ...]) -> None:
    ports = {"joint": np.array([0.7, -1.1])}
    system = SecondOrderSystem(np.eye(2), np.diag([0.1, 0.4]), np.diag([81.0, 961.0]), ports)
    internal = laws_of(ModelPatch(laws), system.ports) if laws else NO_LAWS
    time, shape = 0.01 * np.arange(300), np.array([0.4, 0.9])
    force = np.random.default_rng(0).normal(size=300)
    force[0] = 0.0
    even = simulate(
        system.modal, internal, q=np.zeros(2), v=np.zeros(2), force=force, interval=0.01,
        shape=shape @ system.shapes, kernel=compiled_kernel(),
    )  # fmt: skip
    found = system.motion(Acting(time, np.zeros(len(shape)), [(shape, Course.of(time, force))]), internal)
    pairs = ((found.q, even.q), (found.velocity, even.v), (found.port_forces, even.port_forces))
    for one, other in pairs:
        np.testing.assert_allclose(
            one, other, rtol=1e-9, atol=1e-9 * max(1e-9, float(np.abs(other).max(initial=0.0)))
        )


def test_a_forced_motion_at_uneven_stamps_is_exact(chain: LumpedModel) -> None:
    time = jittered(200, 0.02, 0.9)
    force = np.random.default_rng(2).normal(size=len(time))
    force[0] = 0.0
    system = chain.rig(State(np.ones(3))).system()
    matrix = np.zeros((8, 8))
    matrix[:3, 3:6] = np.eye(3)
    matrix[3:6, :3] = -np.linalg.solve(system.mass, system.stiffness)
    matrix[3:6, 3:6] = -np.linalg.solve(system.mass, system.damping)
    matrix[3:6, 6] = np.linalg.solve(system.mass, [0, 0, 1.0])
    matrix[6, 7] = 1.0
    state, states = np.zeros(6), [np.zeros(6)]
    for k, h in enumerate(np.diff(time)):
        state = (expm(h * matrix) @ np.concatenate((state, [force[k], (force[k + 1] - force[k]) / h])))[:6]
        states.append(state)
    found = np.array(states)
    acceleration = found @ matrix[5, :6] + force * matrix[5, 6]
    expected = np.stack([found[:, 0], found[:, 5], acceleration], axis=1)
    measured = shown(chain, trial(TrialKind.FORCED, time, force=force))
    np.testing.assert_allclose(measured, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [TrialKind.RINGDOWN, TrialKind.FORCED])
@pytest.mark.parametrize("laws", [(), (QUADRATIC, CUBIC), (COULOMB,)])
def test_leaving_samples_out_changes_nothing_at_the_others(
    chain: LumpedModel, kind: TrialKind, laws: tuple[Primitive, ...]
) -> None:
    time = 0.005 * np.arange(400)
    kept = np.flatnonzero(np.random.default_rng(5).uniform(size=400) < 0.6)
    kept = np.unique(np.r_[0, kept, 399])
    bare = 0.5 * np.interp(time, time[kept], np.sin(20.0 * time[kept]))
    given = {"release": Release(0.02)} if kind is TrialKind.RINGDOWN else {"force": bare}
    dense = shown(chain, trial(kind, time, **given), *laws, refinement=8)
    if kind is TrialKind.FORCED:
        given = {"force": bare[kept]}
    found = shown(chain, trial(kind, time[kept], **given), *laws, refinement=8)
    np.testing.assert_allclose(found, dense[kept], atol=2e-4 * np.abs(dense).max())


def test_a_high_pass_follows_uneven_stamps() -> None:
    time = jittered(400, 0.01, 0.6)
    wave = 2.0 * np.pi * 1.3
    record = SensorRecord((("x", "velocity"),), "forced", time, 0.0, np.zeros(len(time)))
    patch = ModelPatch((HighPass("x", 0.3),))
    found, _ = apply_sensors(
        patch,
        record,
        np.sin(wave * time)[:, None],
        wave * np.cos(wave * time)[:, None],
        filtered=filtered_record,
    )
    # y' = x' - y / tau from rest: steady part and what the begin leaves
    gain = 1j * wave * 0.3 / (1.0 + 1j * wave * 0.3)
    steady = np.imag(gain * np.exp(1j * wave * time))
    expected = steady - steady[0] * np.exp(-time / 0.3)
    # the gap of eight intervals is bridged by a straight line
    np.testing.assert_allclose(found[:, 0], expected, atol=8e-3)
