"""Fit to the extremes of a record read off a plot: a drawn signal of known damping, the real records."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calibration.dynamics.records import RingDownRecord, read_records
from calibration.dynamics.trials import fit_trials, refine_by_extremes
from calibration.errors import ExperimentDataError

WIDTH = 0.00811


def drawn() -> RingDownRecord:
    """A signal of two modes drawn with a line 0.4 mV wide in columns of pixels."""
    fine = np.arange(0.0, 6.4, WIDTH / 64.0)
    signal = np.zeros(fine.size)
    for frequency, ratio, amplitude, phase in ((5.65, 0.0281, 0.0115, 0.2), (29.97, 0.0717, 0.018, 2.0)):
        omega = 2.0 * math.pi * frequency
        wave = np.cos(omega * math.sqrt(1.0 - ratio**2) * fine + phase)
        signal += amplitude * np.exp(-ratio * omega * fine) * wave
    columns = fine.size // 64
    table = signal[: 64 * columns].reshape(columns, 64)
    lowest, highest = table.min(axis=1) - 2e-4, table.max(axis=1) + 2e-4
    time = WIDTH * (np.arange(columns) + 0.5)
    return RingDownRecord(time, 0.5 * (lowest + highest), lowest, highest, WIDTH)


def test_damping_of_a_drawn_signal() -> None:
    trials = fit_trials([drawn()])
    refined = refine_by_extremes(trials)
    first, second = refined.fits[0].modes
    assert first.damping_ratio == pytest.approx(0.0281, rel=0.02)
    # The spectral peak of a mode damped by 7 % lies a little off its frequency.
    assert second.damping_ratio == pytest.approx(0.0717, rel=0.10)
    assert second.damped_frequency == trials.fits[0].modes[1].damped_frequency
    middle = abs(trials.average("damping_ratio", 1).mean / 0.0717 - 1.0)
    assert abs(second.damping_ratio / 0.0717 - 1.0) <= middle + 0.02
    assert 0.0 < second.standard_error["damping_ratio"] < 0.02


def test_the_digitised_records(reference: Path) -> None:
    trials = fit_trials(read_records(reference))
    refined = refine_by_extremes(trials)
    assert refined.average("damping_ratio", 0).mean == pytest.approx(0.028, rel=0.10)
    # Nearer to the 0.0717 of the raw records than the middle of the ink is.
    assert trials.average("damping_ratio", 1).mean < refined.average("damping_ratio", 1).mean < 0.0717
    assert refined.average("frequency", 1).mean == pytest.approx(29.9, rel=0.005)


def test_a_sampled_record_has_no_extremes() -> None:
    record = drawn()
    trials = fit_trials([RingDownRecord(record.time, record.signal)])
    with pytest.raises(ExperimentDataError, match="no lowest and highest"):
        refine_by_extremes(trials)
