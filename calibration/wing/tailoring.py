"""The design of a wing brought to the lengths that were measured on it."""

from calibration.errors import ExperimentDataError
from calibration.geometry import LENGTH_NAMES, GeometryCalibration
from fe.runtime.errors import InvalidDesignError
from fe.runtime.state import Geometry
from fe.wing.design import WingDesign

RESOLUTION = 1e-4
"""To what the planform of a tailored design is rounded: what the measurement leaves uncertain [m]."""

LARGEST_DEPARTURE = 0.10
"""By how much the measured lengths may differ from the design that is tailored [1]."""

_DIGITS = 4


def tailored_geometry(lengths: GeometryCalibration) -> Geometry:
    """Return the posterior means, rounded to `RESOLUTION` [m].

    The paper keeps the means and drops their standard deviation, which is 0.1 mm.
    """
    return Geometry(*(round(length.posterior.mean, _DIGITS) for length in lengths.lengths))


def tailored_design(design: WingDesign, lengths: GeometryCalibration) -> WingDesign:
    """Return the design with the measured planform; the mesh follows.

    The planform alone is replaced. What the design places by a fraction moves with it: ribs, point masses
    and bands of the skin along the span, and everything along the chord. What it places by a distance stays
    where it is on the wing: gauges and defect regions from the root, the test load from the tip. The
    net load of a turn, skin and web thicknesses, and the largest cell stay.

    Raises
    ------
    ExperimentDataError
        If a length differs from that of the design by more than a tenth: it is another wing.
    InvalidDesignError
        If the tailored wing cannot be built; the sentence names the place.
    """
    geometry = tailored_geometry(lengths)
    planform = {name: getattr(geometry, name) for name in LENGTH_NAMES}
    for name, value in planform.items():
        drawn = getattr(design.planform, name)
        if abs(value / drawn - 1.0) > LARGEST_DEPARTURE:
            raise ExperimentDataError(
                f"{name} measures {value * 1e3:.1f} mm, but the design {design.name} has "
                f"{drawn * 1e3:.1f} mm, more than 10 % apart: give the design of this wing with --design."
            )
    try:
        return design.changed(planform=planform)
    except InvalidDesignError as error:
        reason = str(error).removeprefix("the changed design: ")
        shown = " x ".join(f"{value * 1e3:.1f}" for value in planform.values())
        raise InvalidDesignError(
            f"the design {design.name} does not fit the measured planform ({shown} mm): {reason}"
        ) from None
