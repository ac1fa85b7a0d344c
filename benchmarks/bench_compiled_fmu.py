"""A step of the compiled FMU: in process, through the worker, bare, beside an FMU that computes nothing."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.bare_fmu import LEVELS, bare_step, fmpy_simulation, minimal_fmu
from benchmarks.measurement import Measurement, median_seconds
from fe.reduction.model_cache import reduced_model
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.wing_fmu import build_fmu

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
# Many short batches: on a busy machine an interruption spoils one of them and not the median.
REPEATS, INNER = 400, 20
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
        minimal = minimal_fmu(compiled, folder / "minimal.fmu")
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
            "compiled FMU step in process", in_process[compiled], "us", None, empty, in_process[minimal]
        ),
        Measurement("the same, times that FMU", in_process[compiled] / in_process[minimal], "1", 1.3),
        Measurement(
            "the same, beside the Python FMU", in_process[compiled], "us", None, slow, in_process[python]
        ),
        Measurement(
            "compiled FMU step through the worker", isolated[compiled], "us", None, empty, isolated[minimal]
        ),
        Measurement(
            "the same, times the step in process", isolated[compiled] / in_process[compiled], "1", 2.0
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
        Measurement("the same, times that of unchanged health", transient / transient_same_health, "1", 5.0),
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
    """Time set, step and get through ctypes alone."""
    with bare_step(path, response=response, levels=levels) as step:
        return _microseconds(step)


def _simulate(path: Path) -> float:
    """Time fmpy's own simulation with an input that changes at every step, extraction and start included."""
    return median_seconds(lambda: fmpy_simulation(path, SIMULATED_STEPS), repeats=3)
