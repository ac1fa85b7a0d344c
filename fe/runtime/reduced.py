"""The reduced model of a structure: statics with error bounds, modes, and motion.

Everything here is evaluated online, with NumPy alone. The equations are in
`docs/explanation/reduced_model.md`; `fe.reduction.reduced_basis` makes reduced models. NumPy and
relative imports only: this file is copied into the FMU.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np
import numpy.typing as npt
from numpy.linalg import solve

from .arrays import FloatArray, IntArray, nan_where_masked
from .dense_matrices import dense_sum, lowest_modes
from .errors import OutsideModelError
from .reduced_arrays import CertifiedSolver, ReducedArrays
from .reduced_results import ReducedModes, ReducedResponse
from .state import TIP_FORCE, LossValues

InputValues = Mapping[str, float] | FloatArray
"""Values of a model's inputs: some by name, or all (V,) in the order of
`ReducedArrays.input_names`."""


class ReducedStructure:
    """A reduced structure with fixed inputs, as a `StructureInMotion` in Nm + N coordinates.

    The first Nm coordinates belong to the modal basis, the others to the static basis. The
    structure moves in the modal basis; the static basis represents displacements that the modes
    leave out, and is solved on its own.

    Parameters
    ----------
    vector : (V,) array
        Values of the inputs.
    """

    laws = None
    holding_load = None
    rigid_ports: frozenset[str] = frozenset()
    strain_component_rows = np.zeros((2, 0, 0))

    def __init__(self, model: "ReducedModel", vector: FloatArray) -> None:
        self.modes = model.modes(vector)
        self.mode_count = model.mode_count
        self.load_coefficients = model.load_coefficients
        self.unit_loads = model.unit_loads
        self.output_rows = model.output_rows
        self.acceleration_rows = model.acceleration_rows
        # sizes of the two bases
        static = len(model.static_load.T)
        modal = len(self.modes.shape)
        # statics
        theta = model.stiffness_coefficients(vector)
        self._static_stiffness = dense_sum(theta, model.static_stiffness)
        self.unit_responses = self.static(self.unit_loads)
        # mass and stiffness in both bases
        cross_mass = dense_sum(model.mass_coefficients(vector), model.cross_mass)
        self.mass = np.pad(self.modes.mass, (0, static))
        self.mass[:modal, modal:] = cross_mass
        self.mass[modal:, :modal] = cross_mass.T
        self.stiffness = np.pad(dense_sum(theta, model.modal_stiffness), (0, static))
        # modes
        self.mode_shapes = np.pad(self.modes.shape, ((0, static), (0, 0)))
        self.modal_projection = self.mode_shapes.T @ self.mass

    def static(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 f for loads f (Nm + N,) or (Nm + N, k), in the static basis."""
        modal = len(loads) - len(self._static_stiffness)
        static_part = solve(self._static_stiffness, loads[modal:])
        return np.concatenate((np.zeros_like(loads[:modal]), static_part))


@dataclass(frozen=True, repr=False)
class ReducedModel(ReducedArrays):
    """The reduced model of a structure: `ReducedArrays` with the methods that evaluate them.

    `fe.reduction.model_cache` makes one; `load` and `from_bytes` read one. Inputs are given by
    name, as a mapping or as keywords, and the losses also together as `stiffness_loss`. An input
    that is left out has its nominal value, and a region without a loss is healthy.
    """

    @cached_property
    def _solver(self) -> CertifiedSolver:
        return CertifiedSolver(self)

    # ------------------------------------------------------------ inputs

    @cached_property
    def validity(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value of each input by name, in SI units."""
        limits = [(low, high) for low, high in self.validity_box.tolist()]
        return dict(zip(self.input_names, limits, strict=True))

    @cached_property
    def _loss_inputs(self) -> slice:
        """The slice of the inputs that are losses of regions."""
        first_loss = len(self.parameters)
        return slice(first_loss, first_loss + len(self.regions))

    def vector(
        self, values: InputValues | None = None, stiffness_loss: LossValues = (), **named: float
    ) -> FloatArray:
        """Return the values (V,) of all inputs, in the order of `input_names`.

        Inputs that are not given have their nominal values.

        Parameters
        ----------
        values : mapping of str to float, or (V,) array, optional
            Values by name; an array is returned as it is, with NaN where it is masked.
        stiffness_loss : mapping or iterable of float
            Losses of all damage regions, see `fe.runtime.state.losses_of`.
        **named : float
            More values by name.

        Raises
        ------
        OutsideModelError
            If a name is unknown.
        InvalidStateError
            If the losses do not fit the regions.
        """
        if isinstance(values, np.ndarray):
            return nan_where_masked(values)
        vector = self.nominal.copy()
        vector[self._loss_inputs] = self.losses(stiffness_loss)
        for name, value in {**(values or {}), **named}.items():
            vector[self._input_number(name)] = value
        return vector

    def vectors(self, columns: Mapping[str, npt.ArrayLike]) -> FloatArray:
        """Return the values (B, V) of all inputs in B cases, in the order of `input_names`.

        Parameters
        ----------
        columns : mapping of str to (B,) array_like or float
            Values by the name of the input. A single number holds in all cases. Inputs that are
            left out have their nominal values.

        Raises
        ------
        OutsideModelError
            If a name is not that of an input.
        """
        arrays = [nan_where_masked(column) for column in columns.values()]
        # With an array of length one among them, single numbers alone make one case.
        zeros_of_cases, *broadcast = np.broadcast_arrays(np.zeros(1), *arrays)
        vectors = np.tile(self.nominal, (len(zeros_of_cases), 1))
        for name, array in zip(columns, broadcast, strict=True):
            vectors[:, self._input_number(name)] = array
        return vectors

    def _input_number(self, name: str) -> int:
        """Return the index of an input; raise `OutsideModelError` for an unknown name."""
        if name not in self.input_names:
            raise OutsideModelError(
                f"The structure {self.name} has no parameter, region, mass or control named "
                f"{name!r}; it has {', '.join(self.input_names)}."
            )
        return self.input_names.index(name)

    def check_validity(self, values: Sequence[float]) -> None:
        """Check that inputs (V,) lie in the validity box; NaN and infinity do not.

        Raises
        ------
        OutsideModelError
            If one lies outside; the message names it and its range.
        """
        for (name, (low, high)), value in zip(self.validity.items(), values, strict=True):
            if not low <= value <= high:
                raise OutsideModelError(
                    f"{name} must lie between {low:g} and {high:g}, the range of the reduced model "
                    f"of {self.name}, but is {float(value)!r}; give a value inside, or build the "
                    "reduced model for a wider range."
                )

    # ------------------------------------------------------------ coefficients of terms

    @cached_property
    def _stiffness_factor_columns(self) -> IntArray:
        """Columns (2, T) of the two factors of each stiffness term, see `_products`."""
        first_parameter = 0
        first_healthy_fraction = len(self.input_names)
        return self._factor_columns(self.stiffness_factors, first_parameter, first_healthy_fraction)

    @cached_property
    def _load_factor_columns(self) -> IntArray:
        """Columns (2, L) of the two factors of each load, see `_products`."""
        first_control = len(self.input_names) - len(self.controls)
        first_mass = first_control - len(self.masses)
        return self._factor_columns(self.load_factors, first_control, first_mass)

    @cached_property
    def _term_and_load_columns(self) -> IntArray:
        """Columns (2, T + L) of the two factors of each stiffness term, and then of each load."""
        return np.concatenate((self._stiffness_factor_columns, self._load_factor_columns), axis=1)

    @staticmethod
    def _factor_columns(factors: IntArray, first: int, second: int) -> IntArray:
        """Return the columns (2, k) of the two factors of each of k terms, see `_products`.

        `factors` (k, 2) count names of two kinds from one, and are zero for none; `first` and
        `second` are the numbers of columns before those of each kind. A factor of zero gets column
        0, which is one.
        """
        return np.where(factors > 0, factors + np.array((first, second)), 0).T

    def _products(self, vectors: FloatArray, columns: IntArray) -> FloatArray:
        """Return the coefficients (..., k) of k terms for inputs (..., V): products of two factors.

        The factors are taken from columns of values: column 0 is one, then come the V inputs, then
        the healthy fractions 1 - loss of the damage regions.
        """
        *cases, inputs = vectors.shape
        first_healthy = 1 + inputs
        values = np.empty((*cases, first_healthy + len(self.regions)))
        values[..., 0] = 1.0
        values[..., 1:first_healthy] = vectors
        np.subtract(1.0, vectors[..., self._loss_inputs], out=values[..., first_healthy:])
        first, second = columns
        # `take` is three times as fast as an index array after an ellipsis
        return np.asarray(values.take(first, axis=-1) * values.take(second, axis=-1))

    def stiffness_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., T) of the stiffness terms for inputs (..., V)."""
        return self._products(vectors, self._stiffness_factor_columns)

    def load_coefficients(self, vectors: FloatArray) -> FloatArray:
        """Return the coefficients (..., L) of the loads for inputs (..., V)."""
        return self._products(vectors, self._load_factor_columns)

    def mass_coefficients(self, vector: FloatArray) -> FloatArray:
        """Return the coefficients (1 + P,) of the mass terms for inputs (V,)."""
        first_mass = self._loss_inputs.stop
        return np.concatenate(([1.0], vector[first_mass : first_mass + len(self.masses)]))

    # ------------------------------------------------------------ motion

    @cached_property
    def unit_loads(self) -> FloatArray:
        """The loads (Nm + N, L) in the coordinates of a `ReducedStructure`."""
        return np.concatenate((self.modal_load, self.static_load), axis=1).T

    @cached_property
    def output_rows(self) -> FloatArray:
        """Rows (O', Nm + N) of the static outputs in the coordinates of a `ReducedStructure`."""
        modal_output = self.modal_output[: len(self.static_output)]
        return np.concatenate((modal_output, self.static_output), axis=1)

    @cached_property
    def acceleration_rows(self) -> FloatArray:
        """Rows (A, Nm + N) of the accelerations in the coordinates of a `ReducedStructure`."""
        modal_output = self.modal_output[len(self.static_output) :]
        return np.pad(modal_output, ((0, 0), (0, self.static_output.shape[1])))

    def structure_at(self, vector: FloatArray) -> ReducedStructure:
        """Return the structure for inputs (V,), for `fe.runtime.transient.ModalIntegrator`.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        return ReducedStructure(self, vector)

    # ------------------------------------------------------------ statics

    def static_response(
        self,
        values: InputValues | None = None,
        stiffness_loss: LossValues = (),
        *,
        load: FloatArray | None = None,
        **named: float,
    ) -> ReducedResponse:
        """Return the static response with certified error bounds.

        Kapteyn et al. 2021, eqs. (13) and (15).

        Parameters
        ----------
        values, stiffness_loss, **named
            Values of the inputs, see `vector`.
        load : (L,) array, optional
            Coefficients of the loads, by default those of the controls.

        Raises
        ------
        OutsideModelError
            If a value is unknown, lies outside the validity box or is not finite.
        """
        vector = self.vector(values, stiffness_loss, **named)
        inputs = vector.tolist()
        self.check_validity(inputs)
        coefficients = self._products(vector, self._term_and_load_columns)
        term_count = len(self.stiffness_factors)
        solution = self._solver.solve(
            coefficients[:term_count],
            coefficients[term_count:] if load is None else load,
            tuple(inputs[self._loss_inputs]),
        )
        gauges = len(self.gauges)
        bounds = solution.bounds.tolist()
        strain = solution.outputs[:gauges]
        displacement = solution.outputs[gauges:]
        return ReducedResponse(
            strain,
            displacement,
            self._bound_with_rounding(bounds[:gauges], strain),
            self._bound_with_rounding(bounds[gauges:], displacement),
            solution.coordinates,
        )

    def _bound_with_rounding(self, bounds: list[float], outputs: FloatArray) -> float:
        """Return the largest of the outputs' bounds plus the allowance for rounding."""
        return max(bounds, default=0.0) + self.rounding_allowance * sqrt(outputs @ outputs)

    def static_outputs(self, vectors: FloatArray) -> FloatArray:
        """Return gauges and displacements (B, O') for many inputs (B, V) at once.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        vectors = nan_where_masked(vectors)
        low, high = self.validity_box.T
        is_within = (vectors >= low) & (vectors <= high)
        outside = np.flatnonzero(~is_within.all(axis=1))
        if outside.size:
            first_outside = vectors[outside[0]]
            self.check_validity(first_outside.tolist())
        stiffness = self.stiffness_coefficients(vectors) @ self._solver.stiffness
        matrices = stiffness.reshape(-1, *self._solver.square)
        load = self.load_coefficients(vectors) @ self.static_load
        load_columns = load[:, :, np.newaxis]
        coordinates = np.squeeze(solve(matrices, load_columns), axis=-1)
        return np.asarray(coordinates @ self.static_output.T)

    def tip_stiffness(self, young_modulus_factor: float, stiffness_loss: LossValues = ()) -> float:
        """Return the tip stiffness of a wing [N/m]: tip force over displacement of its point.

        It is linear in the modulus factor e, Kapteyn et al. 2021, eq. (14).

        Parameters
        ----------
        young_modulus_factor : float
            e, the factor on Young's modulus of the skin [1].
        stiffness_loss : mapping or iterable of float
            Losses of the damage regions.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        vector = self.vector(
            stiffness_loss=stiffness_loss, young_modulus_factor=young_modulus_factor
        )
        unit_force = np.array((0.0, 1.0))
        response = self.static_response(vector, load=unit_force)
        return float(1.0 / (self.static_load[TIP_FORCE] @ response.coordinates))

    # ------------------------------------------------------------ modes

    def modes(
        self,
        values: InputValues | None = None,
        stiffness_loss: LossValues = (),
        **named: float,
    ) -> ReducedModes:
        """Return the lowest undamped modes, Kapteyn et al. 2021, eq. (16).

        Each tracked shape, such as the first flapwise bending, is assigned to the mode with the
        largest modal assurance criterion.

        Parameters
        ----------
        values, stiffness_loss, **named
            Values of the inputs, see `vector`.

        Raises
        ------
        OutsideModelError
            If a value is unknown, lies outside the validity box or is not finite.
        """
        vector = self.vector(values, stiffness_loss, **named)
        self.check_validity(vector.tolist())
        stiffness = dense_sum(self.stiffness_coefficients(vector), self.modal_stiffness)
        mass = dense_sum(self.mass_coefficients(vector), self.modal_mass)
        frequency, shape = lowest_modes(stiffness, mass, self.mode_count)
        # The sign of an eigenvector is arbitrary; that of the last output is made positive.
        shape = shape * np.where(self.modal_output[-1] @ shape < 0.0, -1.0, 1.0)
        # Modal assurance criterion of each tracked shape with each mode
        weighted_shapes = self.followed_shapes @ mass
        squared_norm = np.sum(weighted_shapes * self.followed_shapes, axis=1)[:, np.newaxis]
        assurance = (weighted_shapes @ shape) ** 2 / squared_norm
        return ReducedModes(
            frequency=frequency,
            shape=shape,
            output=self.modal_output @ shape,
            participation=self.modal_load @ shape,
            mass=mass,
            followed=tuple(assurance.argmax(axis=1).tolist()),
            followed_mac=tuple(assurance.max(axis=1, initial=0.0).tolist()),
        )
