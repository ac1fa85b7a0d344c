"""Laws outside the catalogue: the rig beside closed forms and its model file, and what a name is worth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from benchmarks.unlisted_laws.__main__ import verdict_row
from benchmarks.unlisted_laws.campaigns import GAPS, drawn, readings, write
from benchmarks.unlisted_laws.kinds import KINDS
from benchmarks.unlisted_laws.rig import (
    ANGULAR_FREQUENCY,
    DAMPING,
    LENGTH,
    MASS,
    STAMPS,
    STIFFNESS,
    Excitation,
    Tones,
    Truth,
    motion,
)
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.verdict import NamedEffect, ParameterEstimate, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch


def test_the_rig_without_a_law_has_its_closed_form():
    """Forced and released at once, to 1e-7 of the release."""
    tone = Tones(np.array([3.0, -2.0]), np.array([9.0, 31.0]))
    excitation = Excitation(release=LENGTH, command=tone)
    w = tone.angular_frequencies
    response = tone.amplitudes / (STIFFNESS - MASS * w**2 + 1j * DAMPING * w)
    driven = (np.exp(1j * np.outer(STAMPS, w)) @ response).imag
    pole = np.roots([MASS, DAMPING, STIFFNESS])[0]  # its conjugate is the other one
    begin = LENGTH - response.sum().imag
    begin_speed = -(1j * w @ response).imag
    free = begin * np.cos(pole.imag * STAMPS)
    free += (begin_speed - pole.real * begin) / pole.imag * np.sin(pole.imag * STAMPS)
    expected = driven + np.exp(pole.real * STAMPS) * free
    np.testing.assert_allclose(motion(Truth(), excitation)[:, 0], expected, atol=1e-7 * LENGTH)


def test_a_maxwell_branch_relaxes_as_the_matrix_exponential():
    size, rate = 0.4, 0.7 * ANGULAR_FREQUENCY
    matrix = np.array(
        [
            [0.0, 1.0, 0.0],
            [-STIFFNESS / MASS, -DAMPING / MASS, -size * STIFFNESS / MASS],
            [0.0, 1.0, -rate],
        ]
    )
    found = motion(Truth(law="maxwell_branch", size=size, shape=0.7), Excitation(release=LENGTH))
    for index in (20, 200, 449):
        expected = (expm(matrix * STAMPS[index]) @ [LENGTH, 0.0, 0.0])[0]
        assert found[index, 0] == pytest.approx(expected, abs=1e-7 * LENGTH)


def test_a_stop_without_a_gap_has_half_periods_of_two_frequencies():
    truth = Truth(damping=0.0, law="one_sided_stop", size=3.0, shape=0.0)
    period = np.pi / ANGULAR_FREQUENCY * (1.0 + 1.0 / np.sqrt(1.0 + truth.size))
    stamps = period * np.array([0.0, 0.5, 1.0, 3.0])
    found = motion(truth, Excitation(release=LENGTH), stamps)[:, 0]
    # four times the stiffness at positive x: twice the way at negative x holds the same energy
    np.testing.assert_allclose(found / LENGTH, [1.0, -2.0, 1.0, 1.0], atol=1e-4)


@pytest.mark.parametrize("name", ["magnet", "cross-talk", "actuator delay"])
def test_model_files_agree_with_the_rig_without_its_law(name, tmp_path):
    """To a twentieth of the noise, with one force, with an accelerometer, and with two forces."""
    experiment = drawn(name, 3)
    bare = replace(experiment.truth, law="")
    write(tmp_path, replace(experiment, truth=bare), 3)
    campaign = read_campaign(tmp_path)
    model = LumpedModel.load(tmp_path / "model.toml")
    outputs = tuple((channel.output, channel.quantity) for channel in campaign.channels.values())
    conditions = Conditions(np.array([bare.stiffness, bare.damping]), refinement=4)
    expected = readings(experiment.kind, bare, experiment.excitations)[-1]
    found = model.respond(campaign.trials[-1], outputs, ModelPatch(), conditions).values
    assert np.abs((found - expected) / experiment.noise).max() < 0.05
    assert GAPS[0] * 0.9 < experiment.gap < GAPS[1] * 1.1


def test_the_effects_of_right_dependence_are_in_the_catalogue():
    families = {effect.identifier: effect.family for effect in library()}
    for kind in KINDS.values():
        assert kind.families <= set(families.values())
        for effect in kind.effects:
            assert families[effect.split("@")[0]] in kind.families | {"clock"}


def _effect(identifier: str, place: str = "mass", *, free_shape: bool = False) -> NamedEffect:
    families = {effect.identifier: effect.family for effect in library()}
    family = families.get(identifier, identifier)
    shape = (ParameterEstimate("exponent", 1.0, 0.9, 1.1, "1"),) if free_shape else ()
    return NamedEffect(identifier, identifier, place, family, (), shape, ModelPatch())


@pytest.mark.parametrize(
    ("kind", "effects", "outcome"),
    [
        ("named", [_effect("breathing_crack", "mass, open at negative x")], "dependence"),
        ("named", [_effect("breathing_crack", "mass, open at positive x")], "false name"),
        ("named in part", [_effect("coulomb_friction"), _effect("free_play")], "dependence"),
        ("group", [_effect("coulomb_friction"), _effect("clock_error", "")], "false name"),
        ("family", [_effect("quadratic_damping", free_shape=True)], "false name"),
        ("family", [_effect("breathing_crack", free_shape=True)], "dependence"),
        ("family", [_effect("force_over_displacement")], "dependence"),
        ("unexplained", [], "no name"),
    ],
)
def test_what_a_name_is_worth_for_a_stop(kind, effects, outcome):
    verdict = Verdict(VerdictKind(kind), "", 1.0, 10.0, effects=tuple(effects))
    assert verdict_row(KINDS["one-sided stop"], verdict, ())["outcome"] == outcome


@pytest.mark.parametrize(
    ("followed", "outcome"),
    [
        (("displacement",), "dependence"),
        (("displacement", "time"), "no name"),
        (("velocity",), "no name"),
        ((), "no name"),
    ],
)
def test_what_a_variable_that_the_force_follows_is_worth_for_a_stop(followed, outcome):
    verdict = Verdict(VerdictKind.UNEXPLAINED, "", 1.0, 10.0)
    assert verdict_row(KINDS["one-sided stop"], verdict, followed)["outcome"] == outcome
