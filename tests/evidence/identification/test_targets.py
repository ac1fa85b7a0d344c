import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.errors import ExperimentDataError, ExperimentFileError
from evidence.identification.targets import LEVELS, fitted_states, read_targets
from twin_master.errors import MissionInputError

RESULTS = Path("calibration") / "step3" / "massoptimizationresults.csv"
LIBRARY = Path("library") / "UAVconfig.json"


def test_a_folder_with_both_repositories_is_read(published_folder):
    """Slopes come from the fitted rows alone."""
    found = read_targets(published_folder)
    assert found.strain.shape == (5, 5, 24)
    fitted = {(LEVELS[i], LEVELS[j]) for i, j in np.argwhere(fitted_states())}
    assert fitted == {(0.4, 0.0), (0.8, 0.0), (0.0, 0.4), (0.0, 0.8)}
    assert found.fitted_row.tolist() == [number % 2 == 0 for number in range(12)]
    assert found.frequency_slope == pytest.approx([0.41, 0.32], abs=1e-6)
    assert found.all_mass_slope == pytest.approx([-0.5, -0.3], abs=1e-6)
    assert found.frequency_at_one == pytest.approx([5.632, 28.5], rel=1e-6)
    assert found.strain_slope == pytest.approx(np.full(24, -0.85), abs=1e-9)
    assert set(found.sources) == {"UAVconfig.json", "massoptimizationresults.csv"}
    results = published_folder / RESULTS
    lines = results.read_text().splitlines()
    for number in range(2, len(lines), 2):  # the held-out rows
        cells = lines[number].split(",")
        lines[number] = ",".join([*cells[:-2], str(1.05 * float(cells[-2])), cells[-1]])
    results.write_text("\n".join(lines) + "\n")
    after = read_targets(published_folder)
    assert after.frequency_slope.tolist() == found.frequency_slope.tolist()
    assert after.all_frequency_slope.tolist() != found.all_frequency_slope.tolist()


def test_the_published_folders(published_library):
    published = read_targets(published_library.parents[1])
    assert published.strain[0, 0].argmax() == 16
    assert published.strain[:, 0, 16] * 1e6 == pytest.approx([3010, 3274, 3617, 4088, 4788], abs=1.0)
    assert published.all_frequency_at_one == pytest.approx([5.632, 28.544], rel=1e-4)
    assert int(published.fitted_row.sum()) == 50
    assert published.strain_slope[16] == pytest.approx(-0.60, abs=0.01)


def test_a_folder_without_the_files_is_one_sentence(tmp_path, library_file):
    with pytest.raises(ExperimentFileError, match=r"holds 0 files UAVconfig\.json"):
        read_targets(tmp_path)
    with pytest.raises(ExperimentFileError, match="is not a folder"):
        read_targets(tmp_path / "nothing")
    (tmp_path / "UAVconfig.json").write_bytes(library_file.read_bytes())
    with pytest.raises(ExperimentFileError, match=r"holds 0 files step3/massoptimizationresults\.csv"):
        read_targets(tmp_path)


FILE, DATA, INPUT = ExperimentFileError, ExperimentDataError, MissionInputError


def strains(content: dict[str, Any]) -> list[float]:
    """The mean strains in a state."""
    return content["observations"]["20"]["0"]["3g"]["mean"]


@pytest.mark.parametrize(
    ("file", "change", "error", "sentence"),
    [
        (RESULTS, lambda lines: lines.__delitem__(slice(6, None)), DATA, "holds 5 rows; at least 10"),
        (LIBRARY, lambda content: strains(content).insert(4, -strains(content).pop(4)), DATA,
         "must be positive"),
        (LIBRARY, lambda content: content["states"][0].pop(), DATA, "the levels of z1"),
        (LIBRARY, lambda content: content["controls"].pop(), DATA, "has no control 3g"),
    ],
)  # fmt: skip
def test_other_files_are_refused(published_folder, file, change, error, sentence):
    path = published_folder / file
    content = path.read_text().splitlines() if file is RESULTS else json.loads(path.read_text())
    change(content)
    path.write_text("\n".join(content) + "\n" if file is RESULTS else json.dumps(content))
    with pytest.raises(error, match=sentence):
        read_targets(published_folder)
