"""What the workflow asks of a model: structural response under a patch, before any sensor touches it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar, Self

import numpy as np

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import ModelError, said
from discrepancy.system.response import EITHER, Conditions, Outputs, PortedSystem, Response
from discrepancy.system.scales import Scales
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, ModelPatch, PortForce, Primitive
from fe.runtime.state import Losses
from reporting.memory import ResultCache
from reporting.words import brief, capital, counted

KEPT = 400
"""Responses that a model keeps; the oldest goes first."""
NO_PATCH = ModelPatch()


class Model(ABC):
    """A model that can be patched.

    Attributes
    ----------
    name : str
        For people.
    parameters : tuple of ParameterPrior
        Calibrated parameters: the posterior of a calibration is the prior here.
    quantities : mapping of str to Quantity
        What each output is, by name.
    ports : tuple of str
        Names of the ports where internal forces can act on one motion; user effects act at these.
    length : float or None
        Characteristic length [m], if it has any.
    stations : tuple of float, optional
        Least and largest station [m] along the structure, if it has a length.
    patch : ModelPatch
        What is added to every question: a known addition, or an effect that was found.
    regions : tuple of str
        Damage regions.
    kinds : frozenset of TrialKind
        Trials that it can follow.
    load_places : tuple of str, optional
        Where forces can act, by name; None: anywhere along it.
    largest_force : float
        Force there that it takes with ease [N].
    holds_inputs : bool
        Whether static trials can hold other inputs than a force.
    follows_windows : bool
        Whether it can follow laws that act in windows only.
    linear : bool
        Whether its own laws at ports are left out.
    shows_ports : bool
        Whether it tells how its ports move (`ported` and `port_motion`).
    """

    name: str
    parameters: tuple[ParameterPrior, ...]
    quantities: Mapping[str, Quantity] = MappingProxyType({})
    ports: tuple[str, ...] = ()
    length: float | None = None
    stations: tuple[float, float] | None = None
    patch: ModelPatch = NO_PATCH
    regions: tuple[str, ...] = ()
    kinds: frozenset[TrialKind] = frozenset(TrialKind)
    load_places: tuple[str, ...] | None = None
    largest_force: float = np.inf
    holds_inputs: ClassVar[bool] = False
    follows_windows: ClassVar[bool] = False
    shows_ports: ClassVar[bool] = True
    linear: bool = False
    _declared: tuple[ParameterPrior, ...] | None = None
    _kept: ResultCache | None = None

    def __repr__(self) -> str:
        parameters = [parameter.name for parameter in self.parameters]
        return brief(self, name=self.name, parameters=parameters, effects=len(self.patch))

    @property
    def what(self) -> str:
        """What it is called in a sentence."""
        return f"the model {self.name!r}"

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if the model has no such output."""
        return self.quantities.get(output)

    @abstractmethod
    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive; sensors are not asked for: they need no model."""

    @property
    def shown_outputs(self) -> tuple[str, ...]:
        """Its outputs, for a sentence."""
        return tuple(f"{name} ({quantity.value})" for name, quantity in self.quantities.items())

    @abstractmethod
    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign, without what is added."""

    @abstractmethod
    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return what `respond` does, of a patch that holds what is added; outputs and patch are checked."""

    def initial_sizes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return natural sizes (L,) of the state at the begin of a trial; empty: it is never unknown."""
        return np.zeros(0)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds of the ports without laws, (N, P) at so many times as dense samples."""
        raise NotImplementedError

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return what `ported` does."""
        raise NotImplementedError

    def at_ports(self, forces: ModelPatch) -> ModelPatch:
        """Return forces as they act at the ports of `ported`."""
        return forces

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of a force at a port and of what it acts on, `EITHER` if it does not say."""
        return EITHER

    def check(self, trial: Trial) -> None:
        """Refuse a trial that it cannot follow."""
        for kind, why in ((TrialKind.FLIGHT, "models.flight"), (TrialKind.RINGDOWN, "models.free_ringdown")):
            if trial.kind is kind and kind not in self.kinds:
                raise ModelError(said(why, trial=trial, model=self))
        driven = trial.kind is TrialKind.DRIVEN
        if TrialKind.DRIVEN not in self.kinds and (driven or trial.begins is not Start.SETTLED):
            how = "is driven" if driven else f"begins {trial.begins.value}"
            raise ModelError(said("models.driven", trial=trial, how=how, model=self))
        if trial.kind is TrialKind.STATIC and trial.inputs and not self.holds_inputs:
            names = ", ".join(map(repr, trial.input_names))
            raise ModelError(said("models.static_inputs", trial=trial, names=names, model=self))

    def check_outputs(self, outputs: Outputs) -> None:
        """Refuse outputs that it does not have, or that no channel can measure so."""
        for output, quantity in outputs:
            own = self.output_quantity(output)
            if own is None:
                known = ", ".join(self.shown_outputs)
                raise ModelError(f"{capital(self.what)} has no output {output!r}; it has {known}.")
            if not quantity.shows(own):
                raise ModelError(said("models.measured", output=output, model=self, own=own, by=quantity))

    def losses(self, trial: Trial, health: FloatArray) -> list[Losses]:
        """Return the losses of its regions in each row from those (N, K) that a trial names.

        Raises `ModelError` if one is of a region that it does not have.
        """
        losses = np.zeros((len(health), len(self.regions)))
        for name, column in zip(trial.regions, health.T, strict=False):
            if name in self.regions:
                losses[:, self.regions.index(name)] = column
            elif np.any(column):
                raise ModelError(said("models.no_region", trial=trial, name=name, model=self))
        return [tuple(row) for row in losses.tolist()]

    @property
    def oscillates(self) -> bool:
        """Whether it has a mode that vibrates."""
        return True

    @property
    def sensors(self) -> ModelPatch:
        """Sensors that are built in, for channels or for outputs of those names.

        They are no part of its responses: `discrepancy.system.sensing.observe` applies them, since what
        sensors show of a response depends on all of them together.
        """
        return self.patch.of(*SENSORS)

    def stated(self, campaign: Campaign) -> list[tuple[float, float]]:
        """Return mean and deviation of each parameter, those of a campaign where it says them."""
        return [campaign.parameters.get(item.name, (item.mean, item.deviation)) for item in self.parameters]

    def prior_mean(self, campaign: Campaign | None = None) -> FloatArray:
        """Return the means (P,) of what is `declared`, those of a campaign where it says them."""
        known = {} if campaign is None else campaign.parameters
        return np.array([known.get(item.name, (item.mean, 0.0))[0] for item in self.declared])

    @property
    def declared(self) -> tuple[ParameterPrior, ...]:
        """Calibrated parameters as they are without what is added."""
        return self.parameters if self._declared is None else self._declared

    def respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial without sensors; those in `patch` are ignored here.

        Velocity and acceleration are derivatives of displacement, and a signal is the output itself. Raises
        `ModelError` if the model lacks an output or cannot carry a primitive.
        """

        def answer() -> tuple[Trial, Response]:  # the trial lives as long, so that its id stays its own
            count = len(self.parameters)
            if conditions.parameters.shape != (count,):
                came, has = conditions.parameters.size, counted(count, "parameter")
                raise ModelError(f"{capital(self.what)} has {has}, but {came} came.")
            whole = (self.patch + patch).in_trial(trial.name)
            self.check(trial)
            self.check_outputs(outputs)
            for item in whole:
                if not (isinstance(item, SENSORS) or self.supports(type(item))):
                    portless = isinstance(item, INTERNAL_FORCES) and not self.ports
                    port = " (it has no port)" if portless else ""
                    raise ModelError(f"{capital(self.what)} cannot carry the primitive {item.kind!r}{port}.")
            with ModelError.instead_of(FiniteElementError):
                return trial, self._respond(trial, outputs, whole, conditions)

        if self._kept is None:
            return answer()[1]
        key = (id(trial), outputs, patch.primitives, conditions.key)
        return self._kept.get(key, answer)[1]

    def ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, see `PortedSystem`.

        Raises `ModelError` if sensors are built in: what they make of a missing force is not known here.
        """
        self.check_outputs(outputs)
        if len(self.sensors):
            raise ModelError(f"{self.name} has sensors built in, which hide a missing force; leave them out.")
        return self._ported(trial, outputs, parameters)

    def remembering(self) -> Self:
        """Return the model as one that keeps responses: sensors are tried by the dozen on one motion."""
        return self if self._kept is not None else self._changed(_kept=ResultCache(KEPT))

    def patched(
        self, patch: ModelPatch, calibrated: Mapping[str, tuple[float, float]] = MappingProxyType({})
    ) -> Self:
        """Return the model with a patch added to every question.

        Its sensors name channels of a campaign, or outputs of the model, and come before those of a question.
        `calibrated` has means and standard deviations of parameters, where they are not those of the model.
        """
        told = tuple(
            replace(item, mean=mean, deviation=deviation)
            for item in self.parameters
            for mean, deviation in [calibrated.get(item.name, (item.mean, item.deviation))]
        )
        return self._changed(patch=self.patch + patch, parameters=told, _declared=self.declared, _kept=None)

    def own_laws(self, parameters: FloatArray) -> ModelPatch:
        """Return the laws of ports that it has as it is."""
        return NO_PATCH

    def apart(self) -> tuple[Self, ModelPatch]:
        """Return the model without laws at its ports, and these at the prior means."""
        laws = self.own_laws(self.prior_mean()) + self.patch.of(PortForce)
        return self._changed(patch=self.patch.without(PortForce), linear=True, _kept=None), laws

    def _changed(self, **attributes: object) -> Self:
        """Return the model with other attributes."""
        found = copy(self)
        vars(found).update(attributes)
        return found
