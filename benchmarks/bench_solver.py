"""The solver of the full wing (40,000 unknowns) beside SuperLU and CalculiX on the same mesh.

Processor seconds, so that another job on the machine does not count; each the least of a few.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.measurement import Measurement
from fe.verification.calculix_run import calculix_program

REFINEMENT = 1.2
REPEATS = 3

_SOLVE = """
import json, resource, sys, time
import numpy as np
from scipy.sparse.linalg import splu
from fe.full import factorisation
from fe.wing.design import load_design
from fe.wing.operators import assemble
from fe.full.factorisation import Factorisation

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
print(json.dumps({
    "unknowns": operators.unknowns, "assembly": assembly, "first": first_time, "again": again_time,
    "backward_error": backward, "superlu": superlu_time, "before": before, "peak": peak,
    "difference": float(np.abs(displacement - other).max() / np.abs(other).max()),
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
text = deck.text(Step(operators.load_tip))
Path(sys.argv[2]).write_text(text, encoding="ascii")
"""


def _run(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


def _calculix_seconds(program: str) -> float:
    """Return processor seconds of a whole run of CalculiX with the same load on the same mesh."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        _run(_CALCULIX, str(REFINEMENT), str(Path(folder) / "static.inp"))
        for _ in range(REPEATS):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(
                [program, "-i", "static"],
                cwd=folder,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                capture_output=True,
                check=True,
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(times)


def run() -> list[Measurement]:
    """Measure factorisation and solution, and what they are compared with."""
    figures: dict[str, float] = json.loads(_run(_SOLVE, str(REFINEMENT), str(REPEATS)))
    size = f"{int(figures['unknowns']):,} unknowns"
    measured = [
        Measurement(
            f"factorisation and solution, {size}",
            figures["first"],
            "s",
            2.0,
            "SuperLU",
            figures["superlu"],
        ),
        Measurement(
            "the same, a pattern met before",
            figures["again"],
            "s",
            2.0,
            "SuperLU",
            figures["superlu"],
        ),
        Measurement("its backward error", figures["backward_error"], "1", 1e-12),
        Measurement("its difference to SuperLU, of the largest", figures["difference"], "1"),
        Measurement(
            "its peak memory, with the operators",
            figures["peak"],
            "MB",
            None,
            "operators",
            figures["before"],
        ),
        Measurement("mesh and assembly of all operators", figures["assembly"], "s"),
    ]
    program = calculix_program()
    if program is None:
        print("the solver beside CalculiX: left out, CalculiX (ccx) is not installed")
        return measured
    seconds = _calculix_seconds(program)
    assembly_and_solution = figures["assembly"] + figures["first"]
    return [
        *measured,
        Measurement(
            "CalculiX's run over factorisation and solution",
            seconds / figures["first"],
            "x",
            3.0,
            larger_is_better=True,
        ),
        Measurement(
            "CalculiX's run",
            seconds,
            "s",
            None,
            "with mesh and assembly, ours",
            assembly_and_solution,
        ),
    ]
