"""The model's answers to everything that the published folders hold, and their sensitivities.

They are evaluated on reduced operators. Where the static basis holds the solutions of a state and the adjoint
solutions of its gauges, and the modal basis the modes, values and first derivatives are those of the full
model.
"""

from dataclasses import dataclass
from functools import cached_property

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
MASS_STEP = 0.01
"""Steps of the central differences by which slopes of frequencies are defined: of ln e, and [kg]."""
MODES = 2
STIFFNESS, STIFFNESS_SLOPE = 0, 1


class Value:
    """An array with its derivatives: value (...,) and gradient (..., P)."""

    def __init__(self, value: FloatArray, gradient: FloatArray) -> None:
        self.value = value
        self.gradient = gradient

    def log(self) -> "Value":
        """Return the natural logarithm; raises `IdentificationError` where a value is not positive."""
        if not np.all(self.value > 0.0):
            raise IdentificationError(
                "A strain of the local model is not positive, so far is it from the design it was made at; "
                "take a smaller step."
            )
        return Value(np.log(self.value), self.gradient / self.value[..., None])

    def over(self, other: "Value") -> "Value":
        """Return self / other."""
        ratio = self.value / other.value
        return Value(ratio, (self.gradient - ratio[..., None] * other.gradient) / other.value[..., None])


@dataclass(frozen=True, eq=False)
class ReducedWing:
    """Reduced operators of a wing, and their derivatives in P parameters.

    Attributes
    ----------
    terms : ReducedTerms
        The operators.
    derivatives : ReducedTerms
        The same with a first axis (P, ...); empty first axes for values alone.
    bending : (m, 2)
        Shapes of the first and second flapwise bending mode on the modal basis, to find them again.
    """

    terms: ReducedTerms
    derivatives: ReducedTerms
    bending: FloatArray

    def at(self, step: FloatArray) -> "ReducedWing":
        """Return the wing after a step (P,) of the parameters: exact in those that enter affinely."""
        moved = ReducedTerms(
            *(
                base + np.tensordot(step, slope, axes=1)
                for base, slope in zip(self.terms, self.derivatives, strict=True)
            )
        )
        return ReducedWing(moved, self.derivatives, self.bending)

    @cached_property
    def _parameter_count(self) -> int:
        return len(self.derivatives.lift)

    def _theta(self, factor: float, loss: Losses = ()) -> FloatArray:
        """Coefficients (K + 2,) of the stiffness terms; regions beyond those of `loss` are healthy."""
        theta = np.ones(len(self.terms.stiffness))
        theta[0] = factor
        theta[1 : 1 + len(loss)] -= loss
        return theta

    def _solution(self, factor: float, loss: Losses) -> "_State":
        theta = self._theta(factor, loss)
        matrix = np.tensordot(theta, self.terms.stiffness, axes=1)
        try:
            factors = cho_factor(matrix)
        except np.linalg.LinAlgError:
            raise IdentificationError(
                "a step of the identification makes the stiffness indefinite."
            ) from None
        return _State(theta, factors)

    def strain(self, factor: float, loss: Losses) -> Value:
        """Gauge strains (G,) at `LOAD_FACTOR`."""
        state, own, change = self._solution(factor, loss), self.terms, self.derivatives
        u = LOAD_FACTOR * state.solve(own.lift)
        adjoint = state.solve(own.gauges.T)
        force = LOAD_FACTOR * change.lift - _applied(state.theta, change.stiffness, u)
        return Value(own.gauges @ u, (change.gauges @ u).T + adjoint.T @ force.T)

    def strain_slope(self, factor: float) -> Value:
        """D ln strain / d ln e (G,) of the healthy wing."""
        state, own, change = self._solution(factor, ()), self.terms, self.derivatives
        skin = own.stiffness[0]
        u = LOAD_FACTOR * state.solve(own.lift)
        du = -state.solve(skin @ u)
        adjoint = state.solve(own.gauges.T)
        force = LOAD_FACTOR * change.lift - _applied(state.theta, change.stiffness, u)
        u_change = state.solve(force.T)
        du_force = -(
            change.stiffness[:, 0] @ u + (skin @ u_change).T + _applied(state.theta, change.stiffness, du)
        )
        strain = Value(own.gauges @ u, (change.gauges @ u).T + adjoint.T @ force.T)
        slope = Value(own.gauges @ du, (change.gauges @ du).T + adjoint.T @ du_force.T)
        found = slope.over(strain)
        return Value(factor * found.value, factor * found.gradient)

    def tip_stiffness(self, factor: float = 1.0) -> Value:
        """Tip stiffness [N/m] and d ln k / d ln e, (2,)."""
        state, own, change = self._solution(factor, ()), self.terms, self.derivatives
        skin = own.stiffness[0]
        u = state.solve(own.tip)
        flexibility, energy = float(own.tip @ u), float(u @ skin @ u)
        force = change.tip - _applied(state.theta, change.stiffness, u)
        u_change = state.solve(force.T)
        d_flexibility = 2.0 * change.tip @ u - _applied(state.theta, change.stiffness, u) @ u
        d_energy = (change.stiffness[:, 0] @ u) @ u + 2.0 * u_change.T @ (skin @ u)
        value = np.array([1.0 / flexibility, factor * energy / flexibility])
        gradient = np.array(
            [
                -d_flexibility / flexibility**2,
                factor * (d_energy - energy / flexibility * d_flexibility) / flexibility,
            ]
        )
        return Value(value, gradient)

    def log_frequency(self, factor: FloatArray, servo_mass: FloatArray, pitot_mass: FloatArray) -> Value:
        """Logarithms of the flapwise bending frequencies [Hz] (R, 2) at e and masses (R,) [kg]."""
        own, change = self.terms, self.derivatives
        parameters = self._parameter_count
        value, gradient = np.empty((len(factor), MODES)), np.empty((len(factor), MODES, parameters))
        for row, (e, servo, pitot) in enumerate(zip(factor, servo_mass, pitot_mass, strict=True)):
            theta, mass_theta = self._theta(e), np.array([1.0, servo, pitot])
            stiffness = np.tensordot(theta, own.modal_stiffness, axes=1)
            mass = np.tensordot(mass_theta, own.modal_mass, axes=1)
            values, shapes = eigh(stiffness, mass)
            for mode in range(MODES):
                number = int(np.argmax(np.abs(self.bending[:, mode] @ mass @ shapes)))
                shape, square = shapes[:, number], values[number]
                value[row, mode] = 0.5 * np.log(square) - np.log(2.0 * np.pi)
                outer = np.outer(shape, shape)
                stiff = np.tensordot(change.modal_stiffness, outer, axes=2) @ theta
                heavy = np.tensordot(change.modal_mass, outer, axes=2) @ mass_theta
                gradient[row, mode] = 0.5 * (stiff / square - heavy)
        return Value(value, gradient)

    def frequency_slopes(self) -> tuple[Value, Value, Value]:
        """Log frequencies, their slopes in ln e and in the pitot's mass [1/kg], each (2,)."""
        pitot = np.array([0.0, 0.0, 0.0, -MASS_STEP, MASS_STEP]) + REFERENCE_PITOT
        factor = np.exp([0.0, -FACTOR_STEP, FACTOR_STEP, 0.0, 0.0])
        found = self.log_frequency(factor, 0.5 * (MASS_TOTAL - pitot), pitot)
        slopes = [
            Value(
                (found.value[high] - found.value[low]) / (2.0 * step),
                (found.gradient[high] - found.gradient[low]) / (2.0 * step),
            )
            for low, high, step in ((1, 2, FACTOR_STEP), (3, 4, MASS_STEP))
        ]
        return Value(found.value[0], found.gradient[0]), slopes[0], slopes[1]

    def all_strains(self, states: BoolArray) -> Value:
        """Strains (5, 5, G) at the library's e in the chosen states (5, 5); NaN in the others."""
        gauges = self.terms.gauges.shape[0]
        value = np.full((*states.shape, gauges), np.nan)
        gradient = np.full((*states.shape, gauges, self._parameter_count), np.nan)
        for i, j in np.argwhere(states):
            found = self.strain(LIBRARY_FACTOR, (LEVELS[i], LEVELS[j]))
            value[i, j], gradient[i, j] = found.value, found.gradient
        return Value(value, gradient)


class _State:
    """Factorised stiffness of one state, and the coefficients (4,) of its terms."""

    def __init__(self, theta: FloatArray, factors: tuple[FloatArray, bool]) -> None:
        self.theta = theta
        self._factors = factors

    def solve(self, load: FloatArray) -> FloatArray:
        return np.asarray(cho_solve(self._factors, load))


def _applied(theta: FloatArray, change: FloatArray, vector: FloatArray) -> FloatArray:
    """Apply the derivatives of the stiffness (P, 4, N, N) to a vector (N,): (P, N)."""
    return np.asarray(np.einsum("t,ptn->pn", theta, change @ vector))
