"""The FMU of a vibrating structure: each step records accelerations and identifies the modes."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from fe.runtime.modal_system import rayleigh_damping_ratio
from fmu_asset.client.binding import Binding
from fmu_asset.slaves.variables import TRANSIENT
from reporting.arrays import Float
from twin_master.assets.asset_source import Asset, AssetReading
from twin_master.network.identified import packed_row
from twin_master.scenario.observation import ModesSection
from twin_master.scenario.schema import Scenario
from twin_master.seeds import seed_sequence

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from twin_master.assets.fmu_source import Session


def modal_features(
    model: "ReducedModel",
    inputs: Float,
    section: ModesSection,
    damping: tuple[float, float] | None = None,
) -> Float:
    """Return the natural frequency, damping ratio and relative shape of the observed modes.

    Parameters
    ----------
    model : ReducedModel
        The model of the structure, with accelerometers.
    inputs : (V,) array
        The values of the model's inputs, in their order.
    section : ModesSection
        The observed modes and their features, and the accelerometers.
    damping : (float, float), optional
        Rayleigh's alpha [1/s] and beta [s]; by default those of the model.

    Returns
    -------
    (M, 1 + A) array
        One row for each of the M modes: the frequency [Hz], the damping ratio, and the shape at
        each of the A accelerometers but the first, divided by that at the first.

    Raises
    ------
    OutsideModelError
        If a value is outside the ranges of the model.
    """
    modes = model.modes(inputs)
    alpha, beta = model.damping.tolist() if damping is None else damping
    frequency = modes.frequency[section.mode_indices]
    # The outputs of accelerometers follow those of strain and displacement.
    first_row = model.static_output_count
    rows = [first_row + model.accelerations.index(name) for name in section.accelerometers]
    shape = modes.output[rows][:, section.mode_indices]
    # The amplitude of a mode shape is arbitrary; its ratio to the first accelerometer is not.
    relative_shapes = shape[1:] / shape[0]
    damping_ratio = rayleigh_damping_ratio(alpha, beta, frequency)
    return np.column_stack([frequency, damping_ratio, *relative_shapes])


class RecordedStructure(Asset):
    """The FMU of a vibrating structure: each step records accelerations and identifies the modes.

    Each record begins in static equilibrium. The sensor readings are the identified features of the
    modes with their covariance. The observation without noise has the features of the modes of the
    packed model.

    Parameters
    ----------
    scenario : Scenario
        A scenario with `observation.modes` and `truth.record`.
    open_session : callable
        Opens the FMU with a binding and parameters.
    parameters : mapping of str to float
        The parameters of the true structure.
    """

    def __init__(
        self,
        scenario: Scenario,
        model: "ReducedModel",
        open_session: "Callable[[Binding, Mapping[str, float]], Session]",
        binding: Binding,
        parameters: Mapping[str, float],
    ) -> None:
        assert scenario.observation.modes is not None
        assert scenario.truth.record is not None
        self._scenario = scenario
        self._model = model
        self._section = scenario.observation.modes
        self._record = scenario.truth.record
        step_size = 1.0 / self._record.sampling_rate
        binding = binding.with_header(step_size=step_size, decimation=1)
        self._parameters = {**parameters, "response": float(TRANSIENT)}
        self._session = open_session(binding, self._parameters)
        # The columns of the observed accelerometers in the observations of the binding.
        first_column = binding.observation_slice("acceleration").start
        variables = binding.observation["acceleration"].variables
        self._columns = [
            first_column + variables.index(f"acceleration.{name}")
            for name in self._section.accelerometers
        ]
        units = {name: entry.unit for name, entry in binding.parameter.items()}
        self.units = units | {name: entry.unit for name, entry in binding.control.items()}
        self._step = 0

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Simulate the record of a step, and identify the modes from it.

        The reading has the true features, the identified ones with their covariance, and the
        standard error of each as a monitor.

        Raises
        ------
        FmuError
            If the FMU refuses an input, or fails.
        ExperimentDataError
            If the record is too short for the frequency bands.
        """
        from calibration.dynamics.modal_identification import identify_modes

        section = self._section
        record = self._record
        acceleration = self._simulate_record(control, health)
        identified = identify_modes(acceleration, record.sampling_rate, section.bands, record.kind)
        self._step += 1

        standard_errors = section.observed_features(identified.standard_error).tolist()
        titles = self._scenario.observation.titles
        monitors = {}
        for title, standard_error in zip(titles, standard_errors, strict=True):
            monitors[f"standard_error_{title}"] = standard_error
        sensed = packed_row(
            section.observed_features(identified.value),
            section.observed_covariance(identified.covariance),
        )
        true_features = section.observed_features(self._true_features(control, health))
        return AssetReading(true_features, monitors, sensed=sensed)

    def _simulate_record(self, control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        """Return the noisy accelerations (N, A) of one step [m/s^2]: N samples of A accelerometers.

        The structure is excited by white noise, or released from a constant load.
        """
        record = self._record
        # A generator of its own for each step, so that a resumed run draws the same numbers.
        seeds = seed_sequence(self._scenario.mission.seed, "asset").generate_state(4).tolist()
        random = np.random.default_rng([*seeds, self._step])
        sample_count = round(record.duration * record.sampling_rate)
        initial_control = dict(control)
        control_history: dict[str, Float | float] = dict(control)
        if record.kind == "ambient":
            noise = record.amplitude * random.standard_normal(sample_count)
            control_history[record.input] = initial_control[record.input] + noise
        else:
            # The FMU starts in equilibrium under the amplitude, which is then taken away.
            initial_control[record.input] += record.amplitude
        self._session.reset(self._parameters, control=initial_control, health=health)
        history = self._session.simulate(control=control_history, health=health, steps=sample_count)
        acceleration = history.values[:, self._columns]
        return acceleration + record.noise * random.standard_normal(acceleration.shape)

    def _true_features(self, control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        """Return the features (M, 1 + A) of the M true modes, from the packed model."""
        model = self._model
        values = {**self._parameters, **control, **health}
        inputs = model.vector(
            {name: value for name, value in values.items() if name in model.input_names}
        )
        alpha, beta = model.damping.tolist()
        damping = (values.get("damping_alpha", alpha), values.get("damping_beta", beta))
        return modal_features(model, inputs, self._section, damping)

    def save_state(self) -> bytes:
        """Return the number of records made, as bytes.

        It is the whole state: each record begins in equilibrium, with noise seeded by its number.
        """
        return str(self._step).encode()

    def restore_state(self, state: bytes) -> None:
        """Continue after the number of records that `save_state` returned."""
        self._step = int(state)

    def close(self) -> None:
        """Close the FMU."""
        self._session.close()
