"""Sampling of an FMU into an observation library by one process and by two."""

import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement
from fe.reduction.model_cache import reduced_model
from fmu_asset.packing.script import build_script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from scenarios import asset_scripts, binding_files
from twin_master.library.grid import SamplingGrid
from twin_master.library.sampling import sample_library

REPEATS = 5

# Its steps use no processor, so that other work on the machine does not show.
_WAITING = """
import time

from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Waiting(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.load = self.wear = self.shown = 0.0
        for name in ("load", "wear"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("shown", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        time.sleep(0.01)
        self.shown = self.load / (1.0 + self.wear)
        return True
"""
_WAITING_BINDING = """
[binding]
name = "waiting"
step_size = 1.0
[control.load]
variable = "load"
unit = "1"
[health.wear]
variable = "wear"
unit = "1"
[observation.shown]
variables = ["shown"]
unit = "1"
"""


def run() -> Iterator[Measurement]:
    """Measure wing and pump by the least disturbed of alternating runs with one and two processes.

    Beside the wall clock stands what the processor time of the processes says: the speed-up on two
    processors that nobody else uses.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name, grid in (
            ("wing", _wing(place)),
            ("gear pump", _pump(place)),
            ("FMU that waits", _waiting(place)),
        ):
            wall: dict[int, list[float]] = {1: [], 2: []}
            free: dict[int, list[float]] = {1: [], 2: []}
            contents = set()
            for turn in range(REPEATS):
                for workers in (1, 2):
                    begin, own_begin = _children(), time.process_time()
                    out = Path(folder) / f"{name}-{turn}-{workers}.nc"
                    wall[workers].append(sample_library(grid, out, workers=workers).seconds)
                    spent = (_children() - begin) / workers + time.process_time() - own_begin
                    free[workers].append(spent)
                    contents.add(out.read_bytes())
            assert len(contents) == 1
            label = f"{name}, {grid.size} points"
            waits = name == "FMU that waits"
            yield Measurement(
                f"{label}: speed-up by a second process",
                min(wall[1]) / min(wall[2]),
                "x",
                1.7,
                "" if waits else "from processor time",
                None if waits else min(free[1]) / min(free[2]),
                larger_is_better=True,
            )
            yield Measurement(
                f"{label}: two processes, per point", 1e6 * min(wall[2]) / grid.size, "us"
            )


def _children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _wing(folder: Path) -> SamplingGrid:
    levels = tuple(np.linspace(0.0, 0.8, 11).tolist())
    return SamplingGrid(
        fmu=str(build_fmu(reduced_model(), folder / "wing.fmu").path),
        binding=str(binding_files()["uav_wing"]),
        role="strain",
        parameter="young_modulus_factor",
        draws=tuple(np.linspace(0.95, 1.05, 200).tolist()),
        states={"z1": levels, "z2": levels},
        controls={f"{n}g": {"load_factor": float(n)} for n in (1, 2, 3)},
    )


def _pump(folder: Path) -> SamplingGrid:
    return SamplingGrid(
        fmu=str(build_script_fmu(asset_scripts()["gear_pump"], folder / "pump.fmu").path),
        binding=str(binding_files()["gear_pump"]),
        role="operation",
        parameter="viscosity_factor",
        draws=tuple(np.linspace(0.9, 1.1, 300).tolist()),
        states={
            "wear": tuple(np.linspace(0.0, 0.6, 9).tolist()),
            "clogging": tuple(np.linspace(0.0, 0.8, 9).tolist()),
        },
        controls={
            "eco": {"speed": 1000.0, "pressure": 100.0},
            "normal": {"speed": 1500.0, "pressure": 140.0},
            "boost": {"speed": 1800.0, "pressure": 180.0},
        },
    )


def _waiting(folder: Path) -> SamplingGrid:
    (folder / "waiting.py").write_text(_WAITING)
    (folder / "waiting.toml").write_text(_WAITING_BINDING)
    return SamplingGrid(
        fmu=str(build_script_fmu(folder / "waiting.py", folder / "waiting.fmu").path),
        binding=str(folder / "waiting.toml"),
        role="shown",
        parameter="",
        draws=(0.0,),
        states={"wear": tuple(np.linspace(0.0, 1.0, 50).tolist())},
        controls={str(n): {"load": float(n)} for n in range(10)},
    )
