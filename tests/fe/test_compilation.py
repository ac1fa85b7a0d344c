"""Which source files the machine code that is kept on disk depends on."""

import subprocess
import sys
from pathlib import Path

from fe import compilation
from twin_master.gauges import exchanged_densities, fault_evidence, fault_kernels

ROOT = Path(__file__).parents[2]


def test_machine_code_depends_on_files_that_callees_use():
    """`fault_evidence` names no function of `exchanged_densities`, but what it calls does."""
    callees = compilation._compiled_callees(fault_evidence.correct_beliefs.py_func)
    modules = {callee.__module__ for callee in callees}
    assert exchanged_densities.__name__ not in {
        getattr(value, "__module__", "") for value in vars(fault_evidence).values()
    }
    assert {exchanged_densities.__name__, fault_kernels.__name__} <= modules


KERNEL = """
from typing import NamedTuple
import numpy as np
from fe.compilation import compiled

class Pair(NamedTuple):
    values: np.ndarray
    factor: float

@compiled
def scaled(pair):
    return pair.values[0] * pair.factor
"""


def test_machine_code_of_a_module_that_has_moved_is_not_read(tmp_path):
    """It names the module of its records, which is no more."""
    environment = {"PYTHONPATH": f"{ROOT}:{tmp_path}", "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    for folder in ("before", "after"):
        file = tmp_path / folder / "loops.py"
        file.parent.mkdir()
        file.write_text(KERNEL)
        call = (
            f"import numpy; from {folder}.loops import *; print(scaled(Pair(numpy.ones(1), 2.0)))"
        )
        command = [sys.executable, "-c", call]
        process = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=True
        )
        assert process.stdout == "2.0\n"
        file.unlink()
