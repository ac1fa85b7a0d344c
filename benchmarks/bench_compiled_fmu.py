"""Steps of the compiled FMU in process and in its worker, beside an FMU without computation."""

import itertools
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from benchmarks.bare_fmu import LEVELS, bare_step, fmpy_simulation, minimal_fmu
from benchmarks.measurement import (
    Measurement,
    NotAvailableError,
    least_seconds,
    least_seconds_of,
)
from fe.reduction.model_cache import reduced_model
from fmu_asset.client.binding import load_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
SIMULATED_STEPS = 10_000


def run() -> list[Measurement]:
    """Measure the least time of each kind of step; most steps have another health than the last."""
    try:
        find_compiler()
    except FmuBuildError as error:
        raise NotAvailableError(str(error)) from None
    model = reduced_model()
    binding = load_binding(BINDING)
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        folder = Path(place)
        compiled = build_fmu(model, folder / "compiled.fmu", kind="compiled").path
        python = build_fmu(model, folder / "python.fmu").path
        minimal = minimal_fmu(compiled, folder / "minimal.fmu")
        bare = {
            "wing": (compiled, 1, LEVELS),
            "empty": (minimal, 1, LEVELS),
            "same health": (compiled, 1, 1),
            "transient": (compiled, 2, LEVELS),
            "transient, same health": (compiled, 2, 1),
        }
        in_row: dict[str, Callable[[], object]] = {
            name: stack.enter_context(bare_step(path, response=response, levels=levels))
            for name, (path, response, levels) in bare.items()
        }
        through_worker: dict[str, Callable[[], object]] = {}
        for name, path in (("wing", compiled), ("empty", minimal), ("python", python)):
            for kind, steps in (("in process", in_row), ("worker", through_worker)):
                asset = stack.enter_context(FmiAsset(path, binding, isolated=kind == "worker"))
                steps[f"{kind} {name}"] = _stepper(asset)
        # Long batches, as in a simulation: the first steps after other code find cold caches.
        seconds = least_seconds(in_row, repeats=100, inner=200)
        seconds |= least_seconds(through_worker, repeats=200, inner=20)
        least = {name: 1e6 * value for name, value in seconds.items()}
        simulated = {p: _simulate(p) for p in (compiled, minimal, python)}
        building = least_seconds_of(
            lambda: build_fmu(model, folder / "again.fmu", kind="compiled", replace=True), repeats=3
        )

    def beside(name: str, step: str, reference: str, label: str) -> Measurement:
        return Measurement(name, least[step], "us", None, label, least[reference])

    def ratio(name: str, step: str, reference: str, target: float) -> Measurement:
        return Measurement(name, least[step] / least[reference], "x", target)

    empty, slow = "an FMU that computes nothing", "Python FMU"
    return [
        beside("compiled FMU step in process", "in process wing", "in process empty", empty),
        ratio(
            "compiled FMU step in process, over an empty FMU",
            "in process wing",
            "in process empty",
            1.5,
        ),
        beside(
            "compiled FMU step in process, beside Python",
            "in process wing",
            "in process python",
            slow,
        ),
        beside("compiled FMU step through the worker", "worker wing", "worker empty", empty),
        ratio("compiled FMU step, worker over in process", "worker wing", "in process wing", 2.0),
        beside(
            "compiled FMU step through the worker, beside Python",
            "worker wing",
            "worker python",
            slow,
        ),
        beside("compiled FMU step, bare ctypes calls", "wing", "empty", empty),
        beside("compiled FMU step, bare calls, health unchanged", "same health", "empty", empty),
        beside(
            "transient step, bare calls, health unchanged", "transient, same health", "empty", empty
        ),
        beside("transient step, bare calls, other health", "transient", "empty", empty),
        ratio(
            "transient step, other over unchanged health",
            "transient",
            "transient, same health",
            10.0,
        ),
        Measurement(
            f"fmpy.simulate_fmu, {SIMULATED_STEPS} steps",
            simulated[compiled],
            "s",
            None,
            slow,
            simulated[python],
        ),
        Measurement("fmpy.simulate_fmu, an FMU that computes nothing", simulated[minimal], "s"),
        Measurement("compiled FMU built, compiler included", building, "s"),
    ]


def _stepper(asset: FmiAsset) -> Callable[[], object]:
    """Return a step as the master makes it, with all its checks."""
    damage = itertools.cycle(range(LEVELS))
    return lambda: asset.step({"load_factor": 3.0}, {"z1": 0.001 * next(damage), "z2": 0.2})


def _simulate(path: Path) -> float:
    """Return seconds of fmpy's own simulation, with an input that changes at every step."""
    return least_seconds_of(lambda: fmpy_simulation(path, SIMULATED_STEPS), repeats=3)
