"""The authors' published strain library, read from their repository's file as it is.

`UAVconfig.json` of Kapteyn et al. 2021 holds the strains of their finite element model for a grid of damage
states, two controls and thirty draws of Young's modulus. It serves as an observation model, and as an asset
whose state may lie between the levels of the grid.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin_master.errors import InvalidStrainLibraryError
from twin_master.graphical_model import Factor, StateSpace

__all__ = ["FILE_NAME", "StrainLibrary", "load_strain_library"]

Float = NDArray[np.float64]

FILE_NAME = "UAVconfig.json"
REGION_NAMES = ("z1", "z2")
PERCENT = 1e-2
MICROSTRAIN = 1e-6


@dataclass(frozen=True)
class StrainLibrary:
    """Strains for every damage state, control and draw of Young's modulus.

    Attributes
    ----------
    states : StateSpace
        Stiffness loss of the regions z1 and z2, fractions.
    controls : tuple of str
        For example "2g", "3g".
    young_modulus_factor : (E,) dimensionless
        The draws e.
    strain_per_draw : (E, S, U, G) dimensionless
        Strain of each draw, joint state, control and gauge.
    strain : (S, U, G) dimensionless
        The entry "mean": the solution at e = 1.0073, not the average of the draws.
    discount : float
        gamma of the authors' planning problem.
    worsening_probability : dict of str to float
        Probability of each control to worsen a region by one level in a step.
    """

    states: StateSpace
    controls: tuple[str, ...]
    young_modulus_factor: Float
    strain_per_draw: Float
    strain: Float
    discount: float
    worsening_probability: Mapping[str, float]

    @property
    def gauge_count(self) -> int:
        """Number G of gauges."""
        return int(self.strain.shape[-1])

    def strain_at(self, stiffness_loss: ArrayLike, control_index: int) -> Float:
        """Return the strain of a damage state between the levels, as an asset would have it.

        Multilinear in the stiffness losses, from the entry "mean".

        Parameters
        ----------
        stiffness_loss : (regions,)
            Fractions, inside the range of the levels.
        control_index : int
            Of `controls`.

        Returns
        -------
        (G,) dimensionless

        Raises
        ------
        InvalidStrainLibraryError
            If the state lies outside the levels, or there is no such control.
        """
        loss = np.asarray(stiffness_loss, dtype=np.float64)
        if loss.shape != (len(self.states.factors),) or not 0 <= control_index < len(self.controls):
            raise InvalidStrainLibraryError(
                f"expected one stiffness loss for each of {', '.join(self.states.names)} and a control index "
                f"below {len(self.controls)}, got shape {loss.shape} and control {control_index}"
            )
        values = self.strain.reshape(*self.states.shape, *self.strain.shape[1:])[..., control_index, :]
        for factor, value in zip(self.states.factors, loss, strict=True):
            levels = np.asarray(factor.levels)
            if not levels[0] <= value <= levels[-1]:
                raise InvalidStrainLibraryError(
                    f"the strain library covers {factor.name} from {levels[0]:g} to {levels[-1]:g}, "
                    f"got {value:g}"
                )
            upper = min(int(np.searchsorted(levels, value, side="right")), len(levels) - 1)
            lower = max(upper - 1, 0)
            width = levels[upper] - levels[lower]
            share = (value - levels[lower]) / width if width > 0.0 else 0.0
            values = (1.0 - share) * values[lower] + share * values[upper]
        result: Float = np.array(values, dtype=np.float64)
        return result


def load_strain_library(path: str | Path) -> StrainLibrary:
    """Read the authors' library.

    Parameters
    ----------
    path : str or Path
        The file `UAVconfig.json`, or the folder (such as a clone of their repository) that holds it.

    Raises
    ------
    InvalidStrainLibraryError
        If the file is missing, is no JSON, or lacks an entry; the entry is named.
    """
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidStrainLibraryError(
            f"cannot read the strain library {file}: {error.strerror}; give the file {FILE_NAME} of the "
            "authors' repository UAV-Digital-Twin, or its folder"
        ) from error
    except ValueError as error:
        raise InvalidStrainLibraryError(f"the strain library {file} is no JSON file: {error}") from error
    try:
        return _from_content(content)
    except KeyError as error:
        raise InvalidStrainLibraryError(
            f"the strain library {file} lacks the entry {error}; is it the file {FILE_NAME} as published?"
        ) from error
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InvalidStrainLibraryError(
            f"the strain library {file} is not in the published format: {error}"
        ) from error


def _from_content(content: Mapping[str, Any]) -> StrainLibrary:
    """Arrange the content of the file in arrays."""
    levels = content["states"]
    if len(levels) != len(REGION_NAMES):
        raise ValueError(
            f"expected the levels of {len(REGION_NAMES)} regions under 'states', got {len(levels)}"
        )
    states = StateSpace(
        tuple(
            Factor(name, tuple(float(level) * PERCENT for level in given))
            for name, given in zip(REGION_NAMES, levels, strict=True)
        )
    )
    controls = tuple(str(control) for control in content["controls"])
    observations = content["observations"]
    first = observations[str(levels[0][0])][str(levels[1][0])][controls[0]]
    draws = [key for key in first if key != "mean"]
    gauges = len(first["mean"])
    table = np.empty((len(draws) + 1, *states.shape, len(controls), gauges))
    for i, z1 in enumerate(levels[0]):
        for j, z2 in enumerate(levels[1]):
            for u, control in enumerate(controls):
                entry = observations[str(z1)][str(z2)][control]
                for e, draw in enumerate(["mean", *draws]):
                    row = np.asarray(entry[draw], dtype=np.float64)
                    if row.shape != (gauges,) or not np.all(np.isfinite(row)):
                        raise ValueError(
                            f"observations[{z1}][{z2}][{control}][{draw}] must hold {gauges} finite strains"
                        )
                    table[e, i, j, u] = row
    strain = table.reshape(len(draws) + 1, states.size, len(controls), gauges) * MICROSTRAIN
    strain.setflags(write=False)
    probabilities = content["transition_probabilities"]
    return StrainLibrary(
        states=states,
        controls=controls,
        young_modulus_factor=np.array([float(draw) for draw in draws]),
        strain_per_draw=strain[1:],
        strain=strain[0],
        discount=float(content["gamma"]),
        worsening_probability={control: float(probabilities[control]) for control in controls},
    )
