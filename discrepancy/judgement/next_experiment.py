"""The next experiment: the feasible trial that decides most between open hypotheses, for its cost.

`trial_worth` says how much a trial decides.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import entr

from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.errors import SENTENCES, DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.judgement.trial_worth import (
    AddedSensor,
    Alternatives,
    Proposal,
    Worth,
    worth_of_trial,
    worths_of_sensors,
)
from discrepancy.system.interface import NO_PATCH
from discrepancy.verdict import Experiment
from fe.runtime.patch import SENSORS, ModelPatch, ModulusTemperature, PointMass

LEAST_INFORMATION = 0.03
"""Information below which an experiment is not proposed [nat]."""
LEAST_SHARE = 0.1
"""Share of the entropy of the open hypotheses that an experiment has to tell to be proposed."""
MOST_PROPOSED = 4
"""Largest number of experiments that are proposed."""
LEAST_PROBABILITY = 1e-3
"""Least probability with which a hypothesis enters the information."""
MOST_LOADS = 18
"""Largest number of other forces that are tried, the first of the model's possible loads."""
COST_OF_LOAD = 1.5
"""Cost of a loading at another place."""
COST_OF_SENSOR = 2.0
"""Cost of a trial with one more sensor, which has to be mounted first."""
SENSOR_WORDS = {
    Quantity.STRAIN: "a strain gauge",
    Quantity.DISPLACEMENT: "a displacement sensor",
}
"""The sensors that may be added, in a sentence."""


def next_experiments(
    problem: Problem, open_fits: Sequence[tuple[CandidateFit, float]]
) -> tuple[Experiment, ...]:
    """Return the experiments that best separate the open hypotheses, to propose them to the user.

    An experiment is a feasible trial that tells at least `LEAST_INFORMATION`, and `LEAST_SHARE` of
    what is not known yet. None is needed if less than `LEAST_INFORMATION` is open. At most
    `MOST_PROPOSED` are returned, those of the largest information per cost first.

    Parameters
    ----------
    open_fits : sequence of (CandidateFit, float)
        The hypotheses that are still open with their probabilities, the most probable first.
    """
    given_probabilities = np.array([probability for _, probability in open_fits])
    entropy = float(np.sum(entr(given_probabilities / given_probabilities.sum())))
    if entropy < LEAST_INFORMATION:
        return ()  # hardly anything is open
    least_information = max(LEAST_INFORMATION, LEAST_SHARE * entropy)
    # a hypothesis of nearly no probability would make its logarithm infinite
    probabilities = np.maximum(given_probabilities, LEAST_PROBABILITY)
    probabilities /= probabilities.sum()
    fits = [fit for fit, _ in open_fits]
    is_oscillating = oscillates(problem, fits[0]) if fits else True
    alternatives = Alternatives.single(fits, probabilities)
    experiments = []
    proposals = [
        *feasible_proposals(problem, is_oscillating=is_oscillating),
        *second_sensor_proposals(problem, fits),
    ]
    for proposal in proposals:
        try:
            information = worth_of_trial(problem, proposal, alternatives).information
        except DiscrepancyError:  # the model cannot simulate this trial
            continue
        if information >= least_information:
            experiments.append(
                Experiment(proposal.description, information, proposal.cost, proposal.reason)
            )
    for _, proposal, worth in added_sensor_worths(problem, alternatives) if fits else ():
        if worth.information >= least_information:
            experiments.append(
                Experiment(proposal.description, worth.information, proposal.cost, proposal.reason)
            )
    experiments.sort(key=lambda experiment: -experiment.information / experiment.cost)
    return tuple(experiments[:MOST_PROPOSED])


# ---------------------------------------------------------------- feasible trials


def oscillates(problem: Problem, fit: CandidateFit) -> bool:
    """Return whether the motion after a release oscillates in a fit.

    It does if the direction of motion changes more than once in a channel.
    """
    for data, response in zip(problem.trials, fit.responses, strict=True):
        if data.trial.kind is not TrialKind.RINGDOWN:
            continue
        steps = np.diff(response, axis=0)
        # steps of the size of rounding errors have no direction
        is_large = np.abs(steps) > 1e-9 * np.abs(response).max(initial=0.0)
        for column in range(steps.shape[1]):
            signs = np.sign(steps[is_large[:, column], column])
            if np.count_nonzero(np.diff(signs)) > 1:
                return True
    return False


def feasible_proposals(problem: Problem, *, is_oscillating: bool = True) -> Iterator[Proposal]:
    """Yield feasible trials: trials of the campaign with one thing changed.

    The changes are the [[proposal]] tables of `sentences.toml`.

    Parameters
    ----------
    problem : Problem
        The campaign, whose trials are varied, and the model.
    is_oscillating : bool
        Whether the motion after a release oscillates. If not, a longer record is not proposed, as
        it would only show the structure at rest.
    """
    for proposal_table in SENTENCES.tables["proposal"]:
        trials_of_kind = [
            trial for trial in problem.campaign.trials if trial.kind.value == proposal_table["kind"]
        ]
        if not trials_of_kind or (proposal_table["change"] == "length" and not is_oscillating):
            continue
        select_trial = min if proposal_table.get("of") == "smallest" else max
        varied_trial = select_trial(trials_of_kind, key=lambda trial: trial.level)
        changed_trial = _changed_trial(
            problem, varied_trial, proposal_table["change"], proposal_table["by"]
        )
        if changed_trial is None:  # the change is not possible with this trial or model
            continue
        level = varied_trial.level
        description = proposal_table["description"].format(
            top=level,
            most=abs(proposal_table["by"]) * level,
            signed=proposal_table["by"] * level,
            value=changed_trial.value,
        )
        trial = replace(changed_trial.trial, name=proposal_table["name"])
        yield Proposal(
            trial,
            description,
            proposal_table["reason"],
            proposal_table["cost"],
            changed_trial.added_patch,
        )


def second_sensor_proposals(problem: Problem, fits: Sequence[CandidateFit]) -> Iterator[Proposal]:
    """Yield a trial with a second sensor beside each one that may have an error.

    Parameters
    ----------
    problem : Problem
        The campaign, whose trial of the highest level is repeated, and the model.
    fits : sequence of CandidateFit
        The hypotheses. A sensor may have an error if one of them says so.
    """
    doubtful_channels: set[str] = set()
    for fit in fits:
        patch = fit.candidate.patch(problem.setting, fit.effect)
        doubtful_channels.update(getattr(item, "channel", "") for item in patch.of(*SENSORS))
    for name in problem.channel_names:
        trials = [trial for trial in problem.campaign.trials if name in trial.channels]
        if name not in doubtful_channels or not trials:
            continue
        trial = max(trials, key=lambda trial: trial.level)
        second_channel = replace(
            problem.campaign.channels[name],
            name=f"second sensor beside {name}",
            gain_deviation=0.0,
        )
        yield Proposal(
            trial,
            f"Repeat {trial.name!r} with a second sensor beside {name!r}.",
            "An error of a sensor does not show in another one.",
            COST_OF_SENSOR,
            added_sensor=AddedSensor(second_channel, noise_of=name),
        )


def added_sensor_worths(
    problem: Problem, alternatives: Alternatives
) -> Iterator[tuple[AddedSensor, Proposal, Worth]]:
    """Yield, of each quantity that the campaign measures, the additional sensor that tells most.

    The sensors are those that the model says a user may add. One is read in the largest loading at
    each load place, with the noise of a present channel of its quantity.
    """
    channels = problem.campaign.channels
    for quantity in dict.fromkeys(problem.model.possible_sensors.values()):
        similar = [
            name
            for name in channels
            if channels[name].quantity is quantity and np.isfinite(channels[name].gain_deviation)
        ]
        if not similar:
            continue
        sensors = []
        for output, output_quantity in problem.model.possible_sensors.items():
            if output_quantity is quantity:
                channel = replace(channels[similar[0]], name=output, output=output)
                sensors.append(AddedSensor(channel, noise_of=similar[0]))
        choices = []
        for trial in _largest_loadings(problem):
            worths = worths_of_sensors(problem, trial, sensors, alternatives)
            choices += [(trial, *pair) for pair in zip(sensors, worths, strict=True)]
        if choices:
            trial, sensor, worth = max(choices, key=lambda choice: choice[-1].information)
            proposal = Proposal(
                trial,
                f"Repeat {trial.name!r} with {SENSOR_WORDS[quantity]} at {sensor.channel.name}.",
                "There the open hypotheses differ most.",
                COST_OF_SENSOR,
                added_sensor=sensor,
            )
            yield sensor, proposal, worth


def added_load_worths(
    problem: Problem, alternatives: Alternatives
) -> Iterator[tuple[Proposal, Worth]]:
    """Yield the loading at another place that tells most, with the sensors of the campaign.

    Nothing is yielded without a loading in the campaign,
    or if the model cannot be loaded at another place.
    """
    loadings = _largest_loadings(problem)
    choices = []
    for place in problem.model.possible_loads[:MOST_LOADS] if loadings else ():
        trial = replace(loadings[0], name=f"load at {place}", load_place=place)
        description = f"Load at {place} instead, to {trial.level:.3g} N."
        reason = "What looks alike under one load differs under another."
        proposal = Proposal(trial, description, reason, COST_OF_LOAD)
        with suppress(DiscrepancyError):  # the model cannot simulate this trial
            choices.append((proposal, worth_of_trial(problem, proposal, alternatives)))
    if choices:
        yield max(choices, key=lambda choice: choice[1].information)


def _largest_loadings(problem: Problem) -> list[Trial]:
    """Return the static trial with the largest force at each load place."""
    loadings: dict[object, Trial] = {}
    for trial in problem.campaign.trials:
        if trial.kind is TrialKind.STATIC:
            previous = loadings.get(trial.load_place, trial)
            loadings[trial.load_place] = max(previous, trial, key=lambda trial: trial.level)
    return list(loadings.values())


class _ChangedTrial(NamedTuple):
    """A trial with one thing changed.

    Attributes
    ----------
    trial : Trial
        The trial with its readings, inputs and sample times.
    value : float
        The new value of a length, place or mass, as the description prints it; 0 if the load, the
        release or the temperature is changed.
    added_patch : ModelPatch
        The change of the structure.
    """

    trial: Trial
    value: float = 0.0
    added_patch: ModelPatch = NO_PATCH


def _changed_trial(
    problem: Problem, trial: Trial, change: str, amount: float
) -> _ChangedTrial | None:
    """Return a trial with one thing changed; None if the trial or the model does not allow it.

    `change` is the kind of change, as in a [[proposal]] table of `sentences.toml`. `amount` is a
    factor, a fraction of the span or of the modal mass, or a temperature difference [K].
    """
    model = problem.model
    stations = model.stations
    if change == "release" and trial.release is not None:
        release = replace(trial.release, displacement=amount * trial.release.displacement)
        return _ChangedTrial(replace(trial, release=release))
    if change in ("force", "load_factor"):
        return _ChangedTrial(replace(trial, **{change: amount * getattr(trial, change)}))
    if change == "length":
        sample_count = int(amount) * len(trial.time)
        time = trial.time[0] + trial.interval * np.arange(sample_count)
        # the readings are not used: the recorded rows are repeated to fill the longer record
        longer_trial = trial.rows(np.arange(sample_count) % len(trial.time), time=time)
        return _ChangedTrial(longer_trial, sample_count * trial.interval)
    if change == "place" and stations is not None:
        root, tip = stations
        station = round(root + amount * (tip - root), 3)
        return _ChangedTrial(replace(trial, load_place=(station, 0.35)), station)
    if change == "mass" and model.supports(PointMass):
        mass = amount * problem.setting.scales.modal_mass
        tip_mass = PointMass(mass, stations[1] if stations is not None else 0.0)
        return _ChangedTrial(trial, 1e3 * mass, ModelPatch((tip_mass,)))
    has_reference = problem.campaign.reference_temperature is not None
    if change == "temperature" and has_reference and model.supports(ModulusTemperature):
        return _ChangedTrial(replace(trial, temperature=trial.temperature + amount))
    return None
