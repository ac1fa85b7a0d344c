"""The parts of a wing design: the sections of its TOML file, in SI units, each checked on its own.

The shape of the section is of the symmetric four-digit family of NACA Report 460 (Jacobs, Ward and Pinkerton,
1933). Also the lift along the span: the shape of the lift of a symmetrically loaded wing as a function that
integrates to one over the half-wing; the amount is the design's.

References
----------
O. Schrenk, "A simple approximation method for obtaining the spanwise lift distribution", NACA TM 948 (1940).
H. Glauert, "The Elements of Aerofoil and Airscrew Theory" (1926), chapter XI.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from fe.runtime.arrays import FloatArray
from fe.structure.tables import Modulus, Part
from reporting.toml_file import Fault

_SHAPE = (0.2969, -0.1260, -0.3516, 0.2843, -0.1015)


def four_digit_half_thickness(chord_fraction: ArrayLike, thickness_ratio: float) -> FloatArray:
    """Half thickness of a symmetric four-digit section, as a fraction of the chord.

    Parameters
    ----------
    chord_fraction : array_like (...,)
        Distance from the leading edge over the chord, clipped to 0..1.
    thickness_ratio : float
        Largest thickness over the chord.

    Returns
    -------
    ndarray (...,)
    """
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 0.0, 1.0)
    a0, a1, a2, a3, a4 = _SHAPE
    polynomial = a0 * np.sqrt(xi) + xi * (a1 + xi * (a2 + xi * (a3 + xi * a4)))
    return np.asarray(5.0 * thickness_ratio * polynomial)


def four_digit_slope(chord_fraction: ArrayLike, thickness_ratio: float) -> FloatArray:
    """Slope of the upper surface, the derivative of `four_digit_half_thickness` (...,)."""
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 1e-6, 1.0)
    a0, a1, a2, a3, a4 = _SHAPE
    derivative = 0.5 * a0 / np.sqrt(xi) + a1 + xi * (2.0 * a2 + xi * (3.0 * a3 + 4.0 * xi * a4))
    return np.asarray(5.0 * thickness_ratio * derivative)


_Numbers = TypeVar("_Numbers", float, FloatArray)
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Thickness = Annotated[float, Field(gt=0.0, lt=0.1, description="m")]
PoissonRatio = Annotated[float, Field(ge=0.0, lt=0.5)]
ShearRatio = Annotated[float, Field(gt=0.0, le=1.0)]
Density = Annotated[float, Field(ge=0.0, le=3e4, description="kg/m^3")]
Spring = Annotated[float, Field(gt=0.0, le=1e15)]


class Planform(Part):
    """Straight-tapered half-wing; the chord line `straight_chord_line` is the spanwise axis."""

    semi_span: float = Field(gt=0.05, lt=60.0, description="m")
    root_chord: float = Field(gt=0.01, lt=15.0, description="m")
    tip_chord: float = Field(gt=0.01, lt=15.0, description="m")
    straight_chord_line: Fraction

    def chord(self, station: _Numbers) -> _Numbers:
        """Chord (...,) [m] at fractions (...,) of the semi-span."""
        return self.root_chord + (self.tip_chord - self.root_chord) * station


class Airfoil(Part):
    """Symmetric four-digit section."""

    thickness_ratio: float = Field(ge=0.02, le=0.4)


class SkinBand(Part):
    """Young's modulus [Pa] of the skin from the previous band's end to `end`, a fraction of the span."""

    end: Fraction
    young_modulus: Modulus


class SkinStation(Part):
    """Young's modulus [Pa] of the skin at a fraction of the span."""

    station: Fraction
    young_modulus: Modulus


class Skin(Part):
    """Shell of the wing; orthotropic with equal moduli, the shear moduli as ratios to Young's modulus.

    Young's modulus along the span is given either in `bands`, each of one modulus, or at `stations`, between
    which it runs straight.
    """

    thickness: Thickness
    density: Density
    poisson_ratio: PoissonRatio
    in_plane_shear_ratio: ShearRatio
    transverse_shear_ratio: ShearRatio
    closed_leading_edge: bool = True
    bands: tuple[SkinBand, ...] = ()
    stations: tuple[SkinStation, ...] = ()

    def faults(self) -> Iterator[Fault]:
        """Yield other than one course of the modulus."""
        both = bool(self.bands) == bool(self.stations)
        yield both, "Young's modulus must be given either in bands or at stations"
        places = [place.station for place in self.stations]
        off = places and (places != sorted({*places}) or (places[0], places[-1]) != (0.0, 1.0))
        yield off, f"the stations must rise from 0 to 1, but are {places}"
        ends = [band.end for band in self.bands]
        off = ends and ([0.0, *ends] != sorted({0.0, *ends}) or ends[-1] != 1.0)
        yield off, f"the ends of the bands must rise from above 0 to 1, but are {ends}"

    def young_modulus(self, station: FloatArray) -> FloatArray:
        """Young's modulus (...,) [Pa] at fractions of the span (...,)."""
        if self.stations:
            places = [place.station for place in self.stations]
            return np.asarray(np.interp(station, places, [place.young_modulus for place in self.stations]))
        moduli = np.array([band.young_modulus for band in self.bands])
        return moduli[np.searchsorted([band.end for band in self.bands], station)]


class Wall(Part):
    """A wall between the skins."""

    thickness: Thickness
    young_modulus: Modulus
    poisson_ratio: PoissonRatio
    density: Density


class Web(Wall):
    """Spanwise web at a chordwise place; the first and the last close the box."""

    chord: Fraction
    shear_modulus: Modulus


class Rib(Wall):
    """Rib at a fraction of the span, isotropic, over the whole height and width of the box."""

    station: Fraction


class Rod(Part):
    """Solid round rod at mid-height of a web, from the root to `reach`, a fraction of the span.

    Its flapwise bending stiffness and its mass are spread over the cells of that web.
    """

    web: int = Field(ge=0)
    reach: float = Field(gt=0.0, le=1.0)
    diameter: Thickness
    young_modulus: Modulus
    density: Density

    @property
    def bending_stiffness(self) -> float:
        """E I [N m^2]."""
        return self.young_modulus * math.pi * self.diameter**4 / 64.0

    @property
    def mass_per_length(self) -> float:
        """Mass per length [kg/m]."""
        return self.density * math.pi * self.diameter**2 / 4.0


class AddedDensity(Part):
    """Density [kg/m^3] added to everything between two fractions of the span (glue, paint, wiring)."""

    start: Fraction
    end: Fraction
    density: Density


class Root(Part):
    """Springs that carry the rigid root rib; its other motions are held."""

    transverse_spring: Spring = Field(description="N/m")
    flap_spring: Spring = Field(description="N m/rad")
    yaw_spring: Spring = Field(description="N m/rad")


class PointMassPlace(Part):
    """Where a point mass of a kind sits; its mass is `masses.<kind>` until calibrated."""

    kind: Literal["servo", "pitot"]
    station: Fraction
    chord: Fraction


class Masses(Part):
    """Nominal masses [kg] of one servo and of the pitot tube."""

    servo: float = Field(ge=0.0, lt=1e3)
    pitot: float = Field(ge=0.0, lt=1e3)


class Gauges(Part):
    """Strain gauges on the upper skin, along the span.

    Positions are (distance from the root [m], chord fraction); a gauge reads the strain averaged over a
    patch of `averaging_chordwise` by `averaging_spanwise` [m], on the outer surface of the skin or in the
    middle of its thickness, where the bending of the thin skin between its supports does not show.
    """

    averaging_chordwise: float = Field(ge=0.0, lt=1.0, description="m")
    averaging_spanwise: float = Field(default=0.0, ge=0.0, lt=1.0, description="m")
    surface: Literal["outer", "middle"] = "outer"
    positions: tuple[tuple[float, float], ...] = Field(min_length=1)


class Defect(Part):
    """Region of the upper skin that may lose stiffness: distances from the root [m], chord fractions.

    Its name is that of its loss everywhere: in states, FMU variables and scenarios. Without one it is z and
    its number, from 1.
    """

    name: str | None = Field(default=None, max_length=32, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    span_start: float = Field(ge=0.0)
    span_end: float = Field(gt=0.0)
    chord_start: Fraction
    chord_end: Fraction


class Lift(Part):
    """Net load of a level turn, linear in the load factor.

    `force` [N] and `forward_force` [N] are the totals on the half-wing at `load_factor`. The lift is weighted
    along the chord by (1 - xi)^`chordwise_exponent`, xi the chord fraction. With `inertia_relief` the weight
    of the structure and of the nominal point masses, times the load factor, acts against the lift where it
    lies; `force` stays the net total.
    """

    distribution: Literal["schrenk", "lifting_line"]
    force: float = Field(gt=0.0, lt=1e6)
    forward_force: float = Field(ge=0.0, lt=1e6)
    load_factor: float = Field(gt=0.0, lt=20.0)
    chordwise_exponent: float = Field(default=1.0, ge=0.0, le=10.0)
    inertia_relief: bool = False


class TipLoad(Part):
    """Place of the static test load: distance from the tip [m] and chord fraction."""

    distance_from_tip: float = Field(ge=0.0)
    chord: Fraction


class MeshSettings(Part):
    """Largest cell: along the span [m] and along the chord (fraction), and beside the edges of defects [m].

    All are divided by `refinement`. Without `edge_size` the cells beside the edges are like the others.
    """

    span_size: float = Field(gt=1e-3, lt=10.0)
    chord_size: float = Field(gt=0.005, le=1.0)
    edge_size: float | None = Field(default=None, gt=1e-3, lt=1.0)
    refinement: float = Field(default=1.0, ge=0.25, le=8.0)


def schrenk(planform: Planform, station: ArrayLike) -> FloatArray:
    """Mean of the chord and of the elliptic distribution of the same area.

    Parameters
    ----------
    planform : Planform
        The half-wing.
    station : array_like (...,)
        Fractions of the semi-span.

    Returns
    -------
    ndarray (...,)
        Lift per length over total lift [1/m].
    """
    eta = np.asarray(station, dtype=float)
    trapezoid = 2.0 * planform.chord(eta) / (planform.root_chord + planform.tip_chord)
    ellipse = 4.0 / np.pi * np.sqrt(np.clip(1.0 - eta**2, 0.0, None))
    return np.asarray(0.5 * (trapezoid + ellipse) / planform.semi_span)


def lifting_line(planform: Planform, station: ArrayLike, terms: int = 40) -> FloatArray:
    """Prandtl's lifting line solved by Glauert's sine series, the lift slope of the section 2 pi.

    With y = -(b/2) cos(theta), the circulation is 2 b V sum A_n sin(n theta), n odd; collocation at
    `terms` angles solves sum A_n sin(n theta) (n mu + sin theta) = mu alpha sin theta,
    mu = c a0 / (4 b). The wing is untwisted and symmetric; `terms` is the number of odd harmonics, the rest
    as of `schrenk`.
    """
    theta = (np.arange(terms) + 1.0) * np.pi / (2.0 * terms)  # half-wing, tip excluded, root included
    order = 2.0 * np.arange(terms) + 1.0
    mu = (planform.chord(np.cos(theta)) * 2.0 * np.pi / (8.0 * planform.semi_span))[:, None]
    sine = np.sin(np.outer(theta, order))
    amplitude = np.linalg.solve(sine * (order * mu + np.sin(theta)[:, None]), mu[:, 0] * np.sin(theta))
    # Integral of sum A_n sin(n theta) over the half-wing: only n = 1 contributes, A_1 pi/4 * semi-span.
    scale = 1.0 / (amplitude[0] * np.pi / 4.0 * planform.semi_span)
    angle = np.arccos(np.clip(np.asarray(station, dtype=float), 0.0, 1.0))
    return np.asarray(scale * np.tensordot(np.sin(angle[..., None] * order), amplitude, axes=1))


DISTRIBUTIONS = {"schrenk": schrenk, "lifting_line": lifting_line}
"""Lift distributions by their name in a design."""
