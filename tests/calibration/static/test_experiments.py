"""Reading load-displacement measurements, and one clear sentence for each thing wrong with them."""

import dataclasses

import numpy as np
import pytest

from calibration.errors import ExperimentDataError
from calibration.static.experiments import (
    LOAD_STANDARD_DEVIATION,
    published_measurements,
    read_measurements,
)

PAIRS = np.array([[2.4525, 3.937], [4.905, 7.6962], [7.3575, 10.8712], [2.4525, 3.3528], [4.905, 7.2898]])


def write(folder, text):
    file = folder / "step2" / "load_displacement_measurements.csv"
    file.parent.mkdir(exist_ok=True, parents=True)
    file.write_text(text, encoding="utf-8")
    return folder


def table(pairs, header="load,displacement"):
    return "\n".join([header, *(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)]) + "\n"


def test_published_pairs():
    data = published_measurements()
    assert data.run.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert data.load / 9.81 == pytest.approx(np.tile([0.25, 0.5, 0.75, 1.0], 2))
    assert data.load_standard_deviation == pytest.approx(0.0981 / 1.96)
    assert data.displacement_standard_deviation == pytest.approx(0.5e-3 / 1.96)
    with pytest.raises(ExperimentDataError, match="load of reading 2 is 0"):
        dataclasses.replace(data, load=np.where(np.arange(8) == 1, 0.0, data.load))


@pytest.mark.parametrize("above", ["", "datafiles", "src/datafiles"])
def test_folders_files_columns_and_runs(tmp_path, above):
    write(tmp_path / above, "\ufeff" + table(PAIRS, "load , displacement").replace("\n", "\r\n"))
    data = read_measurements(tmp_path)
    assert data.load.tolist() == PAIRS[:, 0].tolist()
    assert data.displacement == pytest.approx(PAIRS[:, 1] * 1e-3)
    assert data.run.tolist() == [0, 0, 0, 1, 1]
    file = tmp_path / above / "step2" / "load_displacement_measurements.csv"
    assert read_measurements(file).sha256 == data.sha256
    rows = "\n".join(f"{displacement},x,{load}" for load, displacement in PAIRS)
    other = read_measurements(write(tmp_path / above, f"displacement,remark,load\n{rows}\n"))
    assert other.load.tolist() == data.load.tolist()
    # equal readings of two runs, or two numbered ones, are no repetition
    runs = "load,displacement\n4.905,7.6\n9.81,14.5\n4.905,7.6\n9.81,14.5\n"
    assert read_measurements(write(tmp_path / above, runs)).run.tolist() == [0, 0, 1, 1]
    numbered = "reading,load,displacement\n1,9.81,14.5\n2,9.81,14.5\n"
    assert read_measurements(write(tmp_path / above, numbered)).count == 2


def test_the_hash_sees_figures_and_not_names():
    data = published_measurements()
    assert dataclasses.replace(data, source="another name").sha256 == data.sha256
    assert dataclasses.replace(data, load=data.load + 1e-12).sha256 != data.sha256
    assert (
        dataclasses.replace(data, load_standard_deviation=2 * LOAD_STANDARD_DEVIATION).sha256 != data.sha256
    )
