"""The reduced model of the wing: everything that is evaluated online, with NumPy alone.

NumPy and relative imports only: this file is copied into the FMU. The offline part, which makes the arrays,
is `fe.reduction.reduced_basis`; the equations are in `docs/reduced_model.md`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, sqrt

import numpy as np
import numpy.typing as npt
from numpy.linalg import solve

from .errors import OutsideModelError
from .online import OnlineArrays
from .reduced_arrays import ReducedArrays, parameter_names
from .responses import Modes, StaticResponse
from .state import Losses

__all__ = ["Modes", "ReducedModel", "StaticResponse"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class ReducedModel(ReducedArrays):
    """Reduced wing: `ReducedArrays`, evaluated.

    `fe.reduction.model_cache.reduced_model` makes one, `load` and `from_bytes` read one. Fields: those of
    `ReducedArrays`.
    """

    _online: OnlineArrays = field(init=False, repr=False, compare=False)
    _limits: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        # of e, of the losses, of load factor and tip force
        limits = tuple((float(low), float(high)) for low, high in self.validity_box[:-2])
        object.__setattr__(self, "_limits", limits)
        object.__setattr__(self, "_online", OnlineArrays(self))

    def __repr__(self) -> str:
        return (
            f"ReducedModel(design_hash={self.design_hash!r}, gauges={self.gauge_count}, "
            f"regions={self.regions}, static_basis={len(self.static_load.T)}, "
            f"modal_basis={len(self.modal_load.T)}, modes={self.mode_count})"
        )

    @property
    def gauge_count(self) -> int:
        """Number of strain gauges G."""
        return int(self.static_output.shape[0]) - 1

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the rows of `validity_box`."""
        return parameter_names(self.regions)

    @property
    def validity(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value for which the model was made, by parameter name (SI units)."""
        return {
            name: (float(low), float(high))
            for name, (low, high) in zip(self.parameter_names, self.validity_box, strict=True)
        }

    def check_validity(self, **values: float) -> None:
        """Check that each value lies in the validity box; also refuses NaN and infinity.

        Parameters
        ----------
        **values : float
            Values by the names of `parameter_names`.

        Raises
        ------
        OutsideModelError
            If a value lies outside; the sentence names it and its range.
        """
        validity = self.validity
        for name, value in values.items():
            low, high = validity[name]
            if not (isfinite(value) and low <= value <= high):
                raise OutsideModelError(
                    f"{name} must lie between {low:g} and {high:g}, the range of the reduced model, but is "
                    f"{value!r}; give a value inside, or build a model with a wider range."
                )

    def static_response(
        self,
        young_modulus_factor: float,
        stiffness_loss: Losses,
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
        online = self._online
        loss = stiffness_loss if len(stiffness_loss) == len(online.splits) else self.losses(stiffness_loss)
        given = (e, *loss, load_factor, tip_force)
        for value, (low, high) in zip(given, self._limits, strict=True):
            if not low <= value <= high:
                self.check_validity(**dict(zip(self.parameter_names, given, strict=False)))
        values = np.array((e, *(1.0 - value for value in loss), 1.0, load_factor, tip_force))
        coordinates, output, bound = online.solution(values[:-2], values[-2:], loss)
        strain = output[:-1]
        tip_displacement = float(output[-1])
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
        stiffness_loss : (B, K) array_like
            Losses of each state in the order of `regions`, fractions.
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
        regions = len(self.regions)
        if loss.ndim != 2 or loss.shape[1] != regions:
            raise ValueError(
                f"stiffness_loss must have the shape (B, {regions}), but has {np.shape(stiffness_loss)}."
            )
        columns: tuple[FloatArray, ...] = np.broadcast_arrays(
            np.asarray(young_modulus_factor, dtype=np.float64),
            *loss.T,
            np.asarray(load_factor, dtype=np.float64),
            np.asarray(tip_force, dtype=np.float64),
        )
        for name, (low, high), column in zip(self.parameter_names, self.validity_box, columns, strict=False):
            bad = np.flatnonzero(~((column >= low) & (column <= high)))
            if bad.size:
                self.check_validity(**{name: float(column[bad[0]])})
        e, *lost, n, f = columns
        theta = np.stack((e, *(1.0 - z for z in lost), np.ones_like(e)), axis=1)
        stiffness = (theta @ self._online.stiffness).reshape(-1, *self._online.square)
        load = np.stack((n, f), axis=1) @ self.static_load
        coordinates = solve(stiffness, load[:, :, np.newaxis])[:, :, 0]
        return np.asarray(coordinates @ self.static_output[:-1].T)

    def tip_stiffness(self, young_modulus_factor: float, stiffness_loss: Losses = ()) -> float:
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
        stiffness_loss: Losses,
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
        loss = self.losses(stiffness_loss)
        self.check_validity(
            young_modulus_factor=young_modulus_factor,
            **dict(zip(self.regions, loss, strict=True)),
            servo_mass=servo_mass,
            pitot_mass=pitot_mass,
        )
        size = self.modal_stiffness.shape[1:]
        theta = np.array((young_modulus_factor, *(1.0 - z for z in loss), 1.0))
        stiffness = (theta @ self.modal_stiffness.reshape(len(theta), -1)).reshape(size)
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
