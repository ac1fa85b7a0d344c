"""What a process computes does not depend on whether it compiles its loops or reads them from disk."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from fe import compilation
from tests.kept import ROOT, share_machine_code
from tests.machine_code_cases import CASES

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("wing"),  # the worker that needs most of these loops
    pytest.mark.skipif(compilation.numba is None, reason="needs numba: pip install 'uav-twin[fast]'"),
]
LEAST_BYTES = 400
"""Each case has fifty numbers or more."""


@pytest.fixture(scope="module")
def results(library_file, write_beam, tmp_path_factory) -> list[dict[str, Any]]:
    """Size and digest of each case in a process that compiles, and in one that finds machine code on disk."""
    beam = write_beam(tmp_path_factory.mktemp("beam"))
    machine_code = tmp_path_factory.mktemp("machine_code")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(machine_code)}
    program = [sys.executable, "-m", "tests.machine_code_cases", str(library_file), str(beam)]
    outputs = []
    for name in ("compiling", "loading"):
        words = [*program, str(tmp_path_factory.mktemp(name))]
        done = subprocess.run(words, env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True)
        outputs.append(json.loads(done.stdout))
    share_machine_code(machine_code)
    return outputs


@pytest.mark.parametrize("name", CASES)
def test_a_process_that_compiles_and_one_that_loads_compute_the_same_bytes(name, results):
    compiling, loading = results

    size, _ = compiling[name]
    assert size >= LEAST_BYTES
    assert compiling[name] == loading[name]
