"""A lumped linear structure as a model: masses, springs, dampers with named inputs, outputs and ports."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Trial, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.models.interface import (
    Conditions,
    Outputs,
    PortedSystem,
    Response,
    Scales,
)
from discrepancy.models.lumped_file import LumpedDescription, load_lumped
from discrepancy.models.lumped_rig import LumpedRig
from discrepancy.models.lumped_scales import lumped_scales, state_sizes
from discrepancy.models.memory import Memory
from discrepancy.models.model_file import DescribedModel
from discrepancy.models.questions import (
    LoadChange,
    SortedPatch,
    check_lumped,
    check_outputs,
    check_parameters,
    laws_at,
    prior_mean,
    sorted_patch,
)
from fe.runtime.laws import LAWS
from fe.runtime.motion import NO_LAWS, Laws
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PortLoad,
    Primitive,
    RootCompliance,
    StiffnessDrift,
)

KEPT_RIGS = 128
"""Values of the parameters and structures that are remembered."""
LEAST_STIFFNESS = 0.05
"""A temperature that leaves less than this share of the stiffness is refused."""


class LumpedModel(DescribedModel):
    """A lumped model (`discrepancy.models.interface.Model`).

    Parameters
    ----------
    description : LumpedDescription
        Content of its file.

    Notes
    -----
    Damping that is given as modal ratios stays at these ratios when the structure changes. Health (z1, z2)
    has no meaning here and is passed over.
    """

    def __init__(self, description: LumpedDescription) -> None:
        self.description = description
        super().__init__(description, {item.name: item.quantity for item in description.output})
        self._ports = {item.name: np.array(item.vector) for item in description.port}
        self._stations = sorted(place.station for place in description.place)
        self._rigs = Memory(KEPT_RIGS)

    @classmethod
    def load(cls, path: Path | str) -> "LumpedModel":
        """Return the model of a TOML file, or a shipped one by name; raises `ModelError`."""
        return cls(load_lumped(path))

    # ------------------------------------------------------------ what it is

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        description, n = self.description, self.description.size
        carried: dict[type[Primitive], bool] = {
            StiffnessDrift: n > 0,
            ModulusTemperature: True,
            PointMass: bool(self._stations),
            RootCompliance: description.root is not None,
            LoadGain: True,
            LoadPlace: any(item.station_derivative is not None for item in description.input),
            PortLoad: bool(self._ports),
        }
        if primitive in carried:
            return carried[primitive]
        if primitive in LAWS and not primitive.of_speed:  # the position of a state's port means nothing
            return bool(self._ports) and all(np.any(row[:n]) for row in self._ports.values())
        return primitive in SENSORS or (primitive in INTERNAL_FORCES and bool(self._ports))

    follows_windows: ClassVar[bool] = True
    shows_ports: ClassVar[bool] = True

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m] of the places, None without places."""
        return (self._stations[0], self._stations[-1]) if self._stations else None

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""
        mean = prior_mean(campaign, self.declared)
        return lumped_scales(self.rig(mean), mean, campaign, self.stations())

    # ------------------------------------------------------------ response

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial; `transverse` and `shear` are never known.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero.
        """
        check_lumped(trial, f"the lumped model {self.name!r}")
        check_outputs(f"The lumped model {self.name!r}", self, outputs, self.quantities)
        structure, forces, change, loads = self._parts(patch.in_trial(trial.name))
        forces = self.description.own_laws(self._factors(conditions.parameters)) + forces
        laws = laws_at(forces, self._ports)
        if trial.kind is TrialKind.STATIC:
            if loads or laws.spans:
                raise ModelError(
                    f"The trial {trial.name!r} has no time, which a law or a force in time asks for."
                )
            return self._static(trial, outputs, structure, laws, change, conditions)
        rig = self.rig(conditions.parameters, structure, float(trial.temperature[0]))
        motion = rig.moved(trial, conditions, laws, change, loads)
        return motion.seen(rig.shown(outputs, motion.acting))

    def _static(
        self,
        trial: Trial,
        outputs: Outputs,
        structure: tuple[Primitive, ...],
        laws: Laws,
        change: LoadChange,
        conditions: Conditions,
    ) -> Response:
        """Return what is shown at rest; levels of one temperature that follow one another go together."""
        warm = trial.temperature if _coefficient(structure) else np.zeros(len(trial.force))
        shown = self.rig(conditions.parameters, structure, float(warm[0])).shown(outputs)
        rows, n = np.array([item.row for item in shown]), self.description.size
        for (_, quantity), item in zip(outputs, shown, strict=True):
            if quantity.is_rate and (item.further or np.any(item.row[:n])):
                raise ModelError(
                    f"The trial {trial.name!r} is static, but a channel measures velocity or acceleration."
                )
        values = np.empty((len(warm), len(shown)))
        memory, before, start = None, None, 0
        changes = (np.flatnonzero(np.diff(warm)) + 1).tolist() if warm.any() else []
        for end in (*changes, len(warm)):
            rig = self.rig(conditions.parameters, structure, float(warm[start]))
            loads = rig.static_loads(trial, change)[start:end]
            try:
                found = rig.system().static(loads, laws, memory=memory, before=before)
            except ModelError as cause:
                raise ModelError(f"The trial {trial.name!r} is static, but {cause}") from cause
            values[start:end] = found.values @ rows.T
            memory, before, start = found.memory, loads[-1], end
        return Response(values + [item.constant for item in shown])

    @property
    def oscillates(self) -> bool:
        """Whether it has a mode that vibrates."""
        return bool(np.any(self.rig(self._mean).system().angular_frequency > 0.0))

    def initial_sizes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return natural sizes (L,) of the state at the begin of a driven or forced trial."""
        mean = prior_mean(campaign, self.declared)
        return state_sizes(self.rig(mean), campaign, trial, Conditions(mean))

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the modes of the prior means."""
        warm, structure = float(trial.temperature[0]), self._parts(self.patch).structure
        rig = self.rig(parameters, structure, warm)
        acting = rig.acting(trial, Conditions(parameters))
        base = self.rig(self._mean, structure, warm).system(tuple(acting.drives))
        return rig.system(tuple(acting.drives)).seen_by(rig.shown(outputs, acting), base.shapes)

    def port_motion(self, trial: Trial, conditions: Conditions) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        structure, _, change, loads = self._parts(self.patch.in_trial(trial.name))
        rig = self.rig(conditions.parameters, structure, float(trial.temperature[0]))
        motion = rig.moved(trial, conditions, NO_LAWS, change, loads)
        rows = np.array(list(motion.system.ports.values())).reshape(-1, rig.width)
        shapes = rows @ motion.system.all_shapes
        return motion.q @ shapes.T, motion.velocity @ shapes.T

    @property
    def has_law(self) -> bool:
        """Whether it has a law of a port of its own, in its file or found."""
        return bool(self.description.law) or super().has_law

    def apart(self) -> tuple[Self, ModelPatch]:
        """Return the linear model, and the laws that it has beside that, at the prior means."""
        linear, laws = super().apart()
        description = self.description.model_copy(update={"law": []})
        own = self.description.own_laws(self._factors(self._mean))
        return linear._changed(description=description, _rigs=Memory(KEPT_RIGS)), own + laws

    def unit_of_state(self, port: str) -> str:
        """Return the unit of what a law at a port of states acts on; empty for a port that moves or turns."""
        first = self.description.size
        if not np.any(self._ports.get(port, np.zeros(0))[first:]):
            return ""
        shown = {
            item.quantity for item in self.description.output if item.vector and any(item.vector[first:])
        }
        return UNITS[shown.pop()].si if len(shown) == 1 else "of the state's unit"

    def turns(self, port: str) -> bool | None:
        """Return whether a port turns; None where the model does not say it.

        It moves or turns as the unknowns do of which it is a sum or difference, and these as what is measured
        or prescribed of them.
        """
        vector = self._ports.get(port)
        if vector is None or not np.all(np.isin(vector, (-1.0, 0.0, 1.0))):
            return None
        told: dict[int, set[bool]] = {}
        known = [(item.vector, item.quantity.moving) for item in self.description.output]
        known += [(item.vector, item.quantity.moving) for item in self.description.input]
        for row, moving in known:
            if row is not None and moving and np.count_nonzero(row) == 1 and max(row) == 1.0:
                told.setdefault(int(np.argmax(row)), set()).add(Quantity.ANGLE in moving)
        kinds = set().union(*(told.get(int(at), {True, False}) for at in np.flatnonzero(vector)))
        return kinds.pop() if len(kinds) == 1 else None

    # ------------------------------------------------------------ parts

    def _parts(self, patch: ModelPatch) -> SortedPatch:
        return sorted_patch(patch, self, f"The lumped model {self.name!r}")

    @property
    def _mean(self) -> FloatArray:
        return np.array([item.mean for item in self.declared])

    def rig(
        self, parameters: FloatArray, structure: tuple[Primitive, ...] = (), temperature: float = 0.0
    ) -> LumpedRig:
        """Return the model at values of the parameters and a temperature above the reference [K]."""
        softening = _coefficient(structure) * temperature
        if 1.0 - softening < LEAST_STIFFNESS:
            raise ModelError(
                f"The temperature leaves {1.0 - softening:.2g} of the stiffness, which no structure has."
            )
        return self._rigs.get(
            (parameters.tobytes(), structure, softening),
            lambda: LumpedRig(self.description, self._factors(parameters), structure, softening),
        )

    def _factors(self, parameters: FloatArray) -> dict[str, float]:
        """Return the factors of the terms at values of the parameters."""
        check_parameters(f"The lumped model {self.name!r}", self.parameters, parameters)
        factors: dict[str, float] = {}
        for item, value in zip(self.description.parameter, parameters, strict=True):
            for term in item.scaled:
                factors[term] = factors.get(term, 1.0) * float(value)
        return factors


def _coefficient(structure: Sequence[Primitive]) -> float:
    return sum((item.coefficient for item in structure if isinstance(item, ModulusTemperature)), 0.0)
