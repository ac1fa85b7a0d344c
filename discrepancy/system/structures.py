"""A structure as a model by its modes: any from a mesh or matrices, and the wing with its patches."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.errors import CalibrationError
from calibration.joint.wing_table import SHIPPED_PRIOR, wing_priors
from calibration.result.file import load_calibration
from calibration.result.record import STATE, ParameterPrior
from discrepancy.campaign.records import FloatArray, Quantity, TrialKind
from discrepancy.errors import ModelError, said
from discrepancy.system.excitation import Acting, Course, Load, Shown, place_among
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.response import MOVES, TURNS, Outputs, Place
from discrepancy.system.scales import PortScale
from discrepancy.system.system_model import Case, State, SystemModel
from fe.reduction.model_cache import patch_arrays
from fe.runtime import patch as changes
from fe.runtime.errors import FiniteElementError
from fe.runtime.motion import PLANFORM, STATION_PORTS
from fe.runtime.patch import INTERNAL_FORCES, PRIMITIVES, SENSORS, ModelPatch, Primitive
from fe.runtime.patched_wing import PatchedState, PatchedWing
from fe.runtime.reduced import ReducedModel, ReducedState
from fe.runtime.state import wing_names
from fe.runtime.wing_rows import LOAD_PLACE, PORTS, PatchArrays, strain_gauge
from fe.structure.affine import PORT_PREFIX
from fe.wing.design import WingDesign, load_design
from reporting.progress import Progress

LOAD_FACTOR = "load_factor"
"""Control that is the load factor of flights."""
DEVIATION = 0.25
"""Standard deviation of a parameter whose calibration is not known, as a share of its range."""
SAME = 1e-9
"""Difference of two rows, relative to the largest entry, that is rounding."""
ROTATING_PORT = "root"
Prior = Mapping[str, tuple[float, float]]
"""Means and standard deviations of calibrated parameters, by the names of `STATE`."""
Design = WingDesign | None


class StructureModel(SystemModel):
    """A structure from a mesh or matrices; its parameters and free masses have `DEVIATION`.

    A control in N is a force, and where a load of it acts along a displacement output, in either direction,
    there is a port, which has the name and the sign of that output. Ports of the file come behind these.
    Other controls are nominal but for the load factor, which is zero where none is recorded; constant loads
    always act.

    Parameters
    ----------
    model : ReducedModel
        The structure, with the ports of its file (`reduced_structure(..., with_ports=True)`).

    Raises
    ------
    ModelError
        If no control is a force or a load factor, or a port of the file moves as another port does.
    """

    def __init__(self, model: ReducedModel) -> None:
        nominal = dict(zip(model.chosen, model.nominal.tolist(), strict=True))
        self.model, self.name, self.regions = model, model.name, model.regions
        self.parameters = tuple(
            ParameterPrior(name, unit, nominal[name], DEVIATION * (high - low), low, high)
            for names, unit in ((model.parameters, "1"), (model.masses, "kg"))
            for name in names
            for low, high in [model.validity[name]]
        )
        units = zip(model.controls, model.control_units, strict=True)
        self.forces = tuple(name for name, unit in units if unit == "N" and not _is_at_port(name))
        if not self.forces and LOAD_FACTOR not in model.controls:
            raise ModelError(said("models.no_load", model=model))
        if LOAD_FACTOR not in model.controls:
            self.kinds -= {TrialKind.FLIGHT}
        self.reference, self.load_places = (*self.forces, LOAD_FACTOR)[0], self.forces
        self.largest_force = 0.5 * min((model.validity[name][1] for name in self.forces), default=np.inf)
        _, outputs, accelerations = model.rows
        names = (*model.gauges, *model.displacements, *model.accelerations)
        self._rows = dict(zip(names, (*outputs, *accelerations), strict=True))
        displacements = [name for name in model.displacements if not _is_at_port(name)]
        self.quantities = {
            **dict.fromkeys(model.gauges, Quantity.STRAIN),
            **dict.fromkeys(displacements, Quantity.DISPLACEMENT),
            **dict.fromkeys(model.accelerations, Quantity.ACCELERATION),
        }
        self.port_rows = self._ports_of_loads(displacements)
        for port, row in self._ports_of_file().items():
            self._check_moves_otherwise(port, row)
            self.port_rows[port] = row
        self.ports = tuple(self.port_rows)

    def _ports_of_loads(self, displacements: Iterable[str]) -> dict[str, FloatArray]:
        """Return the rows of the displacements along which a force acts, by name."""
        mean = State(tuple(self.prior_mean().tolist()))
        pushes = [self._load(mean, force) for force in self.forces]
        return {
            name: self._rows[name]
            for push in pushes
            for name in displacements
            if _acts_along(push, self._rows[name])
        }

    def _ports_of_file(self) -> dict[str, FloatArray]:
        """Return the rows of the ports that the structure file declares, by name."""
        return {
            name.removeprefix(PORT_PREFIX): self._rows[name]
            for name in self.model.displacements
            if _is_at_port(name)
        }

    def _check_moves_otherwise(self, port: str, row: FloatArray) -> None:
        """Refuse a port of the file whose row (n,) reads what another port reads."""
        for other, other_row in self.port_rows.items():
            if _acts_along(row, other_row):
                raise ModelError(
                    f"The port {port!r} of the structure {self.name} moves as its port {other!r} does, so "
                    "that no reading tells their forces apart: take this [[port]] out of the file."
                )

    def _at(self, state: State, controls: Mapping[str, float]) -> FloatArray:
        """Return the values that the structure is made at; controls that are left out are nominal."""
        names = (*self.model.parameters, *self.model.masses)
        return self.model.vector(
            {**dict(zip(names, state.parameters, strict=True)), **controls}, state.losses
        )

    def _pull(self, state: State, controls: Mapping[str, float]) -> FloatArray:
        """Return the load (n,) under controls."""
        return np.asarray(self.model.rows[0] @ self.model.load_coefficients(self._at(state, controls)))

    def _load(self, state: State, control: str) -> FloatArray:
        """Return what one of a control adds to the load (n,)."""
        none = dict.fromkeys(self.model.controls, 0.0)
        return self._pull(state, none | {control: 1.0}) - self._pull(state, none)

    def shown(self, case: Case, outputs: Outputs, acting: Acting | None) -> list[Shown]:
        """Return what outputs show."""
        return [Shown.of(self._rows[output], quantity.order) for output, quantity in outputs]

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the structure can carry a primitive: sensors, laws at its ports, errors of its forces."""
        forces = primitive is changes.LoadGain and bool(self.forces)
        return primitive in SENSORS or forces or (primitive in INTERNAL_FORCES and bool(self.ports))

    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (n,) of 1 N of a force, or, where there is none, of the load factor.

        Raises
        ------
        ModelError
            If there is no such force, or none is named of several.
        """
        return self._load(state, place_among(self.forces or (LOAD_FACTOR,), place, self.what))

    def lift(self, state: State, change: ModelPatch) -> FloatArray:
        """Return the load (1, n) of the load factor."""
        return self._load(state, LOAD_FACTOR)[None]

    def acting(self, case: Case) -> Acting:
        """Return what acts in a trial, with constant loads and controls that no trial records."""
        recorded = {name: 0.0 for name in (*self.forces, LOAD_FACTOR) if name in self.model.controls}
        acting, always = super().acting(case), self._pull(case.state, recorded)
        if not always.any():
            return acting
        steady = Load(always, Course(acting.time, np.ones(len(acting.time))))
        return replace(acting, loads=(*acting.loads, steady))

    def made(self, state: State) -> LinearSystem:
        """Return the structure in a state, in the coordinates of `ReducedModel.at`.

        Raises
        ------
        OutsideModelError
            If a value lies outside the validity box of the reduced model.
        """
        return _system(self.model.at(self._at(state, {})), self.model.damping, self.port_rows)


def _is_at_port(name: str) -> bool:
    """Return whether a control or a displacement is that of a port of the structure file."""
    return name.startswith(PORT_PREFIX)


def _acts_along(push: FloatArray, row: FloatArray) -> bool:
    """Return whether a load (n,) acts along the row (n,) of a displacement, or against it."""
    largest = float(np.abs(push).max())
    amount = float(push @ row) / (float(row @ row) or 1.0)
    return largest > 0.0 and float(np.abs(push - amount * row).max()) <= SAME * largest


def _system(
    structure: ReducedState | PatchedState, rayleigh: Iterable[float], ports: Mapping[str, FloatArray]
) -> LinearSystem:
    """Return a structure with Rayleigh damping [1/s], [s] and rows of its ports."""
    alpha, beta = rayleigh
    return LinearSystem(
        structure.mass, alpha * structure.mass + beta * structure.stiffness, structure.stiffness, ports,
        structure.mode_count, beta, structure.on_modes, solved=structure,
    )  # fmt: skip


def _by_cholesky(stiffness: FloatArray) -> Callable[[FloatArray], FloatArray]:
    return partial(cho_solve, cho_factor(stiffness, check_finite=False), check_finite=False)


class WingModel(SystemModel):
    """The wing in the states and under the structural patches that are asked for, each made once.

    Parameters
    ----------
    arrays : PatchArrays
        The wing for patches.
    name : str
        For people.
    prior : mapping of str to (float, float)
        Mean and standard deviation of the calibrated parameters, by the names of
        `calibration.result.record.STATE`.
    design : WingDesign, optional
        What the arrays were made of.

    Notes
    -----
    Load places are "tip_load" or (y [m], chord fraction). Outputs are strain[k], strain[k].transverse and
    strain[k].shear across it, tip_displacement, load_point_displacement and displacement[y, x].
    """

    reference = LOAD_PLACE

    def __init__(
        self, arrays: PatchArrays, name: str = "wing", prior: Prior = SHIPPED_PRIOR, design: Design = None
    ) -> None:
        self.design = design
        self.wing = wing = PatchedWing(arrays)
        wing.factorised = _by_cholesky
        box = dict(zip(wing_names(arrays.regions), arrays.validity_box.tolist(), strict=True))
        self.name, self.parameters = name, wing_priors(box, **prior)
        self.regions, self.length, self.port_rows = arrays.regions, wing.span, wing.port_rows
        self.stations = 0.0, wing.span
        self.ports = tuple(PORTS)

    @cached_property
    def _row(self) -> Callable[[str], FloatArray | None]:
        return cache(self.wing.output_row)

    @classmethod
    def of_design(cls, path: Path | str | None = None, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a design file, or the shipped one, calibrated as the documentation states.

        Raises
        ------
        ModelError
            If it cannot be read, modelled or reduced.
        """
        with ModelError.instead_of(FiniteElementError):
            design = load_design(path)
            return cls(patch_arrays(design, progress), design.name, design=design)

    @classmethod
    def of_calibration(cls, path: Path | str, progress: Progress | None = None) -> "WingModel":
        """Return the wing of a calibration, its posterior as prior.

        Raises
        ------
        ModelError
            If the calibration cannot be read, or its wing not be modelled.
        """
        unusable = f"The calibration {path} cannot be used: "
        with ModelError.instead_of(FiniteElementError, CalibrationError, OSError, before=unusable):
            result = load_calibration(path)
            prior = {name: (result.mean(name), float(np.std(result.draws_of(name)))) for name in STATE}
            design = result.wing_design
            return cls(patch_arrays(design, progress), result.asset, prior, design)

    # ------------------------------------------------------------ outputs, ports and loads

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if there is no such output."""
        if self._row(output) is None:
            return None
        return Quantity.STRAIN if output.startswith("strain") else Quantity.DISPLACEMENT

    def shown(self, case: Case, outputs: Outputs, acting: Acting | None) -> list[Shown]:
        """Return what outputs show."""
        rows = np.array([self._row(output) for output, _ in outputs])
        factors = self.wing.strain_factors(case.patch)
        if factors is not None:
            gauges = np.array([strain_gauge(output) for output, _ in outputs])
            rows = rows * np.where(gauges >= 0, factors[gauges], 1.0)[:, None]
        return [Shown.of(row, quantity.order) for row, (_, quantity) in zip(rows, outputs, strict=True)]

    @property
    def shown_outputs(self) -> tuple[str, ...]:
        """Its outputs, for a sentence."""
        places = f"displacement[y, x] with y from 0 to {self.wing.span:g} m and x the chord fraction"
        gauges = f"strain[1] to strain[{len(self.wing.arrays.gauge_stations)}]"
        return gauges, "tip_displacement", "load_point_displacement", places

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the wing can carry a primitive; it can carry all but forces by a formula in time."""
        return primitive in PRIMITIVES.values() and primitive is not changes.PortLoad

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of force and motion at a port: the root turns, the others move up and down."""
        return TURNS if port == ROTATING_PORT else MOVES

    def at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at ports of `port_rows`."""
        return self.wing.internal_forces(forces)

    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (n,) of 1 N at a place; raises `InvalidPatchError` if it is off the wing."""
        return self.wing.force_row(place, change)

    def lift(self, state: State, change: ModelPatch) -> FloatArray:
        """Return the parts (2, n) of the lift."""
        return self.wing.load_parts(change)

    def spread(self, ports: Mapping[str, PortScale], shape: FloatArray) -> dict[str, PortScale]:
        """Return the scales of a force over the planform, from those of its mean and the first mode."""
        share = self.wing.planform[1]
        motion = np.array([self.wing.port_rows[port] @ shape for port in STATION_PORTS])
        ratio = motion / float(share @ motion)
        by_place = tuple(zip(share.tolist(), ratio.tolist(), strict=True))
        return {PLANFORM: replace(ports["span"], spread=by_place)}

    def made(self, state: State) -> LinearSystem:
        """Return the wing in a state."""
        factor, servo, pitot, alpha, beta = state.parameters
        vector = np.array((factor, *state.losses, servo, pitot, 0.0, 0.0))
        structure = self.wing.at(vector, state.structure, state.warmer)
        return _system(structure, (alpha, beta), self.port_rows)
