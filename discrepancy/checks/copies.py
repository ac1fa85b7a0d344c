"""Channels of a trial that are copies of each other: scaled, shifted in time, or neither."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Trial
from discrepancy.checks.fault import DataFault, FaultKind, samples_text
from discrepancy.checks.held import estimate_roughness

COPIED_SHARE = 0.01
"""A channel is a copy if another one leaves less than this fraction of its noise unexplained."""
LEAST_COPIED = 32
"""Fewest samples in which copies are searched."""
_MOST_SHIFTED_SAMPLES = 2**14
"""Samples in which the shift between two channels is searched."""


class _Copy(NamedTuple):
    """Two channels of which one is a copy of the other, with a phrase such as "times 1.5"."""

    original: str
    copy: str
    relation: str


def copy_faults(campaign: Campaign) -> Iterator[DataFault]:
    """Yield one fault for each pair of channels in which one channel is a copy of the other.

    Only dynamic trials are searched. The fault names the first trial in which the copy shows, and
    says in how many others it does.
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
            further_trials = f", and so in {len(trials) - 1} more of its trials"
        place = samples_text(campaign.channels[copy], trial)
        sentence = (
            f"The channel {copy!r} is the channel {original!r} {relation} in "
            f"{place}{further_trials}: two sensors never share their noise, so correct `column` "
            "or the table, or leave one of them out."
        )
        yield DataFault(FaultKind.COPIED, sentence, copy, trial.name)


def _copied_pairs(trial: Trial) -> Iterator[_Copy]:
    """Yield the pairs of channels of a trial in which one channel is a copy of the other.

    Different sensors have independent noise, copies have the same. Sixth differences separate the
    noise from the motion. The shift in time between two channels is the lag of the largest
    cross-correlation of their noise, which must be at least 0.5 in magnitude. Channels without
    noise are copies only if they are equal digit for digit and move.
    """
    if len(trial.time) < LEAST_COPIED:
        return
    noise = _noise_by_differences(trial.values[:_MOST_SHIFTED_SAMPLES])  # (samples, channels)
    power = np.sum(noise**2, axis=0)
    # Sixth differences of white noise have the lag-one correlation -6/7; those of a smooth motion
    # without noise have a correlation near 1.
    has_noise = np.sum(noise[1:] * noise[:-1], axis=0) < -0.5 * power
    spectra = np.fft.rfft(noise, 2 * len(noise), axis=0)  # padded, so that it does not wrap around
    change_counts = np.count_nonzero(np.diff(trial.values, axis=0), axis=0)
    for i, j in combinations(range(len(trial.channels)), 2):
        relation = ""
        if not (has_noise[i] and has_noise[j]):
            moves = change_counts[i] >= 2 * LEAST_COPIED
            if moves and np.array_equal(trial.values[:, i], trial.values[:, j]):
                relation = "digit for digit"
        else:
            # cross-correlation at all lags, by the fast Fourier transform (Wiener-Khinchin)
            correlation = np.fft.irfft(spectra[:, j] * np.conj(spectra[:, i]))
            peak = int(np.argmax(np.abs(correlation)))
            if abs(correlation[peak]) >= 0.5 * np.sqrt(power[i] * power[j]):
                # the second half of the inverse transform holds the negative lags
                shift = peak if peak < len(noise) else peak - len(correlation)
                relation = _describe_copy(
                    trial.values[:, i],
                    trial.values[:, j],
                    trial.used[:, i],
                    trial.used[:, j],
                    shift,
                )
        if relation:
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
) -> str:
    """Describe how one record is a copy of another: equal or scaled, and shifted in time.

    A scaled copy leaves less than `COPIED_SHARE` of its noise unexplained (standard deviations).

    Parameters
    ----------
    original, copy : (N,) ndarrays
        The record, and the one that may be its copy.
    original_used, copy_used : (N,) ndarrays of bool
        False for samples that are left out.
    shift : int
        The delay of the copy behind the original, in samples.

    Returns
    -------
    str
        Phrase for a message, such as "times 1.5, 3 samples later,"; empty if it is not a copy, or
        if too few samples or different readings overlap.
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
    if len(y) < LEAST_COPIED or len(np.unique(x)) < LEAST_COPIED // 2:
        return ""
    # The robust estimate is zero if most readings repeat. Sixth differences of white noise have 924
    # times its variance, see `estimate_roughness`.
    noise = estimate_roughness(y) or float(np.std(np.diff(y, 6)) / np.sqrt(924.0))
    if noise == 0.0:
        return ""
    delay = ""
    if shift:
        delay = f", {abs(shift)} samples {'later' if shift > 0 else 'earlier'},"
    if np.array_equal(x, y):
        return f"digit for digit{delay}"
    # scale by least squares
    centred_original = x - x.mean()
    scale = float(centred_original @ (y - y.mean()) / (centred_original @ centred_original))
    unexplained_deviation = float(np.std(y - scale * x))
    return f"times {scale:.6g}{delay}" if unexplained_deviation < COPIED_SHARE * noise else ""
