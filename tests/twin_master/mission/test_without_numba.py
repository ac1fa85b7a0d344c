"""A mission where numba is not installed: the same loops as plain Python, and one sentence about it."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from reporting import progress
from tests.twin_master.runs import flight_of, of_library
from uav_twin import load_scenario

ROOT = Path(__file__).parents[3]
WITHOUT = "import runpy, sys; sys.modules['numba'] = None; runpy.run_path(sys.argv[1], run_name='__main__')"


def arrays(library: Path) -> dict[str, np.ndarray]:
    """Fly with notices, and return what was believed and decided."""
    short = load_scenario("level_turns").scenario.mission.model_copy(update={"steps": 15})
    history = flight_of(*of_library("level_turns", library, mission=short))
    names = ("observed", "control_index", "filtered", "log_evidence", "smoothed", "predicted")
    return {name: getattr(history, name) for name in names}


def test_a_mission_without_numba_is_the_same(library_file: Path, tmp_path: Path) -> None:
    kept = tmp_path / "plain.npz"
    plain = subprocess.run(
        [sys.executable, "-c", WITHOUT, __file__, library_file, kept],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert plain.returncode == 0, plain.stderr
    assert plain.stderr.count("pip install 'uav-twin[fast]'") == 1
    with np.load(kept) as found:
        for name, expected in arrays(library_file).items():
            np.testing.assert_allclose(found[name], expected, rtol=1e-9, atol=1e-12, err_msg=name)


if __name__ == "__main__":
    progress.narrator = progress.RichProgress
    np.savez(sys.argv[3], **arrays(Path(sys.argv[2])))
