"""A measurement that is planned on a structure: which suspicions it can tell apart.

Before anything is measured, the gauges, displacements and accelerations of a structure file are the
channels of a campaign with stated noise, and its forces the trials: static load lines, and releases
of these loads. `judgement.separability` says what such a campaign can decide, and
`judgement.next_experiment` which measurement beside it would decide more.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import ModelError
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.next_experiment import (
    SENSOR_WORDS,
    added_load_worths,
    added_sensor_worths,
)
from discrepancy.judgement.separability import (
    CONFUSION_DISTANCE,
    Confusion,
    Detectability,
    Separability,
    compute_separability,
)
from discrepancy.judgement.trial_worth import Alternatives, Proposal, Worth, worth_of_trial
from discrepancy.system.structures import StructureModel
from discrepancy.system.system_state import SystemState
from fe.reduction.model_cache import changeable_model
from fe.runtime.patch import ModelPatch
from fe.structure.design import load_structure

SUSPECTS = (
    "support_compliance",
    "interface_compliance",
    "added_mass",
    "region_stiffness_loss",
    "load_offset",
    "load_direction",
    "gauge_misalignment",
    "gauge_offset",
    "gauge_gain",
)
"""What a structural engineer suspects first."""
LEVELS = 8
"""Number of levels of a load line, from zero to the largest force."""
SAMPLES, SAMPLES_PER_PERIOD = 1200, 20
"""Samples of the ring-down after a release, and samples in a period of the first mode."""
RELEASED_SHARE = 0.5
"""Force of a release over the largest one."""
RELEASE_DEVIATION = 0.02
"""Standard deviation of the displacement of a release, as a fraction of it."""
MOST_PLACES = 4
"""Largest number of places at which a suspicion is compared with one that looks like it."""
COST_OF_RELEASE = 1.0
"""Cost of a release, see `Proposal.cost`."""
ZERO_OVER_NOISE = 2.0
"""Standard deviation of a channel's zero over that of its noise."""


class Precision(NamedTuple):
    """How precise the planned channels are.

    Attributes
    ----------
    noise : mapping of Quantity to float
        Standard deviation of the noise of a reading, by quantity [SI].
    gain : float
        Standard deviation of the relative error of a gain [1].
    """

    noise: dict[Quantity, float]
    gain: float


class Remedy(NamedTuple):
    """A measurement that would tell two suspicions apart.

    Attributes
    ----------
    description : str
        The measurement in words.
    worth : Worth
        What it is expected to tell, if both suspicions are equally probable before it.
    cost : float
        The cost as in `Proposal.cost`.
    """

    description: str
    worth: Worth
    cost: float

    @property
    def rank(self) -> tuple[float, float]:
        """The key by which measurements are sorted: certainty to two digits, then the cost."""
        return (-round(self.worth.certainty, 2), self.cost)


class LookAlikes(NamedTuple):
    """Two suspicions that planned trials do not tell apart, and what would.

    Attributes
    ----------
    terms : (EffectTerm, EffectTerm)
        The suspicions with the places at which they are compared.
    remedies : tuple of Remedy
        Additional measurements, those that tell most first: at most a gauge, a displacement sensor,
        a load at another place and a release.
    """

    terms: tuple[EffectTerm, EffectTerm]
    remedies: tuple[Remedy, ...]


class Plan(NamedTuple):
    """Trials that are planned, and what they can decide.

    Attributes
    ----------
    setting : Setting
        The campaign of these trials, and the structure.
    separability : Separability
        Which suspicions they show, and which of them look alike.
    """

    setting: Setting
    separability: Separability

    def least_change(self, row: Detectability) -> ModelPatch | None:
        """Return the patch of a suspected effect at the least value that the trials detect.

        The other parameters of the effect have their start values. The result is None if the trials
        detect no value of it.
        """
        if row.reason or not np.isfinite(row.detectable):
            return None
        term = EffectTerm(row.effect, row.place)
        values = term.physical_values(term.start_values()) | {row.parameter: row.detectable}
        return row.effect.patch(self.setting, values, row.place)


def load_plannable_structure(file: Path) -> StructureModel:
    """Return the model of a structure file on which a measurement can be planned.

    Raises
    ------
    ModelError
        If the structure has no force, or nothing that is read at rest. This is said before the
        structure is reduced.
    FiniteElementError
        If the structure cannot be read, modelled or reduced.
    """
    design = load_structure(file)
    if all(control.unit != "N" for control in design.control):
        raise ModelError(
            f"The structure {design.name} has no control in N: a planned load line needs one; give "
            'a [[control]] with unit = "N" and a [[load]] tied to it.'
        )
    if not design.gauge and not design.displacement:
        raise ModelError(
            f"The structure {design.name} has neither a gauge nor a displacement, which a planned "
            "load line would be read by: give a [[gauge]] or a [[displacement]]."
        )
    return StructureModel(changeable_model(file))


class PlannedMeasurement:
    """What planned trials on a structure can decide, and what would decide more.

    Parameters
    ----------
    model : StructureModel
        The structure with the changes that it may have, from `load_plannable_structure`.
    precision : Precision
        How precise the channels are.
    catalogue : sequence of Effect
        The catalogue; only the effects among `SUSPECTS` are compared.

    Attributes
    ----------
    static, with_releases : Plan
        What static loads can decide, and what these together with releases can.
    """

    def __init__(
        self, model: StructureModel, precision: Precision, catalogue: Sequence[Effect]
    ) -> None:
        self._suspects = [effect for effect in catalogue if effect.identifier in SUSPECTS]
        self._lines = _load_lines(model)
        self._releases = _releases(model)
        self._model = model
        self._precision = precision
        self.static = self._plan(self._lines)
        self.with_releases = self._plan([*self._lines, *self._releases])

    def _plan(self, trials: Sequence[Trial]) -> Plan:
        """Return what some of the planned trials can decide."""
        campaign = _campaign_of(self._model, self._precision, trials)
        setting = Setting(campaign, self._model, self._model.scales(campaign))
        separability = compute_separability(campaign, self._model, setting, self._suspects)
        return Plan(setting, separability)

    @property
    def confusions(self) -> list[tuple[Confusion, Plan]]:
        """The pairs of suspicions that static loads do not tell apart, with the plan that shows it.

        If releases do not tell a pair apart either, it is that of the plan with releases, which has
        the places at which they do not.
        """
        with_releases = {pair.effects: pair for pair in self.with_releases.separability.confusions}
        return [
            (with_releases[pair.effects], self.with_releases)
            if pair.effects in with_releases
            else (pair, self.static)
            for pair in self.static.separability.confusions
        ]

    def look_alikes(self, confusion: Confusion, plan: Plan) -> LookAlikes:
        """Return two suspicions with the measurements that tell them apart, best first.

        Both are equally probable before, at the places at which they explain the load lines.

        Parameters
        ----------
        confusion, plan
            A pair of `confusions`.
        """
        problem, fits = self._fits_to_load_lines(confusion, plan.setting)
        other_count = len(fits) - 1
        alternatives = Alternatives(
            fits=fits,
            weights=np.array([0.5, *[0.5 / other_count] * other_count]),
            classes=np.array([0, *[1] * other_count]),
        )
        remedies = []
        for sensor, proposal, worth in added_sensor_worths(problem, alternatives):
            words = f"{SENSOR_WORDS[sensor.channel.quantity]} at {sensor.channel.name}"
            remedies.append(Remedy(words, worth, proposal.cost))
        for proposal, worth in added_load_worths(problem, alternatives):
            words = f"a load at {proposal.trial.load_place}"
            remedies.append(Remedy(words, worth, proposal.cost))
        releases = []
        for trial in self._releases:
            proposal = Proposal(trial, f"a {trial.name}", "", COST_OF_RELEASE)
            worth = worth_of_trial(problem, proposal, alternatives)
            releases.append(Remedy(proposal.description, worth, proposal.cost))
        remedies.append(min(releases, key=lambda remedy: remedy.rank))
        truth, first_other, *_ = [fit.candidate.terms[0] for fit in fits]
        return LookAlikes(
            terms=(truth, first_other),
            remedies=tuple(sorted(remedies, key=lambda remedy: remedy.rank)),
        )

    def _fits_to_load_lines(
        self, confusion: Confusion, setting: Setting
    ) -> tuple[Problem, list[CandidateFit]]:
        """Return the load lines as read under one suspicion, and the fits of both to them.

        The first fit is that of the suspicion that is true. Those of the other one, at each of its
        places where it explains the readings nearly as well, follow the best first.
        Sensors that are read in releases alone, and errors of the mesh in frequencies, are unknowns
        of the problem, too.
        """
        campaign = self.with_releases.setting.campaign
        problem = Problem(campaign, self._model, setting).with_trials(self._lines)
        truth = Candidate((confusion.true_term,))
        start = replace(problem.prior_mean_point(truth), effect=confusion.true_values)
        lines = []
        for number, line in enumerate(self._lines):
            response = problem.response_of_candidate(number, start, truth)
            lines.append(replace(line, values=problem.prediction(number, start, response)))
        problem = problem.with_trials(lines)
        screen = Screen(problem, fit(problem, Candidate(), problem.prior_mean_point(Candidate())))
        # the other suspicion where it explains most
        best_of_places = []
        for place in confusion.other_effect.places(setting):
            changes = list(screen.changes_on_grid(EffectTerm(confusion.other_effect, place)))
            if changes:
                best_of_places.append(max(changes, key=lambda change: change.gain))
        best_of_places.sort(key=lambda change: -change.gain)
        fits = []
        for change in best_of_places[:MOST_PLACES]:
            other = Candidate((change.term,))
            start_of_other = replace(problem.prior_mean_point(other), effect=change.best_values)
            fits.append(fit(problem, other, start_of_other))
        fits.sort(key=lambda other_fit: other_fit.objective)
        limit = fits[0].objective + 0.5 * CONFUSION_DISTANCE
        alike = [other_fit for other_fit in fits if other_fit.objective <= limit]
        return problem, [fit(problem, truth, start), *alike]


def _campaign_of(model: StructureModel, precision: Precision, trials: Sequence[Trial]) -> Campaign:
    """Return the campaign of planned trials, with the channels that they record.

    A channel has stated noise, a zero known to `ZERO_OVER_NOISE` times that, and the gain error of
    the precision.
    """
    recorded = {name for trial in trials for name in trial.channels}
    channels = {}
    for name, quantity in model.quantities.items():
        if name in recorded:
            noise = precision.noise[quantity]
            channels[name] = Channel(
                name,
                quantity,
                output=name,
                noise=NoiseRecord(noise),
                gain_deviation=precision.gain,
                offset_deviation=ZERO_OVER_NOISE * noise,
            )
    return Campaign(
        name=f"planned on {model.name}",
        channels=channels,
        trials=tuple(trials),
        reference_temperature=None,
        parameters={},
        data_hash="",
    )


def _load_lines(model: StructureModel) -> list[Trial]:
    """Return a static trial of each force, from zero to the largest force in `LEVELS` steps.

    The readings of the trials are zero, and accelerations are not among the channels.
    """
    channels = tuple(
        name for name, quantity in model.quantities.items() if quantity is not Quantity.ACCELERATION
    )
    force = np.linspace(0.0, model.largest_force, LEVELS)
    rows = np.arange(float(LEVELS))
    lines = []
    for name in model.forces:
        lines.append(
            Trial.plain(
                f"load {name}", TrialKind.STATIC, channels, rows, force=force, load_place=name
            )
        )
    return lines


def _releases(model: StructureModel) -> list[Trial]:
    """Return a ring-down after the release of each force, held at `RELEASED_SHARE` of the largest.

    The structure is released from the static displacement along the force at the prior mean of the
    parameters.
    """
    state = SystemState(tuple(model.prior_mean().tolist()))
    system = model.build_system(state)
    first_frequency = float(system.angular_frequency.min()) / (2.0 * np.pi)  # Hz
    time = np.arange(SAMPLES) / (SAMPLES_PER_PERIOD * first_frequency)
    releases = []
    for name in model.forces:
        load = model.force_row(name, state)  # (modes,) under a unit force
        flexibility = float(load @ np.linalg.solve(system.stiffness, load))  # m/N
        displacement = RELEASED_SHARE * model.largest_force * flexibility
        releases.append(
            Trial.plain(
                f"release of {name}",
                TrialKind.RINGDOWN,
                tuple(model.quantities),
                time,
                load_place=name,
                release=Release(displacement, RELEASE_DEVIATION),
            )
        )
    return releases
