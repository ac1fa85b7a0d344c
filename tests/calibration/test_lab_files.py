"""What is wrong with a file of a laboratory is told in one sentence."""

import numpy as np
import pytest

from calibration.dynamics.records import read_records
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import read_lengths
from calibration.paper.procedure import read_published_results
from calibration.static.experiments import read_measurements
from calibration.wing.lab_data import WEIGHED_MASS_FILE, read_weighed_mass
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
READERS = {
    "lengths": read_lengths,
    "load_test": read_measurements,
    "ring_down": read_records,
    "weighed_mass": lambda file: read_weighed_mass(file.parents[1]),
    "authors": read_published_results,
}
ERRORS = {"File": ExperimentFileError, "Data": ExperimentDataError}


BAD = [pytest.param(name, *row, id=f"{name}: {row[-1]}") for name in READERS for row in INPUTS.refused(name)]


@pytest.mark.parametrize(("name", "old", "new", "kind", "sentence"), BAD)
def test_a_bad_file_is_one_sentence(tmp_path, name, old, new, kind, sentence):
    file = tmp_path / WEIGHED_MASS_FILE
    file.parent.mkdir()
    file.write_text(INPUTS.text(f"{name}.csv", (old, new)), encoding="utf-8")
    with refused(ERRORS[kind], sentence):
        READERS[name](file)


@pytest.mark.parametrize("name", ["lengths", "load_test", "ring_down", "authors"])
def test_a_file_that_is_not_there(tmp_path, name):
    with refused(ExperimentFileError, "does not exist"):
        READERS[name](tmp_path / "nowhere")
    with refused(ExperimentFileError, "does not hold|holds no ring-down record"):
        READERS[name](tmp_path)
    (tmp_path / "picture.csv").write_bytes(bytes(range(128, 256)))
    with refused(ExperimentFileError, "not text in UTF-8"):
        READERS[name](tmp_path / "picture.csv")


@pytest.mark.parametrize(("load", "displacement", "sentence"), [*INPUTS.refused("units"), (0.0, 0.0, "")])
def test_wrong_units_are_recognised(tmp_path, load, displacement, sentence):
    pairs = np.loadtxt(INPUTS.text("load_test.csv").splitlines(), delimiter=",", skiprows=1)
    pairs = pairs * [load, displacement] if load else pairs[:, ::-1]  # exchanged
    rows = "\n".join(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)
    (tmp_path / "pairs.csv").write_text(f"load,displacement\n{rows}\n", encoding="utf-8")
    with refused(ExperimentDataError, f"{sentence}.*expected before calibration|expected.*{sentence}"):
        read_measurements(tmp_path / "pairs.csv")
