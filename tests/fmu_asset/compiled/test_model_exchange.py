"""The compiled wing for model exchange: its states under CVODE are the motion of the co-simulation one."""

import ctypes
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from fmpy import simulate_fmu
from scipy.linalg import expm

from fmu_asset.compiled.package import STATES as STATE_NAMES
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import MOVING, WING
from tests.fmu_asset.making import changed
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, OK, Slave

STATES = [f"{name}[{mode}]" for name in STATE_NAMES for mode in range(1, 9)]
RATES = [f"der({name})" for name in STATES]
COUNT = len(STATES)
Doubles = ctypes.c_double * COUNT
START = {
    "damping__alpha": 1.5, "damping__beta": 3e-4, "initial_tip_displacement": 0.05, "health__z1": 0.3,
}  # fmt: skip
LOADS, STRAINS = ["load_factor", "tip_force"], [f"strain[{gauge}]" for gauge in range(1, 25)]
SEEN = ["strain[1]", "strain[13]", "tip_displacement", "load_point_displacement"]


@pytest.fixture(params=["exchange", "exchange3"])
def wing(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    """An instance in continuous time, damped and released."""
    with closing(Slave(ours(request.param))) as made:
        assert made.start(anew=False, response=None, **START) == OK
        made.fmu.newDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        yield made


def jacobian(wing: Slave) -> np.ndarray:
    """Return derivatives of rates and outputs by states and loads."""
    return np.array([wing.derivative([*RATES, *SEEN], {known: 1.0}) for known in [*STATES, *LOADS]]).T


def test_fmpy_moves_all_kinds_alike(ours) -> None:
    """By CVODE as in co-simulation: loads jump and health grows on the way; compared where nothing jumps."""
    start = {"load_factor": 1.0, "initial_tip_displacement": 0.05, "damping.alpha": 1.0, "damping.beta": 1e-4}
    times, losses, factors = (0.0, 0.1, 0.1, 0.2, 0.2, 1.0), (0, 0, 0, 0, 0.4, 0.4), (1, 1, 2, 2, 2, 2)
    columns = [(name, float) for name in ("time", "health.z1", "load_factor")]
    course = np.array([*zip(times, losses, factors, strict=True)], dtype=columns)
    given = {"stop_time": 0.4, "output_interval": 0.005, "output": SEEN, "input": course}
    moving = {"start_values": start | {"response": 2}, "step_size": 0.005}
    compiled, python = (simulate_fmu(ours(kind), **given, **moving) for kind in ("compiled", "python"))
    exchanged = simulate_fmu(ours("exchange"), **given, start_values=start, relative_tolerance=1e-10)
    smooth = ~np.isin(np.round(compiled["time"], 6), [0.1, 0.2])
    assert np.ptp(compiled["tip_displacement"]) > 0.05
    for name in SEEN:
        shown, largest = (
            np.interp(compiled["time"], exchanged["time"], exchanged[name]),
            np.abs(compiled[name]).max(),
        )
        np.testing.assert_allclose(python[name], compiled[name], rtol=0, atol=1e-12 * largest)
        np.testing.assert_allclose(shown[smooth], compiled[name][smooth], rtol=0, atol=1e-6 * largest)


def test_rates_and_outputs_are_linear_with_the_derivatives_that_it_gives(wing) -> None:
    fmu, matrix, rng, rates = wing.fmu, jacobian(wing), np.random.default_rng(1), Doubles()
    assert (fmu.getNumberOfContinuousStates() if wing.three else wing.description.states) == COUNT
    for _ in range(3):
        x, u = rng.normal(size=COUNT), rng.uniform(0.5, 3.0, 2)
        wing.set(dict(zip(LOADS, u.tolist(), strict=True)))
        fmu.setTime(1.0)
        fmu.setContinuousStates(Doubles(*x), COUNT)
        fmu.getDerivatives(rates, COUNT)
        apart = np.abs(np.array(wing.get(*RATES, *SEEN)) - matrix @ [*x, *u])
        np.testing.assert_array_less(apart, 1e-13 * np.abs(matrix) @ np.abs([*x, *u]))
        assert wing.get(*STATES, *RATES) == [*x, *rates]
    assert wing.status_of(wing.derivative, RATES, {"health.z1": 1.0}) != OK  # it changes the modes
    poles = np.linalg.eigvals(matrix[:COUNT, :COUNT])
    circular = np.sort(np.abs(poles[poles.imag > 0]))[:6] / (2 * np.pi)
    np.testing.assert_allclose(circular, wing.get(*(f"frequency[{i}]" for i in range(1, 7))), rtol=1e-10)


@pytest.mark.parametrize("wing", ["exchange"], indirect=True)
def test_loads_in_straight_lines_are_those_of_the_linear_system(wing, ours) -> None:
    """The co-simulation FMU along ramps, against the matrix exponential of what model exchange gives."""
    matrix, time = jacobian(wing), 0.0
    x, load = np.array(wing.get(*STATES)), np.array(wing.get(*LOADS))
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
    lines = changed(WING, header={"step_size": 0.02, "interpolation": "linear"})
    with FmiAsset(ours("compiled"), lines, parameters=MOVING, isolated=False) as asset:
        asset.reset(health={"z1": 0.3})
        low, high = asset.input_range("control", "load_factor")
        assert asset.step({"load_factor": high}).time == 0.02  # to the edge of the range
        assert asset.step({"load_factor": low}, {"z1": 0.4}).time == 0.04


def test_health_is_discrete_and_wrong_calls_are_refused(wing) -> None:
    before = wing.get(*STRAINS)
    assert wing.status_of(wing.set, {"health.z1": 0.5}) == DISCARD
    assert wing.status_of(wing.set, {"load_factor": 99.0}) == OK
    assert wing.status_of(wing.get, *STRAINS) == DISCARD  # out of range
    wing.set({"load_factor": 1.0})
    assert wing.get(*STRAINS) == before
    wing.fmu.enterEventMode()
    wing.set({"health.z1": 0.5})
    assert wing.fmu.newDiscreteStates()[3]
    wing.fmu.enterContinuousTimeMode()
    assert wing.get(*STRAINS) != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert wing.of("tip_displacement") != 0.0
    wing.fmu.enterEventMode()
    assert not wing.fmu.newDiscreteStates()[3]
