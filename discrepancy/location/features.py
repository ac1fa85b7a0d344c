"""What residuals of a channel may go with: motion, its amplitude and harmonics, time, load, temperature."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.location.residuals import FittedTrial

FloatArray = NDArray[np.float64]


def envelope(item: FittedTrial, column: int) -> FloatArray:
    """Return the amplitude of a channel's predicted motion, (N,): sqrt(x^2 + (v / w)^2) over one period.

    w is the ratio of the root mean squares of rate and value; the mean is taken out first.
    """
    if item.rates is None:
        raise ValueError(f"The trial {item.trial.name!r} has no rates.")
    x = item.prediction[:, column] - _resting(item, column)
    v = item.rates[:, column]
    size, speed = float(np.sqrt(np.mean(x**2))), float(np.sqrt(np.mean(v**2)))
    if size == 0.0 or speed == 0.0:
        return np.abs(x)
    amplitude = np.hypot(x, v * size / speed)
    width = max(1, round(2.0 * np.pi * size / (speed * item.trial.interval)))
    width = min(width, len(x))
    kernel = np.ones(width)
    return np.asarray(np.convolve(amplitude, kernel, "same") / np.convolve(np.ones_like(x), kernel, "same"))


def _resting(item: FittedTrial, column: int) -> float:
    """Return the value about which a dynamic prediction oscillates: that of its last quarter."""
    values = item.prediction[:, column]
    return float(np.mean(values[-max(len(values) // 4, 1) :]))


def features(item: FittedTrial, column: int) -> dict[str, FloatArray]:
    """Return what residuals of a channel may go with, (n,) each at the used samples.

    Shapes beyond the linear ones (x^3, |v|v and so on) are made orthogonal to mean, x and v, so that an
    error of amplitude or phase does not show in all of them.
    """
    used, trial = item.used[:, column], item.trial
    count = int(used.sum())
    ones = np.ones(count)
    x = item.prediction[used, column] - (_resting(item, column) if trial.is_dynamic else 0.0)
    found: dict[str, FloatArray] = {"mean": ones, "x": x}
    linear = [ones, x]
    candidates: dict[str, FloatArray] = {"x^3": x**3, "|x|": np.abs(x), "sgn x": np.sign(x)}
    if trial.is_dynamic:
        candidates["time"] = trial.time[used]
        if item.rates is not None:
            v = item.rates[used, column]
            found["v"] = v
            linear.append(v)
            candidates |= {"sgn v": np.sign(v), "|v|v": np.abs(v) * v}
            amplitude = envelope(item, column)[used]
            phase = np.arctan2(-v / _scale(v), x / _scale(x))
            for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
                candidates[f"{name} cos"] = amplitude * np.cos(order * phase)
                candidates[f"{name} sin"] = amplitude * np.sin(order * phase)
    else:
        candidates["time"] = trial.time[used]
        candidates["load"] = trial.force[used]
        candidates["load factor"] = trial.load_factor[used]
    candidates["temperature"] = trial.temperature[used]
    base = np.linalg.qr(np.column_stack([column_ / _scale(column_) for column_ in linear]))[0]
    for name, values in candidates.items():
        size = float(np.linalg.norm(values))
        if size == 0.0:
            continue
        # Loads and temperature are themselves what a reader looks for: only their mean goes out.
        against = base[:, :1] if name in ("load", "load factor", "temperature", "time") else base
        rest = values - against @ (against.T @ values)
        if np.linalg.norm(rest) > 1e-6 * size:
            found[name] = rest
    return {name: values for name, values in found.items() if np.any(values)}


def _scale(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) or 1.0
