"""Offline: fewer static basis vectors for the same certified bound."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced import ReducedModel

from .certified_basis import Judgement, State

FloatArray = npt.NDArray[np.float64]


def compressed(model: ReducedModel, directions: FloatArray) -> ReducedModel:
    """Return the model on fewer static basis vectors, its residuals on as few as they then need.

    Parameters
    ----------
    model : ReducedModel
        A model with N static basis vectors.
    directions : (N, K) ndarray
        Orthonormal combinations of them.

    Returns
    -------
    ReducedModel
        The Galerkin model on the combinations; its bound is as certified as before.
    """
    stiffness = directions.T @ model.static_stiffness @ directions
    residual = np.concatenate(
        (model.residual_load, (model.residual_stiffness @ directions).reshape(len(model.residual_load), -1)),
        axis=1,
    )
    orthonormal, factor = np.linalg.qr(residual)
    loads = model.residual_load.shape[1]
    return replace(
        model,
        static_stiffness=0.5 * (stiffness + stiffness.transpose(0, 2, 1)),
        static_load=model.static_load @ directions,
        static_output=model.static_output @ directions,
        residual_load=np.ascontiguousarray(factor[:, :loads]),
        residual_stiffness=np.ascontiguousarray(factor[:, loads:].reshape(len(factor), len(stiffness), -1)),
        dual_correction=model.dual_correction @ orthonormal,
        cross_mass=model.cross_mass @ directions,
    )


def fewest_directions(
    model: ReducedModel, judgement: Judgement, states: list[State], tolerance: float
) -> FloatArray:
    """Return the fewest singular directions of the reduced solutions that keep the bound below a tolerance.

    Parameters
    ----------
    model : ReducedModel
        The model that the greedy search made.
    judgement : Judgement
        Its solutions and its bound.
    states : list of tuple
        States to look at.
    tolerance : float
        Relative bound wanted.

    Returns
    -------
    (N, K) ndarray
        Orthonormal combinations of its static basis vectors; all of them if fewer do not suffice.
    """
    solutions = []
    for state in states:
        for coordinates in judgement.solutions(model, state):
            solutions.append(coordinates / np.linalg.norm(coordinates))
    directions = np.linalg.svd(np.array(solutions).T, full_matrices=False)[0]
    low, high = min(2, directions.shape[1]), directions.shape[1]
    while low < high:
        middle = (low + high) // 2
        smaller = compressed(model, directions[:, :middle])
        if all(judgement.bound(smaller, state) <= tolerance for state in states):
            high = middle
        else:
            low = middle + 1
    return np.asarray(directions[:, :low])
