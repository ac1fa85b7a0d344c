"""What begins with an event of the campaign is named with it; a moment that is not known is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.protocol import Event
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, Trial, TrialKind
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.library import effect_by_identifier, in_events, library
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PowerDamping, Window
from tests.discrepancy.rigs import one_mass
from tests.refusals import Inputs

from . import kit


@pytest.fixture(scope="module")
def campaign():
    rng = np.random.default_rng(7)
    time = np.linspace(0.0, 8.0, 201)
    windows = tuple(Window(name, begin) for name, begin in BEGIN.items())
    patch = ModelPatch((PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0, windows=windows),))
    trials = []
    for name in BEGIN:
        parts = [
            rng.normal() * np.sin(2.0 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.3, 1.7)
        ]
        force = 3.0 * np.sum(parts, axis=0)
        given = {"load_place": "push", "begins": Start.STILL, "held_out": name == "second"}
        trials.append(Trial.plain(name, TrialKind.FORCED, ("x",), time, force=force, **given))
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    events = tuple(Event("bolt_loose", (name,), time=begin) for name, begin in BEGIN.items())
    base = Campaign("a bolt", channels, tuple(trials), None, {}, "0" * 64, events=events)
    for trial in base.trials:
        conditions = Conditions(np.array([1.01, 0.9]), refinement=4)
        shown = observe(MODEL, base, trial, patch, conditions).values
        trial.values[:] = shown + NOISE * rng.standard_normal(shown.shape)
    return base


NOISE = 2e-4
COULOMB = effect_by_identifier("coulomb_friction", library())
MODEL = one_mass(
    stiffness=200.0, damping={"ratios": [0.02]},
    parameter=[
        {"name": "spring", "terms": "stiffness", "deviation": 0.02, "low": 0.5, "high": 1.5},
        {"name": "damper", "terms": "damping", "deviation": 0.2, "low": 0.1, "high": 4.0},
    ],
)  # fmt: skip
BEGIN = {"first": 4.137, "second": 2.221}


def test_friction_that_begins_with_an_event_is_named_with_it(campaign):
    """What cannot be switched, and campaigns without an event to fit, give no such effect."""
    found = investigate(campaign, MODEL, [COULOMB], thorough=False).verdict
    assert found.kind is VerdictKind.NAMED
    (effect,) = found.effects
    assert effect.identifier == "coulomb_friction_during_bolt_loose"
    (law,) = effect.patch.primitives
    assert law.coefficient == pytest.approx(0.4, rel=0.03)
    assert law.windows == (Window("first", 4.137), Window("second", 2.221))
    assert found.sentence.endswith("acts from 4.137 s on in 'first'; from 2.221 s on in 'second'.")
    setting = kit.problem_of(campaign, MODEL).setting
    for events in ((), campaign.events[1:]):
        assert in_events(library(), replace(setting, campaign=replace(campaign, events=events))) == ()
    names = {effect.identifier for effect in in_events(library(), setting)}
    assert {"coulomb_friction_during_bolt_loose", "mains_hum_during_bolt_loose"} <= names
    assert not any(name.startswith(("clock_error", "point_mass", "high_pass")) for name in names)


def test_a_moment_that_is_a_parameter_is_found_within_one_percent(campaign, tmp_path):
    (tmp_path / "own.toml").write_text(Inputs(__file__).text("late_friction.toml"), encoding="utf-8")
    (effect,) = effects_of_file(tmp_path / "own.toml")
    problem = kit.problem_of(replace(campaign, trials=campaign.trials[:1], events=()), MODEL)
    term = Term(effect, "slide")
    candidate = Candidate((term,))
    start = replace(problem.start(candidate), effect=np.array([0.0, 0.8]))
    found = fit(problem, candidate, start)
    values = term.values(found.point.effect)
    assert found.chi_square < 1.3 * float(problem.counts.sum())
    assert abs(values["moment"] - 4.137) < 0.01 * 8.0
    assert values["size"] == pytest.approx(0.4, rel=0.03)
