"""Model exchange beside co-simulation: the same motion, ramps of loads, events of health."""

import ctypes
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import pytest
from fmpy import simulate_fmu
from numpy.typing import NDArray
from scipy.linalg import expm

from fmu_asset.compiled.package import STATES as STATE_NAMES
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, OK, Slave

STATES = [f"{name}[{mode}]" for name in STATE_NAMES for mode in range(1, 7)]
RATES = [f"der({name})" for name in STATES]
STATE_COUNT = len(STATES)
LOADS = ["load_factor", "tip_force"]
OUTPUTS = ["strain[1]", "strain[13]", "tip_displacement", "load_point_displacement"]
STRAINS = [f"strain[{gauge}]" for gauge in range(1, 25)]
START = {
    "damping__alpha": 1.5,
    "damping__beta": 3e-4,
    "initial_tip_displacement": 0.05,
    "health__z1": 0.3,
}
"""Damped, released from 5 cm, with a loss of stiffness."""


@pytest.fixture(params=["exchange", "exchange3"])
def moving(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    """An instance in continuous time."""
    with closing(Slave(ours(request.param))) as slave:
        assert slave.start(anew=False, response=None, **START) == OK
        slave.fmu.newDiscreteStates()
        slave.fmu.enterContinuousTimeMode()
        yield slave


# ---------------------------------------------------------------------- both interfaces by fmpy

RELEASE = {
    "load_factor": 1.0,
    "initial_tip_displacement": 0.05,
    "damping.alpha": 1.0,
    "damping.beta": 1e-4,
}


def inputs_that_jump() -> np.ndarray:
    """Return the load factor, which jumps at 0.1 s, and the health, which does at 0.2 s."""
    rows = [
        (0.0, 0.0, 1.0),
        (0.1, 0.0, 1.0),
        (0.1, 0.0, 2.0),
        (0.2, 0.0, 2.0),
        (0.2, 0.4, 2.0),
        (1.0, 0.4, 2.0),
    ]
    return np.array(rows, dtype=[("time", float), ("health.z1", float), ("load_factor", float)])


@pytest.fixture(scope="module")
def co_simulated(ours: OurFmus) -> np.ndarray:
    return simulate_fmu(
        ours("compiled"),
        stop_time=0.4,
        output_interval=0.005,
        output=OUTPUTS,
        input=inputs_that_jump(),
        start_values=RELEASE | {"response": 2},
        step_size=0.005,
    )


@pytest.fixture(scope="module")
def exchanged(ours: OurFmus) -> np.ndarray:
    """The same by CVODE."""
    return simulate_fmu(
        ours("exchange"),
        stop_time=0.4,
        output_interval=0.005,
        output=OUTPUTS,
        input=inputs_that_jump(),
        start_values=RELEASE,
        relative_tolerance=1e-10,
    )


@pytest.mark.parametrize("name", OUTPUTS)
def test_fmpy_moves_both_interfaces_alike(co_simulated, exchanged, name):
    """Loads jump and health grows on the way; compared where nothing jumps."""
    time = co_simulated["time"]
    is_smooth = ~np.isin(np.round(time, 6), [0.1, 0.2])

    by_exchange = np.interp(time, exchanged["time"], exchanged[name])

    by_co_simulation = co_simulated[name]
    tolerance = 1e-6 * np.abs(by_co_simulation).max()
    np.testing.assert_allclose(
        by_exchange[is_smooth], by_co_simulation[is_smooth], rtol=0, atol=tolerance
    )


def test_the_wing_that_fmpy_moves_swings_widely(co_simulated):
    assert np.ptp(co_simulated["tip_displacement"]) > 0.05


# ---------------------------------------------------------------------- loads in straight lines


@dataclass(frozen=True)
class LinearSystem:
    """Rates and outputs of a structure by its states and loads.

    Attributes
    ----------
    rates : (S, S + 2) array
        Derivatives of the rates by states and loads.
    outputs : (O, S + 2) array
        Derivatives of the outputs.
    state, load : (S,), (2,) array
        At the start.
    """

    rates: NDArray[np.float64]
    outputs: NDArray[np.float64]
    state: NDArray[np.float64]
    load: NDArray[np.float64]

    def state_after(
        self,
        state: NDArray[np.float64],
        load: NDArray[np.float64],
        slope: tuple[float, float],
        duration: float,
    ) -> NDArray[np.float64]:
        """Return the state after a ramp of the loads, by the matrix exponential (Van Loan 1978)."""
        block = np.zeros((STATE_COUNT + 4, STATE_COUNT + 4))
        block[:STATE_COUNT, : STATE_COUNT + 2] = self.rates
        block[STATE_COUNT : STATE_COUNT + 2, STATE_COUNT + 2 :] = np.eye(2)
        augmented = np.concatenate((state, load, slope))
        return np.asarray((expm(block * duration) @ augmented)[:STATE_COUNT])


@pytest.fixture
def linear_system(moving: Slave) -> LinearSystem:
    columns = [moving.derivative([*RATES, *OUTPUTS], {name: 1.0}) for name in [*STATES, *LOADS]]
    matrix = np.transpose(columns)
    return LinearSystem(
        rates=matrix[:STATE_COUNT],
        outputs=matrix[STATE_COUNT:],
        state=np.array(moving.get(*STATES)),
        load=np.array(moving.get(*LOADS)),
    )


RAMPS = [(0.02, (40.0, -100.0)), (0.3, (-5.0, 20.0)), (0.1, (0.0, 0.0))]
"""Durations [s], and slopes of load factor [1/s] and force at the tip [N/s]."""


def set_slopes(slave: Slave, slope: tuple[float, float]) -> None:
    """Set the derivatives of the loads by time."""
    references = [slave.reference[name] for name in LOADS]
    slave.fmu.setRealInputDerivatives(
        (ctypes.c_uint * 2)(*references), (ctypes.c_int * 2)(1, 1), (ctypes.c_double * 2)(*slope)
    )


def test_loads_in_straight_lines_are_those_of_the_linear_system(linear_system, ours):
    """The co-simulation FMU along ramps, against what model exchange gives."""
    state = linear_system.state
    load = linear_system.load
    time = 0.0
    with closing(Slave(ours("compiled"))) as slave:
        assert slave.start(response=2, **START) == OK
        for duration, slope in RAMPS:
            set_slopes(slave, slope)
            assert slave.status_of(slave.fmu.doStep, time, duration) == OK

            state = linear_system.state_after(state, load, slope, duration)
            load = load + duration * np.array(slope)
            time += duration
            expected = linear_system.outputs @ np.concatenate((state, load))
            tolerance = 1e-11 * np.abs(expected).max()
            np.testing.assert_allclose(slave.get(*OUTPUTS), expected, rtol=0, atol=tolerance)
            np.testing.assert_allclose(slave.get(*LOADS), load, rtol=1e-14)


def stepped(slave: Slave, time: float, duration: float) -> list[float]:
    """Return all values after a step that is granted."""
    assert slave.status_of(slave.fmu.doStep, time, duration) == OK
    return slave.everything()


def test_slopes_of_loads_are_part_of_the_state(ours):
    time = 0.0
    with closing(Slave(ours("compiled"))) as slave:
        assert slave.start(response=2, **START) == OK
        for duration, slope in RAMPS:
            set_slopes(slave, slope)
            state = slave.saved()
            values = stepped(slave, time, duration)

            assert slave.restore(state) == OK
            assert stepped(slave, time, duration) == values
            time += duration


# ---------------------------------------------------------------------- health and events


def test_rates_have_no_derivatives_by_health(moving):
    """Health is discrete: it changes the modes."""
    assert moving.status_of(moving.derivative, RATES, {"health.z1": 1.0}) != OK


def test_health_cannot_be_set_in_continuous_time(moving):
    assert moving.status_of(moving.set, {"health.z1": 0.5}) == DISCARD


def test_outputs_of_a_load_outside_its_range_are_refused(moving):
    before = moving.get(*STRAINS)

    assert moving.status_of(moving.set, {"load_factor": 99.0}) == OK
    assert moving.status_of(moving.get, *STRAINS) == DISCARD

    moving.set({"load_factor": 1.0})
    assert moving.get(*STRAINS) == before


def test_health_changes_the_states_at_an_event(moving):
    before = moving.get(*STRAINS)
    moving.fmu.enterEventMode()
    moving.set({"health.z1": 0.5})

    has_new_states = moving.fmu.newDiscreteStates()[3]
    moving.fmu.enterContinuousTimeMode()

    assert has_new_states
    assert moving.get(*STRAINS) != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert moving.get("tip_displacement") != [0.0]


def test_an_event_without_a_change_leaves_the_states(moving):
    moving.fmu.enterEventMode()
    moving.set({"health.z1": 0.5})
    moving.fmu.newDiscreteStates()
    moving.fmu.enterContinuousTimeMode()

    moving.fmu.enterEventMode()

    assert not moving.fmu.newDiscreteStates()[3]
