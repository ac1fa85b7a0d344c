"""What a process computes does not depend on whether it compiles its loops or reads them from disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fe import compilation
from tests.kept import ROOT

FLY = """
import sys
from pathlib import Path

from tests.twin_master.runs import of_library
from twin_master.mission.side_by_side import fly_side_by_side

knowledge, source = of_library("growing_damage", Path(sys.argv[1]))
asset = source.open()
truths = [knowledge.truth(seed) for seed in range(5)]
flights = fly_side_by_side(knowledge, truths, [asset] * 5)
for values in (flights.filtered, flights.log_evidence, flights.unexplained):
    sys.stdout.buffer.write(values.tobytes())
sys.stdout.buffer.write(repr(flights.notices).encode())
"""
"""A program that writes the beliefs and notices of a fleet."""


@pytest.mark.slow
@pytest.mark.skipif(compilation.numba is None, reason="needs numba: pip install 'uav-twin[fast]'")
def test_a_process_that_compiles_and_one_that_loads_fly_the_same_fleet(library_file: Path, tmp_path: Path):
    words = [sys.executable, "-c", FLY, str(library_file)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    compiling = subprocess.run(words, env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    loading = subprocess.run(words, env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout

    assert len(compiling) > 50_000  # bytes: beliefs of 5 twins about 25 states in 50 steps
    assert compiling == loading
