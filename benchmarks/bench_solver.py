"""The solver of the full wing (40,000 unknowns) beside SciPy and CalculiX on the same mesh.

Processor seconds, so that another job on the machine does not count; each the least of a few.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.measurement import Measurement, agreement_within, compared, peer_version
from fe.verification.calculix_run import calculix_program, read_frequencies

REFINEMENT = 1.2
REPEATS = 3

_SOLVE = """
import json, resource, sys, time
import numpy as np
from scipy.sparse.linalg import eigsh, splu
from fe.full import factorisation
from fe.wing.design import load_design
from fe.wing.operators import assemble
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.state import DigitalState
from fe.verification.calculix_deck import wing_deck

def least(function, repeats):
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        found = function()
        times.append(time.process_time() - begin)
    return min(times), found

def solved():
    return Factorisation(stiffness).solve(load)

def first():
    factorisation._analysed_pattern.cache_clear()
    return solved()

def superlu():
    options = {"SymmetricMode": True}
    factors = splu(columns, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factors.solve(load)

def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

repeats = int(sys.argv[2])
design = load_design().changed(mesh={"refinement": float(sys.argv[1])})
assembly, operators = least(lambda: assemble(design), 1)
stiffness, load = operators.stiffness(), operators.load_tip
before = memory()
first_time, displacement = least(first, repeats)
peak = memory()
again_time, _ = least(solved, repeats)
backward = Factorisation(stiffness).backward_error(displacement, load)
columns = stiffness.tocsc()
superlu_time, other = least(superlu, repeats)
system = operators.system_at(wing_deck(operators, DigitalState()).values)

def modes():
    return np.sqrt(lowest_eigenpairs(system.stiffness, system.mass, 6)[0])

def scipy_modes():
    matrices = system.stiffness.tocsc(), system.mass.tocsc()
    return np.sqrt(np.sort(eigsh(matrices[0], 6, matrices[1], 0.0, return_eigenvectors=False)))

modes_time, frequencies = least(modes, repeats)
scipy_modes_time, scipy_frequencies = least(scipy_modes, 1)
print(json.dumps({
    "unknowns": operators.unknowns, "assembly": assembly, "first": first_time, "again": again_time,
    "backward_error": backward, "superlu": superlu_time, "before": before, "peak": peak,
    "difference": float(np.abs(displacement - other).max() / np.abs(other).max()),
    "modes": modes_time, "scipy_modes": scipy_modes_time,
    "frequencies": (frequencies / (2 * np.pi)).tolist(),
    "scipy_frequencies": (scipy_frequencies / (2 * np.pi)).tolist(),
}))
"""
_CALCULIX = """
import sys
from pathlib import Path
from fe.runtime.state import DigitalState
from fe.verification.calculix_deck import Step
from fe.verification.calculix_deck import wing_deck
from fe.wing.design import load_design
from fe.wing.operators import assemble
operators = assemble(load_design().changed(mesh={"refinement": float(sys.argv[1])}))
deck = wing_deck(operators, DigitalState())
folder = Path(sys.argv[2])
static, modal = Step(operators.load_tip), Step(procedure=("*FREQUENCY", "6"))
(folder / "static.inp").write_text(deck.text(static), encoding="ascii")
(folder / "modes.inp").write_text(deck.text(modal), encoding="ascii")
"""


def _run(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


def _calculix_seconds(program: str, folder: Path, job: str, repeats: int) -> float:
    """Return the least processor seconds of whole runs of CalculiX on one core."""
    times = []
    for _ in range(repeats):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [program, "-i", job],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            check=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(times)


def run() -> Iterator[Measurement]:
    """Measure factorisation, solution and modes, and what they are compared with."""
    figures = json.loads(_run(_SOLVE, str(REFINEMENT), str(REPEATS)))
    size = f"{figures['unknowns']:,} unknowns"
    scipy = peer_version("scipy")
    for name, key in (
        (f"factorisation and solution, {size}", "first"),
        ("factorisation and solution, a pattern met before", "again"),
    ):
        yield Measurement(name, figures[key], "s", 2.0).beside(
            "SuperLU",
            figures["superlu"],
            peer=scipy,
            agreement=agreement_within("displacements", figures["difference"], 1e-5),
        )
    yield Measurement("backward error of the solution", figures["backward_error"], "1", 1e-12)
    yield Measurement(
        "peak memory of the solution, with the operators", figures["peak"], "MB"
    ).beside("operators", figures["before"])
    yield Measurement("mesh and assembly of all operators", figures["assembly"], "s")
    yield Measurement(f"six modes, {size}", figures["modes"], "s").beside(
        "eigsh with SuperLU",
        figures["scipy_modes"],
        peer=scipy,
        agreement=compared(
            "frequencies", figures["frequencies"], figures["scipy_frequencies"], 1e-6
        ),
    )
    yield from _beside_calculix(figures)


def _beside_calculix(figures: dict[str, Any]) -> Iterator[Measurement]:
    """Measure CalculiX on the same mesh: its whole runs, with reading and printing."""
    program = calculix_program()
    if program is None:
        yield Measurement(
            "mesh, assembly, factorisation and solution",
            figures["assembly"] + figures["first"],
            "s",
            peer="CalculiX",
            remark="CalculiX is not installed: `apt-get install calculix-ccx`",
        )
        return
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _run(_CALCULIX, str(REFINEMENT), place)
        static_seconds = _calculix_seconds(program, folder, "static", REPEATS)
        modal_seconds = _calculix_seconds(program, folder, "modes", 1)
        text = (folder / "modes.dat").read_text(encoding="latin-1")
        frequencies = read_frequencies(text)[: len(figures["frequencies"])]
    yield Measurement(
        "CalculiX's run over factorisation and solution",
        static_seconds / figures["first"],
        "x",
        3.0,
        larger_is_better=True,
    )
    peer = _calculix_version(program)
    yield Measurement(
        "mesh, assembly, factorisation and solution", figures["assembly"] + figures["first"], "s"
    ).beside("static run", static_seconds, peer=peer)
    yield Measurement(
        "mesh, assembly and six modes", figures["assembly"] + figures["modes"], "s"
    ).beside(
        "frequency run",
        modal_seconds,
        peer=peer,
        agreement=compared("frequencies", figures["frequencies"], frequencies, 1e-4),
    )


def _calculix_version(program: str) -> str:
    """Return the name and version of CalculiX: "CalculiX 2.20"."""
    printed = subprocess.run([program, "-v"], capture_output=True, text=True, check=False).stdout
    return f"CalculiX {printed.split()[-1]}" if printed.split() else "CalculiX"
