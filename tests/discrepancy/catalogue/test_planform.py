"""Effects that act over the wing's planform: their sizes mean what they say of the first mode."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from scipy.linalg import eigh

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.catalogue.effect_file import loss_integral
from discrepancy.models.structures import WingModel
from tests.discrepancy.models.test_wing import RING
from tests.discrepancy.rigs import chosen, setting_of

RELEASE = 0.03
DRAG, SPRING = chosen("quadratic_damping", "cubic_stiffness")


@pytest.fixture(scope="module")
def setting(coarse_patch_arrays):
    model = WingModel(coarse_patch_arrays)
    ring = replace(RING, kind=TrialKind.RINGDOWN, release=Release(displacement=RELEASE))
    campaign = Campaign("lab", {}, (ring,), None, {}, "")
    return setting_of(campaign, model)


def first_mode(setting):
    """Shares of stations, their motion when the mean moves by one, stiffness at the mean, frequency."""
    model = setting.model
    e, servo, pitot, *_ = (item.mean for item in model.parameters)
    structure = model.wing.at(np.array((e, 0.0, 0.0, servo, pitot, 0.0, 0.0)))
    square, shapes = eigh(structure.stiffness, structure.mass, subset_by_index=[0, 0])
    arrays = model.wing.arrays
    motion = arrays.line_rows[2] @ shapes[:, 0]
    mean = float(arrays.station_weights @ motion)
    return arrays.station_weights, motion / mean, float(square[0]) / mean**2, float(np.sqrt(square[0]))


@pytest.mark.parametrize(("velocity", "displacement"), [(2.0, 0.0), (1.4, 0.0), (2.0, 0.6)])
def test_damping_takes_the_stated_share_of_the_first_mode(setting, velocity, displacement):
    """2 pi zeta k A^2 in a cycle, with every station of the mesh instead of six."""
    share, motion, stiffness, frequency = first_mode(setting)
    values = {
        "equivalent_damping_ratio": 0.01,
        "velocity_exponent": velocity,
        "displacement_exponent": displacement,
    }
    assert DRAG.places(setting) == ("planform",)
    (force,) = DRAG.patch(setting, values, "planform")
    size = setting.scales.ports["planform"].displacement
    moved = np.abs(motion) * size
    at_place = (
        share
        * force.coefficient
        * (moved * frequency / force.reference_velocity) ** velocity
        * (moved / force.reference_displacement) ** displacement
    )
    loss = float(at_place @ moved) * 2.0 * loss_integral(velocity, displacement)
    assert loss == pytest.approx(2.0 * pi * 0.01 * stiffness * size**2, rel=1e-2)


def test_a_cubic_spring_has_the_stated_share_of_the_first_modes_force(setting):
    share, motion, stiffness, _ = first_mode(setting)
    assert SPRING.places(setting) == ("tip", "planform")
    (force,) = SPRING.patch(setting, {"stiffening": 0.2}, "planform")
    size = setting.scales.ports["planform"].largest_displacement
    at_place = share * force.coefficient * (motion * size / force.reference_displacement) ** 3
    assert float(at_place @ motion) == pytest.approx(0.2 * stiffness * size, rel=1e-2)
