"""Calibration step 3: masses with a closed solution, the authors' table, our model beside it, bad input."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.dynamics.masses_and_damping import (
    TOTAL_MASS,
    DynamicTargets,
    MassRange,
    calibrate_dynamics,
    damping_coefficients,
    fit_masses,
)
from calibration.dynamics.published import read_factor_samples, read_published_results
from calibration.errors import (
    ExperimentDataError,
    ExperimentFileError,
    MassConstraintError,
    OutsideValidityError,
)
from fe.runtime.modal_system import rayleigh_damping_ratio

REFERENCE = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_experimental_calibration"
MASSES = MassRange(servo=(0.05, 0.3), pitot=(0.0, 0.3))


def line_model(factor: float, servo: float, pitot: float) -> tuple[float, float]:
    """Frequencies of a wing whose logarithms are linear, with the reference model's slopes [Hz]."""
    assert pitot == pytest.approx(TOTAL_MASS - 2.0 * servo)
    first = 5.632 * factor**0.4114 * math.exp(-0.5075 * (pitot - 0.1345))
    second = 28.544 * factor**0.3244 * math.exp(-0.2925 * (pitot - 0.1345))
    return first, second


@given(factor=st.floats(0.97, 1.05))
def test_masses_of_a_closed_solution(factor: float) -> None:
    result = fit_masses(line_model, np.array([factor]), MASSES)
    # The first frequency answers more strongly, so the error of (19), (20) is least where it is met exactly.
    pitot = 0.1345 + math.log(5.632 * factor**0.4114 / 5.6492) / 0.5075
    assert result.pitot_mass[0] == pytest.approx(pitot, abs=1e-6)
    assert 2.0 * result.servo_mass[0] + result.pitot_mass[0] == pytest.approx(0.472, abs=1e-15)
    assert result.frequency[0, 0] == pytest.approx(5.6492, rel=1e-6)
    error = 0.5 * (1.0 - result.frequency[0, 1] / 29.9699)
    assert result.relative_error[0] == pytest.approx(error, abs=1e-6)


@given(
    first=st.floats(2.0, 10.0),
    factor=st.floats(2.0, 9.0),
    alpha=st.floats(0.01, 10.0),
    beta=st.floats(1e-5, 1e-2),
)
def test_damping_coefficients_undo_the_damping_ratios(
    first: float, factor: float, alpha: float, beta: float
) -> None:
    frequency = first, first * factor
    ratio = rayleigh_damping_ratio(alpha, beta, frequency)
    found = damping_coefficients(frequency, (float(ratio[0]), float(ratio[1])))
    assert found == pytest.approx((alpha, beta), rel=1e-6, abs=1e-9)


def test_the_authors_table_gives_their_figures() -> None:
    if not REFERENCE.is_dir():
        pytest.skip("the reference data are not beside the project")
    result = read_published_results(REFERENCE)
    assert result.servo_mass.size == 100
    assert result.mean("servo_mass") == pytest.approx(0.1691, abs=5e-5)
    assert result.standard_deviation("servo_mass") == pytest.approx(0.0039, abs=5e-5)
    assert result.mean("pitot_mass") == pytest.approx(0.1337, abs=5e-5)
    assert result.standard_deviation("pitot_mass") == pytest.approx(0.0077, abs=5e-5)
    assert result.mean("damping_alpha") == pytest.approx(1.030, abs=5e-4)
    assert result.mean("damping_beta") == pytest.approx(7.66e-4, abs=5e-7)
    assert result.targets == DynamicTargets()
    assert read_factor_samples(REFERENCE) == pytest.approx(result.young_modulus_factor, abs=5.1e-5)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_our_wing_on_the_published_targets() -> None:
    if not REFERENCE.is_dir():
        pytest.skip("the reference data are not beside the project")
    from fe.reduction.model_cache import reduced_model

    authors = read_published_results(REFERENCE)
    ours = calibrate_dynamics(reduced_model(), read_factor_samples(REFERENCE))
    assert ours.mean("servo_mass") == pytest.approx(authors.mean("servo_mass"), abs=1e-3)
    assert ours.standard_deviation("servo_mass") == pytest.approx(0.0039, abs=2e-4)
    assert ours.mean("damping_alpha") == pytest.approx(1.030, rel=0.01)
    assert ours.mean("damping_beta") == pytest.approx(7.66e-4, rel=0.01)
    assert ours.frequency[:, 0] == pytest.approx(np.full(100, 5.6492), rel=1e-6)
    states = ours.states()
    assert states[3].servo_mass == ours.servo_mass[3]
    assert states[3].damping_beta == ours.damping_beta[3]
    with pytest.raises(OutsideValidityError, match=r"sample of e is 1\.5"):
        calibrate_dynamics(reduced_model(), [1.0, 1.5])


def test_refusals() -> None:
    one = np.ones(1)
    with pytest.raises(MassConstraintError, match="cannot weigh 2 kg"):
        fit_masses(line_model, one, MASSES, total_mass=2.0)
    with pytest.raises(MassConstraintError, match="cannot weigh nan"):
        fit_masses(line_model, one, MASSES, total_mass=math.nan)
    with pytest.raises(MassConstraintError, match="at the limit of the model"):
        fit_masses(line_model, one, MASSES, DynamicTargets((7.0, 29.9)))
    with pytest.raises(ExperimentDataError, match="at least one sample"):
        fit_masses(line_model, np.array([]), MASSES)
    with pytest.raises(ExperimentDataError, match="must be finite"):
        fit_masses(line_model, np.array([math.nan]), MASSES)
    with pytest.raises(ExperimentDataError, match="frequency of the second"):
        fit_masses(line_model, one, MASSES, DynamicTargets((5.6, math.nan)))
    with pytest.raises(ExperimentDataError, match="damping ratio of the first"):
        fit_masses(line_model, one, MASSES, DynamicTargets((5.6, 29.9), (-0.02, 0.07)))
    with pytest.raises(ExperimentDataError, match="damping ratio of 16 lets nothing swing"):
        fit_masses(line_model, one, MASSES, DynamicTargets((5.6, 29.9), (0.02, 16.0)))
    with pytest.raises(ExperimentDataError, match="neither may be negative"):
        fit_masses(line_model, one, MASSES, DynamicTargets((5.6, 29.9), (0.02, 0.5)))


def test_bad_files(tmp_path: Path) -> None:
    file = tmp_path / "e.csv"
    for text, error, words in (
        ("", ExperimentFileError, "has no rows"),
        ("1.0\nnan\n", ExperimentDataError, "line 2: column 'e' holds nan"),
        ("1.0\ne\n", ExperimentFileError, "line 2: column 'e' must hold a number, and 'e' came"),
        ("1.0\n1,05\n", ExperimentFileError, "line 2: 2 cells came"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(error, match=words):
            read_factor_samples(file)
    header = "e_sample,target_freq_1,target_freq_2,zeta_1,zeta_2,mass_servo_1,mass_pitot,freq_1,freq_2\n"
    for text, error, words in (
        (header, ExperimentFileError, "no rows"),
        (
            header.replace("freq_2\n", "f\n") + "1,5.6,29.9,.03,.07,.17,.1,5.6,28.6\n",
            ExperimentFileError,
            "no column 'freq_2'",
        ),
        (
            header + "1,5.6,29.9,.03,.07,.17,,5.6,28.6\n",
            ExperimentFileError,
            "'mass_pitot' must hold a number, and nothing",
        ),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(error, match=words):
            read_published_results(file)
    for read in (read_factor_samples, read_published_results):
        with pytest.raises(ExperimentFileError, match="does not hold"):
            read(tmp_path)
        with pytest.raises(ExperimentFileError, match="does not exist"):
            read(tmp_path / "nothing")
