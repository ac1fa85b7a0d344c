"""Scans of the catalogue on a whole campaign of the wing, beside one ring-down of it."""

import resource
import time
from collections.abc import Iterator

from benchmarks.measurement import Measurement, least_seconds_of
from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import search
from discrepancy.sources.examples import example_campaign, wing_plan
from discrepancy.system.sensing import observe
from discrepancy.system.wing_model import WingModel
from fe.runtime.patch import ModelPatch, PowerDamping, SupportCompliance

SEED = 20210527
ROUNDS = 3
"""Campaigns of each kind; the median counts."""


def run() -> Iterator[Measurement]:
    """Measure the scan of all effects near and far from the truth, all pairs, and the memory."""
    model = WingModel.of_design()
    cases = {
        "nothing hidden": ModelPatch(),
        "compliant root hidden": ModelPatch((SupportCompliance("root", "rx", 5e-6),)),
        "quadratic drag hidden": ModelPatch((PowerDamping("planform", 2.0, 2.0, 0.0, 1.0, 1.0),)),
    }
    _problem(model, ModelPatch(), SEED)  # compiles
    search(_problem(model, cases["quadratic drag hidden"], SEED), library())
    single = 1e-3 * _one_ringdown(model)
    for name, patch in cases.items():
        seconds = []
        for number in range(ROUNDS):
            problem = _problem(model, patch, SEED + number)
            begin = time.perf_counter()
            search(problem, library())
            seconds.append(time.perf_counter() - begin)
        yield Measurement(
            f"all effects, {name}",
            sorted(seconds)[ROUNDS // 2],
            "s",
            10.0,
            "one ring-down",
            single,
        )
    problem = _problem(model, cases["compliant root hidden"], SEED)
    usable = tuple(effect for effect in library() if effect.unavailable(problem.setting) is None)
    scan = Search(problem, usable, fit(problem, Candidate(), problem.prior_mean_point(Candidate())))
    begin = time.perf_counter()
    scan.fit_pairs()
    pairs = len(usable) * (len(usable) - 1) // 2
    yield Measurement(
        f"all {pairs} pairs, compliant root hidden",
        time.perf_counter() - begin,
        "s",
        60.0,
        "one ring-down",
        single,
    )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2.0**20
    yield Measurement("largest memory of the process, scans", memory, "GiB", 2.0)


def _problem(model: WingModel, patch: ModelPatch, seed: int) -> Problem:
    plan = wing_plan(tuple(range(1, 25)))
    campaign = choose_held_out(example_campaign(model, "complete", seed, plan, patch))
    setting = Setting(campaign, model, model.scales(campaign))
    return Problem(campaign, model, setting)


def _one_ringdown(model: WingModel) -> float:
    """Return milliseconds of one ring-down with a force law, as the scan asks for it."""
    problem = _problem(model, ModelPatch(), SEED)
    number = next(
        n for n, data in enumerate(problem.trials) if data.trial.kind is TrialKind.RINGDOWN
    )
    data = problem.trials[number]
    patch = ModelPatch((PowerDamping("planform", 2.0, 2.0, 0.0, 1.0, 1.0),))
    point = problem.prior_mean_point(Candidate())
    conditions = data.unknowns.conditions(
        data.trial, problem.shared.parameters(point.shared), point.local[number]
    )
    return 1e3 * least_seconds_of(
        lambda: observe(model, problem.campaign, data.trial, patch, conditions)
    )
