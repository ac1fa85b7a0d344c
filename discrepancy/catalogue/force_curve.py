"""A force of free shape at a port: a curve over the displacement that no equation prescribes.

The prior of the curve is a Gaussian process (Rasmussen and Williams 2006, *Gaussian Processes for
Machine Learning*, chapter 2). It is written as a sum of functions with independent amplitudes (the
Karhunen-Loeve expansion), so that the curve is an effect with ordinary parameters.
"""

from collections.abc import Mapping
from functools import cache

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.effect_in_setting import DYNAMIC
from discrepancy.catalogue.entry import (
    NINETY_PERCENT_QUANTILE,
    Effect,
    EffectParameter,
    ForceTable,
    Prior,
    Setting,
)
from fe.runtime.patch import ModelPatch, TableStiffness

FORCE_CURVE = "force_over_displacement"
"""Identifier of a force of free shape over the displacement."""
POINT_COUNT = 49
"""Number of points of the table of a curve."""
CORRELATION_LENGTHS = (0.12, 0.06)
"""Correlation lengths that are tried, as fractions of the range of the displacement. The shorter
one follows a sharper bend, such as that of a stop, and costs evidence where the curve is smooth."""
NEGLECTED_VARIANCE = 1e-4
"""Share of the prior variance that the neglected functions would have."""


@cache
def curve_functions(correlation_length: float) -> FloatArray:
    """Return the functions (P, K) of the expansion of a process with unit variance at P points.

    Each is multiplied by the prior standard deviation of its amplitude.

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


def force_curve(
    port: str,
    displacements: tuple[float, float],
    force_deviation: float,
    correlation_length: float = CORRELATION_LENGTHS[0],
) -> Effect:
    """Return the effect of a force that is any smooth curve over the displacement of a port.

    Parameters
    ----------
    port : str
        Name of the port.
    displacements : tuple of float
        Least and largest displacement in the trials [m or rad].
    force_deviation : float
        Prior standard deviation of the force at each displacement [N or N m].
    correlation_length : float
        Correlation length of the curve, as a fraction of the range of the displacement.
    """
    table = ForceTable(
        displacements=np.linspace(*displacements, POINT_COUNT),
        functions=force_deviation * curve_functions(correlation_length),
    )
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
        return ModelPatch((TableStiffness(place, tuple(table.displacements.tolist()), forces),))

    return Effect(
        identifier=FORCE_CURVE,
        name="force of free shape over the displacement",
        family="force over the displacement",
        equation="F = F(x), a curve through estimated points",
        signature="The missing force is a function of the displacement.",
        reference="Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, chapter 2",
        acts_on=DYNAMIC,
        parameters=tuple(parameters),
        build=build,
        places=lambda setting: (port,),
        table=table,
    )
