"""Accuracy of the beginning and end of events: `python -m benchmarks.event_moments [--count 200]`.

Records of 300 to 2,000 samples of noise, white or of correlation 0.5, half of them with a jitter of
2 % of the interval. In each an event of 5 to 20 noise deviations (rms) begins at any moment, also
between samples, and ends in half of them: an offset, a random motion, a line of 8 to 30 samples a
period, or a scatter. Counted are moments within 1 % of the record, 90 % intervals that hold the
truth, and events in records without one. The size of the noise comes from a record of 100 samples.
"""

import argparse
import time as clock
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from discrepancy.missing_force.events import Events, find_events
from discrepancy.missing_force.windows import strongest_pattern

FloatArray = NDArray[np.float64]

KINDS = ("offset", "random motion", "line", "scatter")
FREEDOM = 99.0


def noise(generator: np.random.Generator, count: int, colour: float) -> FloatArray:
    """Return noise (count,) of unit variance whose neighbours have a correlation."""
    drawn = generator.standard_normal(count + 50)
    return np.asarray(lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], drawn)[50:])


def event(generator: np.random.Generator, kind: str, count: int, size: float) -> FloatArray:
    """Return what an event adds (count,), of the root mean square `size`."""
    if kind == "offset":
        return np.full(count, size * float(generator.choice([-1.0, 1.0])))
    if kind == "random motion":
        return size * noise(generator, count, 0.8)
    if kind == "line":
        phase = (
            2.0 * np.pi * (np.arange(count) / generator.uniform(8.0, 30.0) + generator.uniform())
        )
        return np.asarray(size * np.sqrt(2.0) * np.sin(phase))
    return size * generator.standard_normal(count)


def record(
    generator: np.random.Generator, kind: str | None
) -> tuple[FloatArray, FloatArray, tuple[float, ...]]:
    """Return times (N,) and residuals (N,) of a record, and the true ends of its event."""
    count = int(generator.integers(300, 2001))
    time = np.arange(count, dtype=np.float64) * 0.01
    if generator.random() < 0.5:
        time = np.sort(time + generator.normal(0.0, 0.0002, count))
    values = noise(generator, count, generator.choice([0.0, 0.5]))
    # the noise record has its own scatter
    values /= np.sqrt(generator.chisquare(FREEDOM) / FREEDOM)
    if kind is None:
        return time, values, ()
    begin = generator.uniform(0.1, 0.7) * time[-1]
    end = begin + generator.uniform(0.1, 0.25) * time[-1] if generator.random() < 0.5 else np.inf
    inside = (time >= begin) & (time < end)
    values[inside] += event(generator, kind, int(inside.sum()), generator.uniform(5.0, 20.0))
    moments = (begin, end) if np.isfinite(end) else (begin,)
    return time, values, moments


def found_in(time: FloatArray, values: FloatArray) -> Events:
    """Return the events of a record."""
    force, _ = strongest_pattern("record", time, values[:, None], np.ones((len(values), 1), bool))
    return find_events(force.linearisation, 0, force.processes[0])


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    generator = np.random.default_rng(arguments.seed)
    began = clock.perf_counter()
    print(f"{'event':16s} {'within 1 %':>10s} {'90 % holds':>10s} {'missed':>7s} {'others':>7s}")
    for kind in KINDS:
        counts: dict[str, int] = defaultdict(int)
        for _ in range(arguments.count):
            time, values, truth = record(generator, kind)
            moments = found_in(time, values).change_times(0)
            for true in truth:
                counts["moments"] += 1
                if not len(moments):
                    counts["missed"] += 1
                    continue
                value, low, high = min(moments, key=lambda item: abs(item[0] - true))
                counts["close"] += abs(value - true) <= 0.01 * (time[-1] - time[0])
                counts["held"] += low <= true <= high
            counts["others"] += max(0, len(moments) - len(truth))
        total = counts["moments"]
        print(
            f"{kind:16s} {counts['close'] / total:10.1%} {counts['held'] / total:10.1%} "
            f"{counts['missed']:7d} {counts['others']:7d}  of {total} moments"
        )
    false = 0
    for _ in range(2 * arguments.count):
        time, values, _ = record(generator, None)
        false += bool(found_in(time, values).paths[0].any())
    print(f"quiet records with an event: {false} of {2 * arguments.count}")
    print(f"{clock.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
