"""The wing model: what a build costs, and what the reduced model gives for it."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement, median_seconds

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


def run() -> list[Measurement]:
    with tempfile.TemporaryDirectory() as folder:
        cold = _in_own_process(_BUILD, folder)
        warm = _in_own_process(_WARM, folder, str(Path(folder) / "wing.vtu"))
    return [
        Measurement("reduced wing from nothing, wall", cold["wall"], "s", 60.0),
        Measurement("reduced wing from nothing, processor", cold["processor"], "s"),
        Measurement("reduced wing from nothing, memory", cold["memory"], "GB", 2.0),
        Measurement("reduced wing from the cache, and its VTU", warm["wall"], "s", 2.0),
        *_against_the_full_model(),
    ]


def _against_the_full_model() -> list[Measurement]:
    from fe.reduction.model_cache import reduced_model
    from fe.runtime.state import TIP_FORCE
    from fe.runtime.transient import ModalIntegrator
    from fe.structure.affine import natural_frequencies, static_response
    from fe.wing.design import load_design
    from fe.wing.operators import assemble, point_masses, wing_values

    model = reduced_model()
    begin = time.perf_counter()
    operators = assemble(load_design())
    assembly_time = time.perf_counter() - begin
    random = np.random.default_rng(2021)
    errors = []
    bounds = []
    effectivities = []
    tip_errors = []
    frequency_errors = []
    full_times = []
    for number in range(STATES):
        # the corners of the box first
        corner = number < 8
        e = (0.9, 1.1)[number % 2] if corner else random.uniform(0.9, 1.1)
        z = (
            (0.8 * (number // 2 % 2), 0.8 * (number // 4))
            if corner
            else tuple(random.uniform(0, 0.8, 2))
        )
        load = (1.0, 0.0) if number % 3 else (0.0, 1.0)
        load_factor, tip_force = load
        values = wing_values(operators, e, z, load_factor=load_factor, tip_force=tip_force)
        begin = time.perf_counter()
        full = static_response(operators, values)
        full_times.append(time.perf_counter() - begin)
        vector = model.vector(stiffness_loss=z, young_modulus_factor=e)
        reduced = model.static_response(vector, load=np.array(load))
        largest = np.abs(full.strain).max()
        error = np.abs(reduced.strain - full.strain).max()
        errors.append(error / largest)
        bounds.append(reduced.strain_error_bound / largest)
        effectivities.append(reduced.strain_error_bound / error)
        tip_errors.append(abs(reduced.displacement[0] / full.output[0] - 1.0))
        if number % 2:
            servo_mass, pitot_mass = random.uniform((0.05, 0.0), (0.30, 0.30)).tolist()
            values = wing_values(operators, e, z, **point_masses(servo_mass, pitot_mass))
            frequency = natural_frequencies(operators, 6, values).frequency
            masses = {"servo_mass": servo_mass, "pitot_mass": pitot_mass}
            found = model.modes(masses, z, young_modulus_factor=e).frequency
            frequency_errors.append(np.abs(found / frequency - 1.0).max())
    assert min(effectivities) >= 1.0, "the certified bound does not hold"

    state = model.vector(stiffness_loss=(0.4, 0.2), load_factor=3.0)
    one = median_seconds(lambda: model.static_response(state), inner=500)
    losses = random.uniform(0, 0.8, (2, 1000))
    vectors = model.vectors({"z1": losses[0], "z2": losses[1], "load_factor": 3.0})
    many = median_seconds(lambda: model.static_outputs(vectors)) / len(vectors)
    modes = median_seconds(lambda: model.modes(state), inner=50)
    integrator = ModalIntegrator(model.structure_at(model.nominal), *model.damping)
    at = integrator.state_after_release(0.02, (0.0, 0.0), TIP_FORCE)
    step = median_seconds(
        lambda: integrator.outputs(integrator.advance(at, 0.01, (3.0, 0.0))), inner=200
    )
    full_time = float(np.median(full_times))
    return [
        Measurement(
            "reduced strain against the full model, speed-up",
            full_time / one,
            "x",
            20_000.0,
            larger_is_better=True,
        ),
        Measurement(
            "the same, with mesh and assembly of the full model",
            (assembly_time + full_time) / one,
            "x",
        ),
        Measurement(
            "24 strains with certified bound", one * 1e6, "us", None, "full model", full_time * 1e6
        ),
        Measurement(
            "24 strains, 1,000 states at once, each",
            many * 1e6,
            "us",
            None,
            "one by one",
            one * 1e6,
        ),
        Measurement("six modes", modes * 1e6, "us"),
        Measurement("transient step with outputs", step * 1e6, "us"),
        Measurement("strain error, of the largest strain", max(errors), "1", 1e-3),
        Measurement("certified bound, of the largest strain", max(bounds), "1", 1e-3),
        Measurement("effectivity of the bound, median", float(np.median(effectivities)), "1"),
        Measurement("tip displacement error", max(tip_errors), "1", 1e-3),
        Measurement("frequency error, six modes", max(frequency_errors), "1", 1e-4),
    ]
