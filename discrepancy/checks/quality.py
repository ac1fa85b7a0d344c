"""Faults that a campaign shows without a model: noise records, clipped, dead, frozen and copied channels.

What makes a campaign unreadable (missing columns, uneven sampling, gaps, NaN) is refused by the reader at
once; what only a model can tell (units, signs, swapped channels, length) is in
`discrepancy.checks.model_check`.
"""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from scipy.stats import f as fisher

from discrepancy.campaign.noise import MAINS, line_near, repeat_record, without_lines
from discrepancy.campaign.noise_tests import autocorrelation, times_fewer
from discrepancy.campaign.records import (
    BoolArray,
    Campaign,
    Channel,
    FloatArray,
    NoiseRecord,
    Trial,
)
from discrepancy.campaign.sampling import quantum_of
from discrepancy.checks.fault import DataFault, FaultKind, fault, place_of, with_acceptance
from discrepancy.checks.held import held_faults, roughness, runs_of, update_length
from discrepancy.checks.outliers import LARGEST_SHARE, find_outliers

SHORTEST = 128
"""Fewest samples of a noise record that is judged."""
LARGEST_RATIO = 2.0
"""Scatter of the loudest quarter of a noise record over that of the quietest."""
LARGEST_DRIFT = 0.6
"""Share of the variance of a noise record that a cubic in time may take."""
LARGEST_LINE = 0.05
"""Share of the variance that a line at the model's frequency may take."""
LEAST_PERIODS = 8.0
"""Fewest periods in a noise record in which a line is looked for."""
NEAR = 0.1
"""Share of the model's frequency by which it may be off."""
_LEVEL = 1e-5


def rest_faults(campaign: Campaign, frequency: float | None = None) -> Iterator[DataFault]:
    """Yield a limit for each channel whose noise record moves; see `moves`."""
    for name, channel in campaign.channels.items():
        if channel.noise is not None and (what := moves(channel.noise, frequency)) is not None:
            file = f" of {channel.noise.file}" if channel.noise.file else ""
            column = f"{channel.table_column!r}{file}"
            yield fault(FaultKind.MOVES_AT_REST, name, column=column, what=what)


def moves(record: NoiseRecord, frequency: float | None = None) -> str | None:
    """Return what a noise record holds beside noise of one size; None if nothing.

    Without a frequency: a cubic in time that is most of it, or quarters that scatter unlike (F test
    at 1e-5, with the degrees of freedom that correlation leaves, and a factor of two). With the frequency of
    a mode [Hz]: a line within 10 % of it that holds more than 5 % of the variance. Mains are no motion.
    """
    if record.samples is None or record.interval is None or len(record.samples) < SHORTEST:
        return None
    rest, _ = without_lines(record.samples - record.samples.mean(), record.interval)
    power, interval = float(rest @ rest), record.interval
    if frequency is not None:
        short = frequency * interval * len(rest) < LEAST_PERIODS
        if short or any(abs(frequency / mains - 1.0) < NEAR for mains in MAINS):
            return None
        line = line_near(rest, interval, frequency, NEAR * frequency)
        share = 0.0 if line is None else float(line @ line) / power
        if share <= LARGEST_LINE:
            return None
        return f"holds a line near the model's {frequency:.3g} Hz with {share:.0%} of its variance"
    time = np.linspace(-1.0, 1.0, len(rest))
    trend = np.polynomial.Chebyshev.fit(time, rest, 3)(time)
    if (share := float(trend @ trend) / power) > LARGEST_DRIFT:
        return f"drifts by {np.ptp(trend):.3g} (SI) over its length, {share:.0%} of its variance"
    quarters = np.array_split(rest - trend, 4)
    sizes = np.array([np.mean(np.abs(quarter)) for quarter in quarters])  # single spikes weigh little
    one, two = int(sizes.argmax()), int(sizes.argmin())
    freedom = _freedom(quarters[two]), _freedom(quarters[one])
    ratio = float(sizes[one] / sizes[two]) if sizes[two] > 0.0 else np.inf
    if ratio < LARGEST_RATIO or 12.0 * fisher.sf(ratio**2, freedom[1], freedom[0]) > _LEVEL:
        return None
    first = sum(map(len, quarters[:one]))
    return (
        f"scatters {ratio:.2g} times as much from {first * interval:.4g} to "
        f"{(first + len(quarters[one])) * interval:.4g} s as where it is quietest"
    )


def _freedom(series: FloatArray) -> float:
    """Return the degrees of freedom of the variance of a series that is correlated in time."""
    return len(series) / times_fewer(*autocorrelation([series]))


COPIED = 0.01
"""A channel is a copy if another leaves less than this share of its own noise."""
LEAST_COPIED = 32
_LAGS = 2**14  # samples in which the shift between two channels is looked for


# ---------------------------------------------------------------- copied


def copy_faults(campaign: Campaign) -> Iterator[DataFault]:
    """Yield a fault for each pair of channels of which one is the other, scaled or shifted or neither."""
    found: dict[tuple[str, str], list[tuple[Trial, str]]] = {}
    for trial in campaign.trials:
        if trial.is_dynamic:
            for one, other, how in _copies(trial):
                found.setdefault((one, other), []).append((trial, how))
    for (one, other), where in found.items():
        trial, how = where[0]
        more = f", and so in {len(where) - 1} more of its trials" if where[1:] else ""
        place = place_of(campaign.channels[other], trial)
        yield fault(FaultKind.COPIED, other, trial.name, one=one, how=how, place=place, more=more)


def _copies(trial: Trial) -> Iterator[tuple[str, str, str]]:
    """Yield pairs of channels of a trial that are copies, and how."""
    if len(trial.time) < LEAST_COPIED:
        return
    rough = np.diff(trial.values[:_LAGS], 6, axis=0)
    limit = 15.0 * np.median(np.abs(rough), axis=0)  # a jump or a wrong reading would outweigh all noise
    rough = np.where((np.abs(rough) > limit) & (limit > 0.0), 0.0, rough)
    size = np.sum(rough**2, axis=0)
    # Sixth differences of noise turn at each sample; those of a motion without noise do not.
    noisy = np.sum(rough[1:] * rough[:-1], axis=0) < -0.5 * size
    spectra = np.fft.rfft(rough, 2 * len(rough), axis=0)
    changes = np.count_nonzero(np.diff(trial.values, axis=0), axis=0)
    for i, j in combinations(range(len(trial.channels)), 2):
        if not (noisy[i] and noisy[j]):
            if changes[i] >= 2 * LEAST_COPIED and np.array_equal(trial.values[:, i], trial.values[:, j]):
                yield trial.channels[i], trial.channels[j], "digit for digit"
            continue
        products = np.fft.irfft(spectra[:, j] * np.conj(spectra[:, i]))
        at = int(np.argmax(np.abs(products)))
        if abs(products[at]) < 0.5 * np.sqrt(size[i] * size[j]):
            continue
        shift = at if at < len(rough) else at - len(products)
        how = _copied(trial.values[:, i], trial.values[:, j], trial.used[:, i], trial.used[:, j], shift)
        if how:
            yield trial.channels[i], trial.channels[j], how


def _copied(one: FloatArray, other: FloatArray, first: BoolArray, second: BoolArray, shift: int) -> str:
    """Return how the other is the one so many samples earlier; empty if it is not."""
    count = len(one) - abs(shift)
    a, b = max(-shift, 0), max(shift, 0)
    kept = first[a : a + count] & second[b : b + count]
    x, y = one[a : a + count][kept], other[b : b + count][kept]
    noise = roughness(y) or float(np.std(np.diff(y, 6)) / np.sqrt(924.0)) if len(y) >= LEAST_COPIED else 0.0
    if noise == 0.0 or len(np.unique(x)) < LEAST_COPIED // 2:
        return ""
    late = f", {abs(shift)} samples {'later' if shift > 0 else 'earlier'}," if shift else ""
    if np.array_equal(x, y):
        return f"digit for digit{late}"
    centred = x - x.mean()
    scale = float(centred @ (y - y.mean()) / (centred @ centred))
    rest = float(np.std(y - scale * x))
    return f"times {scale:.6g}{late}" if rest < COPIED * noise else ""


CLIPPED_RUN = 3
"""Consecutive samples at the very extreme value that make a record clipped, if it gets there in a jump."""
_ALPHA = 1e-3
_NOISE_FACTOR = 2.0


def check_data(campaign: Campaign) -> tuple[DataFault, ...]:
    """Return the faults that a campaign shows by itself, by channel and trial.

    A channel without a noise record, or whose noise record contradicts repeats (F test at 0.1 %) or the
    record itself (by a factor of two) or moves, is reported as a limit; a dead, clipped, frozen or copied
    channel, or more than 3 % of outliers in a record in time, as a fault of the data (`DataFault.fatal`).
    """
    faults: list[DataFault] = []
    for name, channel in campaign.channels.items():
        faults += _noise_faults(campaign, channel)
        records = [trial for trial, *_ in campaign.records(name)]
        still = [trial for trial in records if is_still(trial, name)]
        # A load may do nothing at a place: of a channel that moves elsewhere the model knows.
        dead = (trial for trial in still if trial.is_dynamic or len(still) == len(records))
        faults += (fault(FaultKind.DEAD, name, trial.name) for trial in dead)
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            faults += _clipped(trial, name, trial.values[:, column], trial.used[:, column])
        if trial.is_dynamic:
            faults += held_faults(campaign, trial)
    faults += copy_faults(campaign)
    faults += rest_faults(campaign)
    for trial, name, found in find_outliers(campaign):
        if trial.is_dynamic and (share := found.mean()) > LARGEST_SHARE:
            faults.append(fault(FaultKind.OUTLIERS, name, trial.name, share=share, most=LARGEST_SHARE))
    return with_acceptance(faults, campaign)


# ---------------------------------------------------------------- noise


def _noise_faults(campaign: Campaign, channel: Channel) -> Iterator[DataFault]:
    record, what = channel.noise, ""
    if record is None:
        yield fault(FaultKind.NO_NOISE_RECORD, channel.name)
    if record is None or record.source == "repeats":
        return
    stated = record.standard_deviation
    rough = (
        roughness(values) / trial.noise_factor
        for trial, values, _ in campaign.records(channel.name)
        if trial.is_dynamic and len(values) >= 50
    )
    scatter = min(rough, default=np.inf)
    # Only downwards: a fast mode may well be rougher than the noise, but nothing is smoother than its noise.
    told = stated if record.samples is None or len(record.samples) < 50 else roughness(record.samples)
    if 0.0 < scatter < told / _NOISE_FACTOR:
        what = "neighbouring samples scatter"
    if (found := repeat_record(channel, campaign.trials)) is not None:
        ratio = (found.standard_deviation / stated) ** 2
        freedom = found.degrees_of_freedom, min(record.degrees_of_freedom, 1e9)
        tail = min(fisher.sf(ratio, *freedom), fisher.cdf(ratio, *freedom))
        if 2.0 * tail < _ALPHA and not _NOISE_FACTOR**-2 < ratio < _NOISE_FACTOR**2:
            what, scatter = "repeated trials scatter", found.standard_deviation
    if what:
        yield fault(FaultKind.NOISE_LABEL, channel.name, stated=stated, found=scatter, what=what)


# ---------------------------------------------------------------- records


def is_still(trial: Trial, name: str) -> bool:
    """Whether a channel shows one value throughout a trial that excites the structure."""
    column = trial.channels.index(name)
    used = trial.used[:, column]
    if used.sum() < CLIPPED_RUN or np.ptp(trial.values[used, column]) > 0.0:
        return False
    return trial.is_dynamic or bool(np.ptp(trial.load[used]) > 0.0)


def _clipped(trial: Trial, name: str, values: FloatArray, used: BoolArray) -> Iterator[DataFault]:
    kept, load = values[used], None
    if len(kept) < CLIPPED_RUN:
        return
    if not trial.is_dynamic:
        order = np.argsort(trial.load[used], kind="stable")
        kept, load = kept[order], trial.load[used][order]
    for extreme, side in ((float(kept.max()), "largest"), (float(kept.min()), "smallest")):
        if run := clipped_run(kept, extreme, load):
            yield fault(FaultKind.CLIPPED, name, trial.name, run=run, side=side, extreme=extreme)


def clipped_run(values: FloatArray, extreme: float, load: FloatArray | None = None) -> int:
    """Return the longest run of readings that stand at an extreme where they should not; 0 if there is none.

    A run is clipped where the record would have gone beyond the extreme by more than some quanta of the
    sensor (`quantum_of`) and six deviations of its scatter; a record of few digits is flat at its turning
    points too, but by a digit. Records in time: three digits, by a parabola through three samples on either
    side of the run, whose error grows with its length; the run must span three updates of the sensor. Static
    readings, in the order of their load: one and a half, by a line through all others; the run must span
    three loads.
    """
    digit = quantum_of(values)
    least_run = CLIPPED_RUN * (update_length(values) if load is None else 1.0)
    found: list[tuple[int, int]] = runs_of(values == extreme).tolist()
    runs = [(start, stop) for start, stop in found if stop - start >= least_run]
    if not runs:
        return 0

    def clipped(start: int, stop: int) -> bool:
        if load is not None:
            others = np.delete(np.arange(len(values)), np.s_[start:stop])
            if np.unique(load[start:stop]).size < CLIPPED_RUN or np.unique(load[others]).size < 2:
                return False
            line = np.polynomial.Polynomial.fit(load[others], values[others], 1)
            beyond = float(np.max(np.abs(line(load[start:stop]) - extreme)))
            return beyond > 1.5 * digit + 6.0 * float(np.std(values[others] - line(load[others])))
        beside = np.r_[start - 3 : start, stop : stop + 3]
        if beside[0] < 0 or beside[-1] >= len(values):
            return False
        places = beside - 0.5 * (start + stop - 1)
        middle = np.linalg.pinv(np.vander(places, 3))[2]  # weights of the parabola's value there
        far = abs(middle @ values[beside] - extreme)
        return bool(far > 0.5 * np.abs(middle).sum() * (3.0 * digit + 6.0 * roughness(values)))

    return max((stop - start for start, stop in runs if clipped(start, stop)), default=0)
