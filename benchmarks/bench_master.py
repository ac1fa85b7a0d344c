"""Overhead of the master over an FMU: a step in process and in its worker, and a simulation."""

import itertools
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.bare_fmu import LEVELS, bare_step, fmpy_simulation, minimal_fmu
from benchmarks.measurement import (
    Agreement,
    Measurement,
    NotAvailableError,
    compared,
    least_seconds,
    peer_version,
)
from fe.reduction.model_cache import reduced_model
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.observations import ObservationHistory
from fmu_asset.client.session import FmiAsset
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu

BINDING = Path(__file__).parents[1] / "scenarios" / "bindings" / "uav_wing.toml"
STEPS = 10_000
SHORT = 500
"""Steps of a simulation that is over before something interrupts it."""


def run() -> list[Measurement]:
    """Measure all in turns in one run; the least times, since other work only adds to them."""
    try:
        find_compiler()
    except FmuBuildError as error:
        raise NotAvailableError(str(error)) from None
    binding = load_binding(BINDING)
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        folder = Path(place)
        wing = build_fmu(reduced_model(), folder / "compiled.fmu", kind="compiled").path
        empty = minimal_fmu(wing, folder / "minimal.fmu")
        steps: dict[str, Callable[[], object]] = {}
        for name, path in (("wing", wing), ("empty", empty)):
            steps[f"bare {name}"] = stack.enter_context(bare_step(path))
            for kind in ("in process", "worker"):
                asset = stack.enter_context(FmiAsset(path, binding, isolated=kind == "worker"))
                steps[f"{kind} {name}"] = _stepper(asset)
        least = {
            name: 1e6 * value for name, value in least_seconds(steps, repeats=400, inner=25).items()
        }
        simulations: dict[str, Callable[[], object]] = {
            "fmpy": lambda: fmpy_simulation(wing, STEPS),
            "in process": lambda: _simulation(wing, binding, isolated=False),
            "worker": lambda: _simulation(wing, binding, isolated=True),
        }
        simulation_seconds = least_seconds(simulations, repeats=12, inner=1)
        strains_of_simulations = _compared_strains(wing, binding)
        opened = {
            kind: stack.enter_context(FmiAsset(wing, binding, isolated=kind == "worker"))
            for kind in ("in process", "worker")
        }
        running = least_seconds(
            {kind: partial(_simulate, asset, SHORT) for kind, asset in opened.items()},
            repeats=200,
            inner=1,
        )
    bare, nothing = "bare ctypes calls", "an FMU that computes nothing"
    return [
        Measurement(
            "compiled FMU step in process",
            least["in process wing"],
            "us",
            8.0,
            bare,
            least["bare wing"],
        ),
        Measurement(
            "compiled FMU step through the worker",
            least["worker wing"],
            "us",
            60.0,
            nothing,
            least["worker empty"],
        ),
        Measurement(
            "master over bare calls, empty FMU",
            least["in process empty"] - least["bare empty"],
            "us",
            3.0,
            bare,
            least["bare empty"],
        ),
        Measurement(
            "master over bare calls, compiled wing",
            least["in process wing"] - least["bare wing"],
            "us",
            3.0,
            bare,
            least["bare wing"],
        ),
        Measurement(
            f"simulate, {STEPS} steps, times faster than fmpy",
            simulation_seconds["fmpy"] / simulation_seconds["in process"],
            "x",
            2.0,
            larger_is_better=True,
        ),
        Measurement(
            "simulate through the worker, times faster than fmpy",
            simulation_seconds["fmpy"] / simulation_seconds["worker"],
            "x",
            larger_is_better=True,
        ),
        Measurement(
            f"simulate, {STEPS} steps, in process", simulation_seconds["in process"], "s"
        ).beside(
            "simulate_fmu",
            simulation_seconds["fmpy"],
            peer=peer_version("fmpy"),
            agreement=strains_of_simulations,
        ),
        *(
            Measurement(
                f"a step of simulate, {kind}",
                1e6 / SHORT * seconds,
                "us",
                None,
                bare,
                least["bare wing"],
            )
            for kind, seconds in running.items()
        ),
    ]


def _stepper(asset: FmiAsset) -> Callable[[], object]:
    damage = itertools.cycle(range(LEVELS))
    return lambda: asset.step({"load_factor": 3.0}, {"z1": 0.001 * next(damage), "z2": 0.2})


def _simulation(path: Path, binding: Binding, *, isolated: bool) -> ObservationHistory:
    """Simulate as fmpy does, extraction, start and all outputs included."""
    with FmiAsset(path, binding, isolated=isolated) as asset:
        return _simulate(asset, STEPS)


def _simulate(asset: FmiAsset, steps: int) -> ObservationHistory:
    damage = 0.001 * (np.arange(steps) % LEVELS)
    return asset.simulate({"load_factor": 3.0}, {"z1": damage, "z2": 0.0})


def _compared_strains(path: Path, binding: Binding) -> Agreement:
    """Return how far the strains of all steps of both simulations differ."""
    ours = _simulation(path, binding, isolated=False).values
    theirs = fmpy_simulation(path, STEPS)
    gauges = [f"strain[{number + 1}]" for number in range(ours.shape[1])]
    return compared("strains", ours, np.stack([theirs[name][1:] for name in gauges], axis=1), 1e-12)
