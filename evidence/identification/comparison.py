"""The identified wing beside the published model, row by row, fitted and held out apart."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .local_model import LocalModel
from .responses import ReducedWing
from .targets import (
    LEVELS,
    LIBRARY_FACTOR,
    LIMITING_GAUGE,
    Targets,
    fitted_states,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PERCENT = 100.0


@dataclass(frozen=True)
class Comparison:
    """One line of the comparison.

    Attributes
    ----------
    name, unit : str
        What, and its unit.
    rms, largest : float
        Of the differences, model less target; equal up to the sign for a single figure, whose sign `largest`
        keeps.
    wanted_rms, wanted_largest : float or None
        What was aimed at.
    fitted : bool
        Whether the numbers of the design were fitted to it.
    where : str
        Where the largest difference is; gauges are counted from 1.
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
        """Whether all wanted limits are kept; None where there are none."""
        limits = [(self.rms, self.wanted_rms), (abs(self.largest), self.wanted_largest)]
        kept = [found <= limit for found, limit in limits if limit is not None]
        return all(kept) if kept else None


@dataclass(frozen=True, eq=False)
class Outputs:
    """What the model says to everything that the published folders hold.

    Attributes
    ----------
    strain : (5, 5, G) dimensionless
    strain_slope : (G,)
    tip_stiffness, tip_stiffness_slope : float
        N/m, 1.
    frequency : (R, 2) Hz
        In the published rows.
    frequency_at_one, frequency_slope, mass_slope : (2,)
        Hz, 1, 1/kg.
    curvature : float
        Second difference of ln f2 along the line of the rows, over the square of ln e.
    mode_order : tuple of int
        Places of the two flapwise bending modes.
    modes : (m,) Hz
        Lowest frequencies.
    unknowns : int
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
        return np.asarray(self.strain / self.strain[0, 0])

    @property
    def interaction(self) -> FloatArray:
        """Departure (G,) of the strain at (80, 80) from the product of both effects."""
        return _interaction(self.strain)


def outputs(model: LocalModel, targets: Targets) -> Outputs:
    """Evaluate everything at the point of a local model."""
    wing: ReducedWing = model.wing
    stiffness = wing.tip_stiffness().value
    at_one, factor_slope, mass_slope = wing.frequency_slopes()
    rows = targets.young_modulus_factor, targets.servo_mass, targets.pitot_mass
    return Outputs(
        strain=wing.all_strains(np.ones((len(LEVELS), len(LEVELS)), dtype=bool)).value,
        strain_slope=wing.strain_slope(LIBRARY_FACTOR).value,
        tip_stiffness=float(stiffness[0]),
        tip_stiffness_slope=float(stiffness[1]),
        frequency=np.exp(wing.log_frequency(*rows).value),
        frequency_at_one=np.exp(at_one.value),
        frequency_slope=factor_slope.value,
        mass_slope=mass_slope.value,
        mode_order=model.mode_order,
        modes=model.frequency,
        unknowns=model.unknowns,
    )


def compare(found: Outputs, targets: Targets) -> tuple[Comparison, ...]:
    """Compare row by row; the wanted limits are those that the project set itself."""
    return tuple(
        row for group in (_stiffness, _strains, _ratios, _frequencies) for row in group(found, targets)
    )


def _interaction(strain: FloatArray) -> FloatArray:
    return np.asarray(strain[-1, -1] * strain[0, 0] / (strain[-1, 0] * strain[0, -1]) - 1.0)


def _row(
    name: str,
    unit: str,
    difference: FloatArray | float,
    wanted: tuple[float | None, float | None],
    fitted: bool,
    *,
    by_gauge: bool = True,
) -> Comparison:
    values = np.atleast_1d(difference)
    worst = int(np.nanargmax(np.abs(values)))
    where = f"gauge {worst % 24 + 1}" if by_gauge and values.size > 2 else ""
    return Comparison(
        name,
        unit,
        float(np.sqrt(np.nanmean(values**2))),
        float(values.ravel()[worst]),
        *wanted,
        fitted,
        where,
    )


def _stiffness(found: Outputs, targets: Targets) -> Iterator[Comparison]:
    relative = PERCENT * (found.tip_stiffness / targets.tip_stiffness - 1.0)
    yield _row("tip stiffness k(1)", "%", relative, (None, 0.1), True)
    relative = PERCENT * (found.tip_stiffness_slope / targets.tip_stiffness_slope - 1.0)
    yield _row("d ln k / d ln e", "%", relative, (None, 0.5), True)


def _strains(found: Outputs, targets: Targets) -> Iterator[Comparison]:
    healthy = PERCENT * (found.strain[0, 0] / targets.strain[0, 0] - 1.0)
    yield _row("24 healthy strains at 3g", "%", healthy, (2.2, 4.5), True)
    yield _row(
        "slopes d ln strain / d ln e", "1", found.strain_slope - targets.strain_slope, (0.02, 0.05), True
    )
    limiting = found.strain[:, 0, LIMITING_GAUGE] / targets.strain[:, 0, LIMITING_GAUGE] - 1.0
    yield _row("limiting gauge, all z1", "%", PERCENT * limiting, (None, 1.0), True, by_gauge=False)
    largest = found.strain.argmax(axis=2) != LIMITING_GAUGE
    yield _row("states whose largest gauge is another", "1", float(largest.sum()), (None, 0.0), False)


def _ratios(found: Outputs, targets: Targets) -> Iterator[Comparison]:
    points = PERCENT * (found.ratio - targets.ratio)
    fitted = fitted_states()
    one, two = np.zeros_like(fitted), np.zeros_like(fitted)
    one[1:, 0] = two[0, 1:] = True
    combined = np.zeros_like(fitted)
    combined[1:, 1:] = True
    last = np.zeros_like(fitted)
    last[-1, -1] = True
    unit = "points"
    yield _row("strain ratios under z1", unit, points[one], (1.1, 3.2), True)
    yield _row("  z1 at 40, 80 %", unit, points[one & fitted], (None, None), True)
    yield _row("  z1 at 20, 60 %", unit, points[one & ~fitted], (None, None), False)
    yield _row("strain ratios under z2", unit, points[two], (0.85, 4.7), True)
    yield _row("  z2 at 40, 80 %", unit, points[two & fitted], (None, None), True)
    yield _row("  z2 at 20, 60 %", unit, points[two & ~fitted], (None, None), False)
    yield _row("strain ratios at (80, 80)", unit, points[last], (1.5, 4.5), False)
    yield _row("strain ratios, 16 combined states", unit, points[combined], (1.5, 4.5), False)
    yield _row("interaction at (80, 80)", "1", found.interaction, (None, None), False)


def _frequencies(found: Outputs, targets: Targets) -> Iterator[Comparison]:
    for mode in range(2):
        name = f"f{mode + 1}"
        at_one = PERCENT * (found.frequency_at_one[mode] / targets.all_frequency_at_one[mode] - 1.0)
        yield _row(f"{name} at e = 1", "%", float(at_one), (None, 0.05), True)
        rows = PERCENT * (found.frequency[:, mode] / targets.frequency[:, mode] - 1.0)
        for kind, chosen in (("fitted", targets.fitted_row), ("held-out", ~targets.fitted_row)):
            label = f"{name}, {kind} half of the rows"
            yield _row(label, "%", rows[chosen], (None, 0.07), kind == "fitted", by_gauge=False)
        slope = PERCENT * (found.frequency_slope[mode] / PUBLISHED_FACTOR_SLOPE[mode] - 1.0)
        yield _row(f"d ln {name} / d ln e", "%", float(slope), (None, (1.0, 2.0)[mode]), True)
        slope = PERCENT * (found.mass_slope[mode] / PUBLISHED_MASS_SLOPE[mode] - 1.0)
        yield _row(f"d ln {name} / d m_pitot", "%", float(slope), (None, 2.0), True)
    between = found.mode_order[1] - found.mode_order[0] - 1
    yield _row("modes between the two", "1", float(between), (None, 1.0), False)


PUBLISHED_FACTOR_SLOPE = (0.4114, 0.3244)
PUBLISHED_MASS_SLOPE = (-0.5075, -0.2925)
