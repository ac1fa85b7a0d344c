"""The laboratory experiments of the calibration, made on the wing FMU."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from calibration.virtual_wing import (
    RECORDED_GAUGE,
    SENSITIVITY,
    RingDownSignal,
    check_recorded,
    sampling_times,
)
from fe.runtime.state import DigitalState, losses_of
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.experiment import simulate_from_now
from fmu_asset.client.session import FmiAsset
from fmu_asset.slaves.variables import QUASI_STATIC, TRANSIENT
from scenarios import binding_files

BINDING = "uav_wing_laboratory"
"""The shipped binding of the test bench."""


class FmuTestBench(ExitStack):
    """The wing FMU as a `calibration.virtual_wing.TestBench`, loaded and released through FMI.

    In the load test, a weight is a tip force in the quasi-static response, and the displacement of
    the load point is read. In the ring-down test, the parameter `initial_tip_displacement` of the
    transient response displaces the tip before its release, and each sample of the record takes one
    communication step. The FMU runs in a worker process of its own.

    Parameters
    ----------
    fmu : Path
        The wing FMU.
    truth : DigitalState
        The true parameters and damage of the wing. Its geometry is not used: the FMU has its own.

    Raises
    ------
    calibration.errors.ExperimentDataError
        If the FMU's wing has fewer gauges than `RECORDED_GAUGE`.
    FmuError
        If the FMU cannot be flown or its parameters are out of range.
    """

    def __init__(self, fmu: Path, truth: DigitalState) -> None:
        super().__init__()
        self._fmu = Path(fmu)
        regions = []
        for variable in read_fmu(fmu).variables:
            if variable.name.startswith("health."):
                regions.append(variable.name.removeprefix("health."))
        self._binding = load_binding(binding_files()[BINDING]).with_regions(regions)
        check_recorded(len(self._binding.observation["strain"].variables))
        self._parameters = asdict(truth)
        del self._parameters["geometry"]  # that of the FMU's wing
        del self._parameters["stiffness_loss"]  # the FMU has an input for each region
        losses = losses_of(truth.stiffness_loss, tuple(regions))
        self._health = dict(zip(regions, losses, strict=True))
        self._static = self._open_session(self._binding, {"response": float(QUASI_STATIC)})
        self.callback(self._static.close)

    def tip_displacement(self, load: float) -> float:
        """Return the displacement of the load point, 5 cm from the tip, under a load at that point.

        Parameters
        ----------
        load : float
            The load [N].

        Returns
        -------
        float
            The displacement [m].
        """
        observation = self._static.step({"load_factor": 0.0}, self._health, {"tip_force": load})
        return observation.extra["load_point_displacement"]

    def ring_down(
        self, initial_tip_displacement: float, duration: float, sampling_rate: float
    ) -> RingDownSignal:
        """Return the signal of a strain gauge while the wing swings after its tip is released.

        Parameters
        ----------
        initial_tip_displacement : float
            The displacement of the tip before the release [m].
        duration : float
            The length of the record [s].
        sampling_rate : float
            The sampling rate [Hz].

        Returns
        -------
        time : (N,) array
            The time of each sample after the release [s].
        signal : (N,) array
            The signal of the recorded gauge [V].
        """
        time = sampling_times(duration, sampling_rate)
        binding = self._binding.with_header(step_size=1.0 / sampling_rate)
        release = {
            "response": float(TRANSIENT),
            "initial_tip_displacement": initial_tip_displacement,
        }
        with self._open_session(binding, release) as session:
            session.reset(
                control={"load_factor": 0.0}, health=self._health, load={"tip_force": 0.0}
            )
            # The first sample is the initial state, and each step gives a further one.
            step_count = time.size - 1
            history = simulate_from_now(session, step_count, {})
        # from strain to volts
        return time, SENSITIVITY * history.values[:, RECORDED_GAUGE - 1]

    def _open_session(self, binding: Binding, parameters: dict[str, float]) -> FmiAsset:
        """Return the FMU with the true parameters of the wing, and further ones."""
        return FmiAsset(self._fmu, binding, parameters=self._parameters | parameters)
