"""The compiled wing of FMI 3.0: the numbers of that of FMI 2.0, arrays, and exact derivatives in both."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from fmpy.fmi3 import FMU3Slave, fmi3IntermediateUpdateCallback, fmi3LogMessageCallback
from scipy.linalg import eigh

from fe.runtime.reduced import ReducedModel
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave, instantiated

HEALTH, INPUTS = 1, {"load_factor": 0, "tip_force": 3, "young_modulus_factor": 4, "servo": 7, "pitot": 8}
STRAIN, TIP, BOUND, STATUS, LOAD_POINT, FREQUENCY, DAMPING_RATIO = 11, 35, 36, 37, 38, 39, 45
GAUGES = 24


class Wing:
    """An instance in this process: every call gives its status, and the log is kept."""

    def __init__(self, fmu: Any, log: list[str]) -> None:
        self.fmu, self.log = fmu, log

    def call(self, name: str, *arguments: Any) -> int:
        return int(getattr(self.fmu.dll, f"fmi3{name}")(self.fmu.component, *arguments))

    def start(self, *, response: int = 1, damping: tuple[float, ...] = (), **values: float) -> None:
        self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.setInt64([10], [response])
        self.fmu.setFloat64([5, 6][: len(damping)], damping)
        for name, value in values.items():
            self.fmu.setFloat64([INPUTS[name]], [value])
        self.fmu.exitInitializationMode()

    def step(
        self, load_factor: float, health: list[float], tip_force: float, time: float, size: float
    ) -> None:
        self.fmu.setFloat64([HEALTH, 0, 3], [*health, load_factor, tip_force])
        self.fmu.doStep(time, size)

    def everything(self) -> list[float]:
        count = GAUGES + 3 + 12
        return self.fmu.getFloat64([STRAIN, TIP, BOUND, LOAD_POINT, FREQUENCY, DAMPING_RATIO], count)

    def derivative(self, unknowns: Any, knowns: Any, seed: Any, size: int, kind: str = "Directional") -> Any:
        result, seeds = (ctypes.c_double * size)(), (ctypes.c_double * len(seed))(*seed)
        references: list[Any] = []
        for each in (unknowns, knowns):
            references += [(ctypes.c_uint * len(each))(*each), len(each)]
        status = self.call(f"Get{kind}Derivative", *references, seeds, len(seed), result, size)
        return np.array(result) if status == OK else status


@pytest.fixture
def wing3(ours: OurFmus) -> Iterator[Wing]:
    log: list[str] = []
    callback = fmi3LogMessageCallback(lambda _, status, __, text: log.append(text.decode()))
    with instantiated(FMU3Slave, ours("fmi3"), logMessage=callback) as (fmu, _):
        yield Wing(fmu, log)


@pytest.mark.parametrize("response", [1, 2], ids=["steady", "transient"])
def test_it_gives_the_numbers_of_the_wing_of_fmi_2(wing3: Wing, slave: Slave, response: int) -> None:
    """To the last bit, all outputs, under random health, loads and steps."""
    rng, time = np.random.default_rng(5), 0.0
    wing3.start(response=response)
    assert slave.start(response=response) == OK
    for _ in range(40):
        *health, load_factor, tip_force = rng.uniform([0, 0, -1, -20], [0.8, 0.8, 4, 20]).tolist()
        size = float(rng.choice([1e-3, 0.1, 1.0]))
        wing3.step(load_factor, health, tip_force, time, size)
        assert slave.step([load_factor, *health, tip_force], time, size) == OK
        time += size
        assert wing3.everything() == slave.everything()[10:]
        assert wing3.fmu.getFloat64([49 + 2]) == [time]
    assert wing3.fmu.getFloat64([HEALTH], 2) == health


# ---------------------------------------------------------------- derivatives

AT = {"young_modulus_factor": 1.05, "z1": 0.3, "z2": 0.55, "load_factor": 2.5, "tip_force": -7.0}
"""Where the derivatives are taken."""


def direction(name: str) -> tuple[list[int], list[float]]:
    """Value references and seed for a change of one value."""
    if name in ("z1", "z2"):
        return [HEALTH], [float(name == each) for each in ("z1", "z2")]
    return [INPUTS[name]], [1.0]


def outputs(model: ReducedModel, at: dict[str, complex]) -> np.ndarray:
    """Strains, tip and load point displacement at equilibrium: the reduced model in complex numbers."""
    theta = np.array([at["young_modulus_factor"], 1 - at["z1"], 1 - at["z2"], 1.0])
    stiffness = np.tensordot(theta, model.static_stiffness, 1)
    load = at["load_factor"] * model.static_load[0] + at["tip_force"] * model.static_load[1]
    return np.vstack((model.static_output, model.static_load[1])) @ np.linalg.solve(stiffness, load)


def complex_step(model: ReducedModel, name: str) -> np.ndarray:
    return outputs(model, AT | {name: AT[name] + 1e-30j}).imag / 1e-30


def frequencies(model: ReducedModel, at: dict[str, float]) -> np.ndarray:
    theta = [at["young_modulus_factor"], 1 - at["z1"], 1 - at["z2"], 1.0]
    mass = np.tensordot([1.0, at["servo"], at["pitot"]], model.modal_mass, 1)
    squares = eigh(np.tensordot(theta, model.modal_stiffness, 1), mass, eigvals_only=True)[:6]
    return np.sqrt(squares) / (2 * np.pi)


def slope(function: Callable[[float], np.ndarray], at: float, h: float = 1e-3) -> np.ndarray:
    """Differences of sixth order."""
    weights = {1: 0.75, 2: -0.15, 3: 1 / 60}
    return sum(w * (function(at + k * h) - function(at - k * h)) for k, w in weights.items()) / h


def flown(wing3: Wing, response: int = 1) -> Wing:
    wing3.start(response=response, young_modulus_factor=AT["young_modulus_factor"])
    wing3.step(AT["load_factor"], [AT["z1"], AT["z2"]], AT["tip_force"], 0.0, 1.0)
    return wing3


@pytest.mark.parametrize("name", AT)
def test_static_derivatives_are_those_of_a_complex_step(wing3: Wing, model: ReducedModel, name: str) -> None:
    flown(wing3)
    np.testing.assert_allclose(wing3.everything()[:25], outputs(model, AT)[:25], rtol=1e-12)
    seen = wing3.derivative([STRAIN, TIP, LOAD_POINT], *direction(name), 26)
    expected = complex_step(model, name)
    np.testing.assert_allclose(seen, expected, rtol=1e-11, atol=1e-13 * np.abs(expected).max())


def test_modal_derivatives_are_those_of_differences(wing3: Wing, model: ReducedModel) -> None:
    wing3.start(damping=(2.0, 3e-4), young_modulus_factor=AT["young_modulus_factor"])
    wing3.step(1.0, [AT["z1"], AT["z2"]], 0.0, 0.0, 1.0)
    servo, pitot = wing3.fmu.getFloat64([7, 8])
    at = AT | {"servo": servo, "pitot": pitot}
    np.testing.assert_allclose(wing3.fmu.getFloat64([FREQUENCY], 6), frequencies(model, at), rtol=1e-10)

    def damping_ratios(at: dict[str, float]) -> np.ndarray:
        omega = 2 * np.pi * frequencies(model, at)
        return 0.5 * (2.0 / omega + 3e-4 * omega)

    for name in ("young_modulus_factor", "z1", "z2", "servo", "pitot"):
        seen = wing3.derivative([FREQUENCY, DAMPING_RATIO], *direction(name), 12)
        for ours, function in ((seen[:6], lambda at: frequencies(model, at)), (seen[6:], damping_ratios)):
            expected = slope(lambda value: function(at | {name: value}), at[name])  # noqa: B023
            np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    omega = 2 * np.pi * frequencies(model, at)
    np.testing.assert_allclose(
        wing3.derivative([DAMPING_RATIO], [5, 6], [1.0, 0.0], 6), 0.5 / omega, rtol=1e-10
    )
    assert not np.any(wing3.derivative([STRAIN, FREQUENCY], [6], [1.0], 30))


def test_the_adjoint_is_the_transpose(wing3: Wing) -> None:
    flown(wing3)
    rng = np.random.default_rng(3)
    unknowns, knowns = [LOAD_POINT, STRAIN, FREQUENCY, TIP], [HEALTH, 0, 4, 7]
    v, w = rng.normal(size=5), rng.normal(size=1 + GAUGES + 6 + 1)
    forward = wing3.derivative(unknowns, knowns, v, len(w))
    backward = wing3.derivative(unknowns, knowns, w, len(v), "Adjoint")
    assert w @ forward == pytest.approx(backward @ v, rel=1e-12)


def test_fmi_2_gives_the_same_derivatives(wing3: Wing, slave: Slave) -> None:
    flown(wing3)
    reference = slave.reference
    slave.start(young_modulus_factor=AT["young_modulus_factor"])
    slave.step([AT["load_factor"], AT["z1"], AT["z2"], AT["tip_force"]], 0.0, 1.0)
    unknowns = [reference[f"strain[{i}]"] for i in range(1, GAUGES + 1)]
    seen = slave.fmu.getDirectionalDerivative(unknowns, [reference["health.z1"], 0], [0.7, -0.2])
    expected = wing3.derivative([STRAIN], [HEALTH, 0], [0.7, 0.0, -0.2], GAUGES)
    np.testing.assert_array_equal(seen, expected)


def test_in_motion_loads_act_at_once_and_health_is_refused(wing3: Wing) -> None:
    flown(wing3, response=2)
    feed_through = wing3.derivative([STRAIN, TIP, LOAD_POINT], [0], [1.0], 26)
    step = 1e-12  # s; the modes have no time to move
    kept = wing3.fmu.getFMUState()
    shown = []
    for load_factor in (3.0, 2.0):
        wing3.fmu.setFMUState(kept)
        wing3.step(load_factor, [AT["z1"], AT["z2"]], AT["tip_force"], 1.0, step)
        shown.append(np.array(wing3.fmu.getFloat64([STRAIN, TIP, LOAD_POINT], 26)))
    wing3.fmu.freeFMUState(kept)
    scale = np.abs(shown[0]).max()
    np.testing.assert_allclose(feed_through, shown[0] - shown[1], rtol=0, atol=1e-12 * scale)
    assert wing3.derivative([STRAIN], [HEALTH], [1.0, 0.0], GAUGES) == DISCARD
    assert "with respect to health[1] is not offered in motion" in wing3.log[-1]


def test_derivatives_that_there_are_not_are_refused_in_a_sentence(wing3: Wing) -> None:
    assert wing3.derivative([STRAIN], [0], [1.0], GAUGES) == ERROR
    assert "not initialised" in wing3.log[-1]
    flown(wing3)
    for unknown, known, size, sentence in (
        (BOUND, 0, 1, "strain_error_bound with respect to load_factor is not offered"),
        (TIP, 9, 1, "initial_tip_displacement is not offered"),
        (TIP, HEALTH, 1, "one number for each value"),
        (TIP, 0, 2, "one number for each value"),
        (STATUS, 0, 1, "one number for each value"),
        (TIP, 2, 1, "one number for each value"),
    ):
        assert wing3.derivative([unknown], [known], [1.0], size) == DISCARD
        assert sentence in wing3.log[-1]


def test_wrong_calls_are_refused_and_change_nothing(wing3: Wing) -> None:
    flown(wing3)
    before = wing3.everything()
    refs, values = (ctypes.c_uint * 1)(HEALTH), (ctypes.c_double * 3)(0.1, 0.2, 0.3)
    assert wing3.call("SetFloat64", refs, 1, values, 1) == DISCARD
    assert wing3.call("GetFloat64", refs, 1, values, 3) == DISCARD
    assert "not the number that the variables have" in wing3.log[-1]
    assert wing3.call("GetFloat64", (ctypes.c_uint * 1)(2), 1, values, 1) == ERROR
    assert "value reference 2" in wing3.log[-1]
    assert wing3.call("SetFloat64", (ctypes.c_uint * 1)(TIP), 1, values, 1) == DISCARD
    assert wing3.call("GetInt32", refs, 1, (ctypes.c_int32 * 1)(), 1) == DISCARD
    assert wing3.call("EnterEventMode") == DISCARD
    wing3.fmu.setFloat64([HEALTH], [0.95, 0.0])
    flags = [ctypes.byref(ctypes.c_bool()) for _ in range(3)]
    reached = ctypes.c_double()
    step = (ctypes.c_double(1.0), ctypes.c_double(1.0), ctypes.c_bool(True))
    assert wing3.call("DoStep", *step, *flags, ctypes.byref(reached)) == DISCARD
    assert "health[1] = 0.94999999999999996 lies outside its range 0 to 0.85" in wing3.log[-1]
    assert reached.value == 1.0
    assert wing3.everything() == before
    no_update = fmi3IntermediateUpdateCallback()
    for token, path in (("{wrong}", b"x"), (wing3.fmu.guid, b"/nowhere/")):
        words = (b"wing", token.encode(), path, False, False, False, False, None, 0, None)
        assert not wing3.fmu.dll.fmi3InstantiateCoSimulation(*words, wing3.fmu.logMessage, no_update)
    assert "/nowhere//reduced_model.bin" in wing3.log[-1]
