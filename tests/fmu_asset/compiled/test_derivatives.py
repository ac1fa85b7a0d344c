"""The compiled wing as a system of equations: exact derivatives, and states that others' solvers move."""

import ctypes
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from fmpy import simulate_fmu
from scipy.linalg import expm

from fmu_asset.compiled.package import STATES as STATE_NAMES
from tests.fmu_asset.making import tables
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave

REFUSED = tables(__file__)
STRAINS = [f"strain[{gauge}]" for gauge in range(1, 25)]
FREQUENCIES, RATIOS = ([f"{name}[{mode}]" for mode in range(1, 7)] for name in ("frequency", "damping_ratio"))
TIP, LOAD_POINT = "tip_displacement", "load_point_displacement"
STATIC = [*STRAINS, TIP, LOAD_POINT]
AT = {
    "young_modulus_factor": 1.05,
    "health.z1": 0.3,
    "health.z2": 0.55,
    "load_factor": 2.5,
    "tip_force": -7.0,
}
"""Where the derivatives are taken."""
PARAMETERS = {"mass.servo": 0.2, "mass.pitot": 0.1, "damping.alpha": 2.0, "damping.beta": 3e-4}


@pytest.fixture(params=["compiled", "fmi3"])
def wing(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    with closing(Slave(ours(request.param))) as made:
        yield made


def flown(wing: Slave, response: int = 1, **given: float) -> Slave:
    factor = AT["young_modulus_factor"]
    assert wing.start(response=response, anew=False, young_modulus_factor=factor, **given) == OK
    inputs = [AT[name] for name in ("load_factor", "health.z1", "health.z2", "tip_force")]
    assert wing.step(inputs, 0.0, 1.0) == OK
    return wing


def test_derivatives_are_the_slopes_of_the_outputs(wing) -> None:
    """By differences over four neighbours, which are of fourth order."""
    inputs, seen = ("load_factor", "health.z1", "health.z2", "tip_force"), [*STATIC, *FREQUENCIES, *RATIOS]
    kinds, at = np.split(np.arange(len(seen)), [24, 26, 32]), AT | PARAMETERS

    def shown(values: dict[str, float]) -> np.ndarray:
        given = {name.replace(".", "__"): values[name] for name in values.keys() - inputs}
        assert wing.start(**given) == OK
        assert wing.step([values[name] for name in inputs], 0.0, 1.0) == OK
        return np.array(wing.get(*seen))

    slopes = {}
    for name, value in at.items():
        around = [shown(at | {name: value * (1.0 + share)}) for share in (-2e-3, -1e-3, 1e-3, 2e-3)]
        slopes[name] = np.array([1.0, -8.0, 8.0, -1.0]) @ around / (12e-3 * value)
    level = np.abs(shown(at))
    for name, slope in slopes.items():
        told, rounding = wing.derivative(seen, {name: 1.0}), 1e-12 * level / abs(at[name])
        for own in kinds:  # strains, displacements, frequencies, damping ratios
            within = 1e-8 * np.abs(slope[own]).max() + rounding[own].max()
            np.testing.assert_allclose(told[own], slope[own], rtol=0, atol=within, err_msg=name)
    together = wing.derivative(seen, {"health.z1": 0.7, "load_factor": -0.2})
    parts = [wing.derivative(seen, {name: 1.0}) for name in ("health.z1", "load_factor")]
    np.testing.assert_allclose(together, np.array([0.7, -0.2]) @ parts, rtol=1e-12)


def test_in_motion_loads_act_at_once_and_health_is_refused(wing) -> None:
    flown(wing, response=2)
    feed_through = wing.derivative(STATIC, {"load_factor": 1.0})
    kept, shown = wing.saved(), []
    for load_factor in (3.0, 2.0):
        assert wing.restore(kept) == OK
        inputs = [load_factor, AT["health.z1"], AT["health.z2"], AT["tip_force"]]
        assert wing.step(inputs, 1.0, 1e-12) == OK  # s; the modes have no time to move
        shown.append(np.array(wing.get(*STATIC)))
    within = 1e-12 * np.abs(shown[0]).max()
    np.testing.assert_allclose(feed_through, shown[0] - shown[1], rtol=0, atol=within)
    assert wing.status_of(wing.derivative, STRAINS, {"health.z1": 1.0}) == DISCARD
    assert "is not offered in motion" in wing.log[-1][1]


def test_the_adjoint_is_the_transpose(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:
        flown(wing)
        rng = np.random.default_rng(3)
        unknowns, knowns = (
            [wing.reference[name] for name in names]
            for names in (
                (LOAD_POINT, "strain[1]", "frequency[1]", TIP),
                ("health.z1", "load_factor", "young_modulus_factor", "mass.servo"),
            )
        )
        v, w = rng.normal(size=5), rng.normal(size=1 + 24 + 6 + 1)
        forward = wing.fmu.getDirectionalDerivative(unknowns, knowns, v, len(w))
        backward = wing.fmu.getAdjointDerivative(unknowns, knowns, w, len(v))
        assert w @ forward == pytest.approx(np.array(backward) @ v, rel=1e-12)


def test_derivatives_that_there_are_not_are_refused_in_a_sentence(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:

        def status(unknown: str, known: str, size: int) -> int:
            places = [wing.reference[unknown]], [wing.reference[known]]
            return wing.status_of(wing.fmu.getDirectionalDerivative, *places, [1.0], size)

        assert status("strain[1]", "load_factor", 24) == ERROR
        assert "not initialised" in wing.log[-1][1]
        flown(wing)
        for unknown, known, size, sentence in REFUSED["derivatives"]:
            assert status(unknown, known, size) == DISCARD
            assert sentence in wing.log[-1][1]


# ---------------------------------------------------------------------- model exchange

STATES = [f"{name}[{mode}]" for name in STATE_NAMES for mode in range(1, 7)]
RATES = [f"der({name})" for name in STATES]
COUNT = len(STATES)
Doubles = ctypes.c_double * COUNT
START = {
    "damping__alpha": 1.5, "damping__beta": 3e-4, "initial_tip_displacement": 0.05, "health__z1": 0.3,
}  # fmt: skip
LOADS, SEEN = ["load_factor", "tip_force"], ["strain[1]", "strain[13]", TIP, LOAD_POINT]


@pytest.fixture(params=["exchange", "exchange3"])
def moving(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    """An instance in continuous time, damped and released."""
    with closing(Slave(ours(request.param))) as made:
        assert made.start(anew=False, response=None, **START) == OK
        made.fmu.newDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        yield made


def jacobian(moving: Slave) -> np.ndarray:
    """Return derivatives of rates and outputs by states and loads."""
    return np.array([moving.derivative([*RATES, *SEEN], {known: 1.0}) for known in [*STATES, *LOADS]]).T


def test_fmpy_moves_both_interfaces_alike(ours) -> None:
    """By CVODE as in co-simulation: loads jump and health grows on the way; compared where nothing jumps."""
    start = {"load_factor": 1.0, "initial_tip_displacement": 0.05, "damping.alpha": 1.0, "damping.beta": 1e-4}
    times, losses, factors = (0.0, 0.1, 0.1, 0.2, 0.2, 1.0), (0, 0, 0, 0, 0.4, 0.4), (1, 1, 2, 2, 2, 2)
    columns = [(name, float) for name in ("time", "health.z1", "load_factor")]
    course = np.array([*zip(times, losses, factors, strict=True)], dtype=columns)
    given = {"stop_time": 0.4, "output_interval": 0.005, "output": SEEN, "input": course}
    moving = {"start_values": start | {"response": 2}, "step_size": 0.005}
    compiled = simulate_fmu(ours("compiled"), **given, **moving)
    exchanged = simulate_fmu(ours("exchange"), **given, start_values=start, relative_tolerance=1e-10)
    smooth = ~np.isin(np.round(compiled["time"], 6), [0.1, 0.2])
    assert np.ptp(compiled["tip_displacement"]) > 0.05
    for name in SEEN:
        shown, largest = (
            np.interp(compiled["time"], exchanged["time"], exchanged[name]),
            np.abs(compiled[name]).max(),
        )
        np.testing.assert_allclose(shown[smooth], compiled[name][smooth], rtol=0, atol=1e-6 * largest)


def test_rates_and_outputs_are_linear_with_the_derivatives_that_it_gives(moving) -> None:
    fmu, matrix, rng, rates = moving.fmu, jacobian(moving), np.random.default_rng(1), Doubles()
    assert (fmu.getNumberOfContinuousStates() if moving.three else moving.description.states) == COUNT
    for _ in range(3):
        x, u = rng.normal(size=COUNT), rng.uniform(0.5, 3.0, 2)
        moving.set(dict(zip(LOADS, u.tolist(), strict=True)))
        fmu.setTime(1.0)
        fmu.setContinuousStates(Doubles(*x), COUNT)
        fmu.getDerivatives(rates, COUNT)
        apart = np.abs(np.array(moving.get(*RATES, *SEEN)) - matrix @ [*x, *u])
        np.testing.assert_array_less(apart, 1e-13 * np.abs(matrix) @ np.abs([*x, *u]))
        assert moving.get(*STATES, *RATES) == [*x, *rates]
    assert moving.status_of(moving.derivative, RATES, {"health.z1": 1.0}) != OK  # it changes the modes
    poles = np.linalg.eigvals(matrix[:COUNT, :COUNT])
    circular = np.sort(np.abs(poles[poles.imag > 0]))[:6] / (2 * np.pi)
    np.testing.assert_allclose(circular, moving.get(*(f"frequency[{i}]" for i in range(1, 7))), rtol=1e-10)


@pytest.mark.parametrize("moving", ["exchange"], indirect=True)
def test_loads_in_straight_lines_are_those_of_the_linear_system(moving, ours) -> None:
    """The co-simulation FMU along ramps, against the matrix exponential of what model exchange gives."""
    matrix, time = jacobian(moving), 0.0
    x, load = np.array(moving.get(*STATES)), np.array(moving.get(*LOADS))
    with closing(Slave(ours("compiled"))) as slave:
        assert slave.start(response=2, **START) == OK
        places = [slave.reference[name] for name in LOADS]
        for size, slope in ((0.02, (40.0, -100.0)), (0.3, (-5.0, 20.0)), (0.1, (0.0, 0.0))):
            block = np.zeros((COUNT + 4, COUNT + 4))
            block[:COUNT, : COUNT + 2] = matrix[:COUNT]
            block[COUNT : COUNT + 2, COUNT + 2 :] = np.eye(2)
            x = (expm(block * size) @ [*x, *load, *slope])[:COUNT]
            slave.fmu.setRealInputDerivatives(
                (ctypes.c_uint * 2)(*places), (ctypes.c_int * 2)(1, 1), (ctypes.c_double * 2)(*slope)
            )
            kept, shown = slave.saved(), []
            for _ in range(2):  # the slopes are part of the state
                assert slave.restore(kept) == OK
                assert slave.status_of(slave.fmu.doStep, time, size) == OK
                shown.append(slave.everything())
            assert shown[0] == shown[1]
            time, load = time + size, load + size * np.array(slope)
            expected = matrix[COUNT:] @ [*x, *load]
            np.testing.assert_allclose(
                slave.get(*SEEN), expected, rtol=0, atol=1e-11 * np.abs(expected).max()
            )
            np.testing.assert_allclose(slave.get(*LOADS), load, rtol=1e-14)


def test_health_is_discrete_and_wrong_calls_are_refused(moving) -> None:
    before = moving.get(*STRAINS)
    assert moving.status_of(moving.set, {"health.z1": 0.5}) == DISCARD
    assert moving.status_of(moving.set, {"load_factor": 99.0}) == OK
    assert moving.status_of(moving.get, *STRAINS) == DISCARD  # out of range
    moving.set({"load_factor": 1.0})
    assert moving.get(*STRAINS) == before
    moving.fmu.enterEventMode()
    moving.set({"health.z1": 0.5})
    assert moving.fmu.newDiscreteStates()[3]
    moving.fmu.enterContinuousTimeMode()
    assert moving.get(*STRAINS) != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert moving.of("tip_displacement") != 0.0
    moving.fmu.enterEventMode()
    assert not moving.fmu.newDiscreteStates()[3]
