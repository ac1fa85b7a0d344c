"""A force of free shape at a port: a curve over the displacement or the velocity.

At a port of a state, such as a level or a temperature, it is a flow: a curve over the state.

The prior of the curve is a Gaussian process (Rasmussen and Williams 2006, *Gaussian Processes for
Machine Learning*, chapter 2). It is written as a sum of functions with independent amplitudes (the
Karhunen-Loeve expansion), so that the curve is an effect with ordinary parameters.
"""

from collections.abc import Mapping
from functools import cache
from typing import Literal

import numpy as np

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.effect_in_setting import DYNAMIC
from discrepancy.catalogue.entry import (
    NINETY_PERCENT_QUANTILE,
    Effect,
    EffectParameter,
    ForceTable,
    Prior,
    Setting,
)
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch, TableDamping, TableStiffness

IDENTIFIERS = {
    "displacement": "force_over_displacement",
    "velocity": "force_over_velocity",
    "state": "flow_over_state",
}
"""Identifier of a force or flow of free shape, by what it follows."""
POINT_COUNT = 49
"""Number of points of the table of a curve."""
CORRELATION_LENGTHS = (0.12, 0.06)
"""Correlation lengths that are tried, as fractions of the range. The shorter one follows a sharper
bend, such as that of a stop, and costs evidence where the curve is smooth."""
DENSE_VELOCITY = 0.03
"""Velocity over the largest one below which the points of a curve are evenly spaced. Beyond it they
are spaced by its logarithm, since friction changes most near zero."""
NEGLECTED_VARIANCE = 1e-4
"""Share of the prior variance that the neglected functions would have."""

Variable = Literal["displacement", "velocity", "state"]
"""What a curve may run over."""


def curve_family(variable: Variable) -> str:
    """Return the family of all forces that follow a variable, such as "force over the velocity"."""
    kind = "flow" if variable == "state" else "force"
    return f"{kind} over the {variable}"


def curve_families_of(setting: Setting, patch: ModelPatch) -> set[tuple[str, str]]:
    """Return the families of free shape that the laws of a patch belong to, with their ports.

    A law with memory belongs to none.
    """
    families = set()
    for law in patch:
        if not isinstance(law, PortForce) or law.hysteretic:
            continue
        scale = setting.scales.ports.get(law.port)
        variable: Variable = "velocity" if law.depends_on_speed else "displacement"
        if scale is not None and scale.of_state:
            variable = "state"
        families.add((curve_family(variable), law.port))
    return families


@cache
def curve_functions(correlation_length: float) -> FloatArray:
    """Return K functions at P points (P, K), whose sum with random amplitudes is a random curve.

    With standard normal amplitudes the curve is a Gaussian process with unit variance and squared
    exponential covariance (Karhunen-Loève expansion). The functions are the eigenvectors of this
    covariance, largest variance first, times the square root of their variance. Those with less
    than `NEGLECTED_VARIANCE` of the total variance are left out.

    Parameters
    ----------
    correlation_length : float
        The correlation length, as a fraction of the range of the points.
    """
    fractions = np.linspace(0.0, 1.0, POINT_COUNT)
    distances = (fractions[:, np.newaxis] - fractions) / correlation_length
    variances, shapes = np.linalg.eigh(np.exp(-0.5 * distances**2))
    # in descending order of their variance
    variances, shapes = variances[::-1], shapes[:, ::-1]
    count = int(np.sum(variances > NEGLECTED_VARIANCE * POINT_COUNT))
    return np.asarray(shapes[:, :count] * np.sqrt(variances[:count]))


def curve_points(variable: Variable, low: float, high: float) -> FloatArray:
    """Return the points (P,) of a curve between two ends.

    The points are evenly spaced for displacements and states, and dense around zero for velocities;
    see `DENSE_VELOCITY`.
    """
    if variable != "velocity":
        return np.linspace(low, high, POINT_COUNT)
    dense_velocity = DENSE_VELOCITY * max(abs(low), abs(high))
    first = np.arcsinh(low / dense_velocity)
    last = np.arcsinh(high / dense_velocity)
    return np.asarray(dense_velocity * np.sinh(np.linspace(first, last, POINT_COUNT)))


def variance_along_curve(variable: Variable, values: FloatArray, force: FloatArray) -> float:
    """Return the fraction of a force's mean square that a curve over a variable explains.

    The curve is fitted by least squares, without its prior.

    Parameters
    ----------
    variable : {"displacement", "velocity", "state"}
        What the curve runs over.
    values, force : (N,) array
        The variable and the force at the same times.
    """
    points = curve_points(variable, float(values.min()), float(values.max()))
    functions = curve_functions(CORRELATION_LENGTHS[0])
    # the functions at the values of the variable (N, K)
    functions_at_values = np.column_stack(
        [np.interp(values, points, shape) for shape in functions.T]
    )
    amplitudes = np.linalg.lstsq(functions_at_values, force, rcond=None)[0]
    unexplained = force - functions_at_values @ amplitudes
    return 1.0 - float(unexplained @ unexplained) / float(force @ force)


def force_curve(
    port: str,
    variable: Variable,
    ends: tuple[float, float],
    force_deviation: float,
    correlation_length: float = CORRELATION_LENGTHS[0],
) -> Effect:
    """Return the effect of a force that is any smooth curve over the motion of a port.

    Parameters
    ----------
    port : str
        Name of the port.
    variable : {"displacement", "velocity", "state"}
        What the curve runs over.
    ends : tuple of float
        Least and largest displacement or velocity in the trials [m or rad, or per s], or values of
        the state.
    force_deviation : float
        Prior standard deviation of the force at each point [N or N m], or of the flow.
    correlation_length : float
        Correlation length of the curve, as a fraction of the range.
    """
    table = ForceTable(
        variable=variable,
        points=curve_points(variable, *ends),
        functions=force_deviation * curve_functions(correlation_length),
    )
    # a law at a port of a state takes the state for a speed
    law = TableStiffness if variable == "displacement" else TableDamping
    family = curve_family(variable)
    kind = family.split()[0]
    # a physical value of one is one prior standard deviation
    amplitude_prior = Prior("normal", -NINETY_PERCENT_QUANTILE, NINETY_PERCENT_QUANTILE)
    parameters = []
    for number in range(1, table.functions.shape[1] + 1):
        parameters.append(
            EffectParameter(
                name=f"amplitude_{number}",
                symbol=f"a_{number}",
                unit="1",
                description=f"amplitude of function {number} of the curve",
                prior=amplitude_prior,
                magnitude=True,
            )
        )

    def build(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
        amplitudes = np.array([values[parameter.name] for parameter in parameters])
        forces = tuple((table.functions @ amplitudes).tolist())
        return ModelPatch((law(place, tuple(table.points.tolist()), forces),))

    return Effect(
        identifier=IDENTIFIERS[variable],
        name=f"{kind} of free shape over the {variable}",
        family=family,
        equation=f"F = F({variable}), a curve through estimated points",
        signature=f"The missing {kind} is a function of the {variable}.",
        reference="Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, chapter 2",
        acts_on=frozenset(TrialKind) if variable == "displacement" else DYNAMIC,
        parameters=tuple(parameters),
        build=build,
        places=lambda setting: (port,),
        table=table,
    )
