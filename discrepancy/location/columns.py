"""What residuals may go with, as named columns, and the regression that says whether they do.

A column b has z = b . r / sqrt(b . b - |S^T b|^2): every p-value allows for what the fit has absorbed, and a
column that the fit absorbs is not tested.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.location.residuals import FittedTrial

_FREE_SHARE = 0.02  # of a direction's square must survive the fit, else it says nothing


class Part(NamedTuple):
    """One channel of a dependence: B'B, B'r and S'B, where B has unit columns."""

    gram: FloatArray
    along: FloatArray
    absorbed: FloatArray


def part_of(basis: FloatArray, items: Sequence[tuple[FittedTrial, BoolArray]], column: int) -> Part | None:
    """Return columns (n, k) over rows (N,) of trials beside residuals; None if they explain anything."""
    size = np.linalg.norm(basis, axis=0)
    basis = basis[:, size > 0.0] / size[size > 0.0]
    residual = np.concatenate([item.standardised[rows, column] for item, rows in items])
    if not 0 < basis.shape[1] < max(residual.size, 2):
        return None  # as many coefficients as samples explain anything
    sensitive = [item.sensitivity[rows, column] for item, rows in items if item.sensitivity is not None]
    if len(sensitive) == len(items):
        return Part(basis.T @ basis, basis.T @ residual, np.vstack(sensitive).T @ basis)
    expected = np.concatenate([item.expected_variance[rows, column] for item, rows in items])
    return Part((basis.T * expected) @ basis, basis.T @ residual, np.zeros((0, basis.shape[1])))


def explained(parts: Sequence[Part]) -> tuple[float, int]:
    """Return the sum of squares that a dependence explains, and the number of its coefficients.

    B'r has the covariance G = B'(I - S S')B under the null, so that (B'r)' G^-1 (B'r) is chi^2; with a gap it
    is what B explains of it after the fit has absorbed its share. Directions that it absorbs are left out.
    """
    gram = block_diag(*(part.gram for part in parts))
    if all(part.absorbed.shape[0] for part in parts):
        absorbed = np.hstack([part.absorbed for part in parts])
        gram = gram - absorbed.T @ absorbed
    along = np.concatenate([part.along for part in parts])
    values, vectors = np.linalg.eigh(gram)
    kept = values > _FREE_SHARE
    return float(np.sum((vectors[:, kept].T @ along) ** 2 / values[kept])), int(kept.sum())


def envelope(item: FittedTrial, column: int) -> FloatArray:
    """Return the amplitude of a channel's predicted motion, (N,): sqrt(x^2 + (v / w)^2) over one period.

    w is the ratio of the root mean squares of rate and value; the mean is taken out first.
    """
    assert item.rates is not None
    x = item.prediction[:, column] - _resting(item, column)
    v = item.rates[:, column]
    size, speed = float(np.sqrt(np.mean(x**2))), float(np.sqrt(np.mean(v**2)))
    if size == 0.0 or speed == 0.0:
        return np.abs(x)
    amplitude = np.hypot(x, v * size / speed)
    width = min(max(1, round(2.0 * np.pi * size / (speed * item.trial.interval))), len(x))
    kernel = np.ones(width)
    return np.asarray(np.convolve(amplitude, kernel, "same") / np.convolve(np.ones_like(x), kernel, "same"))


def _resting(item: FittedTrial, column: int) -> float:
    """Return the value about which a dynamic prediction oscillates: that of its last quarter."""
    values = item.prediction[:, column]
    return float(np.mean(values[-max(len(values) // 4, 1) :]))


def features(item: FittedTrial, column: int) -> dict[str, FloatArray]:
    """Return what residuals of a channel may go with, (n, k) each at the used samples.

    Shapes beyond the linear ones (x^3, |v|v and so on) are made orthogonal to mean, x and v, so that an
    error of amplitude or phase does not show in all of them.
    """
    used, trial = item.used[:, column], item.trial
    ones = np.ones(int(used.sum()))
    x = item.prediction[used, column] - (_resting(item, column) if trial.is_dynamic else 0.0)
    linear = {"mean": ones, "x": x}
    bent = {"x^3": [x**3], "|x|": [np.abs(x)], "sgn x": [np.sign(x)]}
    # loads, time and temperature are themselves what a reader looks for: only their mean goes out
    inputs = {"time": trial.time[used], "temperature": trial.temperature[used]}
    if not trial.is_dynamic:
        inputs |= {"load": trial.force[used], "load factor": trial.load_factor[used]}
    elif item.rates is not None:
        v = linear["v"] = item.rates[used, column]
        bent |= {"sgn v": [np.sign(v)], "|v|v": [np.abs(v) * v]}
        wave = x / _scale(x) - 1j * v / _scale(v)
        amplitude, phase = envelope(item, column)[used], np.angle(wave)
        for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
            bent[name] = [amplitude * np.cos(order * phase), amplitude * np.sin(order * phase)]
    base = np.linalg.qr(np.column_stack([values / _scale(values) for values in linear.values()]))[0]
    found = {name: values[:, np.newaxis] for name, values in linear.items() if np.any(values)}
    for name, rows in {**bent, **{name: [values] for name, values in inputs.items()}}.items():
        table = np.column_stack(rows)
        against = base[:, :1] if name in inputs else base
        rest = table - against @ (against.T @ table)
        size = np.linalg.norm(table, axis=0)
        if np.all((size > 0.0) & (np.linalg.norm(rest, axis=0) > 1e-6 * size)):
            found[name] = rest
    return found


def _scale(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) or 1.0
