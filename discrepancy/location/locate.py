"""Locate where model and data disagree: a global verdict, a map, patterns, and one-sentence findings.

Patterns are singular vectors over the channels: one channel means a sensor, the shape of a mode dynamics or
load, all channels alike hum or temperature.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.noise_tests import holm, variance_p_value
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError
from discrepancy.sentences import said

from .dependence import Disagreement, excess, explanations, kinds, mode_shares, predicted_frequencies
from .map import Cell, residual_map
from .omnibus_tests import OmnibusTest, coloured_noise, mean_square, noise_groups, serial_tests, variance_test
from .residuals import FittedTrial, ResidualSet

ALIKE = 0.9
"""Squared cosine from which two patterns over the channels count as the same."""

PATTERN_LEVEL = 0.01
"""Largest p-value of a pattern that is told."""

_SIMULATIONS = 999


def singular_patterns(
    residuals: ResidualSet, white: Sequence[FloatArray], generator: np.random.Generator
) -> tuple[Disagreement, ...]:
    """Return the significant singular patterns of each kind of trial, largest first.

    Vectors of the residual matrix (samples x channels, in units of the noise). Their p-value is the share of
    simulated noise matrices of this size whose largest singular value is larger.

    Parameters
    ----------
    residuals : ResidualSet
        Fitted trials.
    white : sequence of (N, C) ndarray
        What its `white` returned.
    generator : numpy.random.Generator
        For the null distribution of singular values.
    """
    found: list[Disagreement] = []
    for name, members in kinds(residuals).items():
        items = [residuals.trials[number] for number in members]
        channels = items[0].trial.channels
        matrix = np.vstack([white[number] for number in members])
        rows, columns = matrix.shape
        if columns < 2 or rows < 2:
            continue
        _, singular, right = np.linalg.svd(matrix, full_matrices=False)
        null = _largest_singular_squares(rows, columns, generator)
        surplus = max(float(np.sum(singular**2)) - rows * columns, 1e-9)
        expected = rows * columns / min(rows, columns)
        for number, (value, weights) in enumerate(zip(singular**2, right, strict=True)):
            # After k patterns the rest is compared with whole noise matrices: a little too strict, never lax.
            p = (1.0 + float(np.sum(null >= value))) / (null.size + 1.0)
            if p > PATTERN_LEVEL:
                break
            share = float(np.clip((value - expected) / surplus, 0.0, 1.0))
            meaning, words = _meaning(residuals, items, weights)
            told = f"p {'<=' if p <= 1.0 / _SIMULATIONS else '='} {p:.1g}"
            sentence = said("location.explains", what=words, trials=name, percent=100.0 * share, p=told)
            channel = channels[int(np.argmax(np.abs(weights)))]
            found.append(Disagreement(name, meaning, "channels", share, p, 0, sentence, channel))
            if number >= 2:
                break
    return tuple(found)


def _largest_singular_squares(rows: int, columns: int, generator: np.random.Generator) -> FloatArray:
    """Return draws of the largest squared singular value of a standard normal matrix.

    Bartlett's decomposition: the triangular factor of a Wishart matrix is drawn, not the matrix.
    """
    size, longer = min(rows, columns), max(rows, columns)
    factor = np.tril(generator.standard_normal((_SIMULATIONS, size, size)), -1)
    diagonal = np.sqrt(generator.chisquare(longer - np.arange(size), (_SIMULATIONS, size)))
    factor[:, np.arange(size), np.arange(size)] = diagonal
    return np.asarray(np.linalg.norm(factor, ord=2, axis=(1, 2)) ** 2)


def _meaning(residuals: ResidualSet, items: Sequence[FittedTrial], weights: FloatArray) -> tuple[str, str]:
    """Return "sensor", "dynamics or load", "common" or "mixed" of a pattern, and it in words."""
    channels = items[0].trial.channels
    largest = int(np.argmax(np.abs(weights)))
    noise, alone = items[0].noise_deviation, np.eye(len(weights))[largest]
    compared = [(alone, "sensor", said("location.sensor", name=channels[largest]))]
    if len({residuals.channels[name].quantity for name in channels}) == 1:
        compared.append((1.0 / noise, "common", said("location.common")))
    prediction = np.vstack([(i.prediction - i.prediction.mean(axis=0)) / noise for i in items])
    own = np.linalg.svd(prediction, full_matrices=False)[2][0]
    compared.append((own if np.any(prediction) else 0.0 * own, "dynamics or load", said("location.response")))
    candidates = [
        (float((weights @ v) ** 2 / ((weights @ weights) * (v @ v))), kind, words)
        for v, kind, words in compared
        if np.any(v)
    ]
    best = max(candidates, key=lambda row: row[0])
    if best[0] < ALIKE:
        listed = np.argsort(-np.abs(weights))[:3]
        return "mixed", f"A pattern of its own, strongest on {', '.join(channels[i] for i in listed)},"
    rivals = {row[1] for row in candidates if row[0] >= max(ALIKE, best[0] - 0.05)} - {best[1]}
    if rivals:
        return "mixed", f"{best[2].rstrip(',')} or equally {' or '.join(sorted(rivals))}"
    return best[1], best[2]


GLOBAL_LEVEL = 0.01
"""Rate of false alarms of the global verdict."""

MAP_RATE = 0.05
"""False discovery rate of the map."""

_TOO_SMALL = 1e-3  # p-value below which residuals are smaller than the noise record allows
_FAR_OUT = 6.0  # noise deviations; 2e-9 of Gaussian samples lie beyond
_MEDIAN = 0.6745  # of the magnitude of a standard normal variable
_WORTH_TELLING = 0.05  # share of the excess variance below which a dependence is not told
_CLOSE = 0.02  # shares this close are not told apart


@dataclass(frozen=True)
class Location:
    """Where a fitted hypothesis disagrees with the data.

    Attributes
    ----------
    disagrees : bool
        Global verdict: Holm at `GLOBAL_LEVEL` over the omnibus tests.
    tests : tuple of OmnibusTest
        Variance, Ljung-Box, cumulative periodogram, Fisher g.
    cells : tuple of Cell
        The map; significant at the false discovery rate `MAP_RATE`.
    disagreements : tuple of Disagreement
        Findings in words, largest first; empty if nothing disagrees.
    remarks : tuple of str
        Limits: a missing noise record, noise that is not white, residuals smaller than the noise, a model so
        far off that no cell can be judged.
    """

    disagrees: bool
    tests: tuple[OmnibusTest, ...]
    cells: tuple[Cell, ...]
    disagreements: tuple[Disagreement, ...]
    remarks: tuple[str, ...]


def locate(residuals: ResidualSet, *, seed: int = 0) -> Location:
    """Locate disagreement in the fitted trials of a set.

    Parameters
    ----------
    residuals : ResidualSet
        Residuals of one hypothesis; held-out trials are not looked at.
    seed : int
        Of the draw that restores what the fit absorbed, and of the null distribution of singular values.

    Returns
    -------
    Location
        The same bits for the same input and seed.

    Raises
    ------
    FitError
        If no trial was fitted.
    """
    fitted = residuals.fitted
    if fitted is None:
        raise FitError("Nothing can be located: every trial is held out, and at least one fitted is needed.")
    generator = np.random.default_rng(seed)
    white = fitted.white(generator)
    coloured = coloured_noise(fitted)
    tests = (variance_test(fitted), *serial_tests(fitted, white, tuple(coloured)))
    rejected = holm([test.p_value for test in tests], GLOBAL_LEVEL)
    tests = tuple(replace(test, rejected=flag) for test, flag in zip(tests, rejected, strict=True))
    patterns = singular_patterns(fitted, white, generator)
    disagrees = any(rejected)
    cells = residual_map(fitted, white, MAP_RATE)
    judged = any(cell.axis != "frequency" for cell in cells)
    return Location(
        disagrees=disagrees,
        tests=tests,
        cells=cells,
        disagreements=_disagreements(fitted, white, patterns) if disagrees else (),
        remarks=(
            *coloured.values(),
            *_noise_remarks(fitted),
            *(() if judged else (said("location.not_judged"),)),
        ),
    )


def _noise_remarks(residuals: ResidualSet) -> tuple[str, ...]:
    remarks = []
    named = {name for item in residuals.trials for name in item.trial.channels}
    unknown = sorted(name for name in named if residuals.degrees_of_freedom(name) <= 0.0)
    if unknown:
        remarks.append(said("location.no_noise_record", names=", ".join(unknown)))
    for names in noise_groups(residuals).values():
        square, freedom = mean_square(residuals, names)
        if freedom < 1.0:
            continue
        p = variance_p_value(square, freedom, residuals.degrees_of_freedom(names[0]), small=True)
        if p < _TOO_SMALL:
            few = f"{', '.join(names[:4])}{' ..' if len(names) > 4 else ''}"
            remarks.append(said("location.too_small", names=few, square=square, p=p))
    return tuple(remarks)


def outlier_remarks(residuals: ResidualSet) -> tuple[str, ...]:
    """Return a sentence on single samples far out whose neighbours are not: errors of the data.

    Far out of the noise, and of what the hypothesis leaves elsewhere: where a model is off, its residuals are
    large at many places. Samples beside a gap have no neighbours to be compared with.
    """
    places: dict[str, int] = {}
    for item in residuals.trials:
        if not item.trial.is_dynamic:
            continue
        for column, name in enumerate(item.trial.channels):
            size = np.abs(item.standardised[:, column])
            kept = size[np.isfinite(size)]
            beside = np.full((2, len(size)), np.nan)
            beside[0, 1:], beside[1, :-1] = size[:-1], size[1:]
            far = _FAR_OUT * max(1.0, float(np.median(kept)) / _MEDIAN) if kept.size else np.inf
            alone = (size > far) & (beside.max(axis=0) < 0.5 * size)  # not a number beside a gap
            places[name] = places.get(name, 0) + int(alone.sum())
    found = {name: count for name, count in places.items() if count}
    if not found:
        return ()
    listed = ", ".join(f"{name} ({count})" for name, count in found.items())
    return (said("location.outliers", far=_FAR_OUT, names=listed),)


def _disagreements(
    residuals: ResidualSet, white: Sequence[FloatArray], patterns: Sequence[Disagreement]
) -> tuple[Disagreement, ...]:
    found: list[Disagreement] = []
    explained = explanations(residuals)
    gap: dict[str, float] = {}
    for name, members in kinds(residuals).items():
        items = [residuals.trials[number] for number in members]
        gap[name] = sum(max(excess([item]), 0.0) for item in items)
        rows = [row for row in explained if row.trials == name]
        told = _smallest_sufficient(rows)
        if told is None:
            continue
        subject = told.subject or _subject(name, items, [white[n] for n in members], patterns)
        line = told.dependence.startswith("a ")
        if line and subject.startswith("mode"):
            subject = "all channels"  # a line of its own frequency is no matter of a mode that the model has
        words = told.dependence if line else f"by {_dependence_words(told, rows)}"
        whose = f"{subject[0].upper()}{subject[1:]}, {words},"
        p = "p < 1e-6" if told.p_value < 1e-6 else f"p = {told.p_value:.1g}"
        sentence = said("location.explains", what=whose, trials=name, percent=100.0 * told.share, p=p)
        found.append(replace(told, subject=subject, sentence=sentence))
    # Shares are of one kind of trial; what explains most of the whole gap is told first.
    return tuple(sorted((*found, *patterns), key=lambda item: -item.share * gap[item.trials]))


def _subject(
    name: str,
    items: Sequence[FittedTrial],
    white: Sequence[FloatArray],
    patterns: Sequence[Disagreement],
) -> str:
    """Return what disagrees: a channel alone, the mode with most of the excess, or all channels."""
    channels = items[0].trial.channels
    if len(channels) == 1:
        return f"channel {channels[0]}"
    for pattern in patterns:
        if pattern.trials == name and pattern.subject == "sensor" and pattern.share > 0.5:
            return f"channel {pattern.channel}"
    if items[0].trial.is_dynamic:
        at = predicted_frequencies(items)
        shares = mode_shares(items, white, at) if at else np.zeros(1)
        if shares.max() > 0.5:
            return f"mode {int(np.argmax(shares)) + 1}"
    return "all channels"


def _smallest_sufficient(rows: Sequence[Disagreement]) -> Disagreement | None:
    """Return the dependence with fewest coefficients among those within 2 % of the largest share."""
    rows = [row for row in rows if row.share >= _WORTH_TELLING and row.p_value < 1e-3]
    if not rows:
        return None
    best = max(row.share for row in rows)
    return min(
        (row for row in rows if row.share >= best - _CLOSE), key=lambda row: (row.coefficients, -row.share)
    )


def _dependence_words(told: Disagreement, rows: Sequence[Disagreement]) -> str:
    """Return the dependence, and its rival where one release amplitude cannot tell the two apart."""
    rivals = {"amplitude": "time", "time": "amplitude"}
    if told.dependence not in rivals:
        return told.dependence
    wanted = (told.subject, rivals[told.dependence])
    other = next((row for row in rows if (row.subject, row.dependence) == wanted), None)
    if other is None or other.share < told.share - _CLOSE:
        return told.dependence
    return "amplitude or time (these releases do not tell the two apart)"
