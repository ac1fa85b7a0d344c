"""Calibration step 3: masses with a closed solution, the authors' table, our model beside it, bad input."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import ExperimentDataError, OutsideValidityError
from calibration.joint.measurement import PUBLISHED_MODES
from calibration.joint.wing_table import TOTAL_MASS, tabulate_wing, weighed
from calibration.paper.procedure import damping_coefficients, fit_masses, read_published_results
from fe.runtime.modal_system import rayleigh_damping_ratio
from tests.refusals import Inputs

MASSES = {"servo_mass": (0.05, 0.3), "pitot_mass": (0.0, 0.3)}
READ = (weighed(), *PUBLISHED_MODES)


def read(**changed):
    """What is published, some of it changed."""
    return tuple(replace(item, value=changed.get(item.name, item.value)) for item in READ)


def line_model(states):
    """Frequencies of a wing whose logarithms are linear, with the reference model's slopes [Hz]."""
    factor, servo, pitot = states.T
    assert pitot == pytest.approx(TOTAL_MASS - 2.0 * servo)
    first = 5.632 * factor**0.4114 * np.exp(-0.5075 * (pitot - 0.1345))
    second = 28.544 * factor**0.3244 * np.exp(-0.2925 * (pitot - 0.1345))
    return np.column_stack([first, second])


@given(factor=st.floats(0.97, 1.05))
def test_masses_of_a_closed_solution(factor):
    result = fit_masses(line_model, np.array([factor]), MASSES, READ)
    # The first frequency answers more strongly, so the error of (19), (20) is least where it is met exactly.
    pitot = 0.1345 + math.log(5.632 * factor**0.4114 / 5.6492) / 0.5075
    assert result.samples[0, 2] == pytest.approx(pitot, abs=1e-6)
    assert 2.0 * result.samples[0, 1] + result.samples[0, 2] == pytest.approx(0.472, abs=1e-15)
    assert result.frequency[0, 0] == pytest.approx(5.6492, rel=1e-6)


@given(
    first=st.floats(2.0, 10.0),
    factor=st.floats(2.0, 9.0),
    alpha=st.floats(0.01, 10.0),
    beta=st.floats(1e-5, 1e-2),
)
def test_damping_coefficients_undo_the_damping_ratios(first, factor, alpha, beta):
    frequency = first, first * factor
    ratio = rayleigh_damping_ratio(alpha, beta, frequency)
    found = damping_coefficients(frequency, (float(ratio[0]), float(ratio[1])))
    assert found == pytest.approx((alpha, beta), rel=1e-6, abs=1e-9)


def test_the_authors_table_gives_their_figures(reference):
    result = read_published_results(reference)
    assert result.samples.shape == (100, 5)
    mean, deviation = result.samples.mean(axis=0), result.samples.std(axis=0, ddof=1)
    assert mean[1:3] == pytest.approx([0.1691, 0.1337], abs=5e-5)
    assert deviation[1:3] == pytest.approx([0.0039, 0.0077], abs=5e-5)
    assert mean[3] == pytest.approx(1.030, abs=5e-4)
    assert mean[4] == pytest.approx(7.66e-4, abs=5e-7)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_our_wing_on_the_published_targets(reference):
    from fe.reduction.model_cache import reduced_model

    authors = read_published_results(reference)
    wing = tabulate_wing(reduced_model())
    ours = fit_masses(wing.frequency, authors.samples[:, 0], wing.validity, READ)
    mean, deviation = ours.samples.mean(axis=0), ours.samples.std(axis=0, ddof=1)
    assert mean[1] == pytest.approx(authors.samples[:, 1].mean(), abs=1e-3)
    assert deviation[1] == pytest.approx(0.0039, abs=2e-4)
    assert mean[3] == pytest.approx(1.030, rel=0.01)
    assert mean[4] == pytest.approx(7.66e-4, rel=0.01)
    assert ours.frequency[:, 0] == pytest.approx(np.full(100, 5.6492), rel=1e-6)
    with pytest.raises(OutsideValidityError, match=r"modulus of the skin, e is 1\.5"):
        fit_masses(wing.frequency, np.array([1.0, 1.5]), wing.validity, READ)


@pytest.mark.parametrize(("changed", "words"), Inputs(Path(__file__).parents[1]).refused("masses"))
def test_refusals(changed, words):
    with pytest.raises(ExperimentDataError, match=words):
        fit_masses(line_model, np.ones(1), MASSES, read(**changed))
