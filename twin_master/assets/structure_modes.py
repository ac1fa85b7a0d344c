"""Modes of a structure as what is observed: identified of a record of its FMU, and expected of a model."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fe.runtime.modal_system import rayleigh_damping_ratio
from twin_master.assets.interface import AssetReading, InnerTruth
from twin_master.network.identified import packed_row
from twin_master.scenario.observation import ModesSection
from twin_master.scenario.schema import Scenario
from twin_master.seeds import seed_sequence

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from fmu_asset.door.binding import Binding
    from fmu_asset.door.session import FmiAsset

Float = NDArray[np.float64]


def modal_values(
    model: "ReducedModel", vector: Float, section: ModesSection, damping: tuple[float, float] | None = None
) -> Float:
    """Return frequency [Hz], damping ratio and relative shape (M, 1 + A) of the observed modes of a model.

    Parameters
    ----------
    model : ReducedModel
    vector : (V,)
        Values of all that can be chosen.
    section : ModesSection
        Which modes, at which accelerometers.
    damping : (float, float), optional
        Rayleigh's alpha [1/s] and beta [s]; those of the model by default.

    Raises
    ------
    OutsideModelError
        A value lies outside the ranges of the model.
    """
    modes = model.modes(vector)
    alpha, beta = model.damping.tolist() if damping is None else damping
    frequency = modes.frequency[section.places]
    rows = [model.static_count + model.accelerations.index(name) for name in section.accelerometers]
    shape = modes.output[rows][:, section.places]
    return np.column_stack(
        [frequency, rayleigh_damping_ratio(alpha, beta, frequency), *(shape[1:] / shape[0])]
    )


class RecordedStructure:
    """The FMU of a structure in motion: each step makes a record of accelerations and identifies its modes.

    Each record begins anew at rest; what the sensors say are the features that were identified, with their
    covariance, and the noise-free observation are those of the model that was packed.

    Parameters
    ----------
    scenario : Scenario
        With `observation.modes` and `truth.record`.
    model : ReducedModel
        The model that was packed.
    session : callable
        Opens the FMU with a binding and parameters.
    binding : Binding
        Of the FMU.
    parameters : mapping of str to float
        Of the true structure.
    """

    def __init__(
        self,
        scenario: Scenario,
        model: "ReducedModel",
        session: "Callable[[Binding, Mapping[str, float]], FmiAsset]",
        binding: "Binding",
        parameters: Mapping[str, float],
    ) -> None:
        assert scenario.observation.modes is not None
        assert scenario.truth.record is not None
        self._scenario, self._model = scenario, model
        self._section, self._record = scenario.observation.modes, scenario.truth.record
        bound = binding.with_header(step_size=1.0 / self._record.sampling_rate)
        self._parameters = {**parameters, "response": 2.0}
        self._session = session(bound, self._parameters)
        chosen = bound.observation_slice("acceleration")
        names = [
            variable.removeprefix("acceleration.") for variable in bound.observation["acceleration"].variables
        ]
        self._chosen = [chosen.start + names.index(name) for name in self._section.accelerometers]
        self._units = {
            name: scalar.unit for name, scalar in (*bound.parameter.items(), *bound.control.items())
        }
        self._turn = 0

    @property
    def units(self) -> Mapping[str, str]:
        """Units of parameters and control inputs."""
        return self._units

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make and identify the record of a turn.

        Raises
        ------
        FmuError
            The FMU refuses an input, or fails.
        ExperimentDataError
            The record is too short for the bands.
        """
        from calibration.dynamics.modal_identification import identify_modes

        section, record = self._section, self._record
        root = seed_sequence(self._scenario.mission.seed, "asset")
        random = np.random.default_rng([*root.generate_state(4).tolist(), self._turn])
        count = round(record.duration * record.sampling_rate)
        held: dict[str, float] = dict(control)
        course: dict[str, Float | float] = dict(control)
        if record.kind == "ambient":
            course[record.input] = held[record.input] + record.amplitude * random.standard_normal(count)
        else:
            held[record.input] += record.amplitude
        self._session.reset(self._parameters, control=held, health=health)
        history = self._session.simulate(control=course, health=health, steps=count)
        acceleration = history.values[:, self._chosen]
        acceleration = acceleration + record.noise * random.standard_normal(acceleration.shape)
        found = identify_modes(acceleration, record.sampling_rate, section.bands, record.kind)
        values, errors = section.observed(found.value), section.observed(found.standard_error)
        self._turn += 1
        names = (*control, *health, *self._parameters)
        true = {
            name: {**self._parameters, **control, **health}[name]
            for name in names
            if name in self._model.chosen
        }
        damping = self._parameters.get("damping_alpha"), self._parameters.get("damping_beta")
        alpha, beta = (
            nominal if given is None else given
            for given, nominal in zip(damping, self._model.damping.tolist(), strict=True)
        )
        free = section.observed(modal_values(self._model, self._model.vector(true), section, (alpha, beta)))
        titles = self._scenario.observation.titles
        told = {
            f"standard_error_{title}": error for title, error in zip(titles, errors.tolist(), strict=True)
        }
        return AssetReading(
            free, told, InnerTruth({}, packed_row(values, section.covariance(found.covariance)))
        )

    def save_state(self) -> bytes:
        """Return the number of records made: each begins anew."""
        return str(self._turn).encode()

    def restore_state(self, state: bytes) -> None:
        """Go on behind as many records."""
        self._turn = int(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()
