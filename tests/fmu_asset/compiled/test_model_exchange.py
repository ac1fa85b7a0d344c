"""The compiled wing for model exchange: its states under CVODE are the motion of the co-simulation one."""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from fmpy.validation import validate_fmu
from scipy.linalg import expm

from fe.runtime.reduced import ReducedModel
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.check import check_fmu
from fmu_asset.compiled.package import STATES as STATE_NAMES
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu
from tests.kept import compiled_wing

STATES = 16
HALF = STATES // 2
DISCARD = 2
MOVING = {"damping_alpha": 2.0, "damping_beta": 2e-4, "initial_tip_displacement": 0.05, "response": 2.0}


@pytest.fixture(scope="module")
def exchange(compiler: list[str], model: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled_wing(model, tmp_path_factory.mktemp("exchange"), interface="model-exchange")


@pytest.fixture(scope="module")
def exchange3(compiler: list[str], model: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled_wing(model, tmp_path_factory.mktemp("exchange3"), fmi=3, interface="model-exchange")


@pytest.fixture
def wing(exchange: Path) -> Iterator[tuple[FMU2Model, dict[str, int]]]:
    """An instance in continuous time, damped and released, and its value references."""
    described = read_fmu(exchange)
    folder = extract_fmu(described)
    made = FMU2Model(
        guid=described.guid, modelIdentifier=described.model_identifier, unzipDirectory=str(folder)
    )
    reference = {variable.name: variable.reference for variable in described.variables}
    made.instantiate()
    made.setupExperiment(startTime=0.0)
    made.enterInitializationMode()
    names = ("damping.alpha", "damping.beta", "initial_tip_displacement", "health.z1")
    made.setReal([reference[name] for name in names], [1.5, 3e-4, 0.05, 0.3])
    made.exitInitializationMode()
    made.newDiscreteStates()
    made.enterContinuousTimeMode()
    yield made, reference
    made.freeInstance()
    shutil.rmtree(folder)


def test_nothing_is_found_to_complain_of(exchange: Path, exchange3: Path) -> None:
    for fmu in (exchange, exchange3):
        assert validate_fmu(str(fmu)) == []
        assert read_fmu(fmu).states == STATES
    assert check_fmu(exchange3, cycles=20).problems == ()


def test_fmi_3_gives_the_numbers_of_fmi_2(exchange3: Path, wing: tuple[FMU2Model, dict[str, int]]) -> None:
    """To the last bit: states, rates, outputs and derivatives, before and after an event."""
    two, reference = wing
    described = read_fmu(exchange3)
    folder = extract_fmu(described)
    place = {variable.name: variable.reference for variable in described.variables}
    three = FMU3Model(
        guid=described.guid, modelIdentifier=described.model_identifier, unzipDirectory=str(folder)
    )
    three.instantiate()
    three.enterInitializationMode(startTime=0.0)
    names = ("damping.alpha", "damping.beta", "initial_tip_displacement", "health")
    three.setFloat64([place[name] for name in names], [1.5, 3e-4, 0.05, 0.3, 0.0])
    three.exitInitializationMode()
    three.updateDiscreteStates()
    three.enterContinuousTimeMode()
    assert three.getNumberOfContinuousStates() == STATES
    assert three.getNumberOfEventIndicators() == 0
    rng = np.random.default_rng(3)
    for loss in (0.3, 0.5, 0.5):
        for fmu in (two, three):
            fmu.enterEventMode()
        two.setReal([reference["health.z1"]], [loss])
        three.setFloat64([place["health"]], [loss, 0.0])
        assert two.newDiscreteStates()[3] == three.updateDiscreteStates()[3]
        x, load = rng.normal(size=STATES), float(rng.uniform(0.5, 3.0))
        for fmu in (two, three):
            fmu.enterContinuousTimeMode()
            fmu.setTime(1.0)
            fmu.setContinuousStates((ctypes.c_double * STATES)(*x), STATES)
        two.setReal([reference["load_factor"]], [load])
        three.setFloat64([place["load_factor"]], [load])
        rates = (ctypes.c_double * STATES)(), (ctypes.c_double * STATES)()
        two.getDerivatives(rates[0], STATES)
        three.getContinuousStateDerivatives(rates[1], STATES)
        assert list(rates[0]) == list(rates[1])
        moving = [place["modal_displacement"], place["modal_velocity"]]
        assert three.getFloat64(moving, STATES) == x.tolist()
        assert three.getFloat64([place[f"der({name})"] for name in STATE_NAMES], STATES) == list(rates[1])
        seen = two.getReal([reference[f"strain[{i}]"] for i in range(1, 25)])
        assert three.getFloat64([place["strain"]], 24) == seen
        assert three.getFloat64([place["time"]]) == [1.0]
        column = two.getDirectionalDerivative(
            [reference[f"der(modal_velocity[{i}])"] for i in range(1, HALF + 1)],
            [reference["modal_displacement[2]"]],
            [1.0],
        )
        direction = np.eye(HALF)[1].tolist()
        knowns = [place["modal_displacement"]]
        assert column == three.getDirectionalDerivative(
            [place["der(modal_velocity)"]], knowns, direction, HALF
        )
    three.freeInstance()
    shutil.rmtree(folder)


def test_cvode_moves_it_as_the_co_simulation_moves(exchange: Path, compiled_fmu: Path) -> None:
    """Loads jump and health grows on the way; compared where nothing jumps."""
    start = {"load_factor": 1.0, "initial_tip_displacement": 0.05, "damping.alpha": 1.0, "damping.beta": 1e-4}
    times, losses, factors = (0.0, 0.1, 0.1, 0.2, 0.2, 1.0), (0, 0, 0, 0, 0.4, 0.4), (1, 1, 2, 2, 2, 2)
    columns = [(name, float) for name in ("time", "health.z1", "load_factor")]
    course = np.array([*zip(times, losses, factors, strict=True)], dtype=columns)
    names = ["strain[1]", "strain[20]", "tip_displacement", "load_point_displacement"]
    flown = {
        path: simulate_fmu(path, stop_time=0.4, output_interval=0.005, output=names, input=course, **options)
        for path, options in (
            (exchange, {"start_values": start, "relative_tolerance": 1e-10}),
            (compiled_fmu, {"start_values": start | {"response": 2}, "step_size": 0.005}),
        )
    }
    theirs = flown[compiled_fmu]
    smooth = ~np.isin(np.round(theirs["time"], 6), [0.1, 0.2])
    for name in names:
        ours = np.interp(theirs["time"], flown[exchange]["time"], flown[exchange][name])
        np.testing.assert_allclose(
            ours[smooth], theirs[name][smooth], rtol=0, atol=1e-6 * np.abs(theirs[name]).max()
        )


def elementwise(binding: Binding) -> Binding:
    """Return the binding of FMI 2 with health as elements of the array that it is in FMI 3."""
    health = {
        name: item.model_copy(update={"variable": f"health[{number}]"})
        for number, (name, item) in enumerate(binding.health.items(), 1)
    }
    header = binding.binding.model_copy(update={"fmi_version": "3.0"})
    return binding.model_copy(update={"health": health, "binding": header})


def test_our_door_flies_all_alike(
    exchange: Path, exchange3: Path, compiled_fmu: Path, binding: Binding
) -> None:
    rng = np.random.default_rng(2)
    settings = binding.binding.model_copy(update={"step_size": 0.01, "tolerance": 1e-9})
    slow = binding.model_copy(update={"binding": settings})
    with (
        FmiAsset(exchange, slow, parameters=MOVING, isolated=False) as one,
        FmiAsset(exchange3, elementwise(slow), parameters=MOVING, isolated=False) as three,
        FmiAsset(compiled_fmu, slow, parameters=MOVING, isolated=False) as two,
    ):
        for index in range(20):
            control = {"load_factor": float(rng.uniform(-1, 4))}
            health = {"z1": 0.04 * (index // 5), "z2": 0.02 * (index // 3)}
            seen = [asset.step(control, health).values for asset in (one, two, three)]
            np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-6 * np.abs(seen[1]).max())
            assert seen[2].tobytes() == seen[0].tobytes()


def test_rates_and_outputs_are_linear_with_the_derivatives_that_it_gives(
    wing: tuple[FMU2Model, dict[str, int]],
) -> None:
    fmu, reference = wing
    modes = range(1, STATES // 2 + 1)
    states = [reference[f"modal_{what}[{i}]"] for what in ("displacement", "velocity") for i in modes]
    rates = [reference[f"der(modal_{what}[{i}])"] for what in ("displacement", "velocity") for i in modes]
    names = ("strain[1]", "strain[13]", "tip_displacement", "load_point_displacement")
    outputs = [reference[name] for name in names]
    inputs = [reference["load_factor"], reference["tip_force"]]
    unknowns, knowns = [*rates, *outputs], [*states, *inputs]
    columns = [fmu.getDirectionalDerivative(unknowns, [known], [1.0]) for known in knowns]
    jacobian = np.array(columns).T
    rng = np.random.default_rng(1)
    for _ in range(3):
        x, u = rng.normal(size=STATES), rng.uniform(0.5, 3.0, 2)
        fmu.setReal(inputs, u.tolist())
        fmu.setContinuousStates((np.ctypeslib.ctypes.c_double * STATES)(*x), STATES)
        expected = jacobian @ [*x, *u]
        seen = np.array(fmu.getReal(unknowns))
        scale = np.abs(jacobian) @ np.abs([*x, *u])
        np.testing.assert_array_less(np.abs(seen - expected), 1e-13 * scale)
        assert fmu.getReal(states) == x.tolist()
    with pytest.raises(FMICallException):  # health changes the modes
        fmu.getDirectionalDerivative(unknowns, [reference["health.z1"]], [1.0])
    frequencies = [reference[f"frequency[{i}]"] for i in range(1, 7)]
    poles = np.linalg.eigvals(jacobian[:STATES, :STATES])
    circular = np.sort(np.abs(poles[poles.imag > 0]))[:6] / (2 * np.pi)
    np.testing.assert_allclose(circular, fmu.getReal(frequencies), rtol=1e-10)


def test_loads_in_straight_lines_are_those_of_the_linear_system(
    wing: tuple[FMU2Model, dict[str, int]], slave: Any, compiled_fmu: Path, binding: Binding
) -> None:
    """The co-simulation FMU along ramps, against the matrix exponential of what model exchange gives."""
    fmu, reference = wing
    modes = range(1, HALF + 1)
    states = [reference[f"{name}[{i}]"] for name in STATE_NAMES for i in modes]
    rates = [reference[f"der({name}[{i}])"] for name in STATE_NAMES for i in modes]
    names = ("strain[1]", "strain[13]", "tip_displacement")
    outputs = [reference[name] for name in names]
    inputs = [reference["load_factor"], reference["tip_force"]]
    known = [*states, *inputs]
    unknowns = [*rates, *outputs]
    jacobian = np.array([fmu.getDirectionalDerivative(unknowns, [one], [1.0]) for one in known]).T
    motion, shown = jacobian[:STATES], jacobian[STATES:]
    parameters = {"damping__alpha": 1.5, "damping__beta": 3e-4, "initial_tip_displacement": 0.05}
    assert slave.start(response=2, **parameters, health__z1=0.3) == 0
    x, load = np.array(fmu.getReal(states)), np.array(fmu.getReal(inputs))
    places, time = [slave.reference[name] for name in ("load_factor", "tip_force")], 0.0
    for size, slope in ((0.02, (40.0, -100.0)), (0.3, (-5.0, 20.0)), (0.1, (0.0, 0.0))):
        block = np.zeros((STATES + 4, STATES + 4))
        block[:STATES, : STATES + 2], block[STATES : STATES + 2, STATES + 2 :] = motion, np.eye(2)
        x = (expm(block * size) @ [*x, *load, *slope])[:STATES]
        slave.fmu.setRealInputDerivatives(
            (ctypes.c_uint * 2)(*places), (ctypes.c_int * 2)(1, 1), (ctypes.c_double * 2)(*slope)
        )
        kept = slave.saved()
        assert slave.status_of(slave.fmu.doStep, time, size) == 0
        once = slave.everything()
        assert slave.restore(kept) == 0
        assert slave.status_of(slave.fmu.doStep, time, size) == 0
        assert slave.everything() == once  # the slopes are part of the state
        time, load = time + size, load + size * np.array(slope)
        seen = slave.fmu.getReal([slave.reference[name] for name in names])
        expected = shown @ [*x, *load]
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        np.testing.assert_allclose(slave.fmu.getReal(places), load, rtol=1e-14)
    slow = binding.model_copy(update={"binding": binding.binding.model_copy(update={"step_size": 0.02})})
    linear = slow.with_header(interpolation="linear")
    with FmiAsset(compiled_fmu, linear, parameters=MOVING, isolated=False) as asset:
        asset.reset(health={"z1": 0.3})
        low, high = asset.input_range("control", "load_factor")
        assert asset.step({"load_factor": high}).time == 0.02  # to the edge of the range
        assert asset.step({"load_factor": low}, {"z1": 0.4}).time == 0.04


def test_health_is_discrete_and_wrong_calls_are_refused(wing: tuple[FMU2Model, dict[str, int]]) -> None:
    fmu, reference = wing

    def status_of(*call: object) -> int:
        try:
            getattr(fmu, str(call[0]))(*call[1:])
        except FMICallException as error:
            return int(error.status)
        return 0

    z1, strains = [reference["health.z1"]], [reference[f"strain[{i}]"] for i in range(1, 25)]
    before = fmu.getReal(strains)
    assert status_of("setReal", z1, [0.5]) == DISCARD
    assert status_of("setReal", [reference["load_factor"]], [99.0]) == 0
    assert status_of("getReal", strains) == DISCARD  # out of range
    fmu.setReal([reference["load_factor"]], [1.0])
    assert fmu.getReal(strains) == before
    fmu.enterEventMode()
    fmu.setReal(z1, [0.5])
    *_, states_changed, _, _ = fmu.newDiscreteStates()
    assert states_changed
    fmu.enterContinuousTimeMode()
    after = fmu.getReal(strains)
    assert after != before
    # The structure stays where it is, as far as the modes that are kept can say.
    assert fmu.getReal([reference["tip_displacement"]])[0] != 0.0
    assert not fmu.newDiscreteStates()[3]


@pytest.mark.parametrize("options", [{}, {"fmi": 3}])
def test_what_it_cannot_be_is_refused(model: ReducedModel, tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(FmuBuildError, match="build the kind 'compiled'"):
        build_fmu(model, tmp_path / "wing.fmu", kind="python", interface="model-exchange", **options)
