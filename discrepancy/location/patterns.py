"""Patterns of residuals over the channels: singular vectors and what they mean.

One channel means a sensor, the shape of a mode dynamics or load, all channels alike hum or temperature.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.location.dependence import kinds
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.sentences import said

ALIKE = 0.9
"""Squared cosine from which two patterns over the channels count as the same."""

_SIMULATIONS = 999


@dataclass(frozen=True)
class SingularPattern:
    """A singular vector of the residual matrix (samples x channels, in units of the noise).

    Attributes
    ----------
    trials : str
        "ring-down", "forced", "static" or "flight" trials.
    channels : tuple of str
        Columns of the matrix.
    weights : (C,) ndarray
        Right singular vector, unit length.
    share : float
        Of the excess variance of these trials.
    p_value : float
        Share of simulated noise matrices of this size whose largest singular value is larger.
    meaning : str
        "sensor", "dynamics or load", "common" or "mixed".
    sentence : str
        In words.
    """

    trials: str
    channels: tuple[str, ...]
    weights: FloatArray
    share: float
    p_value: float
    meaning: str
    sentence: str


def singular_patterns(
    residuals: ResidualSet,
    white: Sequence[FloatArray],
    shapes: Mapping[str, Mapping[str, float]],
    generator: np.random.Generator,
    level: float = 0.01,
) -> tuple[SingularPattern, ...]:
    """Return the significant singular patterns of each kind of trial, largest first.

    Parameters
    ----------
    residuals : ResidualSet
        Fitted trials.
    white : sequence of (N, C) ndarray
        What its `white` returned.
    shapes : mapping of str to mapping of str to float
        Patterns to compare with, such as mode shapes: name -> channel -> value [channel's unit]. The pattern
        of the prediction itself is always compared.
    generator : numpy.random.Generator
        For the null distribution of singular values.
    level : float
        Largest p-value of a pattern that is returned.
    """
    found: list[SingularPattern] = []
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
            if p > level:
                break
            share = float(np.clip((value - expected) / surplus, 0.0, 1.0))
            meaning, words = _meaning(residuals, items, channels, weights, shapes)
            told = f"p {'<=' if p <= 1.0 / _SIMULATIONS else '='} {p:.1g}"
            sentence = said("location.explains", what=words, trials=name, percent=100.0 * share, p=told)
            found.append(SingularPattern(name, channels, weights, share, p, meaning, sentence))
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


def _meaning(
    residuals: ResidualSet,
    items: Sequence[FittedTrial],
    channels: tuple[str, ...],
    weights: FloatArray,
    shapes: Mapping[str, Mapping[str, float]],
) -> tuple[str, str]:
    """Return the meaning of a pattern over the channels, and it in words."""
    largest = int(np.argmax(np.abs(weights)))
    noise, alone = items[0].noise_deviation, np.eye(len(weights))[largest]
    compared = [(alone, "sensor", said("location.sensor", name=channels[largest]))]
    if len({residuals.channels[name].quantity for name in channels}) == 1:
        compared.append((1.0 / noise, "common", said("location.common")))
    prediction = np.vstack([(i.prediction - i.prediction.mean(axis=0)) / noise for i in items])
    own = np.linalg.svd(prediction, full_matrices=False)[2][0]
    compared.append((own if np.any(prediction) else 0.0 * own, "dynamics or load", said("location.response")))
    for name, shape in shapes.items():
        values = np.array([shape.get(channel, 0.0) for channel in channels]) / noise
        compared.append((values, "dynamics or load", said("location.shape", name=name)))
    candidates = [(_squared_cosine(weights, v), kind, words) for v, kind, words in compared if np.any(v)]
    best = max(candidates, key=lambda row: row[0])
    if best[0] < ALIKE:
        listed = np.argsort(-np.abs(weights))[:3]
        return "mixed", f"A pattern of its own, strongest on {', '.join(channels[i] for i in listed)},"
    rivals = {row[1] for row in candidates if row[0] >= max(ALIKE, best[0] - 0.05)} - {best[1]}
    if rivals:
        return "mixed", f"{best[2].rstrip(',')} or equally {' or '.join(sorted(rivals))}"
    return best[1], best[2]


def _squared_cosine(first: FloatArray, second: FloatArray) -> float:
    return float((first @ second) ** 2 / ((first @ first) * (second @ second)))
