"""The shape of a force over the displacement in words."""

import numpy as np
import pytest

from discrepancy.catalogue.force_curve import curve_points
from discrepancy.judgement.curve_words import curve_in_words
from fe.runtime.patch import TableDamping, TableStiffness

VELOCITIES = curve_points("velocity", -0.5, 0.5)
DISPLACEMENTS = np.linspace(-0.02, 0.02, 49)


@pytest.mark.parametrize(
    ("forces", "words"),
    [
        (
            400.0 * np.maximum(DISPLACEMENTS - 0.007, 0.0),
            "it is zero from −20 mm to 7 mm, with a slope of 400 N/m above",
        ),
        (
            300.0 * np.sign(DISPLACEMENTS) * np.maximum(np.abs(DISPLACEMENTS) - 0.005, 0.0),
            "it is zero from −5 mm to 5 mm, with a slope of 300 N/m below and 300 N/m above",
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
            "apart from a line of −9 N/m, as an error of the stiffness gives, it is zero from "
            "−20 mm to 10 mm, with a slope of 60 N/m above",
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
        "it is zero from −0.02 rad to 0.01 rad, with a slope of 2 N m/rad above"
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
