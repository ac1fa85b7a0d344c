"""The reduced model of the wing: everything that is evaluated online, with NumPy alone.

NumPy and relative imports only: this file is copied into the FMU. The offline part, which makes the arrays,
is `fe.reduction.reduced_basis`; the equations are in `docs/reduced_model.md`.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, sqrt

import numpy as np
import numpy.typing as npt
from numpy import einsum
from numpy.linalg import solve

from .errors import OutsideModelError
from .online import OnlineArrays
from .reduced_arrays import PARAMETER_NAMES, ReducedArrays
from .responses import Modes, StaticResponse

__all__ = ["PARAMETER_NAMES", "Modes", "ReducedModel", "StaticResponse"]

FloatArray = npt.NDArray[np.float64]
multiply_outer = np.multiply.outer


@dataclass(frozen=True, repr=False)
class ReducedModel(ReducedArrays):
    """Reduced wing: `ReducedArrays`, evaluated.

    `fe.reduction.model_cache.reduced_model` makes one, `load` and `from_bytes` read one. Fields: those of
    `ReducedArrays`.
    """

    _online: OnlineArrays = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(
            self,
            "_online",
            OnlineArrays(
                static_stiffness=self.static_stiffness,
                validity_box=self.validity_box,
                bound_reference=self.bound_reference,
                residual_load=self.residual_load,
                residual_stiffness=self.residual_stiffness,
                splits=(self.dual_split_1, self.dual_split_2),
                dual_correction=self.dual_correction,
                dual_residual=self.dual_residual,
            ),
        )

    def __repr__(self) -> str:
        return (
            f"ReducedModel(design_hash={self.design_hash!r}, gauges={self.gauge_count}, "
            f"static_basis={len(self.static_load.T)}, modal_basis={len(self.modal_load.T)}, "
            f"modes={self.mode_count})"
        )

    @property
    def gauge_count(self) -> int:
        """Number of strain gauges G."""
        return int(self.static_output.shape[0]) - 1

    @property
    def validity(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value for which the model was made, by parameter name (SI units)."""
        return {
            name: (float(low), float(high))
            for name, (low, high) in zip(PARAMETER_NAMES, self.validity_box, strict=True)
        }

    def check_validity(self, **values: float) -> None:
        """Check that each value lies in the validity box; also refuses NaN and infinity.

        Parameters
        ----------
        **values : float
            Values by the names of `PARAMETER_NAMES`.

        Raises
        ------
        OutsideModelError
            If a value lies outside; the sentence names it and its range.
        """
        for name, value in values.items():
            low, high = self.validity_box[PARAMETER_NAMES.index(name)]
            if not (isfinite(value) and low <= value <= high):
                raise OutsideModelError(
                    f"{name} must lie between {low:g} and {high:g}, the range of the reduced model, but is "
                    f"{value!r}; give a value inside, or build a model with a wider range."
                )

    def static_response(
        self,
        young_modulus_factor: float,
        stiffness_loss: tuple[float, float],
        load_factor: float,
        tip_force: float = 0.0,
    ) -> StaticResponse:
        """Return the static response with its certified error bound, Kapteyn et al. 2021, eqs. (13), (15).

        Parameters
        ----------
        young_modulus_factor, stiffness_loss
            As of `fe.runtime.state.DigitalState`.
        load_factor : float
            Load factor of the manoeuvre [1].
        tip_force : float
            Force 5 cm from the tip [N], upwards positive.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        e = young_modulus_factor
        z1, z2 = stiffness_loss
        online = self._online
        e_low, e_high, z1_low, z1_high, z2_low, z2_high, n_low, n_high, f_low, f_high = online.limits
        if not (
            e_low <= e <= e_high
            and z1_low <= z1 <= z1_high
            and z2_low <= z2 <= z2_high
            and n_low <= load_factor <= n_high
            and f_low <= tip_force <= f_high
        ):
            self.check_validity(
                young_modulus_factor=e, z1=z1, z2=z2, load_factor=load_factor, tip_force=tip_force
            )
        remaining_1, remaining_2 = 1.0 - z1, 1.0 - z2
        values = np.array((e, remaining_1, remaining_2, 1.0, load_factor, tip_force))
        theta, load = values[:4], values[4:]
        stiffness = (theta @ online.stiffness).reshape(online.square)
        coordinates = np.asarray(solve(stiffness, load @ self.static_load), dtype=np.float64)
        output = self.static_output @ coordinates
        strain = output[:-1]
        tip_displacement = float(output[-1])

        # |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha, norms dual to bound_reference
        coefficients = np.empty(online.residual.shape[1])
        coefficients[:2] = load
        multiply_outer(theta, coordinates, out=coefficients[2:].reshape(4, -1))
        residual = online.residual @ coefficients
        anchor = online.dual[bisect_right(online.split_1, z1)][bisect_right(online.split_2, z2)]
        dual = (anchor.factor @ theta).reshape(-1, 4)
        reference_e, reference_1, reference_2 = online.reference
        coercivity = min(e / reference_e, remaining_1 / reference_1, remaining_2 / reference_2, 1.0)
        outside = self.residual_allowance * sqrt(coordinates @ coordinates)
        remainder = (sqrt(residual @ residual) + outside) / coercivity
        bound = remainder * np.sqrt(einsum("ij,ij->i", dual, dual)) + np.abs(anchor.correction @ residual)
        rounding = self.rounding_allowance
        return StaticResponse(
            strain=strain,
            tip_displacement=tip_displacement,
            strain_error_bound=float(bound[:-1].max()) + rounding * sqrt(strain @ strain),
            tip_displacement_error_bound=float(bound[-1]) + rounding * abs(tip_displacement),
            coordinates=coordinates,
        )

    def static_strains(
        self,
        young_modulus_factor: npt.ArrayLike,
        stiffness_loss: npt.ArrayLike,
        load_factor: npt.ArrayLike,
        tip_force: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Return the gauge strains of many states at once, Kapteyn et al. 2021, eqs. (13), (15).

        Parameters
        ----------
        young_modulus_factor : (B,) array_like
            e of each state [1]; scalars are broadcast, here and below.
        stiffness_loss : (B, 2) array_like
            (z1, z2) of each state, fractions.
        load_factor : (B,) array_like
            Load factor of each state [1].
        tip_force : (B,) array_like
            Tip force of each state [N].

        Returns
        -------
        (B, G) ndarray
            Strains, dimensionless.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        ValueError
            If the shapes do not fit.
        """
        loss = np.atleast_2d(np.asarray(stiffness_loss, dtype=np.float64))
        if loss.ndim != 2 or loss.shape[1] != 2:
            raise ValueError(
                f"stiffness_loss must have the shape (B, 2), but has {np.shape(stiffness_loss)}."
            )
        columns: tuple[FloatArray, ...] = np.broadcast_arrays(
            np.asarray(young_modulus_factor, dtype=np.float64),
            loss[:, 0],
            loss[:, 1],
            np.asarray(load_factor, dtype=np.float64),
            np.asarray(tip_force, dtype=np.float64),
        )
        for name, column in zip(PARAMETER_NAMES, columns, strict=False):
            low, high = self.validity_box[PARAMETER_NAMES.index(name)]
            bad = np.flatnonzero(~((column >= low) & (column <= high)))
            if bad.size:
                self.check_validity(**{name: float(column[bad[0]])})
        e, z1, z2, n, f = columns
        theta = np.stack((e, 1.0 - z1, 1.0 - z2, np.ones_like(e)), axis=1)
        stiffness = (theta @ self._online.stiffness).reshape(-1, *self._online.square)
        load = np.stack((n, f), axis=1) @ self.static_load
        coordinates = solve(stiffness, load[:, :, np.newaxis])[:, :, 0]
        return np.asarray(coordinates @ self.static_output[:-1].T)

    def tip_stiffness(
        self, young_modulus_factor: float, stiffness_loss: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """Return the tip stiffness: the tip force over the displacement of its point of application.

        Kapteyn et al. 2021, eq. (14), where it is a straight line in e.

        Parameters
        ----------
        young_modulus_factor, stiffness_loss
            As of `fe.runtime.state.DigitalState`.

        Returns
        -------
        float
            Stiffness [N/m].

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        coordinates = self.static_response(young_modulus_factor, stiffness_loss, 0.0, 1.0).coordinates
        return float(1.0 / (self.static_load[1] @ coordinates))

    def modes(
        self,
        young_modulus_factor: float,
        stiffness_loss: tuple[float, float],
        servo_mass: float,
        pitot_mass: float,
    ) -> Modes:
        """Return the first undamped modes, Kapteyn et al. 2021, eq. (16).

        Parameters
        ----------
        young_modulus_factor, stiffness_loss, servo_mass, pitot_mass
            As of `fe.runtime.state.DigitalState`.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box or is not finite.
        """
        z1, z2 = stiffness_loss
        self.check_validity(
            young_modulus_factor=young_modulus_factor,
            z1=z1,
            z2=z2,
            servo_mass=servo_mass,
            pitot_mass=pitot_mass,
        )
        size = self.modal_stiffness.shape[1:]
        theta = np.array((young_modulus_factor, 1.0 - z1, 1.0 - z2, 1.0))
        stiffness = (theta @ self.modal_stiffness.reshape(4, -1)).reshape(size)
        mass = self._modal_mass(servo_mass, pitot_mass)
        # M x = K x / omega^2: the stiffness is well conditioned in this basis, the mass is not, and the low
        # modes are the largest eigenvalues, which keep all their digits.
        to_standard = np.linalg.inv(np.linalg.cholesky(stiffness))
        inverse_square, vectors = np.linalg.eigh(to_standard @ mass @ to_standard.T)
        inverse_square = inverse_square[::-1][: self.mode_count]
        shape = to_standard.T @ vectors[:, ::-1][:, : self.mode_count] / np.sqrt(inverse_square)
        shape = shape * np.where(self.modal_output[-1] @ shape < 0.0, -1.0, 1.0)
        output = self.modal_output @ shape
        force = self.modal_load @ shape
        reference = self.flapwise_reference @ mass
        assurance = (reference @ shape) ** 2 / np.sum(reference * self.flapwise_reference, axis=1)[
            :, np.newaxis
        ]
        first, second = (int(i) for i in assurance.argmax(axis=1))
        return Modes(
            frequency=1.0 / (2.0 * np.pi * np.sqrt(inverse_square)),
            shape=shape,
            tip_displacement=output[-1],
            strain=output[:-1],
            lift_participation=force[0],
            tip_participation=force[1],
            flapwise=(first, second),
            flapwise_mac=(float(assurance[0, first]), float(assurance[1, second])),
        )

    def _modal_mass(self, servo_mass: float, pitot_mass: float) -> FloatArray:
        mass = self.modal_mass[0] + servo_mass * self.modal_mass[1] + pitot_mass * self.modal_mass[2]
        return np.asarray(mass, dtype=np.float64)

    def modal_projection(
        self, modes: Modes, servo_mass: float, pitot_mass: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return what takes reduced displacements to modal coordinates, q = shape^T M u.

        Parameters
        ----------
        modes : Modes
            The modes to project on.
        servo_mass, pitot_mass : float
            The masses that belong to them [kg].

        Returns
        -------
        from_modal : (M, Nm) ndarray
            For displacements given in the modal basis.
        from_static : (M, N) ndarray
            For displacements given in the static basis.
        """
        cross = self.cross_mass[0] + servo_mass * self.cross_mass[1] + pitot_mass * self.cross_mass[2]
        return modes.shape.T @ self._modal_mass(servo_mass, pitot_mass), modes.shape.T @ cross
