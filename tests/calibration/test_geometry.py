"""Calibration step 1: conjugate posterior, published lengths, bad files."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import READING_UNCERTAINTY, MeasuredLength, published_lengths, read_lengths


def test_the_published_lengths():
    result = published_lengths()
    for length, measured in zip(result, (1.828, 0.433, 0.260), strict=True):
        assert length.prior.deviation == pytest.approx(2.54e-3 / 1.96)
        # The tolerance is 12.7 times the reading's: the posterior is the measurement within 0.02 mm.
        assert length.posterior.mean == pytest.approx(measured, abs=0.02e-3)
        assert length.posterior.standard_deviation == pytest.approx(0.1017e-3, rel=1e-3)
    assert result.semi_span.posterior.mean == pytest.approx(1.828005, abs=1e-6)


def test_posterior_by_quadrature():
    length = published_lengths().root_chord
    grid = np.linspace(0.432, 0.436, 40001)
    density = np.exp(
        -0.5 * ((grid - 0.43561) / (2.54e-3 / 1.96)) ** 2 - 0.5 * ((grid - 0.433) / (0.2e-3 / 1.96)) ** 2
    )
    density /= density.sum()
    mean = float(np.sum(grid * density))
    deviation = math.sqrt(float(np.sum((grid - mean) ** 2 * density)))
    assert length.posterior.mean == pytest.approx(mean, rel=1e-9)
    assert length.posterior.standard_deviation == pytest.approx(deviation, rel=1e-6)


@given(designed=st.floats(0.1, 5.0), shift=st.floats(-0.05, 0.05))
def test_posterior_lies_between_and_is_narrower(designed, shift):
    length = MeasuredLength("semi_span", designed, designed * (1.0 + shift))
    low, high = sorted((length.designed, length.measured))
    assert low - 1e-12 <= length.posterior.mean <= high + 1e-12
    assert length.posterior.standard_deviation <= READING_UNCERTAINTY / 1.96 * (1.0 + 1e-12)
    assert length.posterior.standard_deviation <= length.prior.deviation


GOOD = """parameter,designed,manufactured
length,1828.8,1828.0
chord_{root},435.61,433.0
chord_{tip},261.112,260.0
"""


def test_files_of_lengths(tmp_path):
    file = tmp_path / "lengths.csv"
    with pytest.raises(ExperimentFileError, match="does not hold"):
        read_lengths(tmp_path)
    with pytest.raises(ExperimentFileError, match="does not exist"):
        read_lengths(file)
    file.write_text(GOOD, encoding="utf-8")
    for own, published in zip(read_lengths(file), published_lengths(), strict=True):
        assert own.posterior.mean == pytest.approx(published.posterior.mean, rel=1e-12)


def test_the_published_file_gives_the_published_figures(reference):
    for read, published in zip(read_lengths(reference), published_lengths(), strict=True):
        found = read.designed, read.measured
        assert found == pytest.approx((published.designed, published.measured), rel=1e-12)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (GOOD.replace("manufactured", "as_built"), ExperimentFileError, "no column 'manufactured'"),
        (GOOD.replace("chord_{tip}", "chord_end"), ExperimentFileError, "lacks the row chord_{tip}"),
        (GOOD.replace("433.0", "nan"), ExperimentDataError, "line 3: column 'manufactured' holds nan"),
        (GOOD.replace("433.0", "433,4"), ExperimentFileError, "line 3: 4 cells came, and the header has 3"),
        (GOOD + "chord_{root},435.61,431.0\n", ExperimentFileError, "lines 3 and 5 hold the same parameter"),
        (GOOD.replace("1828.0", "1.828"), ExperimentDataError, "looks like m"),
        (GOOD.replace("1828.0", "182.8"), ExperimentDataError, "more than 10 % apart"),
    ],
)
def test_bad_files_are_told_in_one_sentence(tmp_path, text, error, words):
    file = tmp_path / "lengths.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(error, match=words):
        read_lengths(file)
