"""Closed-form models whose fits are known exactly, and simulated campaigns on the lumped chain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from math import inf
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Release, Trial, TrialKind
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem
from discrepancy.models.interface import Conditions, Model, Outputs, Response
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.scales import PortScale, Scales
from discrepancy.models.sensing import observe
from fe.runtime.patch import ModelPatch, Primitive, RunOffset, SensorDrift

FloatArray = NDArray[np.float64]

OUTPUTS = ("y1", "y2", "y3")
STATIC_SHAPES = np.array([[1.0, 0.6, 0.3], [0.02, -0.03, 0.05]])  # by parameter and output
HEALTH_SHAPES = np.array([[0.3, 0.1, 0.0], [0.05, 0.4, 0.2]])  # by region and output
MODES = np.array([[1.0, 0.5, 0.2], [0.7, -0.6, 0.3]])  # by mode and output
FREQUENCIES, DECAYS = np.array([3.0, 11.0]), np.array([0.25, 0.6])


@dataclass(frozen=True)
class ClosedForm(Model):
    """Responses that are linear in everything a hypothesis can move, or bent where `bent` says so.

    Static: y_c = sum_p theta_p F^(p+1) S_pc, times 1 + z . H_c if `bent`. Ring-down: two decaying modes of
    unit release, deviations of the initial state by mode; `bent` scales their frequencies
    with the root of theta_0.
    """

    bent: bool = False

    name = "closed form"
    parameters = (
        ParameterPrior("slope", "1", 1.0, 0.05, 0.1, 2.0),
        ParameterPrior("curvature", "1", 0.5, 0.2, -3.0, 3.0),
    )

    def output_quantity(self, output: str) -> Quantity | None:
        return Quantity.DISPLACEMENT if output in OUTPUTS else None

    def supports(self, primitive: type[Primitive]) -> bool:
        return False

    def scales(self, campaign: Campaign) -> Scales:
        w = 2.0 * np.pi * float(FREQUENCIES[0])
        return Scales(1.0, 1.0, 1.0, w, 10.0, 1.0, 1.0, 100.0, {"y": PortScale(1.0, 1.0, w)})

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        columns = [OUTPUTS.index(output) for output, _ in outputs]
        theta = conditions.parameters
        if not trial.is_dynamic:
            force = trial.load_factor if trial.kind is TrialKind.FLIGHT else trial.force
            values = sum(theta[p] * np.outer(force ** (p + 1), STATIC_SHAPES[p]) for p in range(2))
            if self.bent:
                values = values * (1.0 + conditions.health @ HEALTH_SHAPES)
            else:
                values = values + np.outer(force, np.ones(3)) * (conditions.health @ HEALTH_SHAPES)
            return Response(np.asarray(values)[:, columns])
        rate, zero = conditions.clock
        time = (1.0 + rate) * trial.time + zero
        factor = float(np.sqrt(theta[0])) if self.bent else 1.0
        values, rates = np.zeros((2, len(time), 3))
        for mode in range(2):
            w, d = 2.0 * np.pi * factor * FREQUENCIES[mode], DECAYS[mode]
            pole = -d + 1j * w
            wave = np.exp(pole * time)
            if trial.release.at_rest:
                amplitude = 1.0 + conditions.initial[0, 0] if len(conditions.initial) else 1.0
                amplitude += conditions.initial[mode, 0] if mode < len(conditions.initial) else 0.0
                complex_amplitude = amplitude + 0j
            else:
                complex_amplitude = conditions.initial[mode, 0] - 1j * conditions.initial[mode, 1]
            size = trial.release.displacement * complex_amplitude
            values += np.outer((size * wave).real, MODES[mode])
            rates += np.outer((size * pole * wave).real, MODES[mode])
        return Response(values[:, columns], rates[:, columns] * (1.0 + rate))


def blank_trial(
    name: str,
    kind: TrialKind,
    channels: Sequence[str],
    rows: FloatArray,
    *,
    start: float = 0.0,
    temperature: float = 0.0,
    **given: Any,
) -> Trial:
    """Return a trial without readings; `rows` are forces of a static trial, times of a dynamic one."""
    time = rows
    if kind is TrialKind.STATIC:
        time, given = start + 10.0 * np.arange(len(rows)), {"force": rows, **given}
    given = {"run": "A", "temperature": np.full(len(rows), temperature), **given}
    return Trial.plain(name, kind, tuple(channels), time, start=start, **given)


def offset_effect(identifier: str = "offset", deviation: float = 0.3) -> Effect:
    """Return an effect that is linear in its only parameter: an offset of all readings of run A."""

    def build(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        return ModelPatch((RunOffset("A", values["offset"], channel=place, quantity=""),))

    return _effect(identifier, build, "offset", deviation, frozenset({TrialKind.STATIC}), "y1")


def drift_effect(
    identifier: str = "drift", deviation: float = 0.3, exponent: float = 1.0, channel: str = "y2"
) -> Effect:
    """Return an effect that is linear in its only parameter: a zero that moves with a power of time."""

    def build(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        return ModelPatch((SensorDrift(place, values["drift"], 100.0, exponent),))

    return _effect(identifier, build, "drift", deviation, frozenset(TrialKind), channel)


def _effect(
    identifier: str, build: Callable[[Setting, Mapping[str, float], str], ModelPatch], name: str,
    deviation: float, acts_on: frozenset[TrialKind], place: str,
) -> Effect:  # fmt: skip
    ninety = 1.6448536269514722 * deviation
    size = EffectParameter(name, name, "m", name, Prior("normal", -ninety, ninety), magnitude=True)
    return Effect(
        identifier=identifier, name=identifier, family=identifier, equation="-", signature="-", reference="-",
        acts_on=acts_on, parameters=(size,), build=build, places=lambda setting: (place,),
    )  # fmt: skip


@dataclass(frozen=True)
class Linear:
    """A problem whose residuals are affine in all unknowns, with its dense matrices."""

    problem: Problem
    candidate: Candidate

    def point(self, x: FloatArray) -> Point:
        """Return the point of a vector: shared, effect, then local unknowns."""
        q, e = self.problem.shared.size, self.candidate.size
        ends = np.cumsum([data.unknowns.size for data in self.problem.trials])
        return Point(x[:q], tuple(np.split(x[q + e :], ends[:-1])), x[q : q + e])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        local = sum(data.unknowns.size for data in self.problem.trials)
        return self.problem.shared.size + self.candidate.size + local

    @property
    def precision(self) -> FloatArray:
        """Prior precisions in the order of `point`."""
        local = [data.unknowns.precision for data in self.problem.trials]
        return np.concatenate((self.problem.shared.precision, np.ones(self.candidate.size), *local))

    def residual(self, x: FloatArray) -> FloatArray:
        """Return all residuals, those that do not count left out."""
        point, parts = self.point(x), []
        for number, data in enumerate(self.problem.trials):
            acts = data.trial.kind in self.candidate.acts_on
            patch = self.candidate.patch(self.problem.setting, point.effect) if acts else ModelPatch()
            response, _ = self.problem.response(number, point.shared, point.local[number], patch)
            residual = self.problem.residual(number, point, response)
            parts.append(residual[data.weight > 0.0])
        return np.concatenate(parts)

    @property
    def groups(self) -> NDArray[np.int64]:
        """Channel of each residual."""
        return np.concatenate(
            [
                np.broadcast_to(data.groups, data.weight.shape)[data.weight > 0.0]
                for data in self.problem.trials
            ]
        )

    def dense(self) -> tuple[FloatArray, FloatArray]:
        """Return y and A of residual = y - A x, exact because it is affine."""
        zero = np.zeros(self.size)
        y = self.residual(zero)
        return y, np.stack([y - self.residual(row) for row in np.eye(self.size)], axis=1)


def closed_problem(
    *,
    seed: int = 0,
    bent: bool = False,
    noise: NoiseRecord | None = None,
    known_noise: bool = True,
    offset_deviation: float = 0.05,
    gain_deviation: float = 0.0,
    health: bool = False,
    at_rest: bool = True,
    time_zero: float = 0.0,
    effect: float = 0.0,
    samples: int = 60,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    left_out: Mapping[int, Sequence[tuple[int, int]]] | None = None,
    kinds: Sequence[str] = ("static", "ringdown"),
    extra: Callable[[FloatArray], FloatArray] | None = None,
) -> Problem:
    """Return a problem on the closed form: two static trials, two ring-downs, three channels.

    `effect` is an offset of y1 in run A, in metres; `extra` gives what the first channel of every trial shows
    besides, from the row numbers. What is unknown is drawn from its prior.
    """
    generator = np.random.default_rng(seed)
    record = (noise or NoiseRecord(0.02, inf)) if known_noise else None
    channels = {
        name: Channel(name, Quantity.DISPLACEMENT, name, record, gain_deviation, offset_deviation)
        for name in OUTPUTS
    }
    force = np.linspace(-1.0, 2.0, 9)
    spread, prior_loss = (np.full((len(force), 2), size if health else 0.0) for size in (0.1, 0.3))
    time = 0.01 * np.arange(samples)
    trials = []
    if "static" in kinds:
        trials += [
            blank_trial("up", TrialKind.STATIC, OUTPUTS, force, health=prior_loss, health_deviation=spread),
            blank_trial("down", TrialKind.STATIC, OUTPUTS[::-1], force[::-1], run="B", start=200.0),
        ]
    if "ringdown" in kinds:
        release = Release(1.0, 0.05, at_rest, 2, time_zero)
        trials += [
            blank_trial("one", TrialKind.RINGDOWN, OUTPUTS, time, start=400.0, release=release),
            blank_trial(
                "two", TrialKind.RINGDOWN, OUTPUTS[:2], time, start=500.0,
                release=replace(release, displacement=0.5), noise_factor=1.5,
            ),
        ]  # fmt: skip
    bare = Campaign("closed form", channels, tuple(trials), None, dict(parameters or {}), "")
    model = ClosedForm(bent)
    problem = Problem(bare, model, Setting(bare, model, model.scales(bare)))
    shared = generator.standard_normal(problem.shared.size) * (problem.shared.precision > 0.0)
    measured = []
    for number, data in enumerate(problem.trials):
        local = generator.standard_normal(data.unknowns.size)
        if not at_rest and data.trial.release is not None:
            local[data.unknowns.zeros :] *= 0.3
        patch = ModelPatch((RunOffset("A", effect, channel="y1", quantity=""),))
        response, _ = problem.response(number, shared, local, patch if effect else ModelPatch())
        prediction = problem.prediction(number, _local_point(problem, shared, local, number), response)
        deviation = data.trial.noise_factor * (0.02 if record is None else record.standard_deviation)
        values = prediction + deviation * generator.standard_normal(response.shape)
        if extra is not None:
            values[:, 0] += extra(np.arange(len(values), dtype=np.float64))
        used = np.ones(values.shape, dtype=bool)
        for row, column in (left_out or {}).get(number, ()):
            used[row, column] = False
        measured.append(replace(data.trial, values=values, used=used))
    campaign = replace(bare, trials=tuple(measured))
    return Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))


def fitted(problem: Problem, *terms: Term, **given: Any) -> CandidateFit:
    """Return the fit of some terms, from the start that the problem has for them."""
    candidate = Candidate(terms)
    return fit(problem, candidate, problem.start(candidate), **given)


def _local_point(problem: Problem, shared: FloatArray, local: FloatArray, number: int) -> Point:
    locals_ = [np.zeros(data.unknowns.size) for data in problem.trials]
    locals_[number] = local
    return Point(shared, tuple(locals_), np.empty(0))


# ---------------------------------------------------------------- the lumped chain


@dataclass(frozen=True)
class Bench:
    """A lumped model, and what is measured on it.

    Attributes
    ----------
    model : LumpedModel
        The model as it is believed.
    campaign : Campaign
        Trials without readings.
    """

    model: LumpedModel
    campaign: Campaign

    @property
    def setting(self) -> Setting:
        """Scales of the campaign."""
        return Setting(self.campaign, self.model, self.model.scales(self.campaign))

    def patch(self, identifier: str, values: Mapping[str, float], place: str = "") -> ModelPatch:
        """Return the patch of an effect of the library."""
        return effect_by_identifier(identifier, library()).patch(self.setting, values, place)

    def measured(
        self,
        seed: int,
        patch: ModelPatch = ModelPatch(),  # noqa: B008 - frozen
        *,
        noise_scale: float = 1.0,
        noise: Callable[[np.random.Generator, tuple[int, ...]], FloatArray] | None = None,
    ) -> Campaign:
        """Return the campaign with readings: nuisances and calibrated parameters drawn from their priors.

        Simulated at half the time steps. `noise` draws standard noise; `noise_scale` is the true deviation
        over the one that the channels' records say.
        """
        generator = np.random.default_rng(np.random.SeedSequence(seed))
        theta = np.array([p.mean + p.deviation * generator.standard_normal() for p in self.model.parameters])
        gains = {
            name: 1.0 + (channel.gain_deviation * generator.standard_normal())
            for name, channel in self.campaign.channels.items()
        }
        trials = []
        for trial in self.campaign.trials:
            rows = 0 if trial.release is None else trial.release.mode_count
            initial = np.zeros((rows, 2))
            if trial.release is not None:
                initial[:, 0] = trial.release.deviation * generator.standard_normal(rows)
            conditions = Conditions(theta, initial, (0.0, 0.0), trial.health, refinement=2)
            values = observe(self.model, self.campaign, trial, patch, conditions).values.copy()
            drawn = (noise or (lambda g, shape: g.standard_normal(shape)))(generator, values.shape)
            for column, name in enumerate(trial.channels):
                channel = self.campaign.channels[name]
                s0 = channel.noise.standard_deviation * noise_scale
                values[:, column] = values[:, column] * gains[name] + s0 * drawn[:, column]
                values[:, column] += channel.offset_deviation * generator.standard_normal()
            trials.append(replace(trial, values=values))
        return replace(self.campaign, trials=tuple(trials))

    def problem(self, campaign: Campaign) -> Problem:
        """Return the problem of a measured campaign."""
        return Problem(campaign, self.model, Setting(campaign, self.model, self.model.scales(campaign)))


def chain_bench(
    *,
    static: bool = True,
    amplitudes: Sequence[float] = (0.02, 0.012, 0.006),
    dynamic_channels: Sequence[str] = ("x3", "x2", "g1"),
    static_channels: Sequence[str] = ("x3", "x2", "g1", "g2"),
    samples: int = 240,
    interval: float = 0.012,
    freedom: float = 200.0,
    mode_count: int = 3,
    gain_deviation: float = 0.005,
    held_out: bool = False,
) -> Bench:
    """Return a bench on the shipped three-mass chain."""
    model = LumpedModel.load(str(files("discrepancy.lumped_models") / "three_mass_chain.toml"))
    length, strain = Quantity.DISPLACEMENT, Quantity.STRAIN
    every = {
        "x3": Channel("x3", length, "x3", NoiseRecord(2e-5, freedom), 0.0, 2e-5),
        "x2": Channel("x2", length, "x2", NoiseRecord(2e-5, freedom), gain_deviation, 2e-5),
        "g1": Channel("g1", strain, "base_strain", NoiseRecord(4e-7, freedom), gain_deviation, 4e-7),
        "g2": Channel("g2", strain, "joint_strain", NoiseRecord(4e-7, freedom), gain_deviation, 4e-7),
    }
    trials = []
    if static:
        force = np.linspace(0.0, 12.0, 7)
        for number, (run, rows) in enumerate((("A", force), ("A", -force), ("B", force))):
            trials.append(
                blank_trial(
                    f"static {number}", TrialKind.STATIC, static_channels, rows, run=run, load_place="end",
                    start=600.0 * number, held_out=held_out and number == 2,
                )
            )  # fmt: skip
    time = interval * np.arange(samples)
    for number, amplitude in enumerate(amplitudes):
        trials.append(
            blank_trial(
                f"release {number}", TrialKind.RINGDOWN, dynamic_channels, time,
                start=3000.0 + 120.0 * number, load_place="end",
                release=Release(amplitude, 0.02, mode_count=mode_count),
                held_out=held_out and number == 1,
            )
        )  # fmt: skip
    names = {name for trial in trials for name in trial.channels}
    channels = {name: channel for name, channel in every.items() if name in names}
    return Bench(model, Campaign("chain", channels, tuple(trials), None, {}, ""))


@dataclass(frozen=True)
class Kit:
    """Builders that the tests of this folder share."""

    ClosedForm = ClosedForm
    Linear = Linear
    closed_problem = staticmethod(closed_problem)
    fitted = staticmethod(fitted)
    offset_effect = staticmethod(offset_effect)
    drift_effect = staticmethod(drift_effect)
    chain_bench = staticmethod(chain_bench)
    blank_trial = staticmethod(blank_trial)


@pytest.fixture(scope="session")
def kit() -> Kit:
    """Builders of problems and campaigns."""
    return Kit()


@pytest.fixture(scope="session")
def catalogue() -> tuple[Effect, ...]:
    """The shipped effects, without what a user has installed."""
    return library()


@pytest.fixture(scope="session")
def bench() -> Bench:
    """A laboratory test of the chain: static to both sides, releases at three amplitudes."""
    return chain_bench()
