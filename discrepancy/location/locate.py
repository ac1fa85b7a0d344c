"""Locate where model and data disagree: a global verdict, a map, patterns, and one-sentence findings.

Patterns are singular vectors over the channels: one channel means a sensor, the shape of a mode dynamics or
load, all channels alike hum or temperature.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from discrepancy.campaign.noise_tests import holm, variance_p_value
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, said

from .dependence import dependences, excess, mode_shares, predicted_frequencies
from .map import Cell, residual_map
from .residuals import (
    FittedTrial,
    OmnibusTest,
    ResidualSet,
    coloured_noise,
    mean_square,
    noise_groups,
    serial_tests,
    variance_test,
    without_colour,
)

ALIKE = 0.9
"""Squared cosine from which two patterns over the channels count as the same."""

PATTERN_LEVEL = 0.01
"""Largest p-value of a pattern that is told."""
MOST_PATTERNS = 3


@dataclass(frozen=True)
class Disagreement:
    """One finding.

    Attributes
    ----------
    trials : str
        Kind of the trials where it shows.
    subject : str
        "mode 1", "channel g17", "all channels", ...; of a pattern over channels what it means.
    dependence : str
        What it goes with: "amplitude", "time", "load (not proportional)", "channels", ...
    share : float
        Of the excess variance of these trials.
    p_value : float
        Of the finding.
    sentence : str
        In words.
    channel : str
        Where a pattern over channels is strongest.
    """

    trials: str
    subject: str
    dependence: str
    share: float
    p_value: float
    sentence: str
    channel: str = ""


class Kind(NamedTuple):
    """Trials of one kind with the same channels, and their white residuals (N, C)."""

    name: str
    items: list[FittedTrial]
    white: list[FloatArray]

    def disagreement(self, subject: str, dependence: str, what: str, share: float, p: float) -> Disagreement:
        """Return a finding in these trials, `what` it is in words."""
        told = "p < 1e-6" if p < 1e-6 else f"p = {p:.1g}"
        sentence = said("location.explains", what=what, trials=self.name, percent=100.0 * share, p=told)
        return Disagreement(self.name, subject, dependence, share, p, sentence)


def kinds_of(residuals: ResidualSet, white: Sequence[FloatArray]) -> list[Kind]:
    """Return the trials by kind and channels: the groups that form one matrix each."""
    groups: dict[tuple[str, tuple[str, ...]], Kind] = {}
    for item, values in zip(residuals.trials, white, strict=True):
        kind = item.trial.kind.value.replace("ringdown", "ring-down")
        same = sum(name == kind for name, _ in groups)
        own = groups.setdefault(
            (kind, item.trial.channels), Kind(kind if not same else f"{kind} ({len(groups) + 1})", [], [])
        )
        own.items.append(item)
        own.white.append(values)
    return list(groups.values())


def singular_patterns(residuals: ResidualSet, kind: Kind) -> list[Disagreement]:
    """Return the significant singular patterns of a kind of trial, largest first.

    Vectors of the residual matrix (samples x channels, in units of the noise). Their p-value is that of the
    largest singular value of a noise matrix of this size: Tracy and Widom's law (Johnstone 2001, Ann.
    Statist. 29, 295-327) by the gamma distribution of its moments (Chiani 2014, J. Multivar. Anal. 129,
    69-81), averaged over what a noise record may be wrong by: that of the loudest channel.
    """
    found: list[Disagreement] = []
    matrix = np.vstack(kind.white)
    rows, columns = matrix.shape
    if min(rows, columns) < 2:
        return found
    _, singular, right = np.linalg.svd(matrix, full_matrices=False)
    surplus = max(float(np.sum(singular**2)) - rows * columns, 1e-9)
    roots = np.sqrt(max(rows, columns) - 1.0), np.sqrt(min(rows, columns))
    scale = sum(roots) * sum(1.0 / root for root in roots) ** (1.0 / 3.0)
    known = filter(None, map(residuals.degrees_of_freedom, kind.items[0].trial.channels))
    freedom = min([*known, 1e9])
    louder = freedom / stats.chi2.isf(((np.arange(1000) + 0.5) / 1000) ** (1.0 / columns), freedom)
    # After k patterns the rest is compared with whole noise matrices: a little too strict, never lax.
    for value, weights in zip(singular[:MOST_PATTERNS] ** 2, right, strict=False):
        off = (value / louder - sum(roots) ** 2) / scale
        p = float(np.mean(stats.gamma.sf(off + 9.84801, 46.446, scale=0.186054)))
        if p > PATTERN_LEVEL:
            break
        share = float(np.clip((value - max(rows, columns)) / surplus, 0.0, 1.0))
        meaning, words = _meaning(residuals, kind.items, weights)
        channel = kind.items[0].trial.channels[int(np.argmax(np.abs(weights)))]
        found.append(replace(kind.disagreement(meaning, "channels", words, share, p), channel=channel))
    return found


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
        Of the draw that restores what the fit absorbed.

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
    fitted = without_colour(fitted)
    white = fitted.white(np.random.default_rng(seed))
    coloured = coloured_noise(fitted)
    tests = (variance_test(fitted), *serial_tests(fitted, white, tuple(coloured)))
    rejected = holm([test.p_value for test in tests], GLOBAL_LEVEL)
    tests = tuple(replace(test, rejected=flag) for test, flag in zip(tests, rejected, strict=True))
    found: list[tuple[float, Disagreement]] = []
    for kind in kinds_of(fitted, white) if any(rejected) else ():
        # shares are of one kind of trial; what explains most of the whole gap is told first
        gap = sum(max(excess([item]), 0.0) for item in kind.items)
        patterns = singular_patterns(fitted, kind)
        told = (_disagreement(kind, patterns), *patterns)
        found += [(gap * item.share, item) for item in told if item is not None]
    cells = residual_map(fitted, white, MAP_RATE)
    remarks = [*coloured.values(), *_noise_remarks(fitted)]
    if any(item.used.any() for item in fitted.trials) and all(cell.axis == "frequency" for cell in cells):
        remarks.append(said("location.not_judged"))
    disagreements = tuple(item for _, item in sorted(found, key=lambda row: -row[0]))
    return Location(any(rejected), tests, cells, disagreements, tuple(remarks))


def _noise_remarks(residuals: ResidualSet) -> tuple[str, ...]:
    remarks = []
    if unknown := sorted({*residuals.measured} - {*residuals.recorded}):
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


def _disagreement(kind: Kind, patterns: Sequence[Disagreement]) -> Disagreement | None:
    """Return the finding on what the excess of a kind of trial goes with."""
    rows = list(dependences(kind.items))
    worth = [row for row in rows if row.share >= _WORTH_TELLING and row.p_value < 1e-3]
    if not worth:
        return None
    close = [row for row in worth if row.share >= max(row.share for row in worth) - _CLOSE]
    told = min(close, key=lambda row: (row.coefficients, -row.share))  # the simplest that suffices
    subject, words = told.subject or _subject(kind, patterns), f"by {told.name}"
    rival = told.subject, {"amplitude": "time", "time": "amplitude"}.get(told.name)
    if any((row.subject, row.name) == rival and row.share >= told.share - _CLOSE for row in rows):
        words = "by amplitude or time (these releases do not tell the two apart)"
    if told.name.startswith("a "):
        words = told.name
        if subject.startswith("mode"):
            subject = "all channels"  # a line of its own frequency is no matter of a mode that the model has
    what = f"{subject[0].upper()}{subject[1:]}, {words},"
    return kind.disagreement(subject, told.name, what, told.share, told.p_value)


def _subject(kind: Kind, patterns: Sequence[Disagreement]) -> str:
    """Return what disagrees: a channel alone, the mode with most of the excess, or all channels."""
    channels = kind.items[0].trial.channels
    alone = [item.channel for item in patterns if item.subject == "sensor" and item.share > 0.5]
    if len(channels) == 1 or alone:
        return f"channel {[*alone, *channels][0]}"
    at = predicted_frequencies(kind.items) if kind.items[0].trial.is_dynamic else ()
    shares = mode_shares(kind.items, kind.white, at) if at else np.zeros(1)
    return f"mode {int(np.argmax(shares)) + 1}" if shares.max() > 0.5 else "all channels"
