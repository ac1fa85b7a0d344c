"""Back to the start: by the FMU's own reset where every start shows that it is as good as a new instance.

Some FMUs return OK from their reset and go on from where they were, or keep a clock that shows later only.
The first step of the first instance is therefore kept. At every later start that step is made again, and
where the flight itself begins with it, it is compared once more: the first difference turns to the next way
of starting for good, a new instance in the same process and then a new process.
"""

import logging
from array import array
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fmu_asset.instances.base import FmuInstance
from fmu_asset.instances.plan import Settings
from fmu_asset.worker.client import WorkerInstance

Instance = FmuInstance | WorkerInstance

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Start:
    """How an instance is brought to its first communication point.

    Attributes
    ----------
    time, step_size : float
        Start time, and size of a communication step [s].
    settings : Settings
        What is set before initialisation.
    request : list of float
        The request block: time, step size, inputs.
    with_inputs : bool
        Whether the inputs of the block hold already during initialisation.
    """

    time: float
    step_size: float
    settings: Settings
    request: list[float]
    with_inputs: bool

    def make(self, instance: Instance) -> None:
        """Initialise an instance that is as after its instantiation or reset.

        Raises
        ------
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        memoryview(instance.request).cast("B").cast("d")[:] = array("d", self.request)
        instance.initialise(self.time, self.settings, with_inputs=self.with_inputs)


class Way(IntEnum):
    """How an instance is brought back to its start, the fastest first."""

    RESET = 0
    RENEWAL = 1
    LOADING = 2


@dataclass(frozen=True)
class FirstStep:
    """The first step of a flight.

    Attributes
    ----------
    start : Start
        How the instance was started.
    request : bytes
        The request block of the step.
    reply : (n,) ndarray
        The outputs after it.
    """

    start: Start
    request: bytes
    reply: npt.NDArray[np.float64]

    def again(self, instance: Instance) -> npt.NDArray[np.float64]:
        """Return the outputs (n,) of an instance that is started and asked alike."""
        self.start.make(instance)
        memoryview(instance.request).cast("B")[:] = self.request
        instance.step()
        return np.array(instance.reply)


class ResetTrial:
    """Whether the reset of an FMU can be believed; shared by all assets of one opening.

    Attributes
    ----------
    works : bool or None
        None as long as nothing has shown it.
    fault : str
        What is wrong with it, one sentence; empty as long as nothing is known to be.
    lies : bool
        Whether it returns OK and does nothing of use.
    way : Way
        The fastest way to start again that has shown no difference.
    first : FirstStep or None
        Of the first instance; None as long as it has made none.
    comparable : bool
        Whether there are other instances to compare one with, and they begin alike.
    """

    def __init__(self, *, comparable: bool = True) -> None:
        self.works: bool | None = None
        self.fault = ""
        self.lies, self.comparable = False, comparable
        self.way = Way.RESET
        self.first: FirstStep | None = None

    def refused(self) -> None:
        """Remember that the FMU has no reset."""
        self.works, self.way = False, Way.RENEWAL
        self.fault = "It cannot be reset; every start takes a new instance."

    def agrees(self, path: Path, way: Way, reply: npt.NDArray[np.float64]) -> bool:
        """Return whether a start can be believed; if not, say it once and turn to the next way for good.

        Parameters
        ----------
        path : Path
            The FMU.
        way : Way
            How it was started.
        reply : (n,) ndarray
            Outputs after the first step, which was asked as that of `first`.
        """
        assert self.first is not None
        true = self.first.reply
        different = ~((reply == true) | (np.isnan(reply) & np.isnan(true)))
        if not different.any():
            if way == Way.RESET:
                self.works = True
            return True
        if way == Way.LOADING:
            self.comparable, self.first, self.way = False, None, Way.RENEWAL
            return True
        at = np.flatnonzero(different)[0]
        doubted = " Flights that began by a reset before may be wrong." * bool(self.works)
        self.works, self.lies, self.way = False, True, Way(way + 1)
        what, instead = _FAULTS[way]
        self.fault = (
            f"{what} (an output is {reply[at]:.9g} where that of a new instance is {true[at]:.9g}); "
            f"every start takes a new {instead} instead.{doubted}"
        )
        if (path, way) not in _said:
            _logger.warning("%s: %s", path, self.fault)
            _said.add((path, way))
        return False


_said: set[tuple[Path, Way]] = set()
_FAULTS = {
    Way.RESET: ("Its reset returns OK and does not bring it back to its start", "instance"),
    Way.RENEWAL: ("Another instance in the same process does not begin as the first one did", "process"),
}
