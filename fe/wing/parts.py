"""The parts of a wing design: the sections of its TOML file, in SI units, each checked on its own.

This module also has the shape of the section, of the symmetric four-digit family of NACA Report 460
(Jacobs, Ward and Pinkerton, 1933), and the distribution of lift along the span of a symmetrically
loaded wing, as a function that integrates to one over the half-wing.

References
----------
O. Schrenk, "A simple approximation method for obtaining the spanwise lift distribution", NACA TM
948 (1940). H. Glauert, "The Elements of Aerofoil and Airscrew Theory" (1926), chapter XI.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from fe.runtime.arrays import FloatArray
from fe.structure.tables import DesignSection, Modulus
from reporting.formats.toml_file import Check

_FOUR_DIGIT_COEFFICIENTS = (0.2969, -0.1260, -0.3516, 0.2843, -0.1015)


def four_digit_half_thickness(chord_fraction: ArrayLike, thickness_ratio: float) -> FloatArray:
    """Return the half thickness (...,) of a symmetric four-digit section over the chord.

    Parameters
    ----------
    chord_fraction : array_like (...,)
        Distance from the leading edge over the chord, clipped to 0..1.
    thickness_ratio : float
        Largest thickness over the chord.
    """
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 0.0, 1.0)
    a0, a1, a2, a3, a4 = _FOUR_DIGIT_COEFFICIENTS
    cubic = a1 + xi * (a2 + xi * (a3 + xi * a4))
    polynomial = a0 * np.sqrt(xi) + xi * cubic
    return np.asarray(5.0 * thickness_ratio * polynomial)


def four_digit_slope(chord_fraction: ArrayLike, thickness_ratio: float) -> FloatArray:
    """Return the slope of the upper surface, the derivative of `four_digit_half_thickness`."""
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 1e-6, 1.0)
    a0, a1, a2, a3, a4 = _FOUR_DIGIT_COEFFICIENTS
    slope_of_root = 0.5 * a0 / np.sqrt(xi)
    quadratic = 2.0 * a2 + xi * (3.0 * a3 + 4.0 * xi * a4)
    derivative = slope_of_root + a1 + xi * quadratic
    return np.asarray(5.0 * thickness_ratio * derivative)


_Numbers = TypeVar("_Numbers", float, FloatArray)
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Thickness = Annotated[float, Field(gt=0.0, lt=0.1)]
PoissonRatio = Annotated[float, Field(ge=0.0, lt=0.5)]
ShearRatio = Annotated[float, Field(gt=0.0, le=1.0)]
Density = Annotated[float, Field(ge=0.0, le=3e4)]
Spring = Annotated[float, Field(gt=0.0, le=1e15)]


class Planform(DesignSection):
    """Straight-tapered half-wing; the chord line `straight_chord_line` is the spanwise axis."""

    semi_span: float = Field(gt=0.05, lt=60.0)
    """Length of the half-wing [m]."""
    root_chord: float = Field(gt=0.01, lt=15.0)
    """Chord at the root [m]."""
    tip_chord: float = Field(gt=0.01, lt=15.0)
    """Chord at the tip [m]."""
    straight_chord_line: Fraction
    """Fraction of the chord whose line is the spanwise axis [1]."""

    def chord(self, station: _Numbers) -> _Numbers:
        """Return the chord (...,) [m] at fractions (...,) of the semi-span."""
        taper = self.tip_chord - self.root_chord
        return self.root_chord + taper * station


class Airfoil(DesignSection):
    """Symmetric four-digit section."""

    thickness_ratio: float = Field(ge=0.02, le=0.4)
    """Largest thickness over the chord [1]."""


class SkinBand(DesignSection):
    """Young's modulus [Pa] of the skin from the previous band's end to `end`, in spans."""

    end: Fraction
    """End of the band, as a fraction of the span [1]."""
    young_modulus: Modulus
    """Young's modulus of the skin from the previous band's end to this one [Pa]."""


class SkinStation(DesignSection):
    """Young's modulus [Pa] of the skin at a fraction of the span."""

    station: Fraction
    """Place, as a fraction of the span [1]."""
    young_modulus: Modulus
    """Young's modulus of the skin at this place [Pa]."""


class Skin(DesignSection):
    """Shell of the wing, orthotropic with equal moduli; shear moduli are ratios to Young's modulus.

    Young's modulus along the span is given either in `bands`, each of one modulus, or at
    `stations`, between which it is linear.
    """

    thickness: Thickness
    """Thickness [m]."""
    density: Density
    """Density [kg/m^3]."""
    poisson_ratio: PoissonRatio
    """Poisson's ratio [1]."""
    in_plane_shear_ratio: ShearRatio
    """In-plane shear modulus over Young's modulus [1]."""
    transverse_shear_ratio: ShearRatio
    """Transverse shear modulus over Young's modulus [1]."""
    closed_leading_edge: bool = True
    """Whether the skin closes the leading edge in front of the box."""
    bands: tuple[SkinBand, ...] = ()
    """Bands along the span, each of one Young's modulus."""
    stations: tuple[SkinStation, ...] = ()
    """Places along the span, between which Young's modulus is linear."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks of Young's modulus along the span."""
        has_both_or_none = bool(self.bands) == bool(self.stations)
        yield has_both_or_none, "Young's modulus must be given either in bands or at stations"
        stations = [place.station for place in self.stations]
        yield (
            bool(stations) and not _rises_from_0_to_1(stations),
            f"the stations must rise from 0 to 1, but are {stations}",
        )
        ends = [band.end for band in self.bands]
        yield (
            bool(ends) and not _rises_from_0_to_1([0.0, *ends]),
            f"the ends of the bands must rise from above 0 to 1, but are {ends}",
        )

    def young_modulus(self, station: FloatArray) -> FloatArray:
        """Return Young's modulus (...,) [Pa] at fractions of the span (...,)."""
        if self.stations:
            stations = [place.station for place in self.stations]
            moduli = [place.young_modulus for place in self.stations]
            return np.asarray(np.interp(station, stations, moduli))
        ends = [band.end for band in self.bands]
        band_moduli = np.array([band.young_modulus for band in self.bands])
        return band_moduli[np.searchsorted(ends, station)]


def _rises_from_0_to_1(fractions: Sequence[float]) -> bool:
    """Return whether fractions begin at 0, rise strictly, and end at 1."""
    is_rising = list(fractions) == sorted({*fractions})
    return is_rising and fractions[0] == 0.0 and fractions[-1] == 1.0


class Wall(DesignSection):
    """A wall between the skins."""

    thickness: Thickness
    """Thickness [m]."""
    young_modulus: Modulus
    """Young's modulus [Pa]."""
    poisson_ratio: PoissonRatio
    """Poisson's ratio [1]."""
    density: Density
    """Density [kg/m^3]."""


class Web(Wall):
    """Spanwise web at a chordwise place; the first and the last close the box."""

    chord: Fraction
    """Place, as a fraction of the chord [1]."""
    shear_modulus: Modulus
    """Shear modulus [Pa]."""


class Rib(Wall):
    """Rib at a fraction of the span, isotropic, over the whole height and width of the box."""

    station: Fraction
    """Place, as a fraction of the span [1]."""


class Rod(DesignSection):
    """Solid round rod at mid-height of a web, from the root to `reach`, a fraction of the span.

    Its flapwise bending stiffness and its mass are distributed over the cells of that web.
    """

    web: int = Field(ge=0)
    """Number of the web in which the rod lies, counted from 0."""
    reach: float = Field(gt=0.0, le=1.0)
    """End of the rod, as a fraction of the span [1]."""
    diameter: Thickness
    """Diameter [m]."""
    young_modulus: Modulus
    """Young's modulus [Pa]."""
    density: Density
    """Density [kg/m^3]."""

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness E I [N m^2]."""
        return self.young_modulus * math.pi * self.diameter**4 / 64.0

    @property
    def mass_per_length(self) -> float:
        """Mass per length [kg/m]."""
        return self.density * math.pi * self.diameter**2 / 4.0


class AddedDensity(DesignSection):
    """Density [kg/m^3] of glue, paint or wiring, added between two fractions of the span."""

    start: Fraction
    """Start, as a fraction of the span [1]."""
    end: Fraction
    """End, as a fraction of the span [1]."""
    density: Density
    """Density that is added [kg/m^3]."""


class Root(DesignSection):
    """Springs that carry the rigid root rib; its other motions are held."""

    transverse_spring: Spring
    """Stiffness against displacement [N/m]."""
    flap_spring: Spring
    """Stiffness against rotation in bending [N m/rad]."""
    yaw_spring: Spring
    """Stiffness against rotation in the plane of the wing [N m/rad]."""


class PointMassPlace(DesignSection):
    """Location of a point mass of a kind; its mass is `masses.<kind>` until it is calibrated."""

    kind: Literal["servo", "pitot"]
    """What the mass is."""
    station: Fraction
    """Place, as a fraction of the span [1]."""
    chord: Fraction
    """Place, as a fraction of the chord [1]."""


class Masses(DesignSection):
    """Nominal masses [kg] of one servo and of the pitot tube."""

    servo: float = Field(ge=0.0, lt=1e3)
    """Mass of one servo [kg]."""
    pitot: float = Field(ge=0.0, lt=1e3)
    """Mass of the pitot tube [kg]."""


class Gauges(DesignSection):
    """Strain gauges on the upper skin, along the span.

    Positions are (distance from the root [m], chord fraction). A gauge reads the strain averaged
    over a rectangle of `averaging_chordwise` by `averaging_spanwise` [m], on the outer surface of
    the skin, or in the middle of its thickness, where the bending of the thin skin between its
    supports does not show.
    """

    averaging_chordwise: float = Field(ge=0.0, lt=1.0)
    """Width over which a gauge averages, along the chord [m]."""
    averaging_spanwise: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Length over which a gauge averages, along the span [m]."""
    surface: Literal["outer", "middle"] = "outer"
    """Whether gauges read the strain of the outer surface, or of the middle of the skin."""
    positions: tuple[tuple[float, float], ...] = Field(min_length=1)
    """Distance from the root and fraction of the chord of each gauge [m and 1]."""


class Defect(DesignSection):
    """Region of the upper skin that may lose stiffness, between distances and chord fractions.

    Its name is that of its loss everywhere: in states, FMU variables and scenarios. By default it
    is z and the region's number, counted from 1.
    """

    name: str | None = Field(default=None, max_length=32, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    """Name of the region; by default z and its number, counted from 1."""
    span_start: float = Field(ge=0.0)
    """Start, as a distance from the root [m]."""
    span_end: float = Field(gt=0.0)
    """End, as a distance from the root [m]."""
    chord_start: Fraction
    """Start, as a fraction of the chord [1]."""
    chord_end: Fraction
    """End, as a fraction of the chord [1]."""


class Lift(DesignSection):
    """Net load of a level turn, linear in the load factor.

    `force` [N] and `forward_force` [N] are the totals on the half-wing at `load_factor`. The lift
    is weighted along the chord by (1 - xi)^`chordwise_exponent`, where xi is the chord fraction.
    With `inertia_relief` the weight of the structure and of the nominal point masses, times the
    load factor, acts against the lift where the masses are; `force` stays the net total.
    """

    distribution: Literal["schrenk", "lifting_line"]
    """Method by which the lift is distributed along the span."""
    force: float = Field(gt=0.0, lt=1e6)
    """Lift of the half-wing at `load_factor` [N]."""
    forward_force: float = Field(ge=0.0, lt=1e6)
    """Force along the chord on the half-wing at `load_factor` [N]."""
    load_factor: float = Field(gt=0.0, lt=20.0)
    """Load factor at which the forces are given [1]."""
    chordwise_exponent: float = Field(default=1.0, ge=0.0, le=10.0)
    """Exponent p of the weight (1 - xi)^p of the lift along the chord [1]."""
    inertia_relief: bool = False
    """Whether the weight of structure and masses acts against the lift where they are; `force`
    stays the net total."""


class TipLoad(DesignSection):
    """Point of the static test load: distance from the tip [m] and chord fraction."""

    distance_from_tip: float = Field(ge=0.0)
    """Distance from the tip [m]."""
    chord: Fraction
    """Place, as a fraction of the chord [1]."""


class MeshSettings(DesignSection):
    """Largest cells: along the span [m], along the chord (fraction), beside edges of defects [m].

    All are divided by `refinement`. Without `edge_size` the cells beside the edges are like the
    others.
    """

    span_size: float = Field(gt=1e-3, lt=10.0)
    """Largest cell along the span [m]."""
    chord_size: float = Field(gt=0.005, le=1.0)
    """Largest cell along the chord, as a fraction of it [1]."""
    edge_size: float | None = Field(default=None, gt=1e-3, lt=1.0)
    """Largest cell beside edges of damage regions; by default as elsewhere [m]."""
    refinement: float = Field(default=1.0, ge=0.25, le=8.0)
    """Number by which all sizes are divided [1]."""


def schrenk(planform: Planform, station: ArrayLike) -> FloatArray:
    """Return Schrenk's lift distribution: the mean of the chord and of an ellipse of equal area.

    Returns the lift per length over the total lift (...,) [1/m] at fractions (...,) of the semi-
    span.
    """
    eta = np.asarray(station, dtype=float)
    chord_sum = planform.root_chord + planform.tip_chord
    trapezoid = 2.0 * planform.chord(eta) / chord_sum
    circle = np.sqrt(np.clip(1.0 - eta**2, 0.0, None))
    ellipse = 4.0 / np.pi * circle
    return np.asarray(0.5 * (trapezoid + ellipse) / planform.semi_span)


def lifting_line(planform: Planform, station: ArrayLike, terms: int = 40) -> FloatArray:
    """Return the lift of Prandtl's lifting line, solved by Glauert's sine series (Glauert 1926).

    With y = -(b/2) cos(theta), the circulation is 2 b V sum A_n sin(n theta), n odd. Collocation at
    `terms` angles solves sum A_n sin(n theta) (n mu + sin theta) = mu alpha sin theta with
    mu = c a0 / (4 b) and the lift slope a0 = 2 pi. The wing is untwisted and symmetric.

    Parameters
    ----------
    station : array_like (...,)
        Fractions of the semi-span.
    terms : int
        Number of odd harmonics.

    Returns
    -------
    (...,) array
        Lift per length over total lift [1/m].
    """
    number = np.arange(terms)
    # collocation on the half-wing, without the tip, with the root
    theta = (number + 1.0) * np.pi / (2.0 * terms)
    n = 2.0 * number + 1.0
    chord = planform.chord(np.cos(theta))
    mu = chord * 2.0 * np.pi / (8.0 * planform.semi_span)
    sine_of_theta = np.sin(theta)
    harmonics = np.sin(np.outer(theta, n))
    induced = n * mu[:, np.newaxis]
    factors = induced + sine_of_theta[:, np.newaxis]
    right_hand_side = mu * sine_of_theta
    amplitude = np.linalg.solve(harmonics * factors, right_hand_side)
    # Only n = 1 contributes to the integral over the half-wing, A_1 pi/4 times the semi-span.
    integral = amplitude[0] * np.pi / 4.0 * planform.semi_span
    # the circulation at the stations
    fraction = np.clip(np.asarray(station, dtype=float), 0.0, 1.0)
    angle = np.arccos(fraction)[..., np.newaxis]
    harmonics_at_stations = np.sin(angle * n)
    circulation = np.tensordot(harmonics_at_stations, amplitude, axes=1)
    return np.asarray(1.0 / integral * circulation)


DISTRIBUTIONS = {"schrenk": schrenk, "lifting_line": lifting_line}
"""Lift distributions by their name in a design."""
