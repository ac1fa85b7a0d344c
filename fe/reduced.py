"""The reduced model of the wing: everything that is evaluated online, with NumPy alone.

NumPy and relative imports only: this file is copied into the FMU, together with the other `RUNTIME_FILES`.
The offline part, which makes the arrays, is `fe.reduction`; the equations are in `docs/reduced_model.md`.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import isfinite, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy import einsum
from numpy.linalg import solve

from .archive import arrays_from_bytes, arrays_to_bytes, write_bytes_atomically
from .errors import OutsideModelError, ReducedModelFileError
from .online import OnlineArrays
from .responses import Modes, StaticResponse

__all__ = ["PARAMETER_NAMES", "RUNTIME_FILES", "Modes", "ReducedModel", "StaticResponse"]

FloatArray = npt.NDArray[np.float64]
multiply_outer = np.multiply.outer

RUNTIME_FILES = (
    "errors.py",
    "state.py",
    "archive.py",
    "damping.py",
    "responses.py",
    "online.py",
    "reduced.py",
    "transient.py",
)
"""Files of this package that evaluate a reduced model; they need the standard library and NumPy only."""

PARAMETER_NAMES = ("young_modulus_factor", "z1", "z2", "load_factor", "tip_force", "servo_mass", "pitot_mass")
"""The rows of `ReducedModel.validity_box`, in this order."""

FORMAT = 1
"""Version of the array layout in the file."""


@dataclass(frozen=True, repr=False)
class ReducedModel:
    """Reduced wing: affine dense matrices, outputs, modal data, error bound, validity.

    Terms of the stiffness, in this order: skin (times e), first defect region (times 1 - z1), second defect
    region (times 1 - z2), everything else (times 1). Terms of the mass: structure, servos (times servo
    mass), pitot (times pitot mass). Loads: lift at load factor 1, tip force of 1 N. Output rows: the G
    gauges [1], then the tip displacement [m].

    Attributes
    ----------
    design_hash : str
        Hash of the design that this model was made of.
    validity_box : (7, 2) ndarray
        Least and largest value of each of `PARAMETER_NAMES`, SI units.
    static_stiffness : (4, N, N) ndarray
        Stiffness terms in the static basis.
    static_load : (2, N) ndarray
        Loads in the static basis.
    static_output : (G + 1, N) ndarray
        Outputs of the static basis vectors.
    bound_reference : (3,) ndarray
        The values of (e, 1 - z1, 1 - z2) whose stiffness is the norm of the error bound.
    residual_load : (R, 2) ndarray
        Loads in an orthonormal basis of the residuals (norm dual to the one of `bound_reference`).
    residual_stiffness : (R, 4, N) ndarray
        Stiffness terms times static basis vectors, in the same basis.
    residual_allowance : float
        Bound of what that basis leaves out of a residual, per unit length of the reduced coordinates.
    rounding_allowance : float
        Part of the norm of the strains, and of the tip displacement, added to the bounds for rounding: a
        multiple of the difference seen where the reduced model holds the full solution itself.
    dual_split_1, dual_split_2 : (A1 - 1,), (A2 - 1,) ndarray
        Values of z1 and z2 at which the next approximate dual solution takes over.
    dual_correction : (A1, A2, G + 1, R) ndarray
        Approximate dual solutions, applied to the basis of the residuals.
    dual_residual : (A1, A2, G + 1, 4, 4) ndarray
        Factors of the dual residuals: their norm is that of the factor times (1, -e, z1 - 1, z2 - 1).
    modal_stiffness : (4, Nm, Nm) ndarray
        Stiffness terms in the modal basis.
    modal_mass : (3, Nm, Nm) ndarray
        Mass terms in the modal basis.
    modal_load : (2, Nm) ndarray
        Loads in the modal basis.
    modal_output : (G + 1, Nm) ndarray
        Outputs of the modal basis vectors.
    cross_mass : (3, Nm, N) ndarray
        Mass terms between the modal and the static basis.
    flapwise_reference : (2, Nm) ndarray
        Shapes that define the first and second flapwise bending, in the modal basis.
    mode_count : int
        Number of modes M that `modes` returns.
    """

    design_hash: str
    validity_box: FloatArray
    static_stiffness: FloatArray
    static_load: FloatArray
    static_output: FloatArray
    bound_reference: FloatArray
    residual_load: FloatArray
    residual_stiffness: FloatArray
    residual_allowance: float
    rounding_allowance: float
    dual_split_1: FloatArray
    dual_split_2: FloatArray
    dual_correction: FloatArray
    dual_residual: FloatArray
    modal_stiffness: FloatArray
    modal_mass: FloatArray
    modal_load: FloatArray
    modal_output: FloatArray
    cross_mass: FloatArray
    flapwise_reference: FloatArray
    mode_count: int
    _online: OnlineArrays = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, expected in self._expected_shapes().items():
            array = getattr(self, name)
            if array.shape != expected or array.dtype != np.float64 or not np.isfinite(array).all():
                raise ReducedModelFileError(
                    f"The array {name} of a reduced model must hold finite numbers in the shape {expected}, "
                    f"but it has shape {array.shape} and type {array.dtype}; build the model anew."
                )
        if not 1 <= self.mode_count <= self.modal_stiffness.shape[1]:
            raise ReducedModelFileError(
                f"A reduced model with {self.modal_stiffness.shape[1]} modal basis vectors cannot have "
                f"{self.mode_count} modes; build the model anew."
            )
        for name in ("residual_allowance", "rounding_allowance"):
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0.0):
                raise ReducedModelFileError(
                    f"The {name} of a reduced model must not be negative, but is {value!r}; build it anew."
                )
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

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        n, outputs, r = (
            self.static_stiffness.shape[-1],
            self.static_output.shape[0],
            self.residual_load.shape[0],
        )
        a1, a2, m = self.dual_split_1.size + 1, self.dual_split_2.size + 1, self.modal_stiffness.shape[-1]
        return {
            "validity_box": (len(PARAMETER_NAMES), 2),
            "static_stiffness": (4, n, n),
            "static_load": (2, n),
            "static_output": (outputs, n),
            "bound_reference": (3,),
            "residual_load": (r, 2),
            "residual_stiffness": (r, 4, n),
            "dual_split_1": (a1 - 1,),
            "dual_split_2": (a2 - 1,),
            "dual_correction": (a1, a2, outputs, r),
            "dual_residual": (a1, a2, outputs, 4, 4),
            "modal_stiffness": (4, m, m),
            "modal_mass": (3, m, m),
            "modal_load": (2, m),
            "modal_output": (outputs, m),
            "cross_mass": (3, m, n),
            "flapwise_reference": (2, m),
        }

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
        young_modulus_factor : float
            e, the factor on Young's modulus of the skin [1].
        stiffness_loss : tuple of float
            (z1, z2), fractions of stiffness lost [1].
        load_factor : float
            Load factor of the manoeuvre [1].
        tip_force : float
            Force 5 cm from the tip [N], upwards positive.

        Returns
        -------
        StaticResponse
            Strain, tip displacement, their error bounds, reduced coordinates.

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
        young_modulus_factor : float
            e [1].
        stiffness_loss : tuple of float
            (z1, z2), fractions.

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
        young_modulus_factor : float
            e [1].
        stiffness_loss : tuple of float
            (z1, z2), fractions.
        servo_mass, pitot_mass : float
            Mass of each servo and of the pitot tube [kg].

        Returns
        -------
        Modes
            Frequencies, shapes, outputs, participations, indices of the flapwise bending modes.

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
        to_standard = np.linalg.inv(np.linalg.cholesky(mass))
        square, vectors = np.linalg.eigh(to_standard @ stiffness @ to_standard.T)
        shape = to_standard.T @ vectors[:, : self.mode_count]
        shape = shape * np.where(self.modal_output[-1] @ shape < 0.0, -1.0, 1.0)
        output = self.modal_output @ shape
        force = self.modal_load @ shape
        reference = self.flapwise_reference @ mass
        assurance = (reference @ shape) ** 2 / np.sum(reference * self.flapwise_reference, axis=1)[
            :, np.newaxis
        ]
        first, second = (int(i) for i in assurance.argmax(axis=1))
        return Modes(
            frequency=np.sqrt(square[: self.mode_count]) / (2.0 * np.pi),
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

    def to_bytes(self) -> bytes:
        """Return the model as the bytes of an `.npz` file; the same model gives the same bytes."""
        arrays: dict[str, npt.NDArray[Any]] = {"format": np.array(FORMAT)}
        for item in fields(self):
            if item.init:
                arrays[item.name] = np.array(getattr(self, item.name))
        return arrays_to_bytes(arrays)

    @classmethod
    def from_bytes(cls, content: bytes, where: str = "The reduced model") -> "ReducedModel":
        """Return the model that `to_bytes` packed.

        Parameters
        ----------
        content : bytes
            An `.npz` archive.
        where : str
            What is being read, for the error message.

        Returns
        -------
        ReducedModel
            The model, equal to the last bit.

        Raises
        ------
        ReducedModelFileError
            If the archive is damaged, incomplete or of another format.
        """
        names = [item.name for item in fields(cls) if item.init]
        arrays = arrays_from_bytes(content, where, ("format", *names))
        if arrays["format"].tolist() != FORMAT:
            raise ReducedModelFileError(
                f"{where} has the format {arrays['format']}, but this version reads {FORMAT}; build it anew."
            )
        values: dict[str, Any] = {name: arrays[name] for name in names}
        values["design_hash"] = str(arrays["design_hash"])
        try:
            for name in ("residual_allowance", "rounding_allowance"):
                values[name] = float(arrays[name])
            values["mode_count"] = int(arrays["mode_count"])
            return cls(**values)
        except (TypeError, ValueError, IndexError) as cause:
            raise ReducedModelFileError(
                f"{where} does not hold the arrays of a reduced model ({cause}); build it anew."
            ) from cause

    def save(self, path: str | Path) -> None:
        """Write the model to one `.npz` file, whole or not at all.

        Parameters
        ----------
        path : str or Path
            The file.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        write_bytes_atomically(Path(path), self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> "ReducedModel":
        """Read a model that `save` wrote.

        Parameters
        ----------
        path : str or Path
            The file.

        Returns
        -------
        ReducedModel
            The model, equal to the last bit.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ReducedModelFileError
            If it is damaged, incomplete or of another format.
        """
        return cls.from_bytes(Path(path).read_bytes(), str(path))
