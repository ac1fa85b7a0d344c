"""Singular patterns of residuals over the channels, and what they mean."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from discrepancy.campaign.records import FloatArray
from discrepancy.location.residuals import FittedTrial, ResidualSet

LEAST_AGREEMENT = 0.9
"""Least squared cosine between two patterns over the channels that count as the same."""
PATTERN_LEVEL = 0.01
"""Largest p-value of a pattern that is reported."""
MOST_PATTERNS = 3
"""Most patterns that are reported for a kind of trial."""
NOISE_QUANTILES = 1000
"""Number of quantiles of the error of the noise records over which a p-value is averaged."""
EXACT_NOISE_FREEDOM = 1e9
"""Degrees of freedom of a noise record that stand for an exactly known variance, or for none."""


@dataclass(frozen=True)
class Disagreement:
    """One finding on where model and data disagree.

    Attributes
    ----------
    trials : str
        The kind of the trials in which it shows.
    subject : str
        "mode 1", "channel g17", "all channels", ...; for a pattern over channels its meaning.
    dependence : str
        What the residuals depend on: "amplitude", "time", "load (not proportional)", "channels",
        ...
    share : float
        The fraction of the excess variance of these trials that it explains.
    p_value : float
        The p-value of the finding.
    sentence : str
        The sentence that tells the finding.
    channel : str
        The channel on which a pattern over channels is strongest.
    """

    trials: str
    subject: str
    dependence: str
    share: float
    p_value: float
    sentence: str
    channel: str = ""


class TrialsOfKind(NamedTuple):
    """Trials of one kind with the same C channels.

    Attributes
    ----------
    name : str
        The name of the kind, for messages.
    trials : list of FittedTrial
        The trials with their predictions and residuals.
    white : list of (N, C) ndarray
        The white residuals of each trial.
    """

    name: str
    trials: list[FittedTrial]
    white: list[FloatArray]

    def disagreement(
        self, subject: str, dependence: str, phrase: str, share: float, p_value: float
    ) -> Disagreement:
        """Return the record of a finding on these trials.

        Its sentence consists of the phrase, the kind of trials, the explained fraction of the
        excess variance (`share`) and the p-value.
        """
        p_text = "p < 1e-6" if p_value < 1e-6 else f"p = {p_value:.1g}"
        sentence = (
            f"{phrase} in {self.name} trials; explains {100.0 * share:.0f} % of the excess "
            f"variance ({p_text})."
        )
        return Disagreement(self.name, subject, dependence, share, p_value, sentence)


def group_by_kind(
    residuals: ResidualSet, white_residuals: Sequence[FloatArray]
) -> list[TrialsOfKind]:
    """Return the trials, with the white residuals (N, C) of each, grouped by kind and channels.

    A second group of one kind has a number in its name, such as "static (2)".
    """
    groups: dict[tuple[str, tuple[str, ...]], TrialsOfKind] = {}
    for fitted_trial, values in zip(residuals.trials, white_residuals, strict=True):
        kind = fitted_trial.trial.kind.value.replace("ringdown", "ring-down")
        key = (kind, fitted_trial.trial.channels)
        if key not in groups:
            is_first_of_kind = all(other_kind != kind for other_kind, _ in groups)
            name = kind if is_first_of_kind else f"{kind} ({len(groups) + 1})"
            groups[key] = TrialsOfKind(name, [], [])
        groups[key].trials.append(fitted_trial)
        groups[key].white.append(values)
    return list(groups.values())


def singular_patterns(residuals: ResidualSet, kind: TrialsOfKind) -> list[Disagreement]:
    """Return the significant patterns of residuals over the channels, largest first.

    A pattern is a right singular vector of the matrix of white residuals (samples x channels, in
    units of the noise). The p-value of a pattern is that of its singular value as the largest one
    of a noise matrix of this size. The squared largest singular value of noise has the law of Tracy
    and Widom (Johnstone 2001, Ann. Statist. 29, 295-327), approximated by a shifted gamma
    distribution with the same moments (Chiani 2014, J. Multivar. Anal. 129, 69-81). The p-value is
    averaged over the error of the noise records, because a channel whose noise was underestimated
    looks like a pattern. At most `MOST_PATTERNS` are returned, up to the first with a p-value above
    `PATTERN_LEVEL`.

    Parameters
    ----------
    residuals : ResidualSet
        The set, for the noise records.
    kind : TrialsOfKind
        The trials of one kind, which have the same channels.
    """
    matrix = np.vstack(kind.white)  # (samples of all trials, channels)
    sample_count, channel_count = matrix.shape
    if min(sample_count, channel_count) < 2:
        return []
    _, singular_values, right_vectors = np.linalg.svd(matrix, full_matrices=False)
    sum_of_squares = float(np.sum(singular_values**2))
    excess_squares = max(sum_of_squares - sample_count * channel_count, 1e-9)
    # centre and scale of the largest squared singular value of noise (Johnstone 2001, theorem 1.1)
    longer_root = np.sqrt(max(sample_count, channel_count) - 1.0)
    shorter_root = np.sqrt(min(sample_count, channel_count))
    centre = (longer_root + shorter_root) ** 2
    scale = (longer_root + shorter_root) * (1.0 / longer_root + 1.0 / shorter_root) ** (1.0 / 3.0)
    noise_ratios = _largest_noise_ratios(residuals, kind)
    patterns: list[Disagreement] = []
    # After k patterns the remaining matrix is smaller, but compared with a full noise matrix: later
    # p-values are a little too large, never too small.
    for square, weights in zip(singular_values[:MOST_PATTERNS] ** 2, right_vectors, strict=False):
        standardised = (square / noise_ratios - centre) / scale
        # Chiani's gamma approximation for real data: shape 46.446, scale 0.186054, shift 9.84801
        tail = stats.gamma.sf(standardised + 9.84801, 46.446, scale=0.186054)
        p_value = float(np.mean(tail))
        if p_value > PATTERN_LEVEL:
            break
        # noise alone has about this squared singular value, if samples and channels differ much
        square_of_noise = max(sample_count, channel_count)
        share = float(np.clip((square - square_of_noise) / excess_squares, 0.0, 1.0))
        meaning, phrase = _interpret_pattern(residuals, kind.trials, weights)
        channel = kind.trials[0].trial.channels[int(np.argmax(np.abs(weights)))]
        finding = kind.disagreement(meaning, "channels", phrase, share, p_value)
        patterns.append(replace(finding, channel=channel))
    return patterns


def _largest_noise_ratios(residuals: ResidualSet, kind: TrialsOfKind) -> FloatArray:
    """Return quantiles of the largest ratio of true to recorded noise variance among C channels.

    A variance that is estimated from a noise record of n degrees of freedom is the true variance
    times chi-squared / n, so that the true variance over the recorded one is n / chi-squared. The
    largest of C such independent ratios is below q with the C-th power of the probability that one
    of them is. Its quantile at the probability q is thus n / chi2.isf(q^(1/C)). All records are
    taken to have the degrees of freedom of the shortest one.

    Parameters
    ----------
    residuals : ResidualSet
        The residuals, with the noise records of the channels.
    kind : TrialsOfKind
        The trials, which all have the same C channels.

    Returns
    -------
    (NOISE_QUANTILES,) ndarray
        The quantiles of the largest ratio at evenly spaced probabilities.
    """
    channels = kind.trials[0].trial.channels
    record_freedoms = []
    for name in channels:
        record_freedom = residuals.degrees_of_freedom(name)
        if record_freedom > 0.0:
            record_freedoms.append(record_freedom)
    least_freedom = min([*record_freedoms, EXACT_NOISE_FREEDOM])
    probabilities = (np.arange(NOISE_QUANTILES) + 0.5) / NOISE_QUANTILES
    quantiles = stats.chi2.isf(probabilities ** (1.0 / len(channels)), least_freedom)
    return np.asarray(least_freedom / quantiles)


class _PatternMeaning(NamedTuple):
    """What a pattern over the channels may mean.

    Attributes
    ----------
    subject : str
        "sensor", "common", "dynamics or load" or "mixed".
    phrase : str
        The beginning of a sentence about the pattern.
    """

    subject: str
    phrase: str


def _interpret_pattern(
    residuals: ResidualSet, trials: Sequence[FittedTrial], weights: FloatArray
) -> _PatternMeaning:
    """Interpret a pattern `weights` (C,) over the channels by the known one that it resembles most.

    The agreement of two patterns is the squared cosine of the angle between them. The meaning is
    "mixed" if it is less than `LEAST_AGREEMENT` for all known patterns, or if a known pattern of
    another meaning agrees within 0.05 of the best one.
    """
    channels = trials[0].trial.channels
    agreements = []
    for meaning, pattern in _known_patterns(residuals, trials, weights):
        if np.any(pattern):
            norms = (weights @ weights) * (pattern @ pattern)
            agreements.append((float((weights @ pattern) ** 2 / norms), meaning))
    best_agreement, best_meaning = max(agreements, key=lambda candidate: candidate[0])
    if best_agreement < LEAST_AGREEMENT:
        strongest_channels = np.argsort(-np.abs(weights))[:3]
        names = ", ".join(channels[index] for index in strongest_channels)
        return _PatternMeaning("mixed", f"A pattern of its own, strongest on {names},")
    competing_subjects = set()
    for agreement, meaning in agreements:
        agrees_as_well = agreement >= max(LEAST_AGREEMENT, best_agreement - 0.05)
        if agrees_as_well and meaning.subject != best_meaning.subject:
            competing_subjects.add(meaning.subject)
    if competing_subjects:
        subjects_text = " or ".join(sorted(competing_subjects))
        phrase = f"{best_meaning.phrase.rstrip(',')} or equally {subjects_text}"
        return _PatternMeaning("mixed", phrase)
    return best_meaning


def _known_patterns(
    residuals: ResidualSet, trials: Sequence[FittedTrial], weights: FloatArray
) -> Iterator[tuple[_PatternMeaning, FloatArray]]:
    """Yield the patterns over C channels that have a known meaning, with this meaning.

    Known patterns are one channel alone, the same physical value in all channels (if all measure
    the same quantity), and the main pattern of the predicted motion, which is zero if the
    predictions are zero.

    Parameters
    ----------
    residuals : ResidualSet
        The set, for the quantities of the channels.
    trials : sequence of FittedTrial
        The trials, for their predictions.
    weights : (C,) ndarray
        The pattern to interpret; its largest entry selects the single channel.

    Yields
    ------
    meaning : _PatternMeaning
        What the pattern means.
    pattern : (C,) ndarray
        The pattern, in units of each channel's noise.
    """
    channels = trials[0].trial.channels
    noise = trials[0].noise_deviation
    largest = int(np.argmax(np.abs(weights)))
    single_channel = np.eye(len(weights))[largest]
    sensor = _PatternMeaning("sensor", f"One channel, {channels[largest]} (a sensor),")
    yield sensor, single_channel
    if len({residuals.channels[name].quantity for name in channels}) == 1:
        phrase = "All channels alike, whatever they measure (hum, temperature or zero),"
        yield _PatternMeaning("common", phrase), 1.0 / noise
    # the main pattern of the predictions is their first right singular vector
    predictions = []
    for fitted_trial in trials:
        # deviations from the mean, in units of the noise
        predictions.append((fitted_trial.prediction - fitted_trial.prediction.mean(axis=0)) / noise)
    prediction = np.vstack(predictions)  # (samples of all trials, C)
    _, _, right_vectors = np.linalg.svd(prediction, full_matrices=False)
    response = right_vectors[0] if np.any(prediction) else 0.0 * right_vectors[0]
    phrase = "The pattern of the predicted response itself (dynamics, load, or clock)"
    yield _PatternMeaning("dynamics or load", phrase), response
