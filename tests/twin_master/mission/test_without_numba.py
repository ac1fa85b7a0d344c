"""A mission where numba is not installed: the same loops as plain Python, and one sentence about it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from reporting import progress
from twin_master.assets.strain_library import load_strain_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario

WITHOUT = (
    "import runpy, sys; sys.modules['numba'] = None; runpy.run_path(sys.argv.pop(1), run_name='__main__')"
)


def arrays(library: Path) -> dict[str, np.ndarray]:
    """Fly with notices, and return what was believed and decided."""
    scenario = load_scenario("level_turns").scenario
    source = StrainLibrarySource(scenario, load_strain_library(library), "h")
    knowledge = prepare_knowledge(scenario, source, 3)
    history = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(knowledge.truth(3), source.open()))
    names = ("observed", "control_index", "filtered", "log_evidence", "smoothed", "predicted")
    return {name: getattr(history, name) for name in names}


def test_a_mission_without_numba_is_the_same(library_file: Path, tmp_path: Path) -> None:
    kept = tmp_path / "plain.npz"
    plain = subprocess.run(
        [sys.executable, "-c", WITHOUT, __file__, library_file, kept],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert plain.stderr.count("pip install 'uav-twin[fast]'") == 1
    with np.load(kept) as found:
        for name, expected in arrays(library_file).items():
            np.testing.assert_allclose(found[name], expected, rtol=1e-9, atol=1e-12, err_msg=name)


if __name__ == "__main__":
    progress.narrator = progress.RichProgress
    np.savez(sys.argv[2], **arrays(Path(sys.argv[1])))
