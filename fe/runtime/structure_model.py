"""The reduced model of a structure: everything that is evaluated online, with NumPy alone.

NumPy and relative imports only: this file is copied into the FMU. The equations are in
`docs/reduced_model.md`, the offline part is `fe.reduction.structure_basis`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, sqrt

import numpy as np
import numpy.typing as npt
from numpy.linalg import solve

from .errors import OutsideModelError
from .online import OnlineArrays
from .structure_arrays import StructureArrays

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StructureResponse:
    """Static response of a structure.

    Attributes
    ----------
    strain : (G,) ndarray
        Gauge strains, dimensionless, positive in tension.
    displacement : (D,) ndarray
        Displacement outputs [m].
    strain_error_bound, displacement_error_bound : float
        Certified: no gauge, and no displacement output, of the full model differs by more than this.
    coordinates : (N,) ndarray
        Coefficients of the static basis vectors.
    """

    strain: FloatArray
    displacement: FloatArray
    strain_error_bound: float
    displacement_error_bound: float
    coordinates: FloatArray


@dataclass(frozen=True, slots=True)
class StructureModes:
    """First undamped eigenmodes of a structure, in ascending frequency.

    Attributes
    ----------
    frequency : (M,) ndarray
        Natural frequencies [Hz].
    shape : (Nm, M) ndarray
        Coefficients of the modal basis vectors; mass-normalised, the largest output of a mode is positive.
    output : (O, M) ndarray
        Gauges, displacements and accelerations (as displacements) per unit of modal coordinate.
    participation : (L, M) ndarray
        Modal force of each load [N kg^-1/2].
    mass : (Nm, Nm) ndarray
        The mass in the modal basis [kg].
    """

    frequency: FloatArray
    shape: FloatArray
    output: FloatArray
    participation: FloatArray
    mass: FloatArray


@dataclass(frozen=True, repr=False)
class StructureModel(StructureArrays):
    """Reduced structure: `StructureArrays`, evaluated.

    `fe.reduction.structure_cache.reduced_structure` makes one, `load` and `from_bytes` read one. Values are
    given by the names of `chosen`; what is left out is nominal, and healthy.
    """

    _online: OnlineArrays = field(init=False, repr=False, compare=False)
    _limits: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_online", OnlineArrays(self))
        limits = tuple((float(low), float(high)) for low, high in self.validity_box)
        object.__setattr__(self, "_limits", limits)

    def __repr__(self) -> str:
        return (
            f"StructureModel(name={self.name!r}, design_hash={self.design_hash!r}, regions={self.regions}, "
            f"controls={self.controls}, gauges={len(self.gauges)}, static_basis={len(self.static_load.T)}, "
            f"modal_basis={len(self.modal_load.T)}, modes={self.mode_count})"
        )

    @property
    def validity(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value for which the model was made, by name (SI units)."""
        return dict(zip(self.chosen, self._limits, strict=True))

    def vector(self, values: Mapping[str, float]) -> FloatArray:
        """Return all that can be chosen, (V,), of the values that are given; the others are nominal.

        Raises
        ------
        OutsideModelError
            If a name is unknown.
        """
        found = self.nominal.copy()
        names = self.chosen
        for name, value in values.items():
            if name not in names:
                raise OutsideModelError(
                    f"The structure {self.name} has nothing named {name!r} to be chosen; it has "
                    f"{', '.join(names)}."
                )
            found[names.index(name)] = value
        return found

    def check_validity(self, values: Sequence[float]) -> None:
        """Check that each of the values (V,) lies in the validity box; also refuses NaN and infinity.

        Raises
        ------
        OutsideModelError
            If one lies outside; the sentence names it and its range.
        """
        for name, value, (low, high) in zip(self.chosen, values, self._limits, strict=True):
            if not (isfinite(value) and low <= value <= high):
                raise OutsideModelError(
                    f"{name} must lie between {low:g} and {high:g}, the range of the reduced model of "
                    f"{self.name}, but is {float(value)!r}; give a value inside, or widen the range in the "
                    "structure file."
                )

    def stiffness_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., T) of the stiffness terms at values (..., V)."""
        one, kept = len(self.parameters), len(self.parameters) + len(self.regions)
        unit = np.ones((*vectors.shape[:-1], 1))
        factor = np.concatenate((unit, vectors[..., :one]), axis=-1)
        left = np.concatenate((unit, 1.0 - vectors[..., one:kept]), axis=-1)
        return np.asarray(factor[..., self.stiffness_factors[:, 0]] * left[..., self.stiffness_factors[:, 1]])

    def load_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., L) of the loads at values (..., V)."""
        start = len(self.parameters) + len(self.regions)
        end = start + len(self.masses)
        unit = np.ones((*vectors.shape[:-1], 1))
        mass = np.concatenate((unit, vectors[..., start:end]), axis=-1)
        control = np.concatenate((unit, vectors[..., end:]), axis=-1)
        return np.asarray(control[..., self.load_factors[:, 0]] * mass[..., self.load_factors[:, 1]])

    def losses_in(self, vector: FloatArray) -> tuple[float, ...]:
        """Return the losses of the damage regions among values (V,)."""
        start = len(self.parameters)
        return tuple(vector[start : start + len(self.regions)].tolist())

    def static_response(
        self, values: Mapping[str, float] | FloatArray, load: FloatArray | None = None
    ) -> StructureResponse:
        """Return the static response with its certified error bounds, Kapteyn et al. 2021, eqs. (13), (15).

        Parameters
        ----------
        values : mapping of str to float, or (V,) ndarray
            By name, or all in the order of `chosen`.
        load : (L,) ndarray, optional
            Coefficients of the loads in the place of those of the controls.

        Raises
        ------
        OutsideModelError
            If a value is unknown, lies outside the validity box or is not finite.
        """
        vector = self.vector(values) if isinstance(values, Mapping) else values
        self.check_validity(vector.tolist())
        theta = self.stiffness_coefficients(vector)
        acting = self.load_coefficients(vector) if load is None else load
        found = self._online.solution(theta, acting, self.losses_in(vector))
        gauges, rounding = len(self.gauges), self.rounding_allowance
        strain, displacement = found.output[:gauges], found.output[gauges:]
        return StructureResponse(
            strain=strain,
            displacement=displacement,
            strain_error_bound=float(found.bound[:gauges].max(initial=0.0))
            + rounding * sqrt(strain @ strain),
            displacement_error_bound=float(found.bound[gauges:].max(initial=0.0))
            + rounding * sqrt(displacement @ displacement),
            coordinates=found.coordinates,
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

    def modes(self, values: Mapping[str, float] | FloatArray) -> StructureModes:
        """Return the first undamped modes, Kapteyn et al. 2021, eq. (16).

        Parameters and errors are those of `static_response`.
        """
        vector = self.vector(values) if isinstance(values, Mapping) else values
        self.check_validity(vector.tolist())
        stiffness = np.tensordot(self.stiffness_coefficients(vector), self.modal_stiffness, 1)
        mass = np.tensordot(self.mass_coefficients(vector), self.modal_mass, 1)
        # M x = K x / omega^2: the stiffness is well conditioned in this basis, the mass is not, and the low
        # modes are the largest eigenvalues, which keep all their digits.
        to_standard = np.linalg.inv(np.linalg.cholesky(stiffness))
        inverse_square, vectors = np.linalg.eigh(to_standard @ mass @ to_standard.T)
        inverse_square = inverse_square[::-1][: self.mode_count]
        shape = to_standard.T @ vectors[:, ::-1][:, : self.mode_count] / np.sqrt(inverse_square)
        output = self.modal_output @ shape
        largest = np.take_along_axis(output, np.abs(output).argmax(axis=0)[np.newaxis], axis=0)[0]
        shape = shape * np.where(largest < 0.0, -1.0, 1.0)
        return StructureModes(
            frequency=1.0 / (2.0 * np.pi * np.sqrt(inverse_square)),
            shape=shape,
            output=self.modal_output @ shape,
            participation=self.modal_load @ shape,
            mass=mass,
        )

    def mass_coefficients(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (1 + P,) of the mass terms at values (V,)."""
        start = len(self.parameters) + len(self.regions)
        return np.concatenate(([1.0], vector[start : start + len(self.masses)]))
