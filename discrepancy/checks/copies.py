"""Channels of a trial that are copies of each other: scaled, shifted in time, or neither."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Trial
from discrepancy.checks.fault import DataFault, FaultKind, samples_text
from discrepancy.checks.held import estimate_roughness
from reporting.words import counted

COPIED_SHARE = 0.01
"""A channel is a copy if another one leaves less than this fraction of its noise unexplained."""
LEAST_SAMPLES = 32
"""Fewest samples that two channels must have in common for a comparison."""
LEAST_DIFFERENT_READINGS = 16
"""Fewest different readings of a channel with noise for a comparison."""
LEAST_CHANGES = 64
"""Fewest changes from one sample to the next in a channel without noise for a comparison."""
_MOST_SHIFTED_SAMPLES = 2**14
"""Samples in which the shift between two channels is searched."""


class _Copy(NamedTuple):
    """Two channels of which one is a copy of the other, with a phrase such as "times 1.5"."""

    original: str
    copy: str
    relation: str


def find_copied_channels(campaign: Campaign) -> Iterator[DataFault]:
    """Yield one fault for each pair of channels in which one channel is a copy of the other.

    Only dynamic trials are searched. The sentence of the fault describes the copy in the first
    trial that shows it, and says how many more trials show it.
    """
    trials_of_pairs: dict[tuple[str, str], list[tuple[Trial, str]]] = {}
    for trial in campaign.trials:
        if not trial.is_dynamic:
            continue
        for original, copy, relation in _copied_pairs(trial):
            trials_of_pairs.setdefault((original, copy), []).append((trial, relation))
    for (original, copy), trials in trials_of_pairs.items():
        trial, relation = trials[0]
        further_trials = ""
        if len(trials) > 1:
            further_trials = f", and in {counted(len(trials) - 1, 'more trial')}"
        place = samples_text(campaign.channels[copy], trial)
        sentence = (
            f"The channel {copy!r} is a copy of the channel {original!r} {relation} in "
            f"{place}{further_trials}: two sensors never share their noise, so correct `column` "
            "or the table, or leave one of them out."
        )
        yield DataFault(FaultKind.COPIED, sentence, copy, trial.name)


def _copied_pairs(trial: Trial) -> Iterator[_Copy]:
    """Yield the pairs of channels of a trial in which one channel is a copy of the other.

    Different sensors have independent noise, copies have the same. Sixth differences separate the
    noise from the motion. The shift in time between two channels is the lag of the largest
    cross-correlation of their noise, which must be at least 0.5 in magnitude. If one of two
    channels has no noise, they are copies only if all their readings are equal and change at least
    `LEAST_CHANGES` times.
    """
    if len(trial.time) < LEAST_SAMPLES:
        return
    noise = _noise_by_differences(trial.values[:_MOST_SHIFTED_SAMPLES])  # (samples, channels)
    power = np.sum(noise**2, axis=0)
    # Sixth differences of white noise have the lag-one correlation -6/7; those of a smooth motion
    # without noise have a correlation near 1.
    has_noise = np.sum(noise[1:] * noise[:-1], axis=0) < -0.5 * power
    spectra = np.fft.rfft(noise, 2 * len(noise), axis=0)  # padded, so that it does not wrap around
    change_counts = np.count_nonzero(np.diff(trial.values, axis=0), axis=0)
    for i, j in combinations(range(len(trial.channels)), 2):
        relation = None
        if not (has_noise[i] and has_noise[j]):
            moves = change_counts[i] >= LEAST_CHANGES
            if moves and np.array_equal(trial.values[:, i], trial.values[:, j]):
                relation = "digit for digit"
        else:
            # cross-correlation at all lags, by the fast Fourier transform (Wiener-Khinchin)
            correlation = np.fft.irfft(spectra[:, j] * np.conj(spectra[:, i]))
            peak = int(np.argmax(np.abs(correlation)))
            if abs(correlation[peak]) >= 0.5 * np.sqrt(power[i] * power[j]):
                # by how many samples channel j lags channel i; the second half of the inverse
                # transform holds the negative lags
                shift = peak if peak < len(noise) else peak - len(correlation)
                relation = _describe_copy(
                    trial.values[:, i],
                    trial.values[:, j],
                    trial.used[:, i],
                    trial.used[:, j],
                    shift,
                )
        if relation is not None:
            yield _Copy(trial.channels[i], trial.channels[j], relation)


def _noise_by_differences(values: FloatArray) -> FloatArray:
    """Return the sixth differences (N - 6, C) of records (N, C), which contain mostly noise.

    Differences above 15 times the median are set to zero, because a single jump or wrong reading
    would outweigh all noise in a correlation.
    """
    differences = np.diff(values, 6, axis=0)
    limit = 15.0 * np.median(np.abs(differences), axis=0)
    is_jump = (np.abs(differences) > limit) & (limit > 0.0)
    return np.where(is_jump, 0.0, differences)


def _describe_copy(
    original: FloatArray,
    copy: FloatArray,
    original_used: BoolArray,
    copy_used: BoolArray,
    shift: int,
) -> str | None:
    """Describe how one record is a copy of another: equal or scaled, and shifted in time.

    A scaled copy leaves less than `COPIED_SHARE` of its noise unexplained (standard deviations).

    Parameters
    ----------
    original, copy : (N,) ndarrays
        The record, and the one that may be its copy.
    original_used, copy_used : (N,) ndarrays of bool
        False for samples that are left out.
    shift : int
        By how many samples the copy lags the original; negative if it leads.

    Returns
    -------
    str or None
        A phrase for a message, such as "times 1.5, 3 samples later,". None if it is not a copy, if
        the records have too few samples or different readings in common, or if the copy has no
        noise there.
    """
    # the overlap of the two records after the shift
    count = len(original) - abs(shift)
    first_sample = max(-shift, 0)
    first_of_copy = max(shift, 0)
    in_original = slice(first_sample, first_sample + count)
    in_copy = slice(first_of_copy, first_of_copy + count)
    both_used = original_used[in_original] & copy_used[in_copy]
    x = original[in_original][both_used]
    y = copy[in_copy][both_used]
    if len(y) < LEAST_SAMPLES or len(np.unique(x)) < LEAST_DIFFERENT_READINGS:
        return None
    # The robust estimate is zero if most readings repeat. Sixth differences of white noise have 924
    # times its variance, see `estimate_roughness`.
    noise = estimate_roughness(y) or float(np.std(np.diff(y, 6)) / np.sqrt(924.0))
    if noise == 0.0:
        return None
    delay = ""
    if shift:
        delay = f", {abs(shift)} samples {'later' if shift > 0 else 'earlier'},"
    if np.array_equal(x, y):
        return f"digit for digit{delay}"
    # scale by least squares
    centred_original = x - x.mean()
    scale = float(centred_original @ (y - y.mean()) / (centred_original @ centred_original))
    unexplained_deviation = float(np.std(y - scale * x))
    if unexplained_deviation >= COPIED_SHARE * noise:
        return None
    return f"times {scale:.6g}{delay}"
