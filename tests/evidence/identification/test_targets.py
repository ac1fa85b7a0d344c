import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.errors import ExperimentDataError, ExperimentFileError
from evidence.identification.targets import (
    FITTED_LEVELS,
    LEVELS,
    REFERENCE_PITOT,
    Targets,
    fitted_states,
    frequency_slopes,
    read_targets,
    strain_slopes,
)
from twin_master.errors import InvalidStrainLibraryError

RESULTS = Path("calibration") / "step3" / "massoptimizationresults.csv"
LIBRARY = Path("library") / "UAVconfig.json"


def test_fitted_are_40_and_80_percent_of_one_region_alone() -> None:
    fitted = {(LEVELS[i], LEVELS[j]) for i, j in np.argwhere(fitted_states())}
    assert fitted == {(level, 0.0) for level in FITTED_LEVELS} | {(0.0, level) for level in FITTED_LEVELS}
    assert FITTED_LEVELS == (0.4, 0.8)


def test_a_folder_with_both_repositories_is_read(published_folder: Path) -> None:
    found = read_targets(published_folder)
    assert found.strain.shape == (5, 5, 24)
    assert found.fitted_row.tolist() == [number % 2 == 0 for number in range(12)]
    assert found.frequency_slope == pytest.approx([0.41, 0.32], abs=1e-6)
    assert found.all_mass_slope == pytest.approx([-0.5, -0.3], abs=1e-6)
    assert found.frequency_at_one == pytest.approx([5.632, 28.5], rel=1e-6)
    assert found.strain_slope == pytest.approx(np.full(24, -0.85), abs=1e-9)
    assert set(found.sources) == {"UAVconfig.json", "massoptimizationresults.csv"}


def test_slopes_come_from_the_fitted_rows_alone(published_folder: Path) -> None:
    results = published_folder / RESULTS
    before = read_targets(published_folder)
    lines = results.read_text().splitlines()
    for number in range(2, len(lines), 2):  # the held-out rows
        cells = lines[number].split(",")
        lines[number] = ",".join([*cells[:-2], str(1.05 * float(cells[-2])), cells[-1]])
    results.write_text("\n".join(lines) + "\n")
    after = read_targets(published_folder)
    assert np.all(
        after.frequency[~after.fitted_row, 0] == pytest.approx(1.05 * before.frequency[~before.fitted_row, 0])
    )
    assert after.frequency_slope.tolist() == before.frequency_slope.tolist()
    assert after.all_frequency_slope.tolist() != before.all_frequency_slope.tolist()


def test_slopes_of_power_laws_are_exact() -> None:
    factor = np.linspace(0.95, 1.06, 30)
    strain = np.outer(factor**-0.7, [1e-3, 2e-3])
    assert strain_slopes(factor, strain) == pytest.approx([-0.7, -0.7], abs=1e-10)
    pitot = 0.13 + 0.01 * np.cos(np.arange(30.0))
    frequency = np.column_stack([5.0 * factor**0.4, 28.0 * factor**0.3]) * np.exp(-0.5 * pitot)[:, None]
    level, slope, mass = frequency_slopes(factor, pitot, frequency)
    assert slope == pytest.approx([0.4, 0.3], abs=1e-9)
    assert mass == pytest.approx([-0.5, -0.5], abs=1e-8)
    assert level == pytest.approx(
        [5.0 * np.exp(-0.5 * REFERENCE_PITOT), 28.0 * np.exp(-0.5 * REFERENCE_PITOT)]
    )


def test_the_published_folders(published: Targets) -> None:
    assert published.strain[0, 0].argmax() == 16
    assert published.strain[:, 0, 16] * 1e6 == pytest.approx([3010, 3274, 3617, 4088, 4788], abs=1.0)
    assert published.all_frequency_at_one == pytest.approx([5.632, 28.544], rel=1e-4)
    assert int(published.fitted_row.sum()) == 50
    assert published.strain_slope[16] == pytest.approx(-0.60, abs=0.01)


def test_a_folder_without_the_files_is_one_sentence(tmp_path: Path, library_file: Path) -> None:
    with pytest.raises(ExperimentFileError, match=r"holds 0 files UAVconfig\.json"):
        read_targets(tmp_path)
    with pytest.raises(ExperimentFileError, match="is not a folder"):
        read_targets(tmp_path / "nothing")
    (tmp_path / "UAVconfig.json").write_bytes(library_file.read_bytes())
    with pytest.raises(ExperimentFileError, match=r"holds 0 files step3/massoptimizationresults\.csv"):
        read_targets(tmp_path)


def test_a_renamed_column_and_a_nan_are_named(published_folder: Path) -> None:
    results = published_folder / RESULTS
    text = results.read_text()
    results.write_text(text.replace("freq_2\n", "second\n"))
    with pytest.raises(ExperimentFileError, match="no column 'freq_2'"):
        read_targets(published_folder)
    lines = text.splitlines()
    lines[3] = ",".join(["nan", *lines[3].split(",")[1:]])
    results.write_text("\n".join(lines) + "\n")
    with pytest.raises(ExperimentDataError, match="line 4: column 'e_sample' holds nan"):
        read_targets(published_folder)
    results.write_text("\n".join(text.splitlines()[:6]) + "\n")
    with pytest.raises(ExperimentDataError, match="holds 5 rows; at least 10"):
        read_targets(published_folder)


def test_other_levels_and_signs_are_refused(published_folder: Path) -> None:
    library = published_folder / LIBRARY
    text = library.read_text()

    def refused(
        change: Callable[[dict[str, Any]], None], match: str, error: type[Exception] = ExperimentDataError
    ) -> None:
        content = json.loads(text)
        change(content)
        library.write_text(json.dumps(content))
        with pytest.raises(error, match=match):
            read_targets(published_folder)

    def put(value: float) -> Callable[[dict[str, Any]], None]:
        def change(content: dict[str, Any]) -> None:
            content["observations"]["20"]["0"]["3g"]["mean"][4] = value

        return change

    refused(put(float("nan")), "NaN is no number in JSON", InvalidStrainLibraryError)
    refused(
        lambda content: content["observations"]["20"]["0"]["3g"]["mean"].pop(),
        r"\[20\]\[0\]\[3g\]\[mean\] must hold 24 finite",
        InvalidStrainLibraryError,
    )
    refused(put(-5.0), "must be positive")
    refused(lambda content: content["states"][0].pop(), "the levels of z1")
    refused(lambda content: content["controls"].pop(), "has no control 3g")
