"""The real wing's measurements as a campaign: windows, slow zero, noise; the published records."""

from math import pi
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from discrepancy.campaign.records import TrialKind
from discrepancy.errors import CampaignDataError, CampaignFileError
from discrepancy.sources.measured_rigs import (
    READING_ERROR,
    SIGNAL,
    TIP,
    trial_scatter,
    wing_campaign,
    write_wing_campaign,
)

FloatArray = NDArray[np.float64]

PUBLISHED = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_experimental_calibration"
STEP = 8.1112e-3
NOISE = 5e-5


def write_records(folder, count=4, size=795, seed=3):
    """Write ring-downs (count, size) of one motion, a zero that they share, and noise; return the zero."""
    generator = np.random.default_rng(seed)
    place = folder / "step3"
    place.mkdir(parents=True)
    time = 0.016 + STEP * np.arange(size)
    zero = 3e-4 * np.exp(-time / 2.0)
    for number in range(1, count + 1):
        wave = 8e-3 * np.exp(-0.9 * time) * np.cos(2.0 * pi * 5.6 * (time - 1e-3 * generator.normal()))
        signal = (1.0 + 0.02 * generator.normal()) * wave + zero + NOISE * generator.normal(size=size)
        table = np.column_stack((time, signal - 2e-4, signal, signal + 2e-4))
        np.savetxt(
            place / f"ringdown_trial{number}_digitised.csv",
            table,
            delimiter=",",
            header="t_s,V_low,V_mid,V_high",
        )
    return np.asarray(zero)


def test_a_sample_is_the_mean_of_four_columns_without_the_shared_zero(tmp_path):
    write_records(tmp_path)
    plain = wing_campaign(tmp_path, detrended=False, columns=1)
    averaged = wing_campaign(tmp_path, detrended=False)
    first = plain.trials[0].values[:, 0]
    size = len(averaged.trials[0].values)
    np.testing.assert_allclose(
        averaged.trials[0].values[:, 0], first[: 4 * size].reshape(size, 4).mean(axis=1)
    )
    assert averaged.trials[0].interval == pytest.approx(4.0 * STEP, rel=1e-4)
    slow = [np.mean(wing_campaign(tmp_path, detrended=on).trials[0].values) for on in (False, True)]
    assert abs(slow[1]) < 0.1 * abs(slow[0])


def test_the_scatter_between_trials_is_the_noise(tmp_path):
    generator = np.random.default_rng(5)
    time = 0.03 * np.arange(400, dtype=np.float64)
    # a motion of no law that a model could have, the same in all trials but for size, delay and zero
    motion = np.sin(30.0 * np.sqrt(1.0 + time)) / (1.0 + time)
    windows = []
    for k in range(5):
        shown = (1.0 + 0.02 * k) * motion + 1e-3 * k * np.gradient(motion) + 0.1 * k
        windows.append((time, np.asarray(shown + 1e-2 * generator.normal(size=400))))
    noise = trial_scatter(windows)
    assert noise.shape == (1600,)
    assert np.std(noise) == pytest.approx(1e-2, rel=0.06)


def test_the_noise_record_holds_scatter_and_reading_error(tmp_path):
    write_records(tmp_path)
    record = wing_campaign(tmp_path).channels[SIGNAL].noise
    # the average of four columns has half the noise; the shared zero takes little of it
    assert record.standard_deviation == pytest.approx(np.hypot(NOISE / 2.0, READING_ERROR), rel=0.08)


def test_a_folder_without_records_or_with_too_short_ones_is_refused(tmp_path):
    with pytest.raises(CampaignFileError, match="cannot be read"):
        wing_campaign(tmp_path / "nowhere")
    write_records(tmp_path / "short", size=200)
    with pytest.raises(CampaignDataError, match="60 are needed"):
        wing_campaign(tmp_path / "short")
    write_records(tmp_path / "one", count=1)
    with pytest.raises(CampaignDataError, match="two or more"):
        wing_campaign(tmp_path / "one")


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published measurements are not beside the project")
def test_the_published_measurements_make_a_campaign_that_reads_back(tmp_path):
    made = wing_campaign(PUBLISHED)
    assert [trial.kind for trial in made.trials] == [TrialKind.STATIC] * 2 + [TrialKind.RINGDOWN] * 5
    assert [trial.name for trial in made.held_out] == ["release 3", "release 5"]
    np.testing.assert_allclose(made.trials[0].force, [2.4525, 4.905, 7.3575, 9.81])
    np.testing.assert_allclose(made.trials[1].values[:, 0], [3.3528e-3, 7.2898e-3, 10.7442e-3, 13.7922e-3])
    assert made.channels[TIP].noise is not None
    read = write_wing_campaign(PUBLISHED, tmp_path / "campaign")
    for one, other in zip(made.trials, read.trials, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        assert one.release == other.release
    assert read.parameters == made.parameters
