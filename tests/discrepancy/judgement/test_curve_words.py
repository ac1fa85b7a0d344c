"""The shape of a force over the displacement in words."""

import numpy as np
import pytest

from discrepancy.catalogue.force_curve import curve_points
from discrepancy.judgement.curve_words import curve_in_words, followed_variable_text
from discrepancy.verdict import NamedEffect
from fe.runtime.patch import ModelPatch, TableDamping, TableStiffness

VELOCITIES = curve_points("velocity", -0.5, 0.5)
DISPLACEMENTS = np.linspace(-0.02, 0.02, 49)


@pytest.mark.parametrize(
    ("forces", "words"),
    [
        (
            400.0 * np.maximum(DISPLACEMENTS - 0.007, 0.0),
            "it is zero from −20 mm to 7 mm, with a slope of 400 N/m above, as at a stop",
        ),
        (
            300.0 * np.sign(DISPLACEMENTS) * np.maximum(np.abs(DISPLACEMENTS) - 0.005, 0.0),
            "it is zero from −5 mm to 5 mm, with a slope of 300 N/m below and 300 N/m above, as at two stops",
        ),
        (
            1e6 * DISPLACEMENTS**3,
            "it stiffens by 8 N at 20 mm, about as the power 3 of the displacement",
        ),
        (
            -1e5 * np.maximum(DISPLACEMENTS, 0.0) ** 2,
            "it softens by 40 N at 20 mm, about as the power 2 of the displacement, at positive "
            "displacements only",
        ),
        (
            60.0 * np.maximum(DISPLACEMENTS - 0.01, 0.0) - 9.0 * DISPLACEMENTS,
            "it is zero from −20 mm to 10 mm, with a slope of 60 N/m above, as at a stop (without a "
            "line of −9 N/m, which an error of the stiffness would give)",
        ),
        (
            np.where(DISPLACEMENTS < -0.005, -0.08, -40.0 * np.maximum(DISPLACEMENTS - 0.0075, 0.0)),
            "it is zero from −20 mm to 7.5 mm, with a slope of −40 N/m above",
        ),
        (80.0 * DISPLACEMENTS, "it is proportional to the displacement, 80 N/m"),
        (0.5 * np.sign(DISPLACEMENTS), "it is nearly constant, at most 0.5 N"),
    ],
    ids=[
        "stop",
        "play",
        "cubic",
        "one-sided",
        "stop beside a line",
        "small on one side",
        "linear",
        "constant",
    ],
)
def test_a_curve_is_told_by_its_shape(forces, words):
    assert curve_in_words(TableStiffness("p", tuple(DISPLACEMENTS), tuple(forces)), "N") == words


def test_the_motion_of_a_moment_is_told_in_radians():
    moments = 2.0 * np.maximum(DISPLACEMENTS - 0.01, 0.0)
    assert curve_in_words(TableStiffness("p", tuple(DISPLACEMENTS), tuple(moments)), "N m") == (
        "it is zero from −0.02 rad to 0.01 rad, with a slope of 2 N m/rad above, as at a stop"
    )


@pytest.mark.parametrize(
    ("forces", "words"),
    [
        (
            np.sign(VELOCITIES) * (0.4 + 0.6 * np.exp(-((VELOCITIES / 0.1) ** 2))),
            "it is largest near rest, and falls to 0.4 N at 0.5 m/s",
        ),
        (np.sign(VELOCITIES), "it is nearly constant, at most 1 N"),
        (
            3.0 * VELOCITIES * np.abs(VELOCITIES),
            "it grows to 0.75 N at 0.5 m/s, about as the power 2 of the velocity",
        ),
    ],
    ids=["Stribeck", "dry", "drag"],
)
def test_friction_is_told_by_its_shape(forces, words):
    assert curve_in_words(TableDamping("p", tuple(VELOCITIES), tuple(forces)), "N") == words


def test_a_flow_is_told_at_three_states():
    levels = np.linspace(0.2, 1.0, 49)
    curve = TableDamping("p", tuple(levels), tuple(0.03 * levels**2))
    assert curve_in_words(curve, "m/s times capacity") == (
        "it is 0.0012 at 0.2 m, 0.0108 at 0.6 m and 0.03 at 1 m (in m/s times capacity)"
    )


def test_a_force_that_is_no_power_of_the_motion_is_told_at_three_points():
    forces = 0.2 * np.sin(400.0 * DISPLACEMENTS)
    curve = TableStiffness("p", tuple(DISPLACEMENTS), tuple(forces))
    assert curve_in_words(curve, "N") == "it is −0.198 at −0.02 m, 0 at 0 m and 0.198 at 0.02 m (in N)"


def test_a_motion_in_one_direction_does_not_tell_that_the_other_is_free():
    speeds = np.linspace(0.0, 5.0, 49)
    curve = TableDamping("p", tuple(speeds), tuple(2.0 * speeds**2))
    assert curve_in_words(curve, "N") == ("it grows to 50 N at 5 m/s, about as the power 2 of the velocity")


@pytest.mark.parametrize(
    ("identifier", "law", "words"),
    [
        ("force_over_displacement", TableStiffness, "force that follows the displacement"),
        ("force_over_velocity", TableDamping, "force that follows the velocity"),
        ("flow_over_state", TableDamping, "flow that follows the state"),
    ],
)
def test_what_a_force_of_free_shape_follows_is_told(identifier, law, words):
    patch = ModelPatch((law("p", (0.0, 1.0), (0.0, 1.0)),))
    effect = NamedEffect(identifier, "name", "p", "family", (), (), patch)
    assert followed_variable_text(effect) == words
