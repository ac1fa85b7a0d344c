"""Faults of a campaign that a model reveals: units, signs, swapped channels, outputs, short records."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from math import log10, pi

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.campaign.units import si_value, units_of
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.holds import hold_sentence
from discrepancy.checks.observability import unobservable
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.sensing import observe
from discrepancy.models.wrapped import oscillates
from fe.runtime.patch import ModelPatch

FloatArray = NDArray[np.float64]

LEAST_PERIODS = 3.0
"""Fewest periods of the first mode in a record in time."""
LEAST_SAMPLES = 4.0
_SLIPS = (
    *((10.0**power, 3.0) for power in (3, 6, 9, -3, -6, -9)),
    (100.0, 1.7), (0.01, 1.7), (9.80665, 1.35), (1.0 / 9.80665, 1.35),
)  # fmt: skip
"""Factors of a unit slip, and the factor by which physics may be off besides."""
_INPUTS = {
    TrialKind.STATIC: (Quantity.FORCE,), TrialKind.FORCED: (Quantity.FORCE,),
    TrialKind.RINGDOWN: (Quantity.DISPLACEMENT,), TrialKind.FLIGHT: (Quantity.ACCELERATION,),
}  # fmt: skip
"""What drives a trial, as its quantity: the load factor may have been given in m/s2."""
_UNLISTED = {
    Quantity.FORCE: {9.80665, 1.0 / 9.80665}, Quantity.DISPLACEMENT: {100.0, 0.01},
}  # fmt: skip
"""Factors of units that files do not have: kilograms of force, centimetres."""
SURE_SLIP = 500.0
"""Slips beyond this factor are seen in a single trial of a channel; smaller ones need several trials."""
_FROM_MOTION = {Quantity.DISPLACEMENT, Quantity.VELOCITY, Quantity.ACCELERATION}
_VISIBLE = 0.01  # share of the largest prediction of its kind below which a channel tells nothing
_ABOVE_NOISE = 5.0
_FLOOR = 0.02  # of a prediction: what any model may be off without the channel being another one


def check_against_model(campaign: Campaign, model: Model) -> tuple[DataFault, ...]:
    """Return the faults that show when data are compared with the unpatched model at its prior mean.

    For each channel and trial the data's scale is the robust slope of data over prediction where that is
    steady (static, flight), and the ratio of amplitudes in records in time, whose phase the model need not
    know. A scale is a slip if it is near 10^3, 10^6, 10^9 (within a factor of 3), 100 (1.7) or 9.81 (1.35) or
    one over them, in most trials of the channel; where all channels of some trials slip alike, the input of
    those trials does. Negative slopes are reversed signs (of trials at rest, if the channel is in any).
    Channels of one quantity are swapped if exchanging them leaves each less than half of its misfit and
    explains 30 units of chi-square (with 2 % of the prediction as a floor of the noise). Signals of unknown
    scale are left out of all this.
    """
    missing = tuple(_missing_outputs(campaign, model))
    if missing:
        return missing
    faults = list(_lengths(campaign, model))
    predictions = {
        trial.name: observe(model, campaign, trial, ModelPatch(), prior_mean(campaign, model, trial)).values
        for trial in campaign.trials
    }
    scales = _scales(campaign, predictions)
    swaps = list(_swaps(campaign, predictions))
    exchanged = {name for pair, _ in swaps for name in pair}
    # What an exchange explains is no slip and no reversed sign.
    scales = {key: scale for key, scale in scales.items() if key[0] not in exchanged}
    faults += _slips(campaign, scales)
    faults += _signs(campaign, scales)
    for trial in campaign.trials:
        said = hold_sentence(campaign, model, trial, prior_mean(campaign, model, trial))
        faults += [] if said is None else [DataFault(FaultKind.BETWEEN_SAMPLES, said, trial=trial.name)]
    if any(trial.kind is TrialKind.DRIVEN for trial in campaign.fitted) and model.parameters:
        sentence = unobservable(campaign, model)
        faults += [] if sentence is None else [DataFault(FaultKind.UNOBSERVABLE, sentence)]
    return (*faults, *(fault for _, fault in swaps))


def prior_mean(campaign: Campaign, model: Model, trial: Trial) -> Conditions:
    """Return the conditions before anything is fitted: prior means, nominal release, exact clock."""
    values = [campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in model.parameters]
    rows = 0 if trial.release is None else trial.release.mode_count
    initial = np.zeros((rows, 2))
    if trial.release is not None and not trial.release.at_rest:
        initial[0, 0] = 1.0  # the first mode at the nominal release displacement
    return Conditions(np.array(values), initial, (0.0, 0.0), trial.health)


# ---------------------------------------------------------------- outputs and length


def _missing_outputs(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    for name, channel in campaign.channels.items():
        quantity = model.output_quantity(channel.output)
        if quantity is None:
            yield DataFault(
                FaultKind.MISSING_OUTPUT,
                f"The channel {name!r} is compared with the output {channel.output!r}, which "
                f"{model.name} does not "
                "have: correct `output`, or leave the channel out.",
                name,
            )
        elif channel.quantity is not Quantity.SIGNAL and not (
            channel.quantity is quantity or {channel.quantity, quantity} <= _FROM_MOTION
        ):
            yield DataFault(
                FaultKind.WRONG_QUANTITY,
                f"The channel {name!r} measures {channel.quantity.value}, but the output "
                f"{channel.output!r} of "
                f"{model.name} is {quantity.value}: correct `quantity` or `output`.",
                name,
            )


def _lengths(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    # A driven trial is long enough if the parameters can be observed in it, see `unobservable`.
    dynamic = [trial for trial in campaign.trials if trial.is_dynamic and trial.kind is not TrialKind.DRIVEN]
    if not dynamic or not oscillates(model):
        return
    frequency = model.scales(campaign).angular_frequency / (2.0 * pi)
    for trial in dynamic:
        periods = float(trial.time[-1] - trial.time[0]) * frequency
        if periods < LEAST_PERIODS:
            yield DataFault(
                FaultKind.TOO_SHORT,
                f"The trial {trial.name!r} holds {periods:.2g} periods of the first mode "
                f"({frequency:.3g} Hz), and "
                f"at least {LEAST_PERIODS:.0f} are needed: record longer.",
                trial=trial.name,
            )
        samples = 1.0 / (trial.interval * frequency)
        if samples < LEAST_SAMPLES / 10.0 and 1e3 * samples >= LEAST_SAMPLES:
            yield DataFault(
                FaultKind.UNDERSAMPLED,
                f"The time of the trial {trial.name!r} looks like milliseconds: taken as seconds it gives "
                f"{samples:.2g} samples per period of the first mode ({frequency:.3g} Hz), as milliseconds "
                f"{1e3 * samples:.3g}; write it in seconds, as `uav-twin discrepancy import` does.",
                trial=trial.name,
            )
        elif samples < LEAST_SAMPLES:
            yield DataFault(
                FaultKind.UNDERSAMPLED,
                f"The trial {trial.name!r} has {samples:.2g} samples per period of the first mode "
                f"({frequency:.3g} Hz), and at least {LEAST_SAMPLES:.0f} are needed: sample faster.",
                trial=trial.name,
            )


# ---------------------------------------------------------------- scales


def _scales(campaign: Campaign, predictions: dict[str, FloatArray]) -> dict[tuple[str, str], float]:
    """Return the data's scale over the prediction's by (channel, trial), signed, where it can be told."""
    largest: dict[tuple[str, Quantity], float] = defaultdict(float)
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            key = (trial.name, campaign.channels[name].quantity)
            largest[key] = max(largest[key], _amplitude(predictions[trial.name][:, column], trial))
    result = {}
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            channel = campaign.channels[name]
            if np.isinf(channel.gain_deviation) or channel.quantity is Quantity.SIGNAL:
                continue
            used = trial.used[:, column]
            data, model = trial.values[used, column], predictions[trial.name][used, column]
            expected = _amplitude(model, trial)
            noise = 0.0 if channel.noise is None else channel.noise.standard_deviation * trial.noise_factor
            if expected <= _VISIBLE * largest[trial.name, channel.quantity] or expected == 0.0:
                continue
            scale = _slope(data, model) if not trial.is_dynamic else _dynamic_scale(data, model, trial, used)
            # What stays in the noise has no scale, unless the noise itself is beyond what the model shows.
            if abs(scale) * expected > _ABOVE_NOISE * noise and np.isfinite(scale) and scale != 0.0:
                result[name, trial.name] = scale
    return result


def _amplitude(values: FloatArray, trial: Trial) -> float:
    if len(values) == 0:
        return 0.0
    if trial.is_dynamic:
        return float(np.sqrt(np.mean((values - np.median(values)) ** 2)))
    return float(np.max(np.abs(values)))


def _slope(data: FloatArray, model: FloatArray) -> float:
    """Return the robust slope of data over prediction: median of pairs (Theil and Sen), or a plain ratio."""
    if len(data) > 400:
        rows = np.linspace(0, len(data) - 1, 400).round().astype(int)
        data, model = data[rows], model[rows]
    first, second = np.triu_indices(len(data), 1)
    run = model[second] - model[first]
    far = np.abs(run) > 0.2 * np.max(np.abs(model))
    if not far.any():
        return float(np.median(data) / np.median(model)) if np.median(model) else 0.0
    return float(np.median((data[second] - data[first])[far] / run[far]))


def _dynamic_scale(data: FloatArray, model: FloatArray, trial: Trial, used: NDArray[np.bool_]) -> float:
    """Return the ratio of amplitudes, with the sign of their correlation at the start of a release."""
    centred = data - np.median(data)
    # Robust against outliers, but not against a decaying record whose quiet end is most of it.
    ratio = float(np.quantile(np.abs(centred), 0.95) / np.quantile(np.abs(model - np.median(model)), 0.95))
    if trial.kind is not TrialKind.RINGDOWN or trial.release is None or not trial.release.at_rest:
        return ratio
    # Before the first return through zero no error of frequency matters.
    crossing = np.flatnonzero(np.sign(model) != np.sign(model[0]))
    until = max(int(crossing[0]) if crossing.size else len(model), 3)
    return ratio * (float(np.sign(np.median(centred[:until] * np.sign(model[0])))) or 1.0)


def _plausible(campaign: Campaign, name: str, trial: str) -> tuple[tuple[float, float], ...]:
    """Return the factors of unit slips that a channel can have, and by which factor physics may be off.

    Those between two units of the channel, or of what drives the trial, and no others in a driven trial.
    """
    inputs = next(item for item in campaign.trials if item.name == trial)
    driven = inputs.kind is TrialKind.DRIVEN or bool(inputs.inputs)
    found = set()
    own = campaign.channels[name].quantity
    for quantity in (own, *_INPUTS.get(inputs.kind, ()), *(item.quantity for item in inputs.inputs)):
        sizes = [si_value("1.0", quantity, unit) for unit in units_of(quantity)]
        found |= {one / other for one in sizes for other in sizes if not 1.0 / 5.0 < one / other < 5.0}
        found |= set() if driven else _UNLISTED.get(quantity, set())
    if not driven:
        return tuple(slip for slip in _SLIPS if any(abs(slip[0] / item - 1.0) < 1e-3 for item in found))
    return tuple((factor, 3.0 if not 5e-3 < factor < 200.0 else 1.35) for factor in sorted(found))


def _slip(scale: float, slips: tuple[tuple[float, float], ...] = _SLIPS) -> float | None:
    """Return the factor of a unit slip nearest to a scale, None if it is none."""
    for factor, wide in slips:
        if abs(log10(abs(scale) / factor)) < log10(wide):
            return factor
    return None


def _slips(campaign: Campaign, scales: dict[tuple[str, str], float]) -> Iterator[DataFault]:
    found = {key: _slip(scale, _plausible(campaign, *key)) for key, scale in scales.items()}
    by_trial: dict[str, list[float | None]] = defaultdict(list)
    by_channel: dict[str, list[float | None]] = defaultdict(list)
    for (name, trial), factor in found.items():
        by_trial[trial].append(factor)
        by_channel[name].append(factor)
    # A channel that slips in all its trials is at fault itself; what slips in one trial only is its input's.
    wrong_channels = {
        name: factors[0]
        for name, factors in by_channel.items()
        if factors[0] is not None
        and all(item == factors[0] for item in factors)
        and (
            campaign.channels[name].quantity is Quantity.ACCELERATION
            or not 1.0 / SURE_SLIP < factors[0] < SURE_SLIP
            or len(factors) > 1
        )
    }
    shared = set(wrong_channels.values())
    if set(wrong_channels) == set(by_channel) and len(by_channel) > 1 and len(shared) == 1:
        yield DataFault(
            FaultKind.INPUT_SLIP,
            f"All channels of all trials are about {shared.pop():.6g} times what the model says: check the "
            "units of forces (N), load factors (1) and release displacements.",
        )
        return
    for name, factor in wrong_channels.items():
        if factor is not None:
            yield DataFault(FaultKind.UNIT_SLIP, _slip_sentence(campaign, name, factor), name)
    for trial, factors in by_trial.items():
        right = [
            factor for (name, where), factor in found.items() if where == trial and name not in wrong_channels
        ]
        if right and right[0] is not None and all(factor == right[0] for factor in right):
            yield DataFault(
                FaultKind.INPUT_SLIP,
                f"All channels of the trial {trial!r} are about {right[0]:.6g} times what the model "
                "says, and those "
                "of other trials are not: check the unit of its force, load factor or release displacement.",
                trial=trial,
            )
        elif len(factors) > 0:
            for (name, where), factor in found.items():
                # a small factor in one trial alone may well be physics: lift that leaves the outer wing
                plain = factor is not None and not 1.0 / SURE_SLIP < factor < SURE_SLIP
                if where == trial and name not in wrong_channels and factor is not None and plain:
                    yield DataFault(
                        FaultKind.UNIT_SLIP,
                        _slip_sentence(campaign, name, factor, f" in the trial {trial!r}"),
                        name,
                        trial,
                    )


def _slip_sentence(campaign: Campaign, name: str, factor: float, where: str = "") -> str:
    quantity = campaign.channels[name].quantity
    guess = {
        (Quantity.STRAIN, 1e6): " (microstrain given as strain?)",
        (Quantity.STRAIN, 1e-6): " (strain given as microstrain?)",
        (Quantity.STRAIN, 100.0): " (percent given as strain?)",
        (Quantity.DISPLACEMENT, 1e3): " (mm given as m?)",
        (Quantity.DISPLACEMENT, 1e-3): " (m given as mm?)",
        (Quantity.ACCELERATION, 1.0 / 9.80665): " (g given as m/s2?)",
        (Quantity.ACCELERATION, 9.80665): " (m/s2 given as g?)",
    }.get((quantity, factor), "")
    return (
        f"The channel {name!r} shows about {factor:.6g} times what the model says{where}{guess}: correct "
        "its `unit`; "
        "no physical effect is that large."
    )


# ---------------------------------------------------------------- signs


def _signs(campaign: Campaign, scales: dict[tuple[str, str], float]) -> Iterator[DataFault]:
    dynamic = {trial.name for trial in campaign.trials if trial.is_dynamic}
    at_rest = {name for name, trial in scales if trial not in dynamic}
    by_channel: dict[str, list[float]] = defaultdict(list)
    for (name, trial), scale in scales.items():
        # A filter turns the phase of a motion; readings at rest know no phase and go first.
        if trial not in dynamic or name not in at_rest:
            by_channel[name].append(scale)
    reversed_channels = [name for name, found in by_channel.items() if max(found) < 0.0]
    if len(reversed_channels) == len(by_channel) > 1:
        yield DataFault(
            FaultKind.SIGN,
            "All channels move against the model: check the sign of the forces, which are positive upwards.",
        )
        return
    for name in reversed_channels:
        yield DataFault(
            FaultKind.SIGN,
            f"The channel {name!r} moves against the model in every trial: reverse its sign (as the "
            "model has it: displacement upwards, the wing's strain positive where upward load compresses the "
            "upper skin), or correct its `output`.",
            name,
        )


# ---------------------------------------------------------------- swapped channels


def _swaps(
    campaign: Campaign, predictions: dict[str, FloatArray]
) -> Iterator[tuple[tuple[str, str], DataFault]]:
    groups: dict[tuple[Quantity, tuple[str, ...]], list[str]] = defaultdict(list)
    for name, channel in campaign.channels.items():
        trials = tuple(trial.name for trial in campaign.trials if name in trial.channels)
        if not np.isinf(channel.gain_deviation) and channel.quantity is not Quantity.SIGNAL:
            groups[channel.quantity, trials].append(name)
    for (_, trials), names in groups.items():
        if len(names) > 1:
            chosen = [trial for trial in campaign.trials if trial.name in trials]
            yield from _swaps_of(campaign, chosen, names, predictions)


def _swaps_of(
    campaign: Campaign, trials: list[Trial], names: list[str], predictions: dict[str, FloatArray]
) -> Iterator[tuple[tuple[str, str], DataFault]]:
    misfit = np.zeros((len(names), len(names)))
    for trial in trials:
        columns = [trial.channels.index(name) for name in names]
        for row, own in enumerate(columns):
            channel = campaign.channels[names[row]]
            used = trial.used[:, own]
            noise = 0.0 if channel.noise is None else channel.noise.standard_deviation * trial.noise_factor
            for place, other in enumerate(columns):
                misfit[row, place] += _misfit(
                    trial.values[used, own],
                    predictions[trial.name][used, other],
                    noise,
                    trial.is_dynamic,
                    channel.offset_deviation,
                )
    _, assigned = linear_sum_assignment(misfit)
    for row, place in enumerate(assigned):
        if row < place and assigned[place] == row:
            before = misfit[row, row], misfit[place, place]
            after = misfit[row, place], misfit[place, row]
            better = all(new < 0.5 * old for old, new in zip(before, after, strict=True))
            if better and sum(before) - sum(after) > 30.0:
                fault = DataFault(
                    FaultKind.SWAPPED,
                    f"The channels {names[row]!r} and {names[place]!r} fit the model clearly better "
                    "exchanged: check "
                    "which wire or column is which, and exchange their `column` or `output`.",
                    names[row],
                )
                yield (names[row], names[place]), fault


def _misfit(
    data: FloatArray, model: FloatArray, noise: float, dynamic: bool, offset_deviation: float
) -> float:
    """Return chi-square of data about a prediction, with a share of the prediction as the least deviation."""
    if dynamic:
        # Amplitudes only: a small error of frequency would outweigh what the places of two gauges differ by.
        one, other = np.array([np.std(data)]), np.array([np.std(model)])
        sign = 1.0 if float(data[: max(len(data) // 50, 3)].mean() * model[0]) >= 0.0 else -1.0
        deviation = np.hypot(noise / np.sqrt(len(data)), _FLOOR * other)
        return _chi_square(sign * one - other, deviation)
    rest = data - model
    if offset_deviation > 0.0:
        rest = rest - np.median(rest)
    deviation = np.maximum(np.hypot(noise, _FLOOR * np.abs(model)), 1e-300)
    deviation = np.maximum(deviation, _FLOOR * float(np.max(np.abs(model), initial=0.0)) * 0.2)
    return _chi_square(rest, deviation)


def _chi_square(rest: FloatArray, deviation: FloatArray) -> float:
    # Bounded: readings of any size stay comparable.
    return float(np.sum(np.minimum(np.abs(rest / np.maximum(deviation, 1e-300)), 1e9) ** 2))
