"""References for the speed of the master: bare ctypes calls, fmpy, and an empty FMU."""

import ctypes
import itertools
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import simulate_fmu
from fmpy.fmi2 import FMU2Slave

from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.compiled.compiler import compile_library
from fmu_asset.compiled.package import fmi_headers

LEVELS = 400
"""How many levels of damage follow one another."""

OUTPUTS = (
    *(f"strain[{gauge}]" for gauge in range(1, 25)),
    "tip_displacement",
    "strain_error_bound",
)
_INPUTS = ("load_factor", "health.z1", "health.z2", "tip_force")


@contextmanager
def bare_step(
    path: Path, *, response: int = 1, levels: int = LEVELS
) -> Iterator[Callable[[], None]]:
    """Give a function that makes one FMU step by bare ctypes calls on preallocated arrays.

    Parameters
    ----------
    path : Path
        A wing FMU, or one with its interface.
    response : int
        1 quasi-static, 2 transient.
    levels : int
        Levels of damage that follow one another.
    """
    description = read_fmu(path)
    folder = extract_fmu(description)
    references = {variable.name: variable.reference for variable in description.variables}
    inputs = (ctypes.c_uint * len(_INPUTS))(*(references[name] for name in _INPUTS))
    outputs = (ctypes.c_uint * len(OUTPUTS))(*(references[name] for name in OUTPUTS))
    request, reply = (ctypes.c_double * 4)(3.0, 0.0, 0.2, 0.0), (ctypes.c_double * len(OUTPUTS))()
    slave = FMU2Slave(
        guid=description.guid,
        modelIdentifier=description.model_identifier,
        unzipDirectory=str(folder),
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.setInteger([references["response"]], [response])
    slave.exitInitializationMode()
    put = slave.dll.fmi2SetReal
    do = slave.dll.fmi2DoStep
    get = slave.dll.fmi2GetReal
    component = slave.component
    count = itertools.count()

    def step() -> None:
        index = next(count)
        request[1] = 0.001 * (index % levels)
        put(component, inputs, 4, request)
        do(component, float(index), 1.0, 1)
        get(component, outputs, len(OUTPUTS), reply)

    try:
        yield step
    finally:
        slave.terminate()
        slave.freeInstance()
        shutil.rmtree(folder)


def fmpy_simulation(path: Path, steps: int) -> Any:
    """Simulate with fmpy under an input that changes at every step, extraction and start included.

    Returns
    -------
    (steps + 1,) structured ndarray
        Time and `OUTPUTS`.
    """
    moments = np.arange(steps + 1)
    course = np.zeros(len(moments), dtype=[(name, "f8") for name in ("time", *_INPUTS)])
    course["time"] = moments
    course["load_factor"] = 3.0
    course["health.z1"] = 0.001 * (moments % LEVELS)
    return simulate_fmu(
        str(path),
        stop_time=float(steps),
        step_size=1.0,
        output_interval=1.0,
        input=course,
        output=list(OUTPUTS),
        fmi_type="CoSimulation",
    )


def minimal_fmu(wing: Path, target: Path) -> Path:
    """Write an FMU with the wing's interface that computes nothing."""
    source = Path(__file__).with_name("minimal_fmu.c").read_bytes()
    library = compile_library(fmi_headers() | {"minimal_fmu.c": source})
    with zipfile.ZipFile(wing) as archive, zipfile.ZipFile(target, "w") as copy:
        for name in archive.namelist():
            content = archive.read(name)
            copy.writestr(name, library if name.startswith("binaries/") else content)
    return target
