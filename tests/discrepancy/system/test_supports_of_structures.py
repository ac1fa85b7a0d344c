"""A support of a structure that yields is a cause that is tried, in each motion that it holds."""

from typing import NamedTuple

import pytest

from discrepancy.catalogue.library import library
from discrepancy.report.sizes import si_sizes
from discrepancy.verdict import Verdict, VerdictKind
from discrepancy.workflow import Investigation, investigate
from fe.runtime.patch import ModelPatch, SupportCompliance
from tests.discrepancy.rigs import chosen, hiding, setting_of, simulated

SHARE = 0.2
PLACE = "root, turn about y"
HIDDEN = ("support_compliance", {"compliance_share": SHARE}, PLACE)
RIVALS = chosen("support_compliance", "region_stiffness_loss", "gauge_gain", "load_cell", "clock_error")


class SoftClamp(NamedTuple):
    """The verdict on a campaign with a clamp that turns, and what turns there."""

    investigation: Investigation
    hidden: SupportCompliance

    @property
    def verdict(self) -> Verdict:
        return self.investigation.verdict


@pytest.fixture(scope="module")
def released(beam_model) -> SoftClamp:
    """Ring-downs of the beam whose clamp turns."""
    campaign = simulated(beam_model, "ringdown", 3, HIDDEN)
    investigation = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False)
    return SoftClamp(investigation, *hiding(campaign, beam_model, *HIDDEN))


def test_a_clamp_that_turns_is_named(released: SoftClamp) -> None:
    verdict = released.verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [HIDDEN[::2]]


def test_its_spring_is_in_its_interval(released: SoftClamp) -> None:
    (effect,) = released.verdict.effects
    (primitive,) = effect.patch
    (share,) = effect.parameters
    assert isinstance(primitive, SupportCompliance)
    assert share.low < SHARE < share.high
    assert primitive.compliance == pytest.approx(released.hidden.compliance, rel=0.1)


def test_its_size_is_a_spring_in_words(beam_model, released: SoftClamp) -> None:
    from discrepancy.files.verdict import PrimitiveInterval

    compliance = PrimitiveInterval(0, "compliance", 1e-4, 8e-5, 1.25e-4, "m/N or rad/(N m)")
    (effect,) = released.verdict.effects
    text = si_sizes(effect.patch, [compliance], beam_model, released.investigation.campaign)
    assert text == ("the support root turns about y against a spring of 10000 N m/rad (8000 to 12500)")


def test_one_displacement_cannot_tell_a_clamp_from_the_gain_of_its_sensor(beam_model) -> None:
    """At rest both leave the strains as they are, so that neither is named."""
    campaign = simulated(beam_model, "static", 3, HIDDEN)
    verdict = investigate(campaign, beam_model, library(), seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    assert {"support_compliance", "gauge_gain"} <= set(verdict.group)


def test_each_motion_of_each_support_is_a_place(beam_model) -> None:
    (effect,) = chosen("support_compliance")
    campaign = simulated(beam_model, "static", 3)
    places = effect.places(setting_of(campaign, beam_model))
    shifts = [f"root, shift along {axis}" for axis in "xyz"]
    turns = [f"root, turn about {axis}" for axis in "xyz"]
    assert list(places) == [*shifts, *turns]


def test_an_error_of_the_mesh_is_no_support_that_yields(beam_model) -> None:
    """On a finer mesh the frequencies are lower, each by another fraction."""
    errors = {"mesh_mode_1": (-0.004, 1e-9), "mesh_mode_2": (-0.015, 1e-9)}
    finer = beam_model.with_patch(ModelPatch(), errors)
    campaign = simulated(finer, "ringdown", 3)
    verdict = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def test_at_rest_no_reading_shows_an_error_of_the_mesh(beam_model) -> None:
    moments = beam_model.prior_moments(simulated(beam_model, "static", 3))
    names = [parameter.name for parameter in beam_model.parameters]
    assert {moments[names.index(name)] for name in beam_model.nuisance_parameters} == {(0.0, 0.0)}
