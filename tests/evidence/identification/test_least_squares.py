from dataclasses import replace

import numpy as np
import pytest

from evidence.identification.errors import IdentificationError
from evidence.identification.identifiability import analyse, profile
from evidence.identification.least_squares import DesignFit, identify, minimise_local
from evidence.identification.parameters import FreeParameter, scaled, values_of, with_values
from evidence.identification.targets import Targets, Weights
from fe.wing.design import WingDesign

# the fit that most need takes a minute
pytestmark = [pytest.mark.long, pytest.mark.xdist_group("least_squares")]

FREE = ("skin modulus at 0", "flap root spring", "net lift at 3g", "skin density", "cluster 1 chord")


@pytest.fixture(scope="module")
def free(some_parameters: tuple[FreeParameter, ...], virtual_design: WingDesign) -> tuple[FreeParameter, ...]:
    """Priors so wide that the virtual data decide."""
    return tuple(
        replace(
            p,
            mean=float(values_of(virtual_design, [p])[0]),
            standard_deviation=10.0 * p.standard_deviation,
            lower=p.lower - 9.0 * p.standard_deviation,
            upper=p.upper + 9.0 * p.standard_deviation,
        )
        for p in some_parameters
        if p.name in FREE
    )


@pytest.fixture(scope="module")
def recovered(
    virtual_design: WingDesign, free: tuple[FreeParameter, ...], virtual_targets: Targets
) -> DesignFit:
    truth = values_of(virtual_design, free)
    offset = np.array([0.05, -0.06, 0.1, -0.05, 0.06])
    width = np.array([parameter.standard_deviation for parameter in free])
    start = with_values(virtual_design, free, truth + offset * width)
    return identify(start, free, virtual_targets, tolerance=2e-4)


def test_known_numbers_are_recovered(recovered, virtual_design, free, virtual_targets):
    """And a fit that begins with them stays there."""
    assert recovered.converged
    assert recovered.iterations[0].objective > 100.0 * recovered.iterations[-1].objective
    error = scaled(free, recovered.values) - scaled(free, values_of(virtual_design, free))
    assert np.abs(error).max() < 2e-3
    assert np.abs(scaled(free, recovered.start) - scaled(free, recovered.values)).max() > 0.04
    again = identify(recovered.design, free, virtual_targets, tolerance=2e-4)
    assert again.converged
    assert len(again.iterations) == 1
    assert again.values.tolist() == again.start.tolist()
    assert again.iterations[-1].objective == pytest.approx(recovered.iterations[-1].objective, abs=1e-6)


def test_bounds_and_the_radius_are_kept(virtual_model, some_parameters, virtual_targets):
    """Of a fit whose data weigh nothing, which ends at the prior means, and of one that wants to go far."""
    loose = Weights(**dict.fromkeys(Weights.__dataclass_fields__, 1000000.0))
    found = minimise_local(virtual_model, some_parameters, virtual_targets, loose, 100.0)
    assert np.abs(scaled(some_parameters, found)).max() < 1e-6
    softer = replace(virtual_targets, strain=2.0 * virtual_targets.strain)
    found = minimise_local(virtual_model, some_parameters, softer, Weights(), 0.3)
    step = scaled(some_parameters, found) - scaled(some_parameters, virtual_model.values)
    assert np.abs(step).max() == pytest.approx(0.3, abs=1e-6)
    bounded = [
        replace(p, lower=v - 0.01 * p.standard_deviation, upper=v + 0.01 * p.standard_deviation)
        for p, v in zip(some_parameters, virtual_model.values, strict=True)
    ]
    found = minimise_local(virtual_model, bounded, softer, Weights(), 5.0)
    for parameter, value in zip(bounded, found, strict=True):
        assert parameter.lower - 1e-12 <= value <= parameter.upper + 1e-12


def test_a_start_outside_the_bounds_is_refused(virtual_design, some_parameters, virtual_targets):
    narrow = replace(some_parameters[0], lower=1.0, upper=2.0)
    with pytest.raises(IdentificationError, match="outside its bounds of 1 to 2"):
        identify(virtual_design, [narrow], virtual_targets)


def test_the_analysis_tells_known_from_unknown(recovered, virtual_targets):
    """The profile of a nearly linear number is a parabola."""
    analysis = analyse(recovered, virtual_targets, Weights())
    jacobian = analysis.singular_values[:, None] * analysis.directions
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(FREE)))
    assert analysis.width == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-8)
    assert 0.0 < analysis.effective_count < len(FREE)
    assert np.all(analysis.width < 1.0)
    blind = Weights(**dict.fromkeys(Weights.__dataclass_fields__, 1000000000.0))
    nothing = analyse(recovered, virtual_targets, blind)
    assert nothing.effective_count < 1e-6
    assert nothing.width == pytest.approx(np.ones(len(FREE)))
    found = profile(recovered, virtual_targets, Weights(), analysis, "net lift at 3g")
    assert found.rise.min() == pytest.approx(0.0, abs=1e-3)
    assert found.rise == pytest.approx(found.linear, rel=0.1, abs=0.05)
    with pytest.raises(IdentificationError, match="no free number 'lift'"):
        profile(recovered, virtual_targets, Weights(), analysis, "lift")
