"""A step of the compiled FMU: in process, through the worker, bare, beside an FMU that computes nothing."""

from __future__ import annotations

import ctypes
import itertools
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fmpy import simulate_fmu
from fmpy.fmi2 import FMU2Slave

from benchmarks.measurement import Measurement, median_seconds
from fe.cache import reduced_model
from fmu_asset.archive import extract_fmu, read_fmu
from fmu_asset.binding import Binding, load_binding
from fmu_asset.build import build_fmu
from fmu_asset.compiled.compiler import compile_library, find_compiler
from fmu_asset.compiled.package import fmi_headers
from fmu_asset.errors import FmuBuildError
from fmu_asset.session import FmiAsset

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
# Many short batches: on a busy machine an interruption spoils one of them and not the median.
REPEATS, INNER = 400, 20
LEVELS = 400
SIMULATED_STEPS = 10_000


def run() -> list[Measurement]:
    """Measure a step with another health at every step, and what it consists of."""
    try:
        find_compiler()
    except FmuBuildError as error:
        print(error)
        return []
    model = reduced_model()
    binding = load_binding(BINDING)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        compiled = build_fmu(model, folder / "compiled.fmu", kind="compiled").path
        python = build_fmu(model, folder / "python.fmu").path
        minimal = _minimal_fmu(compiled, folder / "minimal.fmu")
        bare = {path: _bare(path) for path in (compiled, minimal)}
        same_health = _bare(compiled, levels=1)
        transient = _bare(compiled, response=2)
        transient_same_health = _bare(compiled, response=2, levels=1)
        in_process = {p: _asset(p, binding, isolated=False) for p in (compiled, minimal, python)}
        isolated = {p: _asset(p, binding, isolated=True) for p in (compiled, minimal, python)}
        simulated = {p: _simulate(p) for p in (compiled, minimal, python)}
        building = median_seconds(
            lambda: build_fmu(model, folder / "again.fmu", kind="compiled", replace=True), repeats=3
        )
    empty, slow = "an FMU that computes nothing", "Python FMU"
    return [
        Measurement(
            "compiled FMU step in process", in_process[compiled], "us", 8.0, empty, in_process[minimal]
        ),
        Measurement(
            "the same, beside the Python FMU", in_process[compiled], "us", None, slow, in_process[python]
        ),
        Measurement(
            "compiled FMU step through the worker", isolated[compiled], "us", None, empty, isolated[minimal]
        ),
        Measurement(
            "the same, beside the Python FMU", isolated[compiled], "us", None, slow, isolated[python]
        ),
        Measurement("compiled FMU step, bare ctypes calls", bare[compiled], "us", None, empty, bare[minimal]),
        Measurement("the same, health unchanged", same_health, "us", None, empty, bare[minimal]),
        Measurement(
            "the same, transient, health unchanged", transient_same_health, "us", None, empty, bare[minimal]
        ),
        Measurement("the same, transient, other health", transient, "us", None, empty, bare[minimal]),
        Measurement(
            f"fmpy.simulate_fmu, {SIMULATED_STEPS} steps",
            simulated[compiled],
            "s",
            None,
            slow,
            simulated[python],
        ),
        Measurement("the same, an FMU that computes nothing", simulated[minimal], "s"),
        Measurement("build, compiler included", building, "s"),
    ]


def _microseconds(function: Callable[[], object]) -> float:
    return 1e6 * median_seconds(function, repeats=REPEATS, inner=INNER)


def _asset(path: Path, binding: Binding, *, isolated: bool) -> float:
    """Time a step as the master makes it, with all its checks."""
    damage = itertools.cycle(range(LEVELS))
    with FmiAsset(path, binding, isolated=isolated) as asset:

        def step() -> None:
            asset.step({"load_factor": 3.0}, {"z1": 0.001 * next(damage), "z2": 0.2})

        return _microseconds(step)


def _bare(path: Path, *, response: int = 1, levels: int = LEVELS) -> float:
    """Time set, step and get through ctypes alone, with blocks that are allocated once."""
    description = read_fmu(path)
    folder = extract_fmu(description)
    references = {variable.name: variable.reference for variable in description.variables}
    names = [*(f"strain[{gauge}]" for gauge in range(1, 25)), "tip_displacement", "strain_error_bound"]
    inputs = (ctypes.c_uint * 4)(
        *(references[n] for n in ("load_factor", "health.z1", "health.z2", "tip_force"))
    )
    outputs = (ctypes.c_uint * len(names))(*(references[name] for name in names))
    request, reply = (ctypes.c_double * 4)(3.0, 0.0, 0.2, 0.0), (ctypes.c_double * len(names))()
    slave = FMU2Slave(
        guid=description.guid, modelIdentifier=description.model_identifier, unzipDirectory=str(folder)
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.setInteger([references["response"]], [response])
    slave.exitInitializationMode()
    put, do, get = slave.dll.fmi2SetReal, slave.dll.fmi2DoStep, slave.dll.fmi2GetReal
    component, count = slave.component, itertools.count()

    def step() -> None:
        index = next(count)
        request[1] = 0.001 * (index % levels)
        put(component, inputs, 4, request)
        do(component, float(index), 1.0, 1)
        get(component, outputs, len(names), reply)

    try:
        return _microseconds(step)
    finally:
        slave.terminate()
        slave.freeInstance()
        shutil.rmtree(folder)


def _simulate(path: Path) -> float:
    """Time fmpy's own simulation with an input that changes at every step, extraction and start included."""
    steps = np.arange(SIMULATED_STEPS + 1)
    names = ("time", "load_factor", "health.z1", "health.z2", "tip_force")
    course = np.zeros(len(steps), dtype=[(name, "f8") for name in names])
    course["time"], course["load_factor"], course["health.z1"] = steps, 3.0, 0.001 * (steps % LEVELS)
    outputs = [*(f"strain[{gauge}]" for gauge in range(1, 25)), "tip_displacement", "strain_error_bound"]
    return median_seconds(
        lambda: simulate_fmu(
            str(path),
            stop_time=float(SIMULATED_STEPS),
            step_size=1.0,
            output_interval=1.0,
            input=course,
            output=outputs,
            fmi_type="CoSimulation",
        ),
        repeats=3,
    )


def _minimal_fmu(wing: Path, target: Path) -> Path:
    """Write an FMU with the wing's interface that computes nothing."""
    source = Path(__file__).with_name("minimal_fmu.c").read_bytes()
    library = compile_library(fmi_headers() | {"minimal_fmu.c": source})
    with zipfile.ZipFile(wing) as archive, zipfile.ZipFile(target, "w") as copy:
        for name in archive.namelist():
            content = archive.read(name)
            copy.writestr(name, library if name.startswith("binaries/") else content)
    return target
