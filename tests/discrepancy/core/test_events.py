"""What begins with an event of the campaign is named with it; a moment that is not known is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Event,
    NoiseRecord,
    Quantity,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, in_events, library
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PowerDamping, Window
from tests.discrepancy.rigs import one_mass
from tests.refusals import Inputs

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
OWN = Inputs(__file__).text("late_friction.toml")


@pytest.fixture(scope="module")
def campaign():
    rng = np.random.default_rng(7)
    time = np.linspace(0.0, 8.0, 201)
    friction = PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0)
    patch = ModelPatch(
        (replace(friction, windows=tuple(Window(name, begin) for name, begin in BEGIN.items())),)
    )
    trials = []
    for name in BEGIN:
        parts = [
            rng.normal() * np.sin(2.0 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.3, 1.7)
        ]
        trials.append(
            Trial.plain(
                name, TrialKind.FORCED, ("x",), time, force=3.0 * np.sum(parts, axis=0), load_place="push",
                begins=Start.STILL, held_out=name == "second",
            )
        )  # fmt: skip
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    events = tuple(Event("bolt_loose", (name,), begin) for name, begin in BEGIN.items())
    base = Campaign("a bolt", channels, tuple(trials), None, {}, "0" * 64, events=events)
    measured = []
    for trial in base.trials:
        conditions = Conditions(np.array([1.01, 0.9]), refinement=4)
        shown = observe(MODEL, base, trial, patch, conditions).values
        measured.append(replace(trial, values=shown + NOISE * rng.standard_normal(shown.shape)))
    return replace(base, trials=tuple(measured))


def test_friction_that_begins_with_an_event_is_named_with_it(campaign):
    found = investigate(campaign, MODEL, [COULOMB], thorough=False).verdict
    assert found.kind is VerdictKind.NAMED
    (effect,) = found.effects
    assert effect.identifier == "coulomb_friction_during_bolt_loose"
    (law,) = effect.patch.primitives
    assert law.coefficient == pytest.approx(0.4, rel=0.03)
    assert law.windows == (Window("first", 4.137), Window("second", 2.221))
    assert found.sentence.endswith("acts from 4.137 s on in 'first'; from 2.221 s on in 'second'.")


def test_effects_that_cannot_be_switched_and_campaigns_without_events_give_none(campaign):
    setting = Setting(campaign, MODEL, MODEL.scales(campaign))
    assert in_events(library(), replace(setting, campaign=replace(campaign, events=()))) == ()
    held_out = replace(campaign, events=campaign.events[1:])
    assert in_events(library(), replace(setting, campaign=held_out)) == ()
    names = {effect.identifier for effect in in_events(library(), setting)}
    assert {"coulomb_friction_during_bolt_loose", "mains_hum_during_bolt_loose"} <= names
    assert not any(name.startswith(("clock_error", "point_mass", "high_pass")) for name in names)


def test_a_moment_that_is_a_parameter_is_found_within_one_percent(campaign, tmp_path):
    (tmp_path / "own.toml").write_text(OWN, encoding="utf-8")
    (effect,) = effects_of_file(tmp_path / "own.toml")
    fitted = replace(campaign, trials=campaign.trials[:1], events=())
    problem = Problem(fitted, MODEL, Setting(fitted, MODEL, MODEL.scales(fitted)))
    term = Term(effect, "slide")
    start = problem.start(Candidate((term,)))
    found = fit(problem, Candidate((term,)), Point(start.shared, start.local, np.array([0.0, 0.8])))
    values = term.values(found.point.effect)
    assert found.chi_square < 1.3 * float(problem.counts.sum())
    assert abs(values["moment"] - 4.137) < 0.01 * 8.0
    assert values["size"] == pytest.approx(0.4, rel=0.03)
