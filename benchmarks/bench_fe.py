"""The wing model: what a build costs, and what the reduced model gives for it."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement, least_seconds_of
from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from fe.structure.affine import natural_frequencies, static_response
from fe.wing.design import load_design
from fe.wing.operators import AffineOperators, assemble, point_masses, wing_values

# A build from nothing in a process and a cache folder of its own: wall time, processor time, peak
# memory.
_BUILD = """
import json, resource, time
begin = time.perf_counter()
from fe.reduction.model_cache import wing_fields
wing = wing_fields()
usage = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({
    "wall": time.perf_counter() - begin,
    "processor": usage.ru_utime + usage.ru_stime,
    "memory": usage.ru_maxrss / 1024**2,
}))
"""
_WARM = """
import json, sys, time
begin = time.perf_counter()
from fe.reduction.model_cache import wing_fields
from fe.reduction.model_cache import write_wing_vtu
wing = wing_fields()
write_wing_vtu(sys.argv[1], wing, wing.vector(stiffness_loss=(0.4, 0.2), load_factor=3.0))
print(json.dumps({"wall": time.perf_counter() - begin}))
"""
STATES = 12


def _in_own_process(code: str, folder: str, *arguments: str) -> dict[str, float]:
    environment = {**os.environ, "XDG_CACHE_HOME": folder}
    finished = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    result: dict[str, float] = json.loads(finished.stdout)
    return result


def run() -> Iterator[Measurement]:
    """Measure a build from nothing and from the cache, and the reduced against the full model."""
    with tempfile.TemporaryDirectory() as folder:
        cold = _in_own_process(_BUILD, folder)
        yield Measurement("reduced wing from nothing, wall", cold["wall"], "s", 60.0)
        yield Measurement("reduced wing from nothing, processor", cold["processor"], "s")
        yield Measurement("reduced wing from nothing, memory", cold["memory"], "GB", 2.0)
        warm = _in_own_process(_WARM, folder, str(Path(folder) / "wing.vtu"))
        yield Measurement("reduced wing from the cache, and its VTU", warm["wall"], "s", 2.0)
    yield from _against_the_full_model()


@dataclass
class StateErrors:
    """Errors of the reduced wing at states of the validity box, and times of the full model.

    Attributes
    ----------
    strain, bound : list of float
        Largest strain error, and its certified bound, over the largest strain.
    effectivity : list of float
        Bound over error.
    tip : list of float
        Relative error of the tip displacement.
    frequency : list of float
        Largest relative error of six natural frequencies.
    full_seconds : list of float
        Time of a factorisation and solution of the full model [s].
    """

    strain: list[float] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    effectivity: list[float] = field(default_factory=list)
    tip: list[float] = field(default_factory=list)
    frequency: list[float] = field(default_factory=list)
    full_seconds: list[float] = field(default_factory=list)


def draw_state(random: np.random.Generator, number: int) -> tuple[float, tuple[float, float]]:
    """Return Young's modulus factor and stiffness losses: first the corners of the validity box."""
    if number < 8:
        return (0.9, 1.1)[number % 2], (0.8 * (number // 2 % 2), 0.8 * (number // 4))
    e = random.uniform(0.9, 1.1)
    z1, z2 = random.uniform(0, 0.8, 2).tolist()
    return e, (z1, z2)


def compare_states(
    operators: AffineOperators, model: ReducedModel, random: np.random.Generator
) -> StateErrors:
    """Compare static responses and natural frequencies of the reduced and the full wing."""
    errors = StateErrors()
    for number in range(STATES):
        e, z = draw_state(random, number)
        load_factor, tip_force = (1.0, 0.0) if number % 3 else (0.0, 1.0)
        values = wing_values(operators, e, z, load_factor=load_factor, tip_force=tip_force)
        begin = time.perf_counter()
        full = static_response(operators, values)
        errors.full_seconds.append(time.perf_counter() - begin)
        vector = model.vector(stiffness_loss=z, young_modulus_factor=e)
        reduced = model.static_response(vector, load=np.array((load_factor, tip_force)))
        largest = np.abs(full.strain).max()
        error = np.abs(reduced.strain - full.strain).max()
        errors.strain.append(error / largest)
        errors.bound.append(reduced.strain_error_bound / largest)
        errors.effectivity.append(reduced.strain_error_bound / error)
        errors.tip.append(abs(reduced.displacement[0] / full.output[0] - 1.0))
        if number % 2:
            servo_mass, pitot_mass = random.uniform((0.05, 0.0), (0.30, 0.30)).tolist()
            values = wing_values(operators, e, z, **point_masses(servo_mass, pitot_mass))
            full_frequency = natural_frequencies(operators, 6, values).frequency
            masses = {"servo_mass": servo_mass, "pitot_mass": pitot_mass}
            frequency = model.modes(masses, z, young_modulus_factor=e).frequency
            errors.frequency.append(np.abs(frequency / full_frequency - 1.0).max())
    assert min(errors.effectivity) >= 1.0, "the certified bound does not hold"
    return errors


def time_reduced_model(model: ReducedModel, random: np.random.Generator) -> dict[str, float]:
    """Return microseconds of a response alone and in a thousand, of six modes, and of a step."""
    state = model.vector(stiffness_loss=(0.4, 0.2), load_factor=3.0)
    z1, z2 = random.uniform(0, 0.8, (2, 1000))
    vectors = model.vectors({"z1": z1, "z2": z2, "load_factor": 3.0})
    integrator = ModalIntegrator(model.structure_at(model.nominal), *model.damping)
    motion = integrator.state_after_release(0.02, (0.0, 0.0), TIP_FORCE)

    def advance() -> object:
        return integrator.outputs(integrator.advance(motion, 0.01, (3.0, 0.0)))

    seconds_of_all = least_seconds_of(lambda: model.static_outputs(vectors))
    return {
        "one": 1e6 * least_seconds_of(lambda: model.static_response(state), inner=500),
        "one of a thousand": 1e6 * seconds_of_all / len(vectors),
        "modes": 1e6 * least_seconds_of(lambda: model.modes(state), inner=50),
        "step": 1e6 * least_seconds_of(advance, inner=200),
    }


def _against_the_full_model() -> list[Measurement]:
    """Measure speed and errors of the reduced wing against the full model."""
    model = reduced_model()
    begin = time.perf_counter()
    operators = assemble(load_design())
    assembly = 1e6 * (time.perf_counter() - begin)
    random = np.random.default_rng(2021)
    errors = compare_states(operators, model, random)
    times = time_reduced_model(model, random)
    full = 1e6 * float(np.median(errors.full_seconds))
    one = times["one"]
    return [
        Measurement(
            "reduced strain against the full model, speed-up",
            full / one,
            "x",
            20_000.0,
            larger_is_better=True,
        ),
        Measurement(
            "reduced strain against mesh, assembly and solution", (assembly + full) / one, "x"
        ),
        Measurement("24 strains with certified bound", one, "us", None, "full model", full),
        Measurement(
            "24 strains, 1,000 states at once, each",
            times["one of a thousand"],
            "us",
            None,
            "one by one",
            one,
        ),
        Measurement("six modes", times["modes"], "us"),
        Measurement("transient step with outputs", times["step"], "us"),
        Measurement("strain error, of the largest strain", max(errors.strain), "1", 1e-3),
        Measurement("certified bound, of the largest strain", max(errors.bound), "1", 1e-3),
        Measurement("effectivity of the bound, median", float(np.median(errors.effectivity)), "1"),
        Measurement("tip displacement error", max(errors.tip), "1", 1e-3),
        Measurement("frequency error, six modes", max(errors.frequency), "1", 1e-4),
    ]
