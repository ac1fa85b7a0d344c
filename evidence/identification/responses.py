"""Outputs of the reduced model that the published folders hold, and their derivatives.

The static basis holds, for some states, the solution and the adjoint solutions of the gauges; the
modal basis holds the modes. There, values and first derivatives equal those of the full model.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh

from fe.runtime.state import Losses

from .errors import IdentificationError
from .pieces import ReducedTerms
from .targets import LEVELS, LIBRARY_FACTOR, LOAD_FACTOR, MASS_TOTAL, REFERENCE_PITOT

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FACTOR_STEP = 0.03
"""Step of ln e in the central differences that define the slopes of the frequencies."""
MASS_STEP = 0.01
"""Step of the pitot's mass [kg] in the central differences that define the slopes."""
BENDING_MODES = 2
SKIN = 0
"""Index of the stiffness of the undamaged skin, which e scales, among the stiffness terms."""


class Value:
    """An array with its derivatives.

    Parameters
    ----------
    value : (...,) array
        The array.
    gradient : (..., P) array
        Derivatives of the array, per unit of each of P parameters.
    """

    def __init__(self, value: FloatArray, gradient: FloatArray) -> None:
        self.value = value
        self.gradient = gradient

    def log(self) -> "Value":
        """Return the natural logarithm.

        Raises
        ------
        IdentificationError
            If a value is not positive.
        """
        if not np.all(self.value > 0.0):
            raise IdentificationError(
                "A strain of the local model is not positive, so far is it from the design it was "
                "made at; take a smaller step."
            )
        return Value(np.log(self.value), self.gradient / self.value[..., np.newaxis])

    def over(self, divisor: "Value") -> "Value":
        """Return the quotient of this value and another."""
        ratio = self.value / divisor.value
        numerator_gradient = self.gradient - ratio[..., np.newaxis] * divisor.gradient
        return Value(ratio, numerator_gradient / divisor.value[..., np.newaxis])

    def times(self, factor: float) -> "Value":
        """Return the value times a constant factor."""
        return Value(factor * self.value, factor * self.gradient)


class FrequencySlopes(NamedTuple):
    """Both flapwise bending frequencies at e = 1, and their slopes; arrays (2,).

    Attributes
    ----------
    log_frequency : Value
        Logarithms of the frequencies [Hz].
    factor_slope : Value
        Slopes of the logarithms in ln e [1].
    mass_slope : Value
        Slopes of the logarithms in the pitot's mass [1/kg].
    """

    log_frequency: Value
    factor_slope: Value
    mass_slope: Value


@dataclass(frozen=True, eq=False)
class ReducedWing:
    """Reduced operators of a wing, and their derivatives in P parameters.

    Attributes
    ----------
    terms : ReducedTerms
        The operators.
    derivatives : ReducedTerms
        Derivatives of the operators, with a first axis (P, ...) that is empty for values alone.
    bending : (m, 2) array
        Shapes of the first and second flapwise bending mode on the modal basis. They identify the
        bending modes of a changed wing.
    """

    terms: ReducedTerms
    derivatives: ReducedTerms
    bending: FloatArray

    def at(self, step: FloatArray) -> "ReducedWing":
        """Return the wing after a step (P,) of the parameters.

        It is exact in parameters in which the operators are affine.
        """
        return ReducedWing(
            self.terms.after_step(step, self.derivatives), self.derivatives, self.bending
        )

    @cached_property
    def _parameter_count(self) -> int:
        return len(self.derivatives.lift)

    def _stiffness_coefficients(self, factor: float, loss: Losses = ()) -> FloatArray:
        """Return the coefficients (K + 2,) of the stiffness terms.

        Regions beyond those of `loss` are healthy.
        """
        coefficients = np.ones(len(self.terms.stiffness))
        coefficients[SKIN] = factor
        coefficients[1 : 1 + len(loss)] -= loss
        return coefficients

    def _factorised_state(self, factor: float, loss: Losses) -> "_FactorisedState":
        """Return the factorised stiffness of a state.

        Raises
        ------
        IdentificationError
            If the stiffness is not positive definite.
        """
        coefficients = self._stiffness_coefficients(factor, loss)
        stiffness = np.tensordot(coefficients, self.terms.stiffness, axes=1)
        try:
            factors = cho_factor(stiffness)
        except np.linalg.LinAlgError:
            raise IdentificationError(
                "a step of the identification makes the stiffness indefinite."
            ) from None
        return _FactorisedState(coefficients, factors)

    def strain(self, factor: float, loss: Losses) -> Value:
        """Return the gauge strains (G,) at `LOAD_FACTOR`."""
        state = self._factorised_state(factor, loss)
        terms = self.terms
        change = self.derivatives
        u = LOAD_FACTOR * state.solve(terms.lift)
        adjoint = state.solve(terms.gauges.T)
        residual_force = LOAD_FACTOR * change.lift - state.force_change(change.stiffness, u)
        gradient = (change.gauges @ u).T + adjoint.T @ residual_force.T
        return Value(terms.gauges @ u, gradient)

    def strain_slope(self, factor: float) -> Value:
        """Return d ln strain / d ln e (G,) of the healthy wing."""
        state = self._factorised_state(factor, ())
        terms = self.terms
        change = self.derivatives
        skin = terms.stiffness[SKIN]
        skin_change = change.stiffness[:, SKIN]

        # Displacements u and their derivative du in e
        u = LOAD_FACTOR * state.solve(terms.lift)
        du = -state.solve(skin @ u)

        # Derivatives of both in the parameters
        residual_force = LOAD_FACTOR * change.lift - state.force_change(change.stiffness, u)
        u_change = state.solve(residual_force.T)
        du_residual_force = -(
            skin_change @ u + (skin @ u_change).T + state.force_change(change.stiffness, du)
        )

        # Read out at the gauges
        adjoint = state.solve(terms.gauges.T)
        strain_gradient = (change.gauges @ u).T + adjoint.T @ residual_force.T
        slope_gradient = (change.gauges @ du).T + adjoint.T @ du_residual_force.T
        strain = Value(terms.gauges @ u, strain_gradient)
        slope = Value(terms.gauges @ du, slope_gradient)
        return slope.over(strain).times(factor)

    def tip_stiffness(self, factor: float = 1.0) -> Value:
        """Return the tip stiffness k [N/m] and d ln k / d ln e, as one array (2,)."""
        state = self._factorised_state(factor, ())
        terms = self.terms
        change = self.derivatives
        skin = terms.stiffness[SKIN]
        skin_change = change.stiffness[:, SKIN]

        # Flexibility and energy of the skin under a unit force
        u = state.solve(terms.tip)
        flexibility = float(terms.tip @ u)
        energy = float(u @ skin @ u)

        # Their derivatives in the parameters
        internal_force_change = state.force_change(change.stiffness, u)
        u_change = state.solve((change.tip - internal_force_change).T)
        d_flexibility = 2.0 * change.tip @ u - internal_force_change @ u
        d_energy = (skin_change @ u) @ u + 2.0 * u_change.T @ (skin @ u)

        stiffness = 1.0 / flexibility
        slope = factor * energy / flexibility
        d_stiffness = -d_flexibility / flexibility**2
        d_slope = factor * (d_energy - energy / flexibility * d_flexibility) / flexibility
        return Value(np.array([stiffness, slope]), np.array([d_stiffness, d_slope]))

    def log_frequency(
        self, factor: FloatArray, servo_mass: FloatArray, pitot_mass: FloatArray
    ) -> Value:
        """Return the logarithms of the flapwise bending frequencies [Hz], as an array (R, 2).

        Parameters
        ----------
        factor : (R,) array
            Factor e of the Young's modulus in each row.
        servo_mass, pitot_mass : (R,) arrays
            Mass of each servo and of the pitot [kg] in each row.
        """
        terms = self.terms
        change = self.derivatives
        value = np.empty((len(factor), BENDING_MODES))
        gradient = np.empty((len(factor), BENDING_MODES, self._parameter_count))
        for row, (e, servo, pitot) in enumerate(zip(factor, servo_mass, pitot_mass, strict=True)):
            stiffness_coefficients = self._stiffness_coefficients(e)
            mass_coefficients = np.array([1.0, servo, pitot])
            stiffness = np.tensordot(stiffness_coefficients, terms.modal_stiffness, axes=1)
            mass = np.tensordot(mass_coefficients, terms.modal_mass, axes=1)
            eigenvalues, shapes = eigh(stiffness, mass)
            for mode in range(BENDING_MODES):
                # The mode that is most alike in the mass to the bending mode of the design
                number = int(np.argmax(np.abs(self.bending[:, mode] @ mass @ shapes)))
                shape = shapes[:, number]
                eigenvalue = eigenvalues[number]
                value[row, mode] = 0.5 * np.log(eigenvalue) - np.log(2.0 * np.pi)
                # Derivative of an eigenvalue with a shape of unit modal mass
                outer = np.outer(shape, shape)
                stiffness_changes = np.tensordot(change.modal_stiffness, outer, axes=2)
                mass_changes = np.tensordot(change.modal_mass, outer, axes=2)
                stiffness_change = stiffness_changes @ stiffness_coefficients
                mass_change = mass_changes @ mass_coefficients
                gradient[row, mode] = 0.5 * (stiffness_change / eigenvalue - mass_change)
        return Value(value, gradient)

    def frequency_slopes(self) -> FrequencySlopes:
        """Return the bending frequencies at e = 1 with their slopes, from central differences."""
        factor_steps = np.array([0.0, -FACTOR_STEP, FACTOR_STEP, 0.0, 0.0])
        mass_steps = np.array([0.0, 0.0, 0.0, -MASS_STEP, MASS_STEP])
        pitot = mass_steps + REFERENCE_PITOT
        servo = 0.5 * (MASS_TOTAL - pitot)
        log_frequency = self.log_frequency(np.exp(factor_steps), servo, pitot)
        rows = [
            Value(value, gradient)
            for value, gradient in zip(log_frequency.value, log_frequency.gradient, strict=True)
        ]
        at_one, low_factor, high_factor, low_mass, high_mass = rows
        return FrequencySlopes(
            log_frequency=at_one,
            factor_slope=_central_difference(low_factor, high_factor, FACTOR_STEP),
            mass_slope=_central_difference(low_mass, high_mass, MASS_STEP),
        )

    def all_strains(self, states: BoolArray) -> Value:
        """Return the strains (5, 5, G) at the library's e in chosen states.

        Parameters
        ----------
        states : (5, 5) array of bool
            Whether a state of `targets.LEVELS` is chosen; the strains of the others are NaN.
        """
        gauge_count = len(self.terms.gauges)
        value = np.full((*states.shape, gauge_count), np.nan)
        gradient = np.full((*states.shape, gauge_count, self._parameter_count), np.nan)
        for first, second in np.argwhere(states):
            strain = self.strain(LIBRARY_FACTOR, (LEVELS[first], LEVELS[second]))
            value[first, second] = strain.value
            gradient[first, second] = strain.gradient
        return Value(value, gradient)


class _FactorisedState:
    """Factorised stiffness of one state.

    Parameters
    ----------
    coefficients : (K + 2,) array
        Coefficients of the stiffness terms.
    factors : tuple
        Cholesky factors of the stiffness (N, N), as `scipy.linalg.cho_factor` returns them.
    """

    def __init__(self, coefficients: FloatArray, factors: tuple[FloatArray, bool]) -> None:
        self._coefficients = coefficients
        self._factors = factors

    def solve(self, load: FloatArray) -> FloatArray:
        """Return the displacements (N, ...) under loads (N, ...)."""
        return np.asarray(cho_solve(self._factors, load))

    def force_change(self, stiffness_change: FloatArray, displacement: FloatArray) -> FloatArray:
        """Return the derivatives (P, N) of the internal force at fixed displacements (N,).

        Parameters
        ----------
        stiffness_change : (P, K + 2, N, N) array
            Derivatives of the stiffness terms.
        displacement : (N,) array
            The displacements.
        """
        forces = stiffness_change @ displacement
        return np.asarray(np.einsum("t,ptn->pn", self._coefficients, forces))


def _central_difference(low: Value, high: Value, step: float) -> Value:
    """Return the central difference of two values whose arguments lie one step from the middle."""
    return Value(
        (high.value - low.value) / (2.0 * step), (high.gradient - low.gradient) / (2.0 * step)
    )
