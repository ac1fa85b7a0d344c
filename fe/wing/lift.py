"""Lift along the span: Schrenk's approximation and a lifting line.

Both give the shape of the lift of a symmetrically loaded wing as a function that integrates to one over
the half-wing; the amount is the design's.

References
----------
O. Schrenk, "A simple approximation method for obtaining the spanwise lift distribution", NACA TM 948 (1940).
H. Glauert, "The Elements of Aerofoil and Airscrew Theory" (1926), chapter XI.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .parts import Planform

FloatArray = NDArray[np.float64]
Distribution = Callable[[ArrayLike], FloatArray]


def schrenk(planform: Planform) -> Distribution:
    """Mean of the chord and of the elliptic distribution of the same area.

    Returns
    -------
    callable
        Station (...,) as a fraction of the semi-span to lift per length over total lift (...,) [1/m].
    """
    span, root, tip = planform.semi_span, planform.root_chord, planform.tip_chord

    def per_length(station: ArrayLike) -> FloatArray:
        eta = np.asarray(station, dtype=float)
        trapezoid = 2.0 * (root + (tip - root) * eta) / (root + tip)
        ellipse = 4.0 / np.pi * np.sqrt(np.clip(1.0 - eta**2, 0.0, None))
        return np.asarray(0.5 * (trapezoid + ellipse) / span)

    return per_length


def lifting_line(planform: Planform, terms: int = 40, section_slope: float = 2.0 * np.pi) -> Distribution:
    """Prandtl's lifting line solved by Glauert's sine series.

    With y = -(b/2) cos(theta), the circulation is 2 b V sum A_n sin(n theta), n odd; collocation at
    `terms` angles solves sum A_n sin(n theta) (n mu + sin theta) = mu alpha sin theta,
    mu = c a0 / (4 b).

    Parameters
    ----------
    planform : Planform
        The half-wing; the wing is untwisted and symmetric.
    terms : int
        Number of odd harmonics.
    section_slope : float
        Lift slope of the section [1/rad].

    Returns
    -------
    callable
        Station (...,) as a fraction of the semi-span to lift per length over total lift (...,) [1/m].
    """
    theta = (np.arange(terms) + 1.0) * np.pi / (2.0 * terms)  # half-wing, tip excluded, root included
    order = 2.0 * np.arange(terms) + 1.0
    chord = planform.root_chord + (planform.tip_chord - planform.root_chord) * np.cos(theta)
    mu = (chord * section_slope / (8.0 * planform.semi_span))[:, None]
    sine = np.sin(np.outer(theta, order))
    amplitude = np.linalg.solve(sine * (order * mu + np.sin(theta)[:, None]), mu[:, 0] * np.sin(theta))
    # Integral of sum A_n sin(n theta) over the half-wing: only n = 1 contributes, A_1 pi/4 * semi-span.
    scale = 1.0 / (amplitude[0] * np.pi / 4.0 * planform.semi_span)

    def per_length(station: ArrayLike) -> FloatArray:
        angle = np.arccos(np.clip(np.asarray(station, dtype=float), 0.0, 1.0))
        return np.asarray(scale * np.tensordot(np.sin(angle[..., None] * order), amplitude, axes=1))

    return per_length


DISTRIBUTIONS: dict[str, Callable[[Planform], Distribution]] = {
    "schrenk": schrenk,
    "lifting_line": lifting_line,
}
"""Lift distributions by their name in a design."""
