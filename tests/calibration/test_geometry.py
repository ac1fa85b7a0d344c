"""Calibration step 1: conjugate posterior, published lengths, bad files."""

from dataclasses import replace

import pytest

from calibration.errors import ExperimentDataError
from calibration.geometry import published_lengths, tailored_design, tailored_geometry
from fe.runtime.errors import InvalidDesignError
from fe.wing.design import load_design
from fe.wing.mesh import build_mesh
from tests.refusals import Inputs

INPUTS = Inputs(__file__)


# -------------------------------- the measured planform in the design, and what a wing cannot be


def lengths(**measured):
    """The published lengths, some measured otherwise [m]."""
    published = published_lengths()
    changes = {name: replace(getattr(published, name), measured=value) for name, value in measured.items()}
    return published._replace(**changes)


def test_the_published_lengths_are_the_shipped_design():
    """So nothing is built anew for the wing of the paper."""
    assert tailored_design(load_design(), published_lengths()).hash == load_design().hash


def test_the_planform_is_the_posterior_mean_to_a_tenth_of_a_millimetre():
    measured = lengths(semi_span=1.83517, root_chord=0.4401, tip_chord=0.25541)
    found = tailored_geometry(measured)
    # precision-weighted means by hand: tolerances of 2.54 and 0.2 mm, half-widths of 95 % intervals
    precision = 0.2**-2 + 2.54**-2
    for name, designed in (("semi_span", 1.8288), ("root_chord", 0.43561), ("tip_chord", 0.261112)):
        length = getattr(measured, name)
        mean = designed + 0.2**-2 / precision * (length.measured - designed)
        assert length.posterior.mean == pytest.approx(mean, rel=1e-12)
        assert length.posterior.standard_deviation == pytest.approx(1e-3 * precision**-0.5 / 1.96)
        assert getattr(found, name) == round(mean, 4)


def test_what_moves_with_the_planform_and_what_stays():
    drawn = load_design()
    tailored = tailored_design(drawn, lengths(semi_span=1.9, root_chord=0.44, tip_chord=0.255))
    before, after = drawn.model_dump(), tailored.model_dump()
    assert {key for key in before if before[key] != after[key]} == {"planform"}
    planform = tailored.planform
    assert (planform.semi_span, planform.root_chord, planform.tip_chord) != (1.828, 0.433, 0.26)
    assert planform.straight_chord_line == drawn.planform.straight_chord_line
    mesh = build_mesh(tailored)
    corner = mesh.corners.reshape(-1, 3)
    assert corner[:, 1].max() == pytest.approx(planform.semi_span)
    # the test load stays 5 cm from the tip, a gauge where it was glued
    assert tailored.tip_load.distance_from_tip == 0.05
    assert tailored.gauges.positions == drawn.gauges.positions


@pytest.mark.parametrize(("changes", "measured", "kind", "words"), INPUTS.refused("planform"))
def test_what_no_longer_fits_is_refused_with_its_place(changes, measured, kind, words):
    error = {"Data": ExperimentDataError, "Design": InvalidDesignError}[kind]
    with pytest.raises(error, match=words) as caught:
        tailored_design(load_design().changed(**changes), lengths(**measured))
    assert "the changed design" not in str(caught.value)
