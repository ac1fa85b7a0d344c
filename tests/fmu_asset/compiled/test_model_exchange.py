"""The compiled wing for model exchange: its states under CVODE are the motion of the co-simulation one."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fmpy import simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from scipy.linalg import expm

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.compiled.package import STATES as STATE_NAMES
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import KINDS, MOVING, WING
from tests.fmu_asset.making import changed
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, OK, Slave, instantiated

STATES = 16
HALF = STATES // 2
Doubles = ctypes.c_double * STATES
START = {"damping.alpha": 1.5, "damping.beta": 3e-4, "initial_tip_displacement": 0.05}


class Wing:
    """An instance in continuous time, damped and released, of FMI 2; places by name."""

    def __init__(self, fmu: Any, place: dict[str, int]) -> None:
        self.fmu, self.place = fmu, place
        modes = range(1, HALF + 1)
        self.states = [place[f"{name}[{i}]"] for name in STATE_NAMES for i in modes]
        self.rates = [place[f"der({name}[{i}])"] for name in STATE_NAMES for i in modes]
        self.inputs = [place["load_factor"], place["tip_force"]]
        self.strains = [place[f"strain[{i}]"] for i in range(1, 25)]

    def jacobian(self, *outputs: str) -> np.ndarray:
        """Return derivatives of rates and outputs by states and loads."""
        unknowns = [*self.rates, *(self.place[name] for name in outputs)]
        knowns = [*self.states, *self.inputs]
        return np.array([self.fmu.getDirectionalDerivative(unknowns, [known], [1.0]) for known in knowns]).T

    def status_of(self, call: str, *arguments: object) -> int:
        try:
            getattr(self.fmu, call)(*arguments)
        except FMICallException as error:
            return int(error.status)
        return OK


@pytest.fixture
def wing(ours: OurFmus) -> Iterator[Wing]:
    with instantiated(FMU2Model, ours("exchange")) as (fmu, place):
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.setReal([place[name] for name in (*START, "health.z1")], [*START.values(), 0.3])
        fmu.exitInitializationMode()
        fmu.newDiscreteStates()
        fmu.enterContinuousTimeMode()
        yield Wing(fmu, place)


@pytest.fixture
def wing3(ours: OurFmus) -> Iterator[tuple[Any, dict[str, int]]]:
    """The same of FMI 3."""
    with instantiated(FMU3Model, ours("exchange3")) as (fmu, place):
        fmu.enterInitializationMode(startTime=0.0)
        fmu.setFloat64([place[name] for name in (*START, "health")], [*START.values(), 0.3, 0.0])
        fmu.exitInitializationMode()
        fmu.updateDiscreteStates()
        fmu.enterContinuousTimeMode()
        yield fmu, place


def test_fmi_3_gives_the_numbers_of_fmi_2(
    wing: Wing, wing3: tuple[Any, dict[str, int]], ours: OurFmus
) -> None:
    """To the last bit: states, rates, outputs and derivatives, before and after an event; so in our door."""
    two, (three, place) = wing.fmu, wing3
    assert three.getNumberOfContinuousStates() == read_fmu(ours("exchange")).states == STATES
    assert three.getNumberOfEventIndicators() == 0
    rng = np.random.default_rng(3)
    for loss in (0.3, 0.5, 0.5):
        for fmu in (two, three):
            fmu.enterEventMode()
        two.setReal([wing.place["health.z1"]], [loss])
        three.setFloat64([place["health"]], [loss, 0.0])
        assert two.newDiscreteStates()[3] == three.updateDiscreteStates()[3]
        x, load = rng.normal(size=STATES), float(rng.uniform(0.5, 3.0))
        for fmu in (two, three):
            fmu.enterContinuousTimeMode()
            fmu.setTime(1.0)
            fmu.setContinuousStates(Doubles(*x), STATES)
        two.setReal([wing.place["load_factor"]], [load])
        three.setFloat64([place["load_factor"]], [load])
        rates = Doubles(), Doubles()
        two.getDerivatives(rates[0], STATES)
        three.getContinuousStateDerivatives(rates[1], STATES)
        assert list(rates[0]) == list(rates[1])
        moving = [place["modal_displacement"], place["modal_velocity"]]
        assert three.getFloat64(moving, STATES) == x.tolist()
        assert three.getFloat64([place[f"der({name})"] for name in STATE_NAMES], STATES) == list(rates[1])
        assert three.getFloat64([place["strain"]], 24) == two.getReal(wing.strains)
        assert three.getFloat64([place["time"]]) == [1.0]
        column = two.getDirectionalDerivative(wing.rates[HALF:], wing.states[1:2], [1.0])
        known, direction = [place["modal_displacement"]], np.eye(HALF)[1].tolist()
        unknown = [place["der(modal_velocity)"]]
        assert column == three.getDirectionalDerivative(unknown, known, direction, HALF)
    flown = []
    for kind in (KINDS["model exchange wing"], KINDS["model exchange wing of FMI 3"]):
        with FmiAsset(ours(kind.file), kind.binding, parameters=kind.parameters, isolated=False) as asset:
            flown.append(asset.simulate(**kind.course).values.tobytes())
    assert flown[0] == flown[1]


def test_cvode_moves_it_as_the_co_simulation_moves(ours: OurFmus) -> None:
    """Loads jump and health grows on the way; compared where nothing jumps."""
    start = {"load_factor": 1.0, "initial_tip_displacement": 0.05, "damping.alpha": 1.0, "damping.beta": 1e-4}
    times, losses, factors = (0.0, 0.1, 0.1, 0.2, 0.2, 1.0), (0, 0, 0, 0, 0.4, 0.4), (1, 1, 2, 2, 2, 2)
    columns = [(name, float) for name in ("time", "health.z1", "load_factor")]
    course = np.array([*zip(times, losses, factors, strict=True)], dtype=columns)
    names = ["strain[1]", "strain[20]", "tip_displacement", "load_point_displacement"]
    ours_, theirs = (
        simulate_fmu(ours(file), stop_time=0.4, output_interval=0.005, output=names, input=course, **options)
        for file, options in (
            ("exchange", {"start_values": start, "relative_tolerance": 1e-10}),
            ("compiled", {"start_values": start | {"response": 2}, "step_size": 0.005}),
        )
    )
    smooth = ~np.isin(np.round(theirs["time"], 6), [0.1, 0.2])
    for name in names:
        shown = np.interp(theirs["time"], ours_["time"], ours_[name])
        within = 1e-6 * np.abs(theirs[name]).max()
        np.testing.assert_allclose(shown[smooth], theirs[name][smooth], rtol=0, atol=within)


def test_rates_and_outputs_are_linear_with_the_derivatives_that_it_gives(wing: Wing) -> None:
    fmu, place = wing.fmu, wing.place
    names = ("strain[1]", "strain[13]", "tip_displacement", "load_point_displacement")
    unknowns, jacobian = [*wing.rates, *(place[name] for name in names)], wing.jacobian(*names)
    rng = np.random.default_rng(1)
    for _ in range(3):
        x, u = rng.normal(size=STATES), rng.uniform(0.5, 3.0, 2)
        fmu.setReal(wing.inputs, u.tolist())
        fmu.setContinuousStates(Doubles(*x), STATES)
        apart = np.abs(np.array(fmu.getReal(unknowns)) - jacobian @ [*x, *u])
        np.testing.assert_array_less(apart, 1e-13 * np.abs(jacobian) @ np.abs([*x, *u]))
        assert fmu.getReal(wing.states) == x.tolist()
    with pytest.raises(FMICallException):  # health changes the modes
        fmu.getDirectionalDerivative(unknowns, [place["health.z1"]], [1.0])
    poles = np.linalg.eigvals(jacobian[:STATES, :STATES])
    circular = np.sort(np.abs(poles[poles.imag > 0]))[:6] / (2 * np.pi)
    frequencies = [place[f"frequency[{i}]"] for i in range(1, 7)]
    np.testing.assert_allclose(circular, fmu.getReal(frequencies), rtol=1e-10)


def test_loads_in_straight_lines_are_those_of_the_linear_system(
    wing: Wing, slave: Slave, ours: OurFmus
) -> None:
    """The co-simulation FMU along ramps, against the matrix exponential of what model exchange gives."""
    names = ("strain[1]", "strain[13]", "tip_displacement")
    jacobian = wing.jacobian(*names)
    given = {name.replace(".", "__"): value for name, value in START.items()}
    assert slave.start(response=2, **given, health__z1=0.3) == OK
    x, load = np.array(wing.fmu.getReal(wing.states)), np.array(wing.fmu.getReal(wing.inputs))
    places, time = [slave.reference[name] for name in ("load_factor", "tip_force")], 0.0
    for size, slope in ((0.02, (40.0, -100.0)), (0.3, (-5.0, 20.0)), (0.1, (0.0, 0.0))):
        block = np.zeros((STATES + 4, STATES + 4))
        block[:STATES, : STATES + 2] = jacobian[:STATES]
        block[STATES : STATES + 2, STATES + 2 :] = np.eye(2)
        x = (expm(block * size) @ [*x, *load, *slope])[:STATES]
        slave.fmu.setRealInputDerivatives(
            (ctypes.c_uint * 2)(*places), (ctypes.c_int * 2)(1, 1), (ctypes.c_double * 2)(*slope)
        )
        kept = slave.saved()
        assert slave.status_of(slave.fmu.doStep, time, size) == OK
        once = slave.everything()
        assert slave.restore(kept) == OK
        assert slave.status_of(slave.fmu.doStep, time, size) == OK
        assert slave.everything() == once  # the slopes are part of the state
        time, load = time + size, load + size * np.array(slope)
        seen, expected = [slave.of(name) for name in names], jacobian[STATES:] @ [*x, *load]
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        np.testing.assert_allclose(slave.fmu.getReal(places), load, rtol=1e-14)
    lines = changed(WING, header={"step_size": 0.02, "interpolation": "linear"})
    with FmiAsset(ours("compiled"), lines, parameters=MOVING, isolated=False) as asset:
        asset.reset(health={"z1": 0.3})
        low, high = asset.input_range("control", "load_factor")
        assert asset.step({"load_factor": high}).time == 0.02  # to the edge of the range
        assert asset.step({"load_factor": low}, {"z1": 0.4}).time == 0.04


def test_health_is_discrete_and_wrong_calls_are_refused(wing: Wing) -> None:
    fmu, z1, load = wing.fmu, [wing.place["health.z1"]], [wing.place["load_factor"]]
    before = fmu.getReal(wing.strains)
    assert wing.status_of("setReal", z1, [0.5]) == DISCARD
    assert wing.status_of("setReal", load, [99.0]) == OK
    assert wing.status_of("getReal", wing.strains) == DISCARD  # out of range
    fmu.setReal(load, [1.0])
    assert fmu.getReal(wing.strains) == before
    fmu.enterEventMode()
    fmu.setReal(z1, [0.5])
    assert fmu.newDiscreteStates()[3]
    fmu.enterContinuousTimeMode()
    assert fmu.getReal(wing.strains) != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert fmu.getReal([wing.place["tip_displacement"]])[0] != 0.0
    assert not fmu.newDiscreteStates()[3]
