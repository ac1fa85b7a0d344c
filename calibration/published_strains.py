"""The strain library of the authors' model, `UAVconfig.json`, as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.json_file import read_json

from .errors import ExperimentDataError, ExperimentFileError

FILE_NAME = "UAVconfig.json"
"""Name of the file in the authors' repository UAV-Digital-Twin."""

REGIONS = 2
PERCENT = 1e-2
MICROSTRAIN = 1e-6

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PublishedStrains:
    """Strains of the published model for every damage state, control and draw of Young's modulus.

    Attributes
    ----------
    levels : tuple of two tuples
        Stiffness losses of z1 and of z2, fractions.
    controls : tuple of str
        For example "2g", "3g".
    young_modulus_factor : (E,) dimensionless
        The draws e.
    strain_per_draw : (E, n1, n2, U, G) dimensionless
        Strain of each draw, z1, z2, control and gauge.
    strain : (n1, n2, U, G) dimensionless
        The entry "mean": the solution at e = 1.0073, which is not the average of the draws.
    content : mapping
        The file as it is, for what else it holds.
    """

    levels: tuple[tuple[float, ...], tuple[float, ...]]
    controls: tuple[str, ...]
    young_modulus_factor: FloatArray
    strain_per_draw: FloatArray
    strain: FloatArray
    content: Mapping[str, Any]


def read_published_strains(file: Path | str) -> PublishedStrains:
    """Read the authors' strain library.

    Raises
    ------
    ExperimentFileError
        If the file cannot be read, is no JSON, or lacks an entry; the entry is named.
    ExperimentDataError
        If its values are not in the published format.
    """
    content = read_json(file, ExperimentFileError, what="strain library")
    try:
        return _arranged(content)
    except KeyError as error:
        raise ExperimentFileError(
            f"the strain library {file} lacks the entry {error}; is it the file {FILE_NAME} as published?"
        ) from error
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise ExperimentDataError(
            f"the strain library {file} is not in the published format: {error}"
        ) from error


def _arranged(content: Mapping[str, Any]) -> PublishedStrains:
    levels = content["states"]
    if len(levels) != REGIONS:
        raise ValueError(f"expected the levels of {REGIONS} regions under 'states', got {len(levels)}")
    controls = tuple(str(control) for control in content["controls"])
    observations = content["observations"]
    first = observations[str(levels[0][0])][str(levels[1][0])][controls[0]]
    draws = [key for key in first if key != "mean"]
    gauges = len(first["mean"])
    rows = [
        (draw, z1, z2, control, observations[str(z1)][str(z2)][control][draw])
        for draw in ("mean", *draws)
        for z1 in levels[0]
        for z2 in levels[1]
        for control in controls
    ]
    for draw, z1, z2, control, row in rows:
        if np.shape(row) != (gauges,) or not np.all(np.isfinite(np.asarray(row, dtype=np.float64))):
            raise ValueError(f"observations[{z1}][{z2}][{control}][{draw}] must hold {gauges} finite strains")
    shape = (len(draws) + 1, len(levels[0]), len(levels[1]), len(controls), gauges)
    table = np.array([row for *_, row in rows], dtype=np.float64).reshape(shape)
    table *= MICROSTRAIN
    table.setflags(write=False)
    one, two = (tuple(float(level) * PERCENT for level in given) for given in levels)
    return PublishedStrains(
        levels=(one, two),
        controls=controls,
        young_modulus_factor=np.array([float(draw) for draw in draws]),
        strain_per_draw=table[1:],
        strain=table[0],
        content=content,
    )
