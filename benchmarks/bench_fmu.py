"""An FMU step as the master makes it: set inputs with a new health, step, read 24 strains."""

import itertools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from fmpy.fmi2 import FMU2Slave

from benchmarks.measurement import Measurement, median_seconds
from fe.reduction.model_cache import reduced_model
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.packing.structure_fmu import build_fmu

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
# Many short batches: on a busy machine an interruption spoils one of them and not the median.
REPEATS, INNER = 400, 20
LEVELS = 400


def run() -> list[Measurement]:
    """Measure a step in process and through the worker, beside the list-based calls of fmpy."""
    model = reduced_model()
    binding = load_binding(BINDING)
    with tempfile.TemporaryDirectory() as folder:
        path = build_fmu(model, Path(folder) / "wing.fmu").path
        plain = _fmpy_lists(path)
        in_process = _asset(path, binding, isolated=False)
        isolated = _asset(path, binding, isolated=True)
        opening = median_seconds(lambda: _open_and_close(path, binding), repeats=5)
    damage = itertools.cycle(range(LEVELS))
    alone = _microseconds(
        lambda: model.static_response(
            young_modulus_factor=1.0, stiffness_loss=(0.001 * next(damage), 0.2), load_factor=3.0
        )
    )
    lists = "fmpy, lists, no checks"
    return [
        Measurement("FMU step in process", in_process, "us", 60.0, lists, plain),
        Measurement("FMU step through the worker", isolated, "us", 130.0, lists, plain),
        Measurement("static response of the reduced model", alone, "us", None, lists, plain),
        Measurement("worker started, FMU initialised, closed", 1e3 * opening, "ms"),
    ]


def _microseconds(function: Callable[[], object]) -> float:
    return 1e6 * median_seconds(function, repeats=REPEATS, inner=INNER)


def _asset(path: Path, binding: Binding, *, isolated: bool) -> float:
    damage = itertools.cycle(range(LEVELS))
    with FmiAsset(path, binding, isolated=isolated) as asset:

        def step() -> None:
            asset.step({"load_factor": 3.0}, {"z1": 0.001 * next(damage), "z2": 0.2})

        return _microseconds(step)


def _fmpy_lists(path: Path) -> float:
    """Time the same exchange through fmpy's own convenience calls, in process."""
    description = read_fmu(path)
    folder = extract_fmu(description)
    references = {variable.name: variable.reference for variable in description.variables}
    inputs = [references[name] for name in ("load_factor", "health.z1", "health.z2", "tip_force")]
    outputs = [references[f"strain[{gauge}]"] for gauge in range(1, 25)]
    outputs += [references["tip_displacement"], references["strain_error_bound"]]
    slave = FMU2Slave(
        guid=description.guid,
        modelIdentifier=description.model_identifier,
        unzipDirectory=str(folder),
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    count = itertools.count()

    def step() -> None:
        index = next(count)
        slave.setReal(inputs, [3.0, 0.001 * (index % LEVELS), 0.2, 0.0])
        slave.doStep(float(index), 1.0)
        slave.getReal(outputs)

    try:
        return _microseconds(step)
    finally:
        slave.terminate()
        slave.freeInstance()
        shutil.rmtree(folder)


def _open_and_close(path: Path, binding: Binding) -> None:
    with FmiAsset(path, binding):
        pass
