"""Closed-form models whose fits are known exactly, and simulated campaigns on the lumped chain."""

from dataclasses import dataclass, replace
from importlib.resources import files
from math import inf

import numpy as np
from scipy.signal import lfilter

from calibration.result.record import ParameterPrior
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem
from discrepancy.system.interface import Model
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions, Response
from discrepancy.system.scales import PortScale, Scales
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch, RunOffset, SensorDrift
from tests.discrepancy.rigs import chosen, hiding, setting_of

__all__ = ["chosen"]  # for all folders of tests

OUTPUTS = ("y1", "y2", "y3")
STATIC_SHAPES = np.array([[1.0, 0.6, 0.3], [0.02, -0.03, 0.05]])  # by parameter and output
HEALTH_SHAPES = np.array([[0.3, 0.1, 0.0], [0.05, 0.4, 0.2]])  # by region and output
MODES = np.array([[1.0, 0.5, 0.2], [0.7, -0.6, 0.3]])  # by mode and output
FREQUENCIES, DECAYS = np.array([3.0, 11.0]), np.array([0.25, 0.6])
CATALOGUE = library()
NOISE = NoiseRecord(0.02, inf)


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

    def output_quantity(self, output):
        return Quantity.DISPLACEMENT if output in OUTPUTS else None

    def supports(self, primitive):
        return False

    def scales(self, campaign):
        w = 2.0 * np.pi * float(FREQUENCIES[0])
        return Scales(1.0, 1.0, 1.0, w, 10.0, 1.0, 1.0, 100.0, {"y": PortScale(1.0, 1.0, w)})

    def _respond(self, trial, outputs, patch, conditions):
        columns = [OUTPUTS.index(output) for output, _ in outputs]
        theta = conditions.parameters
        if not trial.is_dynamic:
            force = trial.load_factor if trial.kind is TrialKind.FLIGHT else trial.force
            values = sum(theta[p] * np.outer(force ** (p + 1), STATIC_SHAPES[p]) for p in range(2))
            lost = conditions.health @ HEALTH_SHAPES
            values = values * (1.0 + lost) if self.bent else values + force[:, np.newaxis] * lost
            return Response(np.asarray(values)[:, columns])
        rate, zero = conditions.clock
        time = (1.0 + rate) * trial.time + zero
        factor = float(np.sqrt(theta[0])) if self.bent else 1.0
        values, rates = np.zeros((2, len(time), 3))
        initial = np.zeros((2, 2))
        initial[: len(conditions.initial)] = conditions.initial
        for mode in range(2):
            pole = -DECAYS[mode] + 2j * np.pi * factor * FREQUENCIES[mode]
            wave = np.exp(pole * time)
            if trial.release.at_rest:
                amplitude = 1.0 + initial[0, 0] + initial[mode, 0]
            else:
                amplitude = initial[mode, 0] - 1j * initial[mode, 1]
            size = trial.release.displacement * amplitude
            values += np.outer((size * wave).real, MODES[mode])
            rates += np.outer((size * pole * wave).real, MODES[mode])
        return Response(values[:, columns], rates[:, columns] * (1.0 + rate))


def coloured(generator, coefficients, *shape, before=2000):
    """Return an autoregression of white noise of deviation one, that began long before."""
    white = generator.standard_normal((before + shape[0], *shape[1:]))
    return lfilter([1.0], np.r_[1.0, -np.asarray(coefficients)], white, axis=0)[before:]


def blank_trial(name, kind, channels, rows, *, start=0.0, **given) -> Trial:
    """Return a trial without readings; `rows` are forces of a static trial, times of a dynamic one."""
    time = rows
    if kind is TrialKind.STATIC:
        time, given = start + 10.0 * np.arange(len(rows)), {"force": rows, **given}
    return Trial.plain(name, kind, tuple(channels), time, start=start, **{"run": "A", **given})


def _effect(identifier, build, deviation, acts_on, place) -> Effect:
    ninety = 1.6448536269514722 * deviation
    size = EffectParameter("size", "size", "m", "size", Prior("normal", -ninety, ninety), magnitude=True)
    return Effect(
        identifier=identifier, name=identifier, family=identifier, equation="-", signature="-", reference="-",
        acts_on=acts_on, parameters=(size,), build=build, places=lambda setting: (place,),
    )  # fmt: skip


def offset_effect(deviation=0.3) -> Effect:
    """Return an effect that is linear in its only parameter: an offset of all readings of run A."""

    def build(setting, values, place):
        return ModelPatch((RunOffset("A", values["size"], channel=place, quantity=""),))

    return _effect("offset", build, deviation, frozenset({TrialKind.STATIC}), "y1")


def drift_effect(deviation=0.3, exponent=1.0) -> Effect:
    """Return an effect that is linear in its only parameter: a zero that moves with a power of time."""

    def build(setting, values, place):
        return ModelPatch((SensorDrift(place, values["size"], 100.0, exponent),))

    return _effect("drift", build, deviation, frozenset(TrialKind), "y2")


OFFSET, DRIFT = EffectTerm(offset_effect(), "y1"), EffectTerm(drift_effect(), "y2")


@dataclass(frozen=True)
class Linear:
    """A problem whose residuals are affine in all unknowns, with its dense matrices."""

    problem: Problem
    candidate: Candidate = Candidate()  # noqa: RUF009 - frozen

    def point(self, x) -> Point:
        """Return the point of a vector: shared, effect, then local unknowns."""
        q, e = self.problem.shared.unknown_count, self.candidate.parameter_count
        ends = np.cumsum([data.unknowns.unknown_count for data in self.problem.trials])
        return Point(x[:q], tuple(np.split(x[q + e :], ends[:-1])), x[q : q + e])

    @property
    def precision(self):
        """Prior precisions in the order of `point`."""
        local = [data.unknowns.precision for data in self.problem.trials]
        return np.concatenate(
            (self.problem.shared.precision, np.ones(self.candidate.parameter_count), *local)
        )

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.precision)

    def residual(self, x):
        """Return all residuals, those that do not count left out."""
        point, parts = self.point(x), []
        for number, data in enumerate(self.problem.trials):
            response = self.problem.response_of_candidate(number, point, self.candidate)
            parts.append(self.problem.standardised_residual(number, point, response)[data.weight > 0.0])
        return np.concatenate(parts)

    @property
    def groups(self):
        """Channel of each residual."""
        return np.concatenate([
            np.broadcast_to(data.channel_indices, data.weight.shape)[data.weight > 0.0]
            for data in self.problem.trials
        ])  # fmt: skip

    def dense(self):
        """Return y and A of residual = y - A x, exact as it is affine, and A'A with the prior's precision."""
        y = self.residual(np.zeros(self.size))
        a = np.stack([y - self.residual(row) for row in np.eye(self.size)], axis=1)
        return y, a, a.T @ a + np.diag(self.precision)


def closed_problem(
    *,
    seed=0, bent=False, noise=NOISE, offset_deviation=0.05, gain_deviation=0.0, health=False,
    at_rest=True, time_zero=0.0, effect=0.0, samples=60, parameters=None, left_out=None,
    kinds=("static", "ringdown"), extra=None,
) -> Problem:  # fmt: skip
    """Return a problem on the closed form: two static trials, two ring-downs, three channels.

    `effect` is an offset of y1 in run A, in metres; `extra` gives what the first channel of every trial shows
    besides, from the row numbers; `left_out` rows and columns by trial. What is unknown
    is drawn from its prior.
    """
    generator = np.random.default_rng(seed)
    channels = {
        name: Channel(name, Quantity.DISPLACEMENT, name, noise, gain_deviation, offset_deviation)
        for name in OUTPUTS
    }
    force, time = np.linspace(-1.0, 2.0, 9), 0.01 * np.arange(samples)
    spread, loss = (np.full((9, 2), size if health else 0.0) for size in (0.1, 0.3))
    release = Release(1.0, 0.05, at_rest, 2, time_zero)
    half = replace(release, displacement=0.5)
    static, ring = TrialKind.STATIC, TrialKind.RINGDOWN
    trials = (
        blank_trial("up", static, OUTPUTS, force, health=loss, health_deviation=spread),
        blank_trial("down", static, OUTPUTS[::-1], force[::-1], run="B", start=200.0),
        blank_trial("one", ring, OUTPUTS, time, start=400.0, release=release),
        blank_trial("two", ring, OUTPUTS[:2], time, start=500.0, release=half, noise_factor=1.5),
    )
    trials = tuple(trial for trial in trials if trial.kind.value in kinds)
    bare = Campaign("closed form", channels, trials, None, dict(parameters or {}), "")
    model = ClosedForm(bent)
    problem = problem_of(bare, model)
    shared = generator.standard_normal(problem.shared.unknown_count) * (problem.shared.precision > 0.0)
    measured = []
    for number, data in enumerate(problem.trials):
        local = [np.zeros(item.unknowns.unknown_count) for item in problem.trials]
        local[number] = generator.standard_normal(data.unknowns.unknown_count)
        if not at_rest and data.trial.release is not None:
            local[number][data.unknowns.zero_count :] *= 0.3
        patch = ModelPatch((RunOffset("A", effect, channel="y1", quantity=""),) if effect else ())
        response, _ = problem.response(number, shared, local[number], patch)
        values = problem.prediction(number, Point(shared, tuple(local), np.empty(0)), response)
        deviation = data.trial.noise_factor * (0.02 if noise is None else noise.standard_deviation)
        values = values + deviation * generator.standard_normal(response.shape)
        if extra is not None:
            values[:, 0] += extra(np.arange(len(values), dtype=np.float64))
        used = np.ones(values.shape, dtype=bool)
        for place in (left_out or {}).get(number, ()):
            used[place] = False
        measured.append(replace(data.trial, values=values, used=used))
    return problem_of(replace(bare, trials=tuple(measured)), model)


def problem_of(campaign: Campaign, model: Model) -> Problem:
    """Return the problem of a campaign beside a model."""
    return Problem(campaign, model, setting_of(campaign, model))


def with_noise(problem: Problem, **records: NoiseRecord | None) -> Problem:
    """Return a problem some of whose channels have other noise records."""
    channels = {
        name: replace(item, noise=records.get(name, item.noise))
        for name, item in problem.campaign.channels.items()
    }
    return problem_of(replace(problem.campaign, channels=channels), problem.model)


def fitted(problem: Problem, *terms: EffectTerm, **given) -> CandidateFit:
    """Return the fit of some terms, from the start that the problem has for them."""
    candidate = Candidate(terms)
    return fit(problem, candidate, problem.prior_mean_point(candidate), **given)


# ---------------------------------------------------------------- the lumped chain


@dataclass(frozen=True)
class Bench:
    """A lumped model as it is believed, and what is measured on it: trials without readings."""

    model: LumpedModel
    campaign: Campaign

    @property
    def setting(self) -> Setting:
        """Scales of the campaign."""
        return setting_of(self.campaign, self.model)

    def patch(self, identifier, values, place="") -> ModelPatch:
        """Return the patch of an effect of the library."""
        return hiding(self.campaign, self.model, identifier, values, place)

    def measured(self, seed, patch=ModelPatch(), *, noise_scale=1.0, noise=None) -> Campaign:  # noqa: B008
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
            drawn = noise(generator, values.shape) if noise else generator.standard_normal(values.shape)
            for column, name in enumerate(trial.channels):
                channel = self.campaign.channels[name]
                s0 = channel.noise.standard_deviation * noise_scale
                values[:, column] = values[:, column] * gains[name] + s0 * drawn[:, column]
                values[:, column] += channel.offset_deviation * generator.standard_normal()
            trials.append(replace(trial, values=values))
        return replace(self.campaign, trials=tuple(trials))

    def problem(self, *measured, **how) -> Problem:
        """Return the problem of what is measured."""
        return problem_of(self.measured(*measured, **how), self.model)


def chain_bench(
    *,
    static=True, amplitudes=(0.02, 0.012, 0.006), dynamic_channels=("x3", "x2", "g1"),
    static_channels=("x3", "x2", "g1", "g2"), samples=240, gain_deviation=0.005, held_out=False,
) -> Bench:  # fmt: skip
    """Return a bench on the shipped three-mass chain: static to both sides, releases of some amplitudes."""
    model = LumpedModel.load(str(files("discrepancy.lumped_models") / "three_mass_chain.toml"))
    long, strain = (Quantity.DISPLACEMENT, 2e-5), (Quantity.STRAIN, 4e-7)
    every = {
        name: Channel(name, quantity, output, NoiseRecord(size, 200.0), gain, size)
        for name, (quantity, size), output, gain in (
            ("x3", long, "x3", 0.0), ("x2", long, "x2", gain_deviation),
            ("g1", strain, "base_strain", gain_deviation), ("g2", strain, "joint_strain", gain_deviation),
        )
    }  # fmt: skip
    force, time = np.linspace(0.0, 12.0, 7), 0.012 * np.arange(samples)
    trials = [
        blank_trial(
            f"static {number}", TrialKind.STATIC, static_channels, rows, run=run, load_place="end",
            start=600.0 * number, held_out=held_out and number == 2,
        )
        for number, (run, rows) in enumerate((("A", force), ("A", -force), ("B", force)))
        if static
    ]  # fmt: skip
    trials += [
        blank_trial(
            f"release {number}", TrialKind.RINGDOWN, dynamic_channels, time, start=3000.0 + 120.0 * number,
            load_place="end", release=Release(amplitude, 0.02, mode_count=3),
            held_out=held_out and number == 1,
        )
        for number, amplitude in enumerate(amplitudes)
    ]  # fmt: skip
    names = {name for trial in trials for name in trial.channels}
    channels = {name: channel for name, channel in every.items() if name in names}
    return Bench(model, Campaign("chain", channels, tuple(trials), None, {}, ""))


BENCH = chain_bench()
"""A laboratory test of the chain: static to both sides, releases at three amplitudes."""
