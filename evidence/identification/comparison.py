"""The identified wing beside the published model, row by row; rows say what was fitted."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .local_model import LocalModel
from .responses import ReducedWing
from .targets import (
    HEALTHY,
    LEVELS,
    LIBRARY_FACTOR,
    LIMITING_GAUGE,
    NO_LOSS,
    Targets,
    fitted_states,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PERCENT = 100.0
GAUGE_COUNT = 24
"""Number of gauges of the published library."""
PUBLISHED_FACTOR_SLOPE = (0.4114, 0.3244)
"""d ln f / d ln e of both bending modes in the published model."""
PUBLISHED_MASS_SLOPE = (-0.5075, -0.2925)
"""d ln f / d m_pitot [1/kg] of both bending modes in the published model."""


class Limits(NamedTuple):
    """Limits that the project set for the differences of an output; None for no limit.

    Attributes
    ----------
    rms : float or None
        Limit of the root mean square.
    largest : float or None
        Limit of the largest difference.
    """

    rms: float | None = None
    largest: float | None = None


NO_LIMITS = Limits()
LAST = len(LEVELS) - 1
"""Index of the largest loss of a region."""


@dataclass(frozen=True)
class Comparison:
    """Differences of an output between model and published folders, a row of the comparison.

    Attributes
    ----------
    name, unit : str
        Name of the output, and the unit of its differences.
    rms, largest : float
        Root mean square of the differences, model minus target, and the largest difference with
        its sign. For a single figure, they agree except for the sign.
    wanted_rms, wanted_largest : float or None
        Limits that the project set; None for no limit.
    fitted : bool
        Whether the numbers of the design were fitted to the output.
    where : str
        Gauge of the largest difference, counted from 1; empty if no gauge has it.
    """

    name: str
    unit: str
    rms: float
    largest: float
    wanted_rms: float | None
    wanted_largest: float | None
    fitted: bool
    where: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether all wanted limits are kept; None if the row has no limits."""
        if self.wanted_rms is None and self.wanted_largest is None:
            return None
        rms_is_kept = self.wanted_rms is None or self.rms <= self.wanted_rms
        largest_is_kept = self.wanted_largest is None or abs(self.largest) <= self.wanted_largest
        return rms_is_kept and largest_is_kept


@dataclass(frozen=True, eq=False)
class Outputs:
    """Outputs of the model for everything that the published folders hold.

    Attributes
    ----------
    strain : (5, 5, G) array
        Strains [1] of the gauges at 3g, for z1 and z2 at `targets.LEVELS`.
    strain_slope : (G,) array
        d ln strain / d ln e of the healthy wing.
    tip_stiffness, tip_stiffness_slope : float
        Tip stiffness [N/m] at e = 1, and d ln k / d ln e.
    frequency : (R, 2) array
        First and second flapwise bending frequency [Hz] in each published row.
    frequency_at_one, frequency_slope, mass_slope : (2,) arrays
        Both frequencies [Hz] at e = 1, and the slopes of their logarithms in ln e [1] and in the
        pitot's mass [1/kg].
    mode_order : tuple of int
        Numbers of the two flapwise bending modes among all modes, from 0.
    modes : (m,) array
        Lowest frequencies [Hz].
    unknowns : int
        Number of free unknowns of the full model.
    """

    strain: FloatArray
    strain_slope: FloatArray
    tip_stiffness: float
    tip_stiffness_slope: float
    frequency: FloatArray
    frequency_at_one: FloatArray
    frequency_slope: FloatArray
    mass_slope: FloatArray
    mode_order: tuple[int, int]
    modes: FloatArray
    unknowns: int

    @property
    def ratio(self) -> FloatArray:
        """Strain over healthy strain (5, 5, G)."""
        return np.asarray(self.strain / self.healthy_strain)

    @property
    def healthy_strain(self) -> FloatArray:
        """Strains (G,) of the healthy wing."""
        return np.asarray(self.strain[HEALTHY])

    @property
    def interaction(self) -> FloatArray:
        """Relative difference (G,) of the strain at (80, 80) % from the product of both effects."""
        both_damaged = self.strain[LAST, LAST]
        first_damaged = self.strain[LAST, NO_LOSS]
        second_damaged = self.strain[NO_LOSS, LAST]
        ratio = both_damaged * self.healthy_strain / (first_damaged * second_damaged)
        return np.asarray(ratio - 1.0)


def outputs(model: LocalModel, targets: Targets) -> Outputs:
    """Evaluate all outputs at the point of a local model."""
    wing: ReducedWing = model.wing
    every_state = np.ones((len(LEVELS), len(LEVELS)), dtype=bool)
    tip_stiffness, tip_stiffness_slope = wing.tip_stiffness().value
    log_frequency = wing.log_frequency(
        targets.young_modulus_factor, targets.servo_mass, targets.pitot_mass
    )
    regression = wing.frequency_slopes()
    return Outputs(
        strain=wing.all_strains(every_state).value,
        strain_slope=wing.strain_slope(LIBRARY_FACTOR).value,
        tip_stiffness=float(tip_stiffness),
        tip_stiffness_slope=float(tip_stiffness_slope),
        frequency=np.exp(log_frequency.value),
        frequency_at_one=np.exp(regression.log_frequency.value),
        frequency_slope=regression.factor_slope.value,
        mass_slope=regression.mass_slope.value,
        mode_order=model.mode_order,
        modes=model.frequency,
        unknowns=model.unknowns,
    )


def compare(model_outputs: Outputs, targets: Targets) -> tuple[Comparison, ...]:
    """Compare the outputs row by row; the limits are those that the project set itself."""
    return (
        *_stiffness(model_outputs, targets),
        *_strains(model_outputs, targets),
        *_ratios(model_outputs, targets),
        *_frequencies(model_outputs, targets),
    )


def _row(
    name: str,
    unit: str,
    difference: FloatArray | float,
    limits: Limits,
    fitted: bool,
    *,
    by_gauge: bool = True,
) -> Comparison:
    """Return the row of an output.

    Parameters
    ----------
    name, unit : str
        Name of the output, and the unit of its differences.
    difference : (..., G) array or float
        Differences, model minus target.
    limits : Limits
        Limits of the differences.
    fitted : bool
        Whether the numbers of the design were fitted to the output.
    by_gauge : bool
        Whether the last axis of the differences is that of the gauges.
    """
    values = np.atleast_1d(difference)
    worst = int(np.nanargmax(np.abs(values)))
    where = f"gauge {worst % GAUGE_COUNT + 1}" if by_gauge and values.size > 2 else ""
    return Comparison(
        name=name,
        unit=unit,
        rms=float(np.sqrt(np.nanmean(values**2))),
        largest=float(values.ravel()[worst]),
        wanted_rms=limits.rms,
        wanted_largest=limits.largest,
        fitted=fitted,
        where=where,
    )


def _stiffness(model_outputs: Outputs, targets: Targets) -> Iterator[Comparison]:
    """Yield the rows of the static test."""
    relative = PERCENT * (model_outputs.tip_stiffness / targets.tip_stiffness - 1.0)
    yield _row("tip stiffness k(1)", "%", relative, Limits(largest=0.1), True)
    relative = PERCENT * (model_outputs.tip_stiffness_slope / targets.tip_stiffness_slope - 1.0)
    yield _row("d ln k / d ln e", "%", relative, Limits(largest=0.5), True)


def _strains(model_outputs: Outputs, targets: Targets) -> Iterator[Comparison]:
    """Yield the rows of the strains."""
    healthy = PERCENT * (model_outputs.healthy_strain / targets.healthy_strain - 1.0)
    yield _row("24 healthy strains at 3g", "%", healthy, Limits(rms=2.2, largest=4.5), True)

    slope = model_outputs.strain_slope - targets.strain_slope
    yield _row("slopes d ln strain / d ln e", "1", slope, Limits(rms=0.02, largest=0.05), True)

    limiting_strain = model_outputs.strain[:, NO_LOSS, LIMITING_GAUGE]
    limiting = PERCENT * (limiting_strain / targets.strain[:, NO_LOSS, LIMITING_GAUGE] - 1.0)
    yield _row("limiting gauge, all z1", "%", limiting, Limits(largest=1.0), True, by_gauge=False)

    is_another = model_outputs.strain.argmax(axis=2) != LIMITING_GAUGE
    count = float(is_another.sum())
    yield _row("states whose largest gauge is another", "1", count, Limits(largest=0.0), False)


def _ratios(model_outputs: Outputs, targets: Targets) -> Iterator[Comparison]:
    """Yield the rows of the strain ratios under damage."""
    points = PERCENT * (model_outputs.ratio - targets.ratio)
    fitted = fitted_states()
    only_first = np.zeros_like(fitted)
    only_first[1:, NO_LOSS] = True
    only_second = np.zeros_like(fitted)
    only_second[NO_LOSS, 1:] = True
    combined = np.zeros_like(fitted)
    combined[1:, 1:] = True
    unit = "points"

    limits = Limits(rms=1.1, largest=3.2)
    yield _row("strain ratios under z1", unit, points[only_first], limits, True)
    yield _row("  z1 at 40, 80 %", unit, points[only_first & fitted], NO_LIMITS, True)
    yield _row("  z1 at 20, 60 %", unit, points[only_first & ~fitted], NO_LIMITS, False)

    limits = Limits(rms=0.85, largest=4.7)
    yield _row("strain ratios under z2", unit, points[only_second], limits, True)
    yield _row("  z2 at 40, 80 %", unit, points[only_second & fitted], NO_LIMITS, True)
    yield _row("  z2 at 20, 60 %", unit, points[only_second & ~fitted], NO_LIMITS, False)

    limits = Limits(rms=1.5, largest=4.5)
    yield _row("strain ratios at (80, 80)", unit, points[LAST, LAST], limits, False)
    yield _row("strain ratios, 16 combined states", unit, points[combined], limits, False)
    yield _row("interaction at (80, 80)", "1", model_outputs.interaction, NO_LIMITS, False)


def _frequencies(model_outputs: Outputs, targets: Targets) -> Iterator[Comparison]:
    """Yield the rows of both flapwise bending frequencies."""
    slope_limits = (Limits(largest=1.0), Limits(largest=2.0))
    for mode, slope_limit in enumerate(slope_limits):
        name = f"f{mode + 1}"
        ratio = model_outputs.frequency_at_one[mode] / targets.all_frequency_at_one[mode]
        difference = float(PERCENT * (ratio - 1.0))
        yield _row(f"{name} at e = 1", "%", difference, Limits(largest=0.05), True)

        rows = PERCENT * (model_outputs.frequency[:, mode] / targets.frequency[:, mode] - 1.0)
        halves = {"fitted": targets.fitted_row, "held-out": ~targets.fitted_row}
        for half, is_in_half in halves.items():
            yield _row(
                f"{name}, {half} half of the rows",
                "%",
                rows[is_in_half],
                Limits(largest=0.07),
                half == "fitted",
                by_gauge=False,
            )

        ratio = model_outputs.frequency_slope[mode] / PUBLISHED_FACTOR_SLOPE[mode]
        difference = float(PERCENT * (ratio - 1.0))
        yield _row(f"d ln {name} / d ln e", "%", difference, slope_limit, True)

        ratio = model_outputs.mass_slope[mode] / PUBLISHED_MASS_SLOPE[mode]
        difference = float(PERCENT * (ratio - 1.0))
        yield _row(f"d ln {name} / d m_pitot", "%", difference, Limits(largest=2.0), True)
    first, second = model_outputs.mode_order
    modes_between = float(second - first - 1)
    yield _row("modes between the two", "1", modes_between, Limits(largest=1.0), False)
