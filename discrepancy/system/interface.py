"""The interface of models: the response to a trial under a patch, before sensors act on it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Self, cast

import numpy as np

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.campaign.units import quantity_with_unit
from discrepancy.errors import ModelError
from discrepancy.system.response import (
    EITHER,
    Conditions,
    Outputs,
    PortedSystem,
    PortsAtRest,
    Response,
)
from discrepancy.system.scales import Scales
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    ModelPatch,
    PlaceMass,
    PortForce,
    Primitive,
    RegionStiffnessLoss,
)
from fe.runtime.state import Losses
from reporting.system.memory import ResultCache
from reporting.words import brief, capital, comma_list, counted

RESPONSE_CACHE_BYTES = 24_000_000
"""Largest memory of the responses that a model keeps [B]; the least recently used goes first."""
MOST_RESPONSES = 400
"""Largest number of these responses, which short records reach before the memory is full."""
NO_PATCH = ModelPatch()


def _weight_of_response(cached: object) -> int:
    """Return the weight [B] of an entry of a model's cache, a trial with its response.

    A short response weighs as much as if `MOST_RESPONSES` of its kind filled the cache.
    """
    _, response = cast(tuple[Trial, Response], cached)
    size = response.values.nbytes + (0 if response.rates is None else response.rates.nbytes)
    return max(size, RESPONSE_CACHE_BYTES // MOST_RESPONSES)


class MassPoint(NamedTuple):
    """Where an added mass lies.

    Attributes
    ----------
    point : (3,) array
        The point [m].
    axes : (2, 3) array
        Unit vectors along which its distances from its place are measured.
    """

    point: FloatArray
    axes: FloatArray


class Model(ABC):
    """A model that can be patched.

    Attributes
    ----------
    name : str
        The name of the model in messages and reports.
    parameters : tuple of ParameterPrior
        Calibrated parameters: the posterior of a calibration is the prior here.
    quantities : mapping of str to Quantity
        The physical quantity of each output, by name.
    ports : tuple of str
        The names of the ports where internal forces can act on one motion; user effects act at
        these.
    length : float or None
        Characteristic length [m], if it has any.
    stations : tuple of float, optional
        Least and largest station [m] along the structure, if it has a length.
    nuisance_parameters : frozenset of str
        Parameters that no file states and no result lists, such as errors of the mesh. They have
        no influence on trials at rest.
    patch : ModelPatch
        The primitives that act in every response: a known addition, or an effect that was found.
    regions : tuple of str
        Damage regions.
    largest_losses : mapping of str to float
        Largest stiffness loss of each damage region that the model can have.
    kinds : frozenset of TrialKind
        The kinds of trials that it can simulate.
    support_motions : tuple of (str, str)
        The supports that may yield, each with a motion, such as "rx".
    interface_motions : tuple of (str, str)
        The interfaces of two parts that may yield, each with a motion, such as "rs".
    mass_places : tuple of str
        Places where a mass may be added or lost.
    mass_reaches : mapping of str to float
        Distance from a place within which a mass is nearest to it [m]; a mass lies exactly at the
        places that are left out.
    kinds_with_weight : frozenset of TrialKind
        The kinds of static trials in which an acceleration, such as gravity, acts on the masses
        that are added at places, so that these show at rest.
    loss_places : tuple of str
        Patches that are no damage regions and may lose stiffness.
    places_with_gauges : frozenset of str
        The patches on which a gauge sits.
    load_changes : tuple of (str, str, str)
        Changes of forces: the control, "offset" of its place or "tilt", and the axis.
    gauge_shifts : tuple of (str, str)
        Gauges whose place may be wrong, with "along" or "across".
    possible_sensors : mapping of str to Quantity
        Outputs that the structure file does not declare, of sensors that a user may add.
    possible_loads : tuple of str
        Load places that it does not declare, of forces that a user may apply.
    load_places : tuple of str, optional
        The names of the places where forces can act; None: anywhere along the structure.
    largest_force : float
        Largest force at these places that is well within the model's range [N].
    holds_inputs : bool
        Whether static trials can hold other inputs than a force.
    follows_windows : bool
        Whether it can follow laws that act in windows only.
    linear : bool
        Whether the internal forces that the model has itself (`built_in_laws`) are left out.
    shows_ports : bool
        Whether the motion of its ports can be computed (`ported_system` and `port_motion`).
    shows_ports_at_rest : bool
        Whether the action of forces at its ports at rest can be computed (`ports_at_rest`).
    """

    name: str
    parameters: tuple[ParameterPrior, ...]
    quantities: Mapping[str, Quantity] = MappingProxyType({})
    ports: tuple[str, ...] = ()
    length: float | None = None
    stations: tuple[float, float] | None = None
    nuisance_parameters: frozenset[str] = frozenset()
    patch: ModelPatch = NO_PATCH
    regions: tuple[str, ...] = ()
    largest_losses: Mapping[str, float] = MappingProxyType({})
    kinds: frozenset[TrialKind] = frozenset(TrialKind)
    support_motions: tuple[tuple[str, str], ...] = ()
    interface_motions: tuple[tuple[str, str], ...] = ()
    mass_places: tuple[str, ...] = ()
    mass_reaches: Mapping[str, float] = MappingProxyType({})
    kinds_with_weight: frozenset[TrialKind] = frozenset()
    loss_places: tuple[str, ...] = ()
    places_with_gauges: frozenset[str] = frozenset()
    load_changes: tuple[tuple[str, str, str], ...] = ()
    gauge_shifts: tuple[tuple[str, str], ...] = ()
    possible_sensors: Mapping[str, Quantity] = MappingProxyType({})
    possible_loads: tuple[str, ...] = ()
    load_places: tuple[str, ...] | None = None
    largest_force: float = np.inf
    holds_inputs: ClassVar[bool] = False
    follows_windows: ClassVar[bool] = False
    shows_ports: ClassVar[bool] = True
    shows_ports_at_rest: ClassVar[bool] = True
    linear: bool = False
    _unpatched_parameters: tuple[ParameterPrior, ...] | None = None
    _responses: ResultCache | None = None

    def __repr__(self) -> str:
        parameters = [parameter.name for parameter in self.parameters]
        return brief(self, name=self.name, parameters=parameters, effects=len(self.patch))

    @property
    def quoted_name(self) -> str:
        """The model as it is called in a sentence."""
        return f"the model {self.name!r}"

    def output_quantity(self, output: str) -> Quantity | None:
        """Return the quantity of an output, or None if the model has no such output."""
        return self.quantities.get(output)

    @property
    def outputs_with_quantities(self) -> tuple[str, ...]:
        """The outputs with quantity and SI unit, as they are listed in a sentence."""
        return tuple(
            f"{name} ({quantity_with_unit(quantity)})" for name, quantity in self.quantities.items()
        )

    # ------------------------------------------------------------ what each kind of model defines

    @abstractmethod
    def supports(self, primitive: type[Primitive]) -> bool:
        """Return whether the model can carry a primitive; sensors need no model."""

    @abstractmethod
    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, without the model's patch."""

    @abstractmethod
    def _respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the response of a trial, given checked outputs and the whole patch.

        Parameters
        ----------
        trial : Trial
            The trial, of which only the inputs and the sample times are used.
        outputs : tuple of (str, Quantity)
            The outputs that the model has, and the quantity wanted of each.
        patch : ModelPatch
            All primitives that act, those of the model too.
        conditions : Conditions
            Parameters, initial state, clock and health.
        """

    def initial_state_magnitudes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return typical magnitudes (L,) of an unknown initial state; empty if it is known."""
        return np.zeros(0)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws.

        Parameters
        ----------
        trial : Trial
            The dynamic trial.
        conditions : Conditions
            Parameters, initial state, clock and health.
        parts : int
            Each interval between samples of the trial is divided into this many, and N grows
            accordingly.
        """
        raise NotImplementedError

    def _ports_at_rest(self, trial: Trial, outputs: Outputs, conditions: Conditions) -> PortsAtRest:
        """Return the ports in a trial at rest, without laws.

        The caller, `ports_at_rest`, has checked the outputs.
        """
        raise NotImplementedError

    def _ported_system(
        self, trial: Trial, outputs: Outputs, parameters: FloatArray
    ) -> PortedSystem:
        """Return the linear system from missing forces to outputs.

        The caller, `ported_system`, has checked the outputs. A missing force is an unknown force in
        time. It acts at a port: a place of the structure where a force may act.
        """
        raise NotImplementedError

    def forces_at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return the internal forces of a patch as forces at the ports of the model's system.

        A force that is spread over a wing becomes forces at several ports.
        """
        return forces

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of force and motion at a port; `EITHER` if they are not known."""
        return EITHER

    def built_in_laws(self, parameters: FloatArray) -> ModelPatch:
        """Return the laws that the model itself has at ports."""
        return NO_PATCH

    @property
    def oscillates(self) -> bool:
        """Whether the model has a mode that vibrates."""
        return True

    # ------------------------------------------------------------ checks

    def check_trial(self, trial: Trial) -> None:
        """Raise an error if the model cannot follow a trial.

        Raises
        ------
        ModelError
            If the model cannot follow trials of that kind, begin as the trial does, or hold its
            inputs.
        """
        if trial.kind is TrialKind.FLIGHT and TrialKind.FLIGHT not in self.kinds:
            raise ModelError(
                f"The trial {trial.name!r} is a flight, but {self.quoted_name} has no input "
                "load_factor: give it one."
            )
        if trial.kind is TrialKind.RINGDOWN and TrialKind.RINGDOWN not in self.kinds:
            raise ModelError(
                f"The trial {trial.name!r} is a ring-down, which {self.quoted_name} cannot begin, "
                'since it is free, driven or has states; set kind = "driven" and begins = '
                '"unknown".'
            )
        is_driven = trial.kind is TrialKind.DRIVEN
        if TrialKind.DRIVEN not in self.kinds and (is_driven or trial.begins is not Start.SETTLED):
            how = "is driven" if is_driven else f"begins {trial.begins.value}"
            raise ModelError(
                f"The trial {trial.name!r} {how}, which {self.quoted_name} cannot follow: describe "
                "the rig as a lumped model, or record it forced from rest."
            )
        if trial.kind is TrialKind.STATIC and trial.inputs and not self.holds_inputs:
            inputs = ", ".join(map(repr, trial.input_names))
            raise ModelError(
                f"The trial {trial.name!r} is static under the inputs {inputs}, which "
                f"{self.quoted_name} does not have at rest: describe the asset as an FMU model "
                'with [[input]], or record the trial as "driven".'
            )

    def check_outputs(self, outputs: Outputs) -> None:
        """Raise an error if an output does not exist, or lacks the quantity of its channel."""
        for output, measured_kind in outputs:
            quantity = self.output_quantity(output)
            if quantity is None:
                raise ModelError(
                    f"{capital(self.quoted_name)} has no output {output!r}; it has "
                    f"{', '.join(self.outputs_with_quantities)}."
                )
            if not measured_kind.can_measure(quantity):
                raise ModelError(
                    f"The output {output!r} of {self.quoted_name} is a {quantity.value}, but a "
                    f"channel measures {measured_kind.value}."
                )

    def _check_primitives(self, patch: ModelPatch) -> None:
        """Raise an error if a patch has a primitive that the model cannot carry."""
        for primitive in patch:
            if isinstance(primitive, SENSORS) or self.supports(type(primitive)):
                continue
            lacks_port = isinstance(primitive, INTERNAL_FORCES) and not self.ports
            reason = " (it has no port)" if lacks_port else ""
            raise ModelError(
                f"{capital(self.quoted_name)} cannot carry the primitive "
                f"{primitive.kind!r}{reason}."
            )

    def region_losses(
        self, trial: Trial, health: FloatArray, patch: ModelPatch = NO_PATCH
    ) -> list[Losses]:
        """Return the stiffness losses of the model's regions, a tuple of them for each row.

        Parameters
        ----------
        trial : Trial
            The trial, which names the regions of its losses.
        health : (N, K) array
            Losses of these regions that the campaign states.
        patch : ModelPatch
            A patch, whose `RegionStiffnessLoss` act on the stiffness that the stated losses leave.

        Raises
        ------
        ModelError
            If a loss that is not zero is of a region that the model does not have.
        """
        losses = np.zeros((len(health), len(self.regions)))
        for name, region_losses in zip(trial.regions, health.T, strict=False):
            if name in self.regions:
                losses[:, self.regions.index(name)] = region_losses
            elif np.any(region_losses):
                raise ModelError(
                    f"The trial {trial.name!r} gives a loss of the damage region {name!r}, but "
                    f"{self.quoted_name} has {comma_list(self.regions)}."
                )
        for primitive in patch:
            if not isinstance(primitive, RegionStiffnessLoss):
                continue
            if primitive.region not in self.regions:
                raise ModelError(
                    f"The patch takes stiffness from the damage region {primitive.region!r}, but "
                    f"{self.quoted_name} has {comma_list(self.regions)}."
                )
            column = self.regions.index(primitive.region)
            losses[:, column] = 1.0 - (1.0 - losses[:, column]) * (1.0 - primitive.loss)
        return [tuple(row) for row in losses.tolist()]

    # ------------------------------------------------------------ parameters

    @property
    def unpatched_parameters(self) -> tuple[ParameterPrior, ...]:
        """Calibrated parameters of the model without the patch."""
        if self._unpatched_parameters is None:
            return self.parameters
        return self._unpatched_parameters

    def prior_moments(self, campaign: Campaign) -> list[tuple[float, float]]:
        """Return mean and standard deviation of the prior of each parameter.

        Both are those that the campaign states, or else those of the model.
        """
        campaign_parameters = campaign.parameters
        return [
            campaign_parameters.get(parameter.name, (parameter.mean, parameter.deviation))
            for parameter in self.parameters
        ]

    def point_of_mass(self, mass: PlaceMass) -> MassPoint | None:
        """Return where a mass lies that may lie beside its place; None if it lies at the place."""
        return None

    def prior_mean(self, campaign: Campaign | None = None) -> FloatArray:
        """Return the prior means (P,) of the parameters of the model without its patch.

        The campaign's mean is taken if it states one, else the model's.
        """
        means = [parameter.mean for parameter in self.unpatched_parameters]
        if campaign is not None:
            for index, parameter in enumerate(self.unpatched_parameters):
                if parameter.name in campaign.parameters:
                    means[index] = campaign.parameters[parameter.name][0]
        return np.array(means)

    # ------------------------------------------------------------ response

    @property
    def built_in_sensors(self) -> ModelPatch:
        """Sensors that are built in, for channels or for outputs of those names.

        They are not a part of the model's responses: `discrepancy.system.sensing.observe` applies
        them, since what sensors show of a response depends on all of them together.
        """
        return self.patch.of(*SENSORS)

    def respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the true response of a trial: no errors of sensors act, not even of the patch.

        An output that is wanted as a velocity or an acceleration is differentiated in time; one
        that is wanted as a signal is returned unchanged. A model with a response cache takes a
        repeated response from there.

        Parameters
        ----------
        trial : Trial
            The trial, of which only the inputs and the sample times are used.
        outputs : tuple of (str, Quantity)
            Outputs, and the quantity wanted of each.
        patch : ModelPatch
            The primitives that act in addition to those of the model.
        conditions : Conditions
            Parameters, initial state, clock and health.

        Raises
        ------
        ModelError
            If the model lacks an output, cannot follow the trial or cannot carry a primitive.
        """
        if self._responses is None:
            return self._checked_response(trial, outputs, patch, conditions)
        # the cache keeps the trial alive, so that no other trial gets its id
        key = (id(trial), outputs, patch.primitives, conditions.key)
        _, response = self._responses.get(
            key, lambda: (trial, self._checked_response(trial, outputs, patch, conditions))
        )
        return response

    def _checked_response(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the response of a trial after all checks; see `respond`."""
        count = len(self.parameters)
        if conditions.parameters.shape != (count,):
            raise ModelError(
                f"{capital(self.quoted_name)} has {counted(count, 'parameter')}, but "
                f"{conditions.parameters.size} were given."
            )
        whole_patch = (self.patch + patch).in_trial(trial.name)
        self.check_trial(trial)
        self.check_outputs(outputs)
        self._check_primitives(whole_patch)
        with ModelError.instead_of(FiniteElementError):
            return self._respond(trial, outputs, whole_patch, conditions)

    def ported_system(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the linear system from missing forces at ports to outputs; see `PortedSystem`.

        Parameters
        ----------
        trial : Trial
            The dynamic trial.
        outputs : tuple of (str, Quantity)
            Outputs, and the quantity wanted of each.
        parameters : (P,) array
            Values of the model's parameters.

        Raises
        ------
        ModelError
            If the model has sensors built in, whose effect on a missing force is not modelled.
        """
        self._check_missing_forces(outputs)
        return self._ported_system(trial, outputs, parameters)

    def ports_at_rest(self, trial: Trial, outputs: Outputs, conditions: Conditions) -> PortsAtRest:
        """Return the ports of the model in a trial at rest, and what forces at them do.

        The laws of the model are left out.

        Parameters
        ----------
        trial : Trial
            The trial at rest.
        outputs : tuple of (str, Quantity)
            Outputs, and the quantity wanted of each.
        conditions : Conditions
            Parameters and health.

        Raises
        ------
        ModelError
            If the model has sensors built in, or has no position of rest.
        """
        self._check_missing_forces(outputs)
        return self._ports_at_rest(trial, outputs, conditions)

    def _check_missing_forces(self, outputs: Outputs) -> None:
        """Raise `ModelError` if outputs do not show a missing force as a linear system does."""
        self.check_outputs(outputs)
        if len(self.built_in_sensors):
            raise ModelError(
                f"{self.name} has sensors built in, which hide a missing force; leave them out."
            )

    # ------------------------------------------------------------ the model with changes

    def with_response_cache(self) -> Self:
        """Return a copy of the model that keeps its responses; the model itself if it does already.

        A search tries many faults of sensors on one motion.
        """
        if self._responses is not None:
            return self
        return self._copy_with(_responses=ResultCache(RESPONSE_CACHE_BYTES, _weight_of_response))

    def with_patch(
        self,
        patch: ModelPatch,
        calibrated: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> Self:
        """Return a copy of the model with a patch that acts in every response.

        Parameters
        ----------
        patch : ModelPatch
            The change of the model. Its errors of sensors name channels of a campaign or outputs of
            the model, and come before the errors of sensors in the patch of a response.
        calibrated : mapping of str to (float, float)
            Means and standard deviations of the parameters that differ from those of the model.
        """
        parameters = []
        for parameter in self.parameters:
            mean, deviation = calibrated.get(parameter.name, (parameter.mean, parameter.deviation))
            parameters.append(replace(parameter, mean=mean, deviation=deviation))
        return self._copy_with(
            patch=self.patch + patch,
            parameters=tuple(parameters),
            _unpatched_parameters=self.unpatched_parameters,
            _responses=None,
        )

    def without_laws(self) -> tuple[Self, ModelPatch]:
        """Return a copy without laws at its ports, and these laws at the prior means.

        The laws are those of the model itself, and those of its patch.
        """
        laws = self.built_in_laws(self.prior_mean()) + self.patch.of(PortForce)
        without_laws = self._copy_with(
            patch=self.patch.without(PortForce), linear=True, _responses=None
        )
        return without_laws, laws

    def _copy_with(self, **attributes: object) -> Self:
        """Return a copy of the model with other attributes."""
        model = copy(self)
        vars(model).update(attributes)
        return model
