"""Faults of a campaign that a model reveals: units, signs, swapped channels, outputs, short records."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from discrepancy.campaign.records import (
    BoolArray,
    Campaign,
    Channel,
    FloatArray,
    Hold,
    Quantity,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import quantum_of
from discrepancy.catalogue.entry import Setting
from discrepancy.checks.held import roughness
from discrepancy.checks.quality import is_still, rest_faults
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.fits.normal_equations import normal_equations
from discrepancy.fits.problem import Problem
from discrepancy.judgement.separability import prior_point_with_initial_states
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

from .fault import DataFault, FaultKind, fault, unit_slips, with_acceptance

LEFT = 0.9
"""A parameter of whose prior deviation the records leave more than this share is not observable in them."""


def prior_left(campaign: Campaign, model: Model) -> dict[str, float]:
    """Return the share of its prior deviation that the fitted records leave to each calibrated parameter.

    From the information matrix at the prior mean. What begins in an unknown state begins as the records say:
    of a model at rest no parameter shows. Gains, zeros, initial states, constants of inputs and the other
    parameters follow within their priors (what they can do as well is projected out).
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    known, weights = problem.shared.count, np.ones(len(problem.channel_names))
    found = fit(problem, Candidate(), prior_point_with_initial_states(problem), iterations=0)
    matrix = normal_equations(problem, found, Candidate(), weights).matrix
    left = np.sqrt(np.diag(np.linalg.pinv(matrix, hermitian=True))[:known])
    return {
        item.name: float(value)
        for item, value, scale in zip(model.parameters, left, problem.shared.scale[:known], strict=True)
        if scale > 0.0
    }


def unobservable(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    """Yield a limit where the records do not tell calibrated parameters."""
    left = {name: share for name, share in prior_left(campaign, model).items() if share > LEFT}
    if left:
        names = ", ".join(f"{name!r} ({share:.0%})" for name, share in left.items())
        several = "parameters" if len(left) > 1 else "parameter"
        yield fault(FaultKind.UNOBSERVABLE, parameters=several, names=names)


LEAST_PERIODS = 3.0
"""Fewest periods of the first mode in a record in time."""
LEAST_SAMPLES = 4.0
MATTERS = 0.3
"""Difference between two readings of an input from which on it is said, in deviations of the noise (rms)."""
_VISIBLE = 0.01  # share of the largest prediction of its kind below which a channel tells nothing
_ABOVE_NOISE = 5.0
_AGREE = 0.9  # share of the pairs of loads whose slopes have one sign
_NOTHING = 1e9  # data over prediction from which on the model shows rounding alone
_FLOOR = 0.02  # of a prediction: what any model may be off without the channel being another one


def check_against_model(campaign: Campaign, model: Model) -> tuple[DataFault, ...]:
    """Return the faults that show when data are compared with the unpatched model at its prior mean.

    For each channel and trial the data's scale is the robust slope of data over prediction where that is
    steady (static, flight), and the ratio of amplitudes in records in time, whose phase the model need not
    know. A scale is a slip if two units of the channel differ by it (within a factor of 3 from 200 on, of 2
    from 20 on, of 1.35 from 7 on, of 1.1 below) in all its trials; where all channels of some trials slip
    alike, the input of those trials does. A noise record with a line at the first mode is a limit. Negative
    slopes are reversed signs (of trials at rest, if the channel is in any). Channels of one quantity are
    swapped if exchanging them leaves each less than half of its misfit and explains 30 units of chi-square
    (with 2 % of the prediction as a floor of the noise). Signals of unknown scale are left out of all this.
    """
    missing = tuple(_missing_outputs(campaign, model))
    if missing:
        return missing
    faults: list[DataFault] = []
    if model.oscillates:
        frequency = model.scales(campaign).angular_frequency / (2.0 * pi)
        faults = [*_lengths(campaign, frequency), *rest_faults(campaign, frequency)]
    predictions = {
        trial.name: observe(model, campaign, trial, ModelPatch(), prior_mean(campaign, model, trial)).values
        for trial in campaign.trials
    }
    faults += _dead(campaign, predictions)
    scales = _scales(campaign, predictions)
    swaps = list(_swaps(campaign, predictions))
    exchanged = {name for pair, _ in swaps for name in pair}
    # What an exchange explains is no slip and no reversed sign.
    scales = {key: scale for key, scale in scales.items() if key[0] not in exchanged}
    faults += unit_slips(campaign, scales)
    faults += _signs(campaign, scales)
    for trial in campaign.trials:
        faults += _holds(campaign, model, trial)
    if any(trial.kind is TrialKind.DRIVEN for trial in campaign.fitted) and model.parameters:
        faults += unobservable(campaign, model)
    faults += (found for _, found in swaps)
    return with_acceptance(faults, campaign)


def prior_mean(campaign: Campaign, model: Model, trial: Trial) -> Conditions:
    """Return the conditions before anything is fitted: prior means, nominal release, exact clock."""
    values = [mean for mean, _ in model.stated(campaign)]
    rows = 0 if trial.release is None else trial.release.mode_count
    initial = np.zeros((rows, 2))
    if trial.release is not None and not trial.release.at_rest:
        initial[0, 0] = 1.0  # the first mode at the nominal release displacement
    return Conditions(np.array(values), initial, (0.0, 0.0), trial.health)


def _holds(campaign: Campaign, model: Model, trial: Trial) -> Iterator[DataFault]:
    """Yield a limit where straight lines and curves between an input's samples are not the same.

    None if no channel with a noise record sees a difference, or of every input it is said what it did.
    """
    forced = trial.kind is TrialKind.FORCED and trial.hold is None
    straight = ["force"] if forced else [item.name for item in trial.inputs if item.hold is None]
    if trial.kind not in (TrialKind.FORCED, TrialKind.DRIVEN) or not straight or len(trial.time) < 4:
        return
    inputs = tuple(replace(i, hold=Hold.SMOOTH) if i.name in straight else i for i in trial.inputs)
    curved = replace(trial, inputs=inputs, hold=Hold.SMOOTH if forced else trial.hold)
    conditions = prior_mean(campaign, model, trial)
    one, other = (observe(model, campaign, i, ModelPatch(), conditions).values for i in (trial, curved))
    known = [campaign.channels[name].noise_in(trial) or np.inf for name in trial.channels]
    sizes = np.sqrt(np.mean((one - other) ** 2, axis=0)) / known
    if (worst := sizes.max()) > MATTERS:
        told = {"names": ", ".join(map(repr, straight)), "where": trial.channels[int(sizes.argmax())]}
        table = "[[trial]]" if forced else "[[input]]"
        yield fault(FaultKind.BETWEEN_SAMPLES, trial=trial.name, worst=worst, table=table, **told)


# ---------------------------------------------------------------- outputs and length


def _missing_outputs(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    for name, channel in campaign.channels.items():
        quantity = model.output_quantity(channel.output)
        if quantity is None:
            yield fault(FaultKind.MISSING_OUTPUT, name, output=channel.output, model=model.name)
        elif not channel.quantity.shows(quantity):
            told = {"measured": channel.quantity.value, "given": quantity.value, "model": model.name}
            yield fault(FaultKind.WRONG_QUANTITY, name, output=channel.output, **told)


def _lengths(campaign: Campaign, frequency: float) -> Iterator[DataFault]:
    # A driven trial is long enough if the parameters can be observed in it, see `unobservable`.
    for trial in campaign.trials:
        if not trial.is_dynamic or trial.kind is TrialKind.DRIVEN:
            continue
        periods = float(trial.time[-1] - trial.time[0]) * frequency
        told: dict[str, Any] = {"trial": trial.name, "frequency": frequency}
        if periods < LEAST_PERIODS:
            yield fault(FaultKind.TOO_SHORT, periods=periods, least=LEAST_PERIODS, **told)
        samples = 1.0 / (trial.interval * frequency)
        if samples < LEAST_SAMPLES:
            slip = samples < LEAST_SAMPLES / 10.0 and 1e3 * samples >= LEAST_SAMPLES
            told |= {"say": "undersampled_in_milliseconds" if slip else "", "more": 1e3 * samples}
            yield fault(FaultKind.UNDERSAMPLED, samples=samples, least=LEAST_SAMPLES, **told)


def _dead(campaign: Campaign, predictions: dict[str, FloatArray]) -> Iterator[DataFault]:
    """Yield channels that stand still under loads that would show; `check_data` tells the others."""
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            if trial.is_dynamic or not is_still(trial, name):
                continue
            digit = quantum_of(np.concatenate([values for _, values, _ in campaign.records(name)]))
            least = _ABOVE_NOISE * max(campaign.channels[name].noise_in(trial), digit)
            if digit and np.ptp(predictions[trial.name][:, column]) > least:
                yield fault(FaultKind.DEAD, name, trial.name)


# ---------------------------------------------------------------- scales


def _scales(campaign: Campaign, predictions: dict[str, FloatArray]) -> dict[tuple[str, str], float]:
    """Return the data's scale over the prediction's by (channel, trial), signed, where it can be told."""
    result = {}
    for trial in campaign.trials:
        channels = [campaign.channels[name] for name in trial.channels]
        whole = [_amplitude(values, trial) for values in predictions[trial.name].T]
        for column, channel in enumerate(channels):
            if np.isinf(channel.gain_deviation) or channel.quantity is Quantity.SIGNAL:
                continue
            used = trial.used[:, column]
            data, model = trial.values[used, column], predictions[trial.name][used, column]
            expected = _amplitude(model, trial)
            rough = roughness(data) if trial.is_dynamic and len(data) > 6 else 0.0
            noise = channel.noise_in(trial) or rough
            sizes = zip(channels, whole, strict=True)
            largest = max(size for other, size in sizes if other.quantity is channel.quantity)
            if expected <= _VISIBLE * largest or expected == 0.0:
                continue
            if trial.is_dynamic:
                scale = _dynamic_scale(data, model, trial, used)
                # what stays in the noise has no scale, unless noise and data are in other units
                size = abs(scale) * expected
                if max(size, expected if size > _ABOVE_NOISE * rough else 0.0) <= _ABOVE_NOISE * noise:
                    continue
            else:
                scale = _static_scale(data, model, noise, channel.offset_deviation)
            if 0.0 < abs(scale) < _NOTHING:
                result[channel.name, trial.name] = scale
    return result


def _amplitude(values: FloatArray, trial: Trial) -> float:
    if len(values) == 0:
        return 0.0
    if trial.is_dynamic:
        return float(np.sqrt(np.mean((values - np.median(values)) ** 2)))
    return float(np.max(np.abs(values)))


def _static_scale(data: FloatArray, model: FloatArray, noise: float, zero: float) -> float:
    """Return the median slope of data over prediction between two loads, or a plain ratio at one load.

    0 where it cannot be told: beside noise and the deviation of the channel's zero, where pairs of loads do
    not agree in its sign, or where the data have the model's sign and it has not: it is a temperature's, say.
    """
    rows = np.linspace(0, len(data) - 1, min(len(data), 400)).round().astype(int)
    one, other = np.triu_indices(len(rows), 1)
    rise, run = (values[rows][one] - values[rows][other] for values in (data, model))
    # Rows that differ by their health alone would tell the noise over next to nothing.
    far = np.abs(run) > 0.2 * np.max(np.abs(model))
    shown, expected = float(np.median(data)), float(np.median(model))
    if not far.any():
        return shown / expected if expected and abs(shown) > _ABOVE_NOISE * max(noise, zero) else 0.0
    slopes = rise[far] / run[far]
    slope = float(np.median(slopes))
    told = max(abs(slope), 1.0) * np.median(np.abs(run[far])) > _ABOVE_NOISE * noise
    alike = np.mean(slopes * slope > 0.0) > _AGREE
    another = slope < 0.0 and shown * np.sign(expected) > 2.0 * zero
    return slope if told and alike and not another else 0.0


def _dynamic_scale(data: FloatArray, model: FloatArray, trial: Trial, used: BoolArray) -> float:
    """Return the ratio of amplitudes, with the sign of their correlation at the start of a release."""
    centred = data - np.median(data)
    # Robust against outliers, but not against a decaying record whose quiet end is most of it.
    ratio = float(np.quantile(np.abs(centred), 0.95) / np.quantile(np.abs(model - np.median(model)), 0.95))
    return ratio * _begins_as(data, model, trial)


def _begins_as(data: FloatArray, model: FloatArray, trial: Trial) -> float:
    """Return -1 where a release from rest begins on the other side than predicted, else 1."""
    if trial.release is None or not trial.release.at_rest:
        return 1.0
    # Before the first return through zero no error of frequency matters.
    crossing = np.flatnonzero(np.sign(model) != np.sign(model[0]))
    until = max(int(crossing[0]) if crossing.size else len(model), 3)
    # each sample has one vote, as heavy as the prediction: none of a single wrong reading decides
    return float(np.sign(np.sign(data - np.median(data))[:until] @ model[:until])) or 1.0


# ---------------------------------------------------------------- signs


def _signs(campaign: Campaign, scales: dict[tuple[str, str], float]) -> Iterator[DataFault]:
    dynamic = {trial.name for trial in campaign.trials if trial.is_dynamic}
    at_rest = {name for name, trial in scales if trial not in dynamic}
    by_channel: dict[str, list[float]] = defaultdict(list)
    for (name, trial), scale in scales.items():
        # A filter turns the phase of a motion; readings at rest know no phase and go first.
        if trial not in dynamic or name not in at_rest:
            by_channel[name].append(scale)
    wrong = [name for name, found in by_channel.items() if max(found) < 0.0]
    if len(wrong) == len(by_channel) > 1:
        yield fault(FaultKind.SIGN, say="sign_of_all")
    else:
        yield from (fault(FaultKind.SIGN, name) for name in wrong)


# ---------------------------------------------------------------- swapped channels


def _swaps(
    campaign: Campaign, predictions: dict[str, FloatArray]
) -> Iterator[tuple[tuple[str, str], DataFault]]:
    groups: dict[tuple[Quantity, tuple[str, ...]], list[Channel]] = defaultdict(list)
    for name, channel in campaign.channels.items():
        having = tuple(trial.name for trial in campaign.trials if name in trial.channels)
        if not np.isinf(channel.gain_deviation) and channel.quantity is not Quantity.SIGNAL:
            groups[channel.quantity, having].append(channel)
    for (_, names), alike in groups.items():
        trials = [trial for trial in campaign.trials if trial.name in names] if len(alike) > 1 else []
        misfit = sum((_misfits(trial, predictions[trial.name], alike) for trial in trials), np.zeros((1, 1)))
        _, assigned = linear_sum_assignment(misfit)
        for row, place in enumerate(assigned):
            if row < place and assigned[place] == row:
                before, after = misfit[[row, place], [row, place]], misfit[[row, place], [place, row]]
                if np.all(after < 0.5 * before) and np.sum(before - after) > 30.0:
                    pair = alike[row].name, alike[place].name
                    yield pair, fault(FaultKind.SWAPPED, pair[0], other=pair[1])


def _misfits(trial: Trial, predictions: FloatArray, alike: list[Channel]) -> FloatArray:
    """Return the misfits (C, C) of channels to what the model says of each of them."""
    columns = [trial.channels.index(channel.name) for channel in alike]
    rows = []
    for own, channel in zip(columns, alike, strict=True):
        used = trial.used[:, own]
        data, said = trial.values[used, own], predictions[used]
        rows.append([_misfit(data, said[:, other], channel, trial) for other in columns])
    return np.array(rows)


def _misfit(data: FloatArray, model: FloatArray, channel: Channel, trial: Trial) -> float:
    """Return chi-square of data about a prediction, with a share of the prediction as the least deviation."""
    noise = channel.noise_in(trial)
    if trial.is_dynamic:
        # Amplitudes only: a small error of frequency would outweigh what the places of two gauges differ by.
        rest = np.asarray(_begins_as(data, model, trial) * np.std(data) - np.std(model))
        deviation = np.hypot(noise / np.sqrt(len(data)), _FLOOR * np.std(model))
    else:
        rest = data - model
        if channel.offset_deviation > 0.0:
            rest = rest - np.median(rest)
        least = 0.2 * _FLOOR * float(np.max(np.abs(model), initial=0.0))
        deviation = np.maximum(np.hypot(noise, _FLOOR * np.abs(model)), least)
    # Bounded: readings of any size stay comparable.
    return float(np.sum(np.minimum(np.abs(rest / np.maximum(deviation, 1e-300)), 1e9) ** 2))
