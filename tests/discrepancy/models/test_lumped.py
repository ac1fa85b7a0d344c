"""Lumped models against matrices inverted by hand and general integrators of their equations of motion."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from discrepancy.campaign.records import Campaign, Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import Acting, Course, Shown
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.lumped_file import SHIPPED_MODELS, parse_lumped
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.laws.micro_slip import slip_displacements
from fe.runtime.motion import NO_LAWS
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    LoadGain,
    LoadPlace,
    LocalStiffnessLoss,
    MicroSlip,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    RootCompliance,
    SensorGain,
    StiffnessDrift,
    Washout,
)

FloatArray = NDArray[np.float64]

MASS = np.diag([1.5, 1.2, 0.8])
STIFFNESS = np.array([[5200.0, -2600.0, 0.0], [-2600.0, 4800.0, -2200.0], [0.0, -2200.0, 2200.0]])
JOINT = np.array([0.0, -1.0, 1.0])
DISPLACEMENTS = tuple((f"x{k}", Quantity.DISPLACEMENT) for k in (1, 2, 3))
ONES = Conditions(np.ones(3))


@pytest.fixture(scope="module")
def chain() -> LumpedModel:
    return LumpedModel.load("three_mass_chain")


def damping() -> FloatArray:
    square, shapes = eigh(STIFFNESS, MASS)
    weighted = MASS @ shapes
    return np.asarray((weighted * (2.0 * np.array([0.008, 0.006, 0.006]) * np.sqrt(square))) @ weighted.T)


def trial(kind: TrialKind, count: int = 400, **changes: Any) -> Trial:
    time = changes.pop("time", 0.01 * np.arange(count))
    return Trial.plain("a trial", kind, (), time, **{"load_place": "end", **changes})


def ringdown(count: int = 400, **changes: Any) -> Trial:
    return trial(TrialKind.RINGDOWN, count, **{"release": Release(0.02), **changes})


def static(force: list[float], **changes: Any) -> Trial:
    return trial(TrialKind.STATIC, len(force), force=np.array(force), **changes)


def patch(*items: Primitive) -> ModelPatch:
    return ModelPatch(items)


def shown(model: LumpedModel, what: Trial, *items: Primitive, **options: Any) -> FloatArray:
    conditions, outputs = options.pop("conditions", ONES), options.pop("outputs", DISPLACEMENTS)
    return model.respond(what, outputs, patch(*items), replace(conditions, **options)).values


# ---------------------------------------------------------------- static


SCALED = 1.1 * (STIFFNESS - 0.2 * 2200.0 * np.outer(JOINT, JOINT))
ROOT = np.linalg.inv(STIFFNESS) + 3e-4 * np.outer([0.2, 0.4, 0.6], [0.2, 0.4, 0.6])
END = np.linalg.solve(STIFFNESS, [0, 0, 1])


@pytest.mark.parametrize(
    ("items", "force", "wanted", "parameters"),
    [
        ((), [0.0, 1.0, -3.0], np.outer([0, 1, -3], END), (1.0, 1.0, 1.0)),
        ((), [1.0], [np.linalg.solve(SCALED, [0, 0, 1])], (1.1, 0.8, 2.0)),
        ((RootCompliance(3e-4),), [2.0], [2.0 * ROOT[:, 2]], (1.0, 1.0, 1.0)),  # in series
        ((LoadGain(0.05, 0.5),), [0.0, 4.0], np.outer([0.0, 4.7], END), (1.0, 1.0, 1.0)),
        ((LoadPlace(-0.05, 0.0),), [3.0], [np.linalg.solve(STIFFNESS, [0, 0.75, 2.25])], (1.0, 1.0, 1.0)),
    ],
)  # fmt: skip
def test_static_rows_are_those_of_the_matrices(
    chain: LumpedModel, items: Any, force: list[float], wanted: Any, parameters: tuple[float, ...]
) -> None:
    measured = shown(chain, static(force), *items, conditions=Conditions(np.array(parameters)))
    np.testing.assert_allclose(measured, wanted, rtol=1e-10 if items == (RootCompliance(3e-4),) else 1e-12)


def test_temperature_softens_each_row_by_its_own(chain: LumpedModel) -> None:
    temperature = np.array([0.0, 10.0, 0.0, -20.0])
    what = static([1.0, 1.0, 1.0, 1.0], temperature=temperature)
    measured = shown(chain, what, ModulusTemperature(2e-3))
    plain = shown(chain, what)
    np.testing.assert_allclose(measured, plain / (1 - 2e-3 * temperature)[:, None], rtol=1e-12)
    np.testing.assert_allclose(
        shown(chain, what, ModulusTemperature(2e-3), FreePlay("joint", 500.0, 1e-9)), measured, atol=2e-9
    )


@pytest.mark.parametrize(
    "law",
    [
        PowerStiffness("joint", 3.0, 3.0, 0, 2e-3),
        MicroSlip("joint", 0.8, 1500.0, -0.4),
        BoucWen("joint", 1000.0, 8e-4, 2.0),
        FreePlay("joint", 1000.0, 5e-4),
    ],
)
def test_static_rows_with_a_joint_are_in_equilibrium(chain: LumpedModel, law: Primitive) -> None:
    force = np.array([0.0, 2.0, 5.0, 2.0, -4.0])
    u = shown(chain, static(list(force)), law)
    pull = u @ STIFFNESS - np.outer(force, [0, 0, 1])  # what the joint must give: -row F
    np.testing.assert_allclose(pull[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(pull[:, 1], -pull[:, 2], atol=1e-9)
    internal = -pull[:, 2]
    x = u @ JOINT
    if isinstance(law, PowerStiffness):
        np.testing.assert_allclose(internal, 3.0 * np.sign(x) * np.abs(x / 2e-3) ** 3, atol=1e-8)
    elif isinstance(law, FreePlay):
        np.testing.assert_allclose(internal, -1000.0 * np.clip(x, -5e-4, 5e-4), atol=1e-9)
    else:  # softer on first loading, and not the same on the way back
        assert internal[1] < 0.0
        assert internal[2] < internal[1]
        assert abs(u[3, 2]) > abs(u[1, 2])


# ---------------------------------------------------------------- motion


def integrated(
    start: FloatArray, internal: Any, times: FloatArray, force: Any = None, velocity: FloatArray | None = None
) -> FloatArray:
    """Displacement and velocity (N, 6) of the full equations, by a general integrator."""
    viscous = damping()

    def slope(t: float, y: FloatArray) -> FloatArray:
        u, v = y[:3], y[3:]
        pull = -STIFFNESS @ u - viscous @ v - JOINT * internal(JOINT @ u, JOINT @ v)
        if force is not None:
            pull = pull + np.array([0, 0, force(t)])
        return np.concatenate((v, np.linalg.solve(MASS, pull)))

    first = np.concatenate((start, np.zeros(3) if velocity is None else velocity))
    found = solve_ivp(slope, (0.0, times[-1]), first, t_eval=times, rtol=1e-10, atol=1e-13, max_step=2e-3)
    return np.asarray(found.y.T)


def test_a_linear_ringdown_starts_from_the_static_shape(chain: LumpedModel) -> None:
    what = ringdown()
    response = chain.respond(what, DISPLACEMENTS, patch(), ONES)
    shape = np.linalg.solve(STIFFNESS, [0, 0, 1])
    exact = integrated(0.02 * shape / shape[2], lambda x, v: 0.0, what.time)
    np.testing.assert_allclose(response.values, exact[:, :3], atol=1e-9)
    np.testing.assert_allclose(response.rates, exact[:, 3:], atol=1e-7)


@pytest.mark.parametrize(
    ("law", "force"),
    [
        (PowerStiffness("joint", 0.3, 3.0, 0, 2e-3), lambda x, v: 0.3 * (x / 2e-3) ** 3),
        (PowerDamping("joint", 0.5, 2.0, 0.0, 0.1, 1.0), lambda x, v: 0.5 * abs(v / 0.1) * v / 0.1),
        (PowerStiffness("joint", -0.4, 1.0, -1, 2e-3), lambda x, v: -200.0 * x if x < 0 else 0.0),
    ],
)
def test_a_ringdown_with_a_law_is_its_equation(chain: LumpedModel, law: Primitive, force: Any) -> None:
    what = ringdown()
    outputs = (*DISPLACEMENTS, ("x3", Quantity.VELOCITY), ("x3", Quantity.ACCELERATION))
    response = chain.respond(what, outputs, patch(law), ONES)
    start = response.values[0, :3]
    # released from equilibrium under a force at the end only
    holding = STIFFNESS @ start + JOINT * force(JOINT @ start, 0.0)
    np.testing.assert_allclose(holding[:2], 0.0, atol=1e-8)
    assert start[2] == pytest.approx(0.02)
    exact = integrated(start, force, what.time)
    np.testing.assert_allclose(response.values[:, :3], exact[:, :3], atol=0.02 * 5e-4)
    np.testing.assert_allclose(response.values[:, 3], exact[:, 5], atol=0.5 * 1e-3)
    pull = -exact[:, :3] @ STIFFNESS - exact[:, 3:] @ damping().T
    internal = np.array(
        [force(*pair) for pair in zip(exact[:, :3] @ JOINT, exact[:, 3:] @ JOINT, strict=True)]
    )
    acceleration = (pull - np.outer(internal, JOINT))[:, 2] / 0.8
    np.testing.assert_allclose(response.values[:, 4], acceleration, atol=2e-3 * np.max(np.abs(acceleration)))


def test_a_ringdown_with_a_slipping_joint_begins_loaded_and_is_its_equation(chain: LumpedModel) -> None:
    law = MicroSlip("joint", 0.5, 300.0, -0.3, element_count=4)
    values = shown(chain, ringdown(100), law)
    limits = slip_displacements(law)
    elements = np.clip(JOINT @ values[0], -limits, limits)  # loaded from zero without turning back
    u, v, x = values[0].copy(), np.zeros(3), JOINT @ values[0]
    held = STIFFNESS @ u + JOINT * 300.0 * (elements.mean() - x)
    np.testing.assert_allclose(held[:2], 0.0, atol=1e-9)
    assert u[2] == pytest.approx(0.02)
    viscous, inverse, h = damping(), 1.0 / np.diag(MASS), 2e-5
    path = [u.copy()]
    for step in range(1, 99 * 500 + 1):  # leap-frog with steps far smaller than the model's
        pull = -STIFFNESS @ u - viscous @ v - JOINT * (300.0 * (elements.mean() - x))
        v = v + h * (0.5 if step == 1 else 1.0) * inverse * pull
        u = u + h * v
        elements = np.clip(elements + JOINT @ u - x, -limits, limits)
        x = JOINT @ u
        if step % 500 == 0:
            path.append(u.copy())
    np.testing.assert_allclose(values, path, atol=0.02 * 4e-4)


def test_finer_steps_change_less_than_the_noise(chain: LumpedModel) -> None:
    for law in (
        PowerDamping("joint", 0.1, 0, 0, 1, 1),
        MicroSlip("joint", 0.5, 200.0, -0.3),
        StiffnessDrift(0.01),
    ):
        coarse, fine = (shown(chain, ringdown(), law, refinement=n) for n in (1, 8))
        assert np.max(np.abs(coarse - fine)) < 3e-4 * 0.02


def test_a_forced_motion_is_its_equation(chain: LumpedModel) -> None:
    time = np.arange(300) * 0.01
    force = 3.0 * np.sin(25.0 * time) + np.where(time > 1.0, 2.0, 0.0)
    what = trial(TrialKind.FORCED, 300, force=force)
    law = PowerStiffness("joint", 2.0, 3.0, 0, 2e-3)
    values = shown(chain, what, law)
    exact = integrated(
        np.zeros(3), lambda x, v: 2.0 * (x / 2e-3) ** 3, time, lambda t: float(np.interp(t, time, force))
    )
    np.testing.assert_allclose(values, exact[:, :3], atol=5e-4 * np.max(np.abs(exact[:, :3])))


def test_a_record_that_begins_under_load_begins_at_rest(chain: LumpedModel) -> None:
    what = trial(TrialKind.FORCED, 100, force=np.full(100, 3.0))
    for laws in ((), (MicroSlip("joint", 0.5, 800.0, -0.3),)):
        still = shown(chain, static([3.0] * 100), *laws)
        np.testing.assert_allclose(shown(chain, what, *laws), still, rtol=1e-3 if laws else 1e-11)


def test_initial_states_are_shares_of_the_release(chain: LumpedModel) -> None:
    square, shapes = eigh(STIFFNESS, MASS)
    initial = np.array([[0.1, 0.0], [0.05, 0.0]])
    start = shown(chain, ringdown(), conditions=replace(ONES, initial=initial))[0]
    shape = np.linalg.solve(STIFFNESS, [0, 0, 1])
    np.testing.assert_allclose(
        start, 0.02 * (1.1 * shape / shape[2] + 0.05 * shapes[:, 1] / shapes[2, 1]), atol=1e-12
    )
    later = ringdown(release=Release(0.02, at_rest=False))
    outputs = (("x3", Quantity.DISPLACEMENT), ("x3", Quantity.VELOCITY))
    values = shown(
        chain, later, outputs=outputs, conditions=replace(ONES, initial=np.array([[0.0, 0.0], [0.3, -0.4]]))
    )
    np.testing.assert_allclose(values[0], [0.3 * 0.02, -0.4 * 0.02 * np.sqrt(square[1])], rtol=1e-9)


@pytest.mark.parametrize("law", [None, PowerDamping("joint", 0.2, 2.0, 0.0, 0.1, 1.0)])
@pytest.mark.parametrize("clock", [(0.02, 0.013), (-0.01, -0.0333), (0.0, -0.02)])
def test_a_clock_shows_the_motion_at_other_times(
    chain: LumpedModel, law: Primitive | None, clock: tuple[float, float]
) -> None:
    laws = () if law is None else (law,)
    values = shown(chain, ringdown(200), *laws, conditions=replace(ONES, clock=clock))
    fine = shown(chain, ringdown(40001, time=np.arange(40001) * 1e-4), *laws)
    times = (1 + clock[0]) * ringdown(200).time + clock[1]
    expected = np.array([np.interp(times, np.arange(40001) * 1e-4, column) for column in fine.T]).T
    np.testing.assert_allclose(values, expected, atol=0.02 * 2e-4)
    assert np.all(values[times < 0.0] == values[0])  # held until the release


def test_rates_are_derivatives(chain: LumpedModel) -> None:
    what = ringdown(4000, time=np.arange(4000) * 5e-4)
    outputs = (("x3", Quantity.DISPLACEMENT), ("joint_strain", Quantity.STRAIN), ("x1", Quantity.VELOCITY),
               ("x2", Quantity.ACCELERATION))  # fmt: skip
    for laws in ((), (PowerStiffness("joint", 2.0, 3.0, 0, 2e-3),)):
        response = chain.respond(what, outputs, patch(*laws), ONES)
        slope = np.gradient(response.values, what.time, axis=0)
        scale = np.max(np.abs(slope), axis=0)
        np.testing.assert_allclose(response.rates[5:-5] / scale, slope[5:-5] / scale, atol=2e-3)


def test_a_point_mass_sits_between_places(chain: LumpedModel) -> None:
    row = np.array([0.0, 0.25, 0.75])
    mass = MASS + 0.3 * np.outer(row, row)
    first = np.sqrt(eigh(STIFFNESS, mass, eigvals_only=True)[0])
    values = shown(chain, ringdown(4000), PointMass(0.3, 0.55))[:, 2]
    # the free motion of the whole patched model, sampled: its first frequency by counting phase
    rising = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
    exact = (rising + values[rising] / (values[rising] - values[rising + 1])) * 0.01
    assert 2 * np.pi / np.mean(np.diff(exact[20:])) == pytest.approx(first, rel=1e-3)
    np.testing.assert_allclose(shown(chain, static([1.0]), PointMass(0.3, 0.55)), shown(chain, static([1.0])))


def test_omitted_modes_follow_slow_forces() -> None:
    # base excitation far below the second mode: with one mode and the residual the answer is nearly whole
    viscous = damping()
    ports = {"joint": JOINT}
    whole = SecondOrderSystem(MASS, viscous, STIFFNESS, ports)
    one = SecondOrderSystem(MASS, viscous, STIFFNESS, ports, mode_count=1)
    time = np.arange(500) * 0.01
    force = 1.0 - np.cos(4.0 * time)
    row = np.array([0.0, 1.0, 0.0])
    acting = Acting(time, np.zeros(3), [(row, Course.of(time, force))])
    shown = [Shown.of(row) for row in np.eye(3)]
    answers = [system.motion(acting, NO_LAWS).seen(shown).values for system in (whole, one)]
    bare = one.motion(acting, NO_LAWS).q @ one.shapes.T
    scale = np.max(np.abs(answers[0]))
    assert np.max(np.abs(answers[0] - answers[1])) < 2e-3 * scale
    assert np.max(np.abs(answers[0] - bare)) > 2e-2 * scale


@given(ratios=st.tuples(*[st.floats(0.0, 3.0)] * 3), clock=st.floats(0.0, 0.01))
@settings(max_examples=30, deadline=None)
def test_closed_form_and_stepped_ringdown_agree_for_any_damping(
    ratios: tuple[float, float, float], clock: float
) -> None:
    content = tomllib.loads((SHIPPED_MODELS / "three_mass_chain.toml").read_text())
    content["damping"] = {"ratios": list(ratios)}
    closed = LumpedModel(parse_lumped(content))
    conditions = replace(ONES, clock=(0.0, clock))
    # a drift of nothing that counts makes the kernel step
    values = shown(closed, ringdown(200), conditions=conditions)
    stepped = shown(closed, ringdown(200), StiffnessDrift(1e-14), conditions=conditions)
    np.testing.assert_allclose(values, stepped, atol=1e-8 * 0.02)


# ---------------------------------------------------------------- what it says of itself


def campaign(*trials: Trial) -> Campaign:
    return Campaign("c", {}, trials, 20.0, {}, "")


def test_scales_are_those_of_the_campaign(chain: LumpedModel) -> None:
    square, shapes = eigh(STIFFNESS, MASS)
    found = chain.scales(campaign(static([1.0, -6.0]), ringdown(start=100.0)))
    flexibility = np.linalg.inv(STIFFNESS)
    assert found.length == 0.6
    assert found.tip_stiffness == pytest.approx(1.0 / flexibility[2, 2])
    assert found.modal_mass == pytest.approx(1.0 / shapes[2, 0] ** 2)
    assert found.angular_frequency == pytest.approx(np.sqrt(square[0]))
    assert found.force == 6.0
    assert found.duration == pytest.approx(3.99)
    assert found.campaign_time == pytest.approx(103.99)
    joint = found.ports["joint"]
    shape = flexibility[:, 2] / flexibility[2, 2]
    assert joint.displacement == pytest.approx(
        max(0.02 * abs(JOINT @ shape), 6.0 * abs(JOINT @ flexibility[:, 2]))
    )
    assert joint.stiffness == pytest.approx(square[0] / (JOINT @ shapes[:, 0]) ** 2)


def test_it_is_a_model_and_says_what_it_carries(chain: LumpedModel) -> None:
    model: Model = chain
    assert model.ports() == ("joint", "end")
    assert model.stations() == (0.2, 0.6)
    assert model.output_quantity("base_strain") is Quantity.STRAIN
    assert model.output_quantity("nothing") is None
    carried = (
        PointMass, RootCompliance, LoadPlace, LoadGain, ModulusTemperature, MicroSlip, StiffnessDrift,
        SensorGain,
    )  # fmt: skip
    assert all(map(model.supports, carried))
    assert not any(map(model.supports, (Washout, LocalStiffnessLoss)))
    rig = LumpedModel.load("single_mass_rig")
    assert not rig.supports(RootCompliance)
    assert not rig.supports(LoadPlace)
    assert rig.stations() == (0.4, 0.4)
    only = static([1974.0], load_place="tip_load")  # the default of a campaign: its one input
    assert shown(rig, only, outputs=(*DISPLACEMENTS[:0], ("displacement", Quantity.DISPLACEMENT)),
                 conditions=Conditions(np.ones(2)))[0, 0] == pytest.approx(1.0)  # fmt: skip


def test_an_empty_patch_and_sensor_primitives_change_no_bit(chain: LumpedModel) -> None:
    plain = shown(chain, ringdown())
    np.testing.assert_array_equal(
        plain, shown(LumpedModel.load("three_mass_chain"), ringdown(), SensorGain("a", 0.1))
    )
    np.testing.assert_array_equal(plain, shown(chain, ringdown(), LoadGain(0.0, 0.0), PointMass(0.0, 0.3)))


@pytest.mark.parametrize(
    ("what", "outputs", "items", "sentence"),
    [
        (trial(TrialKind.FLIGHT), DISPLACEMENTS, (), "is a flight, but the lumped model"),
        (static([1.0]), (("x9", Quantity.DISPLACEMENT),), (), "has no output 'x9'; it has x1, x2"),
        (static([1.0]), (("x1", Quantity.STRAIN),), (), "is a displacement, but a channel"),
        (static([1.0]), (("x1", Quantity.VELOCITY),), (), "is at rest, but a channel"),
        (static([1.0], load_place="nose"), DISPLACEMENTS, (), "load place is 'nose', .* takes forces at end"),
        (static([1.0], load_place=(0.1, 0.2)), DISPLACEMENTS, (), "takes forces at"),
        (static([1.0]), DISPLACEMENTS, (Washout(0.1, 1.0),), "cannot carry the primitive 'washout'"),
        (static([1.0]), DISPLACEMENTS, (FreePlay("nose", 1.0, 1.0),), "port 'nose', which"),
        (static([1.0], load_place="middle"), DISPLACEMENTS, (LoadPlace(0.1, 0.0),), "no station_deriv"),
        (static([1.0]), DISPLACEMENTS, (PowerStiffness("end", -900.0, 3.0, 0, 1e-3),), "not found"),
        (trial(TrialKind.RINGDOWN), DISPLACEMENTS, (), "does not say how it was released"),
        (static([1.0], temperature=np.array([500.0])), DISPLACEMENTS, (ModulusTemperature(2e-3),),
         "leaves 0 of the stiffness"),
    ],
)  # fmt: skip
def test_what_cannot_be_answered_is_refused_in_a_sentence(
    chain: LumpedModel, what: Trial, outputs: Any, items: tuple[Primitive, ...], sentence: str
) -> None:
    with pytest.raises(ModelError, match=sentence):
        chain.respond(what, outputs, patch(*items), ONES)


SPRINGS = "stiffness = [[3.0, -1.0], [-1.0, 1.0]]\n"
GOOD = """
format = 1
name = "a"
mass = [1.0, 2.0]
stiffness = [[3.0, -1.0], [-1.0, 1.0]]
[damping]
ratios = [0.01, 0.01]
[[input]]
name = "in"
vector = [0.0, 1.0]
[[output]]
name = "x"
vector = [0.0, 1.0]
"""


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("mass = [1.0, 2.0]", "mass = [1.0]", "stiffness must be a 1 x 1 matrix"),
        ("mass = [1.0, 2.0]", "mass = [1.0, -2.0]", "mass .* must be positive definite"),
        ("[-1.0, 1.0]]", "[-1.0, 0.3]]", "a structure that can float away has no static response"),
        ("[-1.0, 1.0]]", "[-0.9, 1.0]]", "stiffness must be symmetric"),
        ("ratios = [0.01, 0.01]", "ratios = [0.01]", "one value for each mode, 2 in all, but 1 value came"),
        ("ratios = [0.01, 0.01]", "", "exactly one of ratios, matrix"),
        ("ratios = [0.01, 0.01]", "matrix = [[-1.0, 0.0], [0.0, 1.0]]", "must not feed energy"),
        ("format = 1", "format = 2", "format"),
        ('name = "x"\nvector = [0.0, 1.0]', 'name = "x"\nvector = [0.0, 0.0]',
         "vector of output 'x' is zero"),
        ('name = "x"\nvector = [0.0, 1.0]', 'name = "x"\nvector = [1.0]', "1 entry, but the model has 2"),
        ("[[output]]", "[[outputs]]", "'outputs' is not a key|'output' is missing"),
        ("[[output]]", '[[parameter]]\nname="p"\nterms="wing"\ndeviation=0.1\nlow=0.5\nhigh=2\n[[output]]',
         "scales 'wing', but there are"),
        ("[[output]]", '[[parameter]]\nname="p"\nterms="mass"\ndeviation=0.1\nlow=1.5\nhigh=2\n[[output]]',
         "0 < low <= mean <= high"),
        ("[[output]]", '[[input]]\nname = "in"\nvector = [1.0, 0.0]\n[[output]]', "two of input 'in'"),
        ("mass = [1.0, 2.0]", "mass = [1.0, nan]", "finite"),
        ("mass = [1.0, 2.0]", "mass = 2.0", r"stiffness must be a 1 x 1 matrix \(or 1 diagonal value\)"),
        ("mass = [1.0, 2.0]", "mass = '2'", "mass: a matrix of finite numbers by rows .* but '2' came"),
        ("mass = [1.0, 2.0]", "mass = []", r"mass: a matrix .* but \[\] came"),
        ("mass = [1.0, 2.0]", "mass = [true, 2.0]", r"mass: a matrix .* but \[True, 2.0\] came"),
        ("mass = [1.0, 2.0]", "mass = [[1.0, 0.0], 2.0]", "mass: a matrix of finite numbers by rows"),
        ('"x"\nvector = [0.0, 1.0]', '"x"\nvector = "up"', r"output\[1\].vector: a list .* but 'up' came"),
        ("ratios = [0.01, 0.01]", "ratios = [0.01, -0.2]", r"damping.ratios\[2\]: .* but -0.2 came"),
        ("[damping]\nratios = [0.01, 0.01]", "", "'damping' is missing"),
        (SPRINGS, "", r"stiffness is missing: give it, or \[\[stiffness_part\]\]"),
        ("[damping]\nratios = [0.01, 0.01]", "[[damping]]", "damping: a table is expected"),
        ("[[output]]", "[output]", r"write \[\[output\]\] for each, not \[output\]"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_model_is_refused_in_a_sentence(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    file = tmp_path / "model.toml"
    file.write_text(GOOD)
    assert LumpedModel.load(file).name == "a"
    assert old in GOOD
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(ModelError, match=sentence) as caught:
        LumpedModel.load(file)
    assert str(file) in str(caught.value)


ONE_MASS = """
format = 1
name = "one mass"
mass = MASS
stiffness = STIFFNESS
characteristic_length = 0.1
damping = { KIND = RATIO }
mass_part = [{ name = "bolt", matrix = BOLT }]
stiffness_part = [{ name = "second spring", matrix = SPRING }]
input = [{ name = "mass", vector = ROW, station_derivative = ROW }]
output = [{ name = "x", vector = ROW }]
port = [{ name = "slide", vector = ROW }]
place = [{ name = "mass", vector = ROW, station = 0.1 }]
root = { lever = ROW }
"""


def test_all_stiffness_may_be_in_parts(tmp_path: Path) -> None:
    part = SPRINGS.replace("stiffness", '[[stiffness_part]]\nname = "all"\nmatrix')
    (tmp_path / "whole.toml").write_text(GOOD)
    (tmp_path / "parts.toml").write_text(GOOD.replace(SPRINGS, "") + part)
    pulled = static([1.5], load_place="in")
    for name in ("whole", "parts"):
        model = LumpedModel.load(tmp_path / f"{name}.toml")
        response = model.respond(pulled, (("x", Quantity.DISPLACEMENT),), patch(), Conditions(np.ones(0)))
        assert response.values[0, 0] == pytest.approx(1.5 * 1.5, rel=1e-12)  # K⁻¹ = [[1, 1], [1, 3]] / 2


@pytest.mark.parametrize("damping", ["ratios", "matrix"])
def test_with_one_unknown_a_number_is_a_matrix_and_a_vector(tmp_path: Path, damping: str) -> None:
    numbers = {"MASS": 2.0, "STIFFNESS": 800.0, "RATIO": 0.01, "BOLT": 0.1, "SPRING": 25, "ROW": 1.0}

    def model(form: Callable[[str, float], str]) -> LumpedModel:
        text = ONE_MASS.replace("KIND", damping)
        for word, value in numbers.items():
            text = text.replace(word, form(word, value))
        file = tmp_path / "model.toml"
        file.write_text(text)
        return LumpedModel.load(file)

    def nested(word: str, value: float) -> str:
        return f"[{value}]" if word == "ROW" or (word, damping) == ("RATIO", "ratios") else f"[[{value}]]"

    bare = model(lambda _, value: str(value))
    assert bare.description == model(lambda _, value: f"[{value}]").description
    pulled = static([1.65], load_place="mass")
    for other in (bare, model(nested)):
        response = other.respond(pulled, (("x", Quantity.DISPLACEMENT),), patch(), Conditions(np.ones(0)))
        assert response.values[0, 0] == pytest.approx(1.65 / 825.0, rel=1e-12)


def test_a_missing_or_broken_file_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("format = ")
    for file, sentence in (
        ("four_mass_chain", "shipped are single_mass_rig, three_mass_chain"),
        (tmp_path / "none.toml", "cannot be read"),
        (broken, "not valid TOML"),
    ):
        with pytest.raises(ModelError, match=sentence):
            LumpedModel.load(file)
