"""The reduced model of a structure, as a wing is one: everything that is evaluated online, with NumPy alone.

NumPy and relative imports only: this file is copied into the FMU. The equations are in
`docs/reduced_model.md`, the offline part is `fe.reduction.reduced_basis`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np
import numpy.typing as npt
from numpy.linalg import solve

from .arrays import FloatArray, IntArray
from .errors import OutsideModelError
from .reduced_arrays import OnlineArrays, ReducedArrays
from .state import GivenLosses

Values = Mapping[str, float] | FloatArray
"""What is chosen: by name, or all of it (V,) in the order of `ReducedArrays.chosen`."""


def dense_sum(coefficients: FloatArray, terms: FloatArray) -> FloatArray:
    """Return the sum of coefficients (T,) times dense terms (T, n, m)."""
    return np.asarray((coefficients @ terms.reshape(len(terms), -1)).reshape(terms.shape[1:]))


def lowest_modes(stiffness: FloatArray, mass: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest frequencies (M,) [Hz] and mass-normalised shapes (n, M) of dense matrices (n, n)."""
    # M x = K x / omega^2: the stiffness is well conditioned in a basis of modes, the mass is not, and the low
    # modes are the largest eigenvalues, which keep all their digits.
    to_standard = np.linalg.inv(np.linalg.cholesky(stiffness))
    inverse_square, vectors = np.linalg.eigh(to_standard @ mass @ to_standard.T)
    root = np.sqrt(inverse_square[::-1][:count])
    return 1.0 / (2.0 * np.pi * root), to_standard.T @ vectors[:, ::-1][:, :count] / root


@dataclass(frozen=True, slots=True)
class StaticResponse:
    """Static response of a structure.

    Attributes
    ----------
    strain : (G,) ndarray
        Gauge strains, dimensionless; of a wing positive where the upper skin is compressed.
    displacement : (D,) ndarray
        Displacement outputs [m]; of a wing that of the tip, upwards.
    strain_error_bound, displacement_error_bound : float
        Certified: no gauge, and no displacement output, of the full model differs by more than this.
    coordinates : (N,) ndarray
        Coefficients of the static basis vectors, from which a field can be reconstructed.
    """

    strain: FloatArray
    displacement: FloatArray
    strain_error_bound: float
    displacement_error_bound: float
    coordinates: FloatArray

    @property
    def bounded(self) -> tuple[tuple[FloatArray, float], ...]:
        """Strains and displacements, each with their bound."""
        return (self.strain, self.strain_error_bound), (self.displacement, self.displacement_error_bound)


@dataclass(frozen=True, slots=True)
class Modes:
    """First undamped eigenmodes of a structure, in ascending frequency, Kapteyn et al. 2021, eq. (16).

    Attributes
    ----------
    frequency : (M,) ndarray
        Natural frequencies [Hz].
    shape : (Nm, M) ndarray
        Coefficients of the modal basis vectors; mass-normalised, the last output of a mode is positive.
    output : (O, M) ndarray
        Gauges, displacements and accelerations (as displacements) per unit of modal coordinate.
    participation : (L, M) ndarray
        Modal force of each load [N kg^-1/2].
    mass : (Nm, Nm) ndarray
        The mass in the modal basis [kg].
    followed : tuple of int
        The mode that is most like each of the shapes that are followed; of a wing those of the first and
        second flapwise bending, found by their shape, never by their rank.
    followed_mac : tuple of float
        Modal assurance criterion (mass-weighted) of these modes against the shapes.
    """

    frequency: FloatArray
    shape: FloatArray
    output: FloatArray
    participation: FloatArray
    mass: FloatArray
    followed: tuple[int, ...]
    followed_mac: tuple[float, ...]


class ReducedState:
    """A reduced structure in one state, as `fe.runtime.transient` takes it, in Nm + N coordinates.

    These are those of the modal and of the static basis; a motion is in the one and what modes leave out in
    the other, so that nothing is solved in both.
    """

    laws = None
    holding = None
    on_modes: frozenset[str] = frozenset()
    components = np.zeros((2, 0, 0))

    def __init__(self, model: "ReducedModel", vector: FloatArray) -> None:
        self.modes = modes = model.modes(vector)
        self.acting, self.mode_count = model.load_coefficients, model.mode_count
        self.loads, self.outputs, self.accelerations = model.rows
        theta = model.stiffness_coefficients(vector)
        cross = dense_sum(model.mass_coefficients(vector), model.cross_mass)
        size, moving = len(model.static_load.T), len(modes.shape)
        self.shapes = np.pad(modes.shape, ((0, size), (0, 0)))
        self._static = dense_sum(theta, model.static_stiffness)
        self.answers = self.static(self.loads)
        self.mass = np.pad(modes.mass, (0, size))
        self.mass[:moving, moving:], self.mass[moving:, :moving] = cross, cross.T
        self.stiffness = np.pad(dense_sum(theta, model.modal_stiffness), (0, size))
        self.to_modes = self.shapes.T @ self.mass

    def static(self, loads: FloatArray) -> FloatArray:
        """Return the displacements K^-1 f of loads (Nm + N,) or (Nm + N, k), in the static basis."""
        moving = len(self.loads) - len(self._static)
        return np.concatenate((np.zeros_like(loads[:moving]), solve(self._static, loads[moving:])))


@dataclass(frozen=True, repr=False)
class ReducedModel(ReducedArrays):
    """Reduced structure: `ReducedArrays`, evaluated.

    `fe.reduction.model_cache` makes one, `load` and `from_bytes` read one. Values are given by the names of
    `chosen`, as a mapping or as keywords, the losses also together as `stiffness_loss`; what is left out is
    nominal, and healthy.
    """

    @cached_property
    def _online(self) -> OnlineArrays:
        return OnlineArrays(self)

    @cached_property
    def _places(self) -> list[IntArray]:
        """Places (2, T) and (2, L) of the factors of stiffness terms and loads: one, values, what is kept."""
        controls = len(self.chosen) - len(self.controls)
        of_load, of_stiffness = (controls, controls - len(self.masses)), (0, len(self.chosen))
        tables = ((self.stiffness_factors, of_stiffness), (self.load_factors, of_load))
        return [np.where(factors > 0, factors + offsets, 0).T for factors, offsets in tables]

    @cached_property
    def validity(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value for which the model was made, by name (SI units)."""
        return dict(zip(self.chosen, map(tuple, self.validity_box.tolist()), strict=True))

    def vector(
        self, values: Values | None = None, stiffness_loss: GivenLosses = (), **named: float
    ) -> FloatArray:
        """Return all that can be chosen, (V,), of the values that are given; the others are nominal.

        Parameters
        ----------
        values : mapping of str to float, or (V,) ndarray, optional
            By name; an array is returned as it is.
        stiffness_loss : mapping or iterable of float
            Losses of the damage regions together, as of `fe.runtime.state.losses_of`.
        **named : float
            More values by name.

        Raises
        ------
        OutsideModelError
            If a name is unknown.
        InvalidStateError
            If the losses are not those of the regions.
        """
        if isinstance(values, np.ndarray):
            return values
        found, first = self.nominal.copy(), len(self.parameters)
        found[first : first + len(self.regions)] = self.losses(stiffness_loss)
        for name, value in {**(values or {}), **named}.items():
            found[self._place(name)] = value
        return found

    def vectors(self, columns: Mapping[str, npt.ArrayLike]) -> FloatArray:
        """Return all that can be chosen, (B, V), of columns (B,) or numbers by name; the others are nominal.

        Raises
        ------
        OutsideModelError
            If a name is unknown.
        """
        arrays = np.broadcast_arrays(np.zeros(1), *(np.asarray(column) for column in columns.values()))
        found = np.tile(self.nominal, (len(arrays[0]), 1))
        for name, array in zip(columns, arrays[1:], strict=True):
            found[:, self._place(name)] = array
        return found

    def _place(self, name: str) -> int:
        if name not in self.chosen:
            raise OutsideModelError(
                f"The structure {self.name} has nothing named {name!r} to be chosen; it has "
                f"{', '.join(self.chosen)}."
            )
        return self.chosen.index(name)

    def check_validity(self, values: Sequence[float]) -> None:
        """Check that each of the values (V,) lies in the validity box; also refuses NaN and infinity.

        Raises
        ------
        OutsideModelError
            If one lies outside; the sentence names it and its range.
        """
        for (name, (low, high)), value in zip(self.validity.items(), values, strict=True):
            if not low <= value <= high:
                raise OutsideModelError(
                    f"{name} must lie between {low:g} and {high:g}, the range of the reduced model of "
                    f"{self.name}, but is {float(value)!r}; give a value inside, or reduce it for a wider "
                    "range."
                )

    def _coefficients(self, vectors: FloatArray, number: int) -> FloatArray:
        first = len(self.parameters)
        kept = 1.0 - vectors[..., first : first + len(self.regions)]
        known = np.concatenate((np.ones_like(vectors[..., :1]), vectors, kept), axis=-1)
        one, other = self._places[number]
        return np.asarray(known[..., one] * known[..., other])

    @cached_property
    def rows(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Loads (n, L), static outputs (O', n) and accelerations (A, n) in the coordinates of `at`."""
        static, modal = self.static_output, self.modal_output
        loads = np.concatenate((self.modal_load, self.static_load), axis=1).T
        outputs = np.concatenate((modal[: len(static)], static), axis=1)
        return loads, outputs, np.pad(modal[len(static) :], ((0, 0), (0, static.shape[1])))

    def at(self, vector: FloatArray) -> ReducedState:
        """Return the structure in motion at values (V,) of all that can be chosen.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        return ReducedState(self, vector)

    def stiffness_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., T) of the stiffness terms at values (..., V)."""
        return self._coefficients(vectors, 0)

    def load_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., L) of the loads at values (..., V)."""
        return self._coefficients(vectors, 1)

    def mass_coefficients(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (1 + P,) of the mass terms at values (V,)."""
        start = len(self.parameters) + len(self.regions)
        return np.concatenate(([1.0], vector[start : start + len(self.masses)]))

    def static_response(
        self,
        values: Values | None = None,
        stiffness_loss: GivenLosses = (),
        *,
        load: FloatArray | None = None,
        **named: float,
    ) -> StaticResponse:
        """Return the static response with its certified error bounds, Kapteyn et al. 2021, eqs. (13), (15).

        Parameters
        ----------
        values, stiffness_loss, **named
            As of `vector`.
        load : (L,) ndarray, optional
            Coefficients of the loads in the place of those of the controls.

        Raises
        ------
        OutsideModelError
            If a value is unknown, lies outside the validity box or is not finite.
        """
        vector = self.vector(values, stiffness_loss, **named)
        chosen = vector.tolist()
        self.check_validity(chosen)
        first, gauges = len(self.parameters), len(self.gauges)
        loss = tuple(chosen[first : first + len(self.regions)])
        acting = self.load_coefficients(vector) if load is None else load
        coordinates, output, errors = self._online.solution(self.stiffness_coefficients(vector), acting, loss)
        strain, displacement, bound = output[:gauges], output[gauges:], errors.tolist()
        return StaticResponse(
            strain,
            displacement,
            max(bound[:gauges], default=0.0) + self.rounding_allowance * sqrt(strain @ strain),
            max(bound[gauges:], default=0.0) + self.rounding_allowance * sqrt(displacement @ displacement),
            coordinates,
        )

    def static_outputs(self, vectors: FloatArray) -> FloatArray:
        """Return gauges and displacements (B, O') at many values (B, V) at once.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        low, high = self.validity_box.T
        bad = np.flatnonzero(~((vectors >= low) & (vectors <= high)).all(axis=1))
        if bad.size:
            self.check_validity(vectors[bad[0]].tolist())
        stiffness = self.stiffness_coefficients(vectors) @ self._online.stiffness
        load = self.load_coefficients(vectors) @ self.static_load
        coordinates = solve(stiffness.reshape(-1, *self._online.square), load[:, :, np.newaxis])[:, :, 0]
        return np.asarray(coordinates @ self.static_output.T)

    def tip_stiffness(self, young_modulus_factor: float, stiffness_loss: GivenLosses = ()) -> float:
        """Return the tip stiffness of a wing [N/m]: the tip force over the displacement of its point.

        Kapteyn et al. 2021, eq. (14), where it is a straight line in e. Errors as of `static_response`.
        """
        vector = self.vector(stiffness_loss=stiffness_loss, young_modulus_factor=young_modulus_factor)
        tip = np.array((0.0, 1.0))
        return float(1.0 / (self.static_load[1] @ self.static_response(vector, load=tip).coordinates))

    def modes(self, values: Values | None = None, stiffness_loss: GivenLosses = (), **named: float) -> Modes:
        """Return the first undamped modes, Kapteyn et al. 2021, eq. (16).

        Parameters and errors are those of `static_response`.
        """
        vector = self.vector(values, stiffness_loss, **named)
        self.check_validity(vector.tolist())
        stiffness = dense_sum(self.stiffness_coefficients(vector), self.modal_stiffness)
        mass = dense_sum(self.mass_coefficients(vector), self.modal_mass)
        frequency, shape = lowest_modes(stiffness, mass, self.mode_count)
        shape = shape * np.where(self.modal_output[-1] @ shape < 0.0, -1.0, 1.0)
        reference = self.followed_shapes @ mass
        size = np.sum(reference * self.followed_shapes, axis=1)[:, np.newaxis]
        assurance = (reference @ shape) ** 2 / size
        return Modes(
            frequency=frequency,
            shape=shape,
            output=self.modal_output @ shape,
            participation=self.modal_load @ shape,
            mass=mass,
            followed=tuple(assurance.argmax(axis=1).tolist()),
            followed_mac=tuple(assurance.max(axis=1, initial=0.0).tolist()),
        )
