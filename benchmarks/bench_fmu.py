"""An FMU step as the master makes it: set inputs with a new health, step, read 24 strains."""

import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fmpy.fmi2 import FMU2Slave
from numpy.typing import NDArray

from benchmarks.measurement import Measurement, compared, least_seconds_of, peer_version
from fe.reduction.model_cache import reduced_model
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.packing.structure_fmu import build_fmu

Float = NDArray[np.float64]

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
# Many short batches: on a busy machine an interruption spoils one of them and not the median.
REPEATS, INNER = 400, 20
LEVELS = 400
GAUGES = 24
STATE = {"z1": 0.1, "z2": 0.2}
"""Losses of stiffness at which the strains of both programs are compared."""


def run() -> Iterator[Measurement]:
    """Measure a step in process and through the worker, beside the list-based calls of fmpy."""
    model = reduced_model()
    binding = load_binding(BINDING)
    with tempfile.TemporaryDirectory() as folder:
        path = build_fmu(model, Path(folder) / "wing.fmu").path
        plain, their_strains = _fmpy_lists(path)
        in_process, strains = _asset(path, binding, isolated=False)
        isolated, strains_through_worker = _asset(path, binding, isolated=True)
        opening = least_seconds_of(lambda: _open_and_close(path, binding), repeats=5)
    damage = itertools.cycle(range(LEVELS))
    alone = _microseconds(
        lambda: model.static_response(
            young_modulus_factor=1.0, stiffness_loss=(0.001 * next(damage), 0.2), load_factor=3.0
        )
    )
    lists = "list-based calls, no checks"
    peer = peer_version("fmpy")
    yield Measurement("FMU step in process", in_process, "us", 60.0).beside(
        lists, plain, peer=peer, agreement=compared("strains", strains, their_strains, 1e-12)
    )
    yield Measurement("FMU step through the worker", isolated, "us", 130.0).beside(
        lists,
        plain,
        peer=peer,
        agreement=compared("strains", strains_through_worker, their_strains, 1e-12),
    )
    yield Measurement("static response of the reduced model", alone, "us").beside(lists, plain)
    yield Measurement("worker started, FMU initialised, closed", 1e3 * opening, "ms")


def _microseconds(function: Callable[[], object]) -> float:
    return 1e6 * least_seconds_of(function, repeats=REPEATS, inner=INNER)


def _asset(path: Path, binding: Binding, *, isolated: bool) -> tuple[float, Float]:
    """Return the microseconds of a step as the master makes it, and strains (24,) at `STATE`."""
    damage = itertools.cycle(range(LEVELS))
    with FmiAsset(path, binding, isolated=isolated) as asset:

        def step() -> None:
            asset.step({"load_factor": 3.0}, {"z1": 0.001 * next(damage), "z2": 0.2})

        microseconds = _microseconds(step)
        return microseconds, np.asarray(asset.step({"load_factor": 3.0}, STATE).values)


def _fmpy_lists(path: Path) -> tuple[float, Float]:
    """Return the same by fmpy's own convenience calls, in process."""
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
        microseconds = _microseconds(step)
        slave.setReal(inputs, [3.0, STATE["z1"], STATE["z2"], 0.0])
        slave.doStep(float(next(count)), 1.0)
        return microseconds, np.array(slave.getReal(outputs)[:GAUGES])
    finally:
        slave.terminate()
        slave.freeInstance()
        shutil.rmtree(folder)


def _open_and_close(path: Path, binding: Binding) -> None:
    with FmiAsset(path, binding):
        pass
