"""Back to the start: by the FMU's own reset where it is seen to work, else by another instance.

Some FMUs return OK from their reset and go on from where they were. What an instance shows after its first
reset is therefore compared with what another one shows at the same start.
"""

import logging
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fmu_asset.instances.base import FmuInstance
from fmu_asset.instances.plan import Settings
from fmu_asset.worker.client import WorkerInstance

Instance = FmuInstance | WorkerInstance

_logger = logging.getLogger(__name__)
_said: set[Path] = set()


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

    def first_outputs(self, instance: Instance) -> npt.NDArray[np.float64]:
        """Initialise an instance, make a step, and return the outputs (2, n) before and after it."""
        self.make(instance)
        before = outputs_of(instance)
        instance.request[0], instance.request[1] = self.time, self.step_size
        instance.step()
        return np.array([before, instance.reply])


def outputs_of(instance: Instance) -> npt.NDArray[np.float64]:
    """Return the outputs (n,) of this moment."""
    instance.read()
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
    """

    def __init__(self) -> None:
        self.works: bool | None = None
        self.fault = ""
        self.lies = False

    def refused(self) -> None:
        """Remember that the FMU has no reset."""
        self.works, self.fault = False, "It cannot be reset; every start takes a new instance."

    def judge(
        self,
        path: Path,
        flown: npt.NDArray[np.float64],
        again: npt.NDArray[np.float64],
        fresh: npt.NDArray[np.float64],
    ) -> None:
        """Compare the starts after a reset and of a new instance, and say it once if they differ.

        Parameters
        ----------
        path : Path
            The FMU.
        flown : (n,) ndarray
            Outputs before the reset. Where they are those of the start, nothing can be seen of the reset.
        again, fresh : (2, n) ndarray
            Outputs at the start and a step later, after the reset and of a new instance.
        """
        different = ~((again == fresh) | (np.isnan(again) & np.isnan(fresh)))
        if different.any():
            at = np.flatnonzero(different)[0]
            self.works, self.lies = False, True
            self.fault = (
                "Its reset returns OK and does not bring it back to its start (an output is "
                f"{again.flat[at]:.9g} where that of a new instance is {fresh.flat[at]:.9g}); every start "
                "takes a new instance instead."
            )
            if path not in _said:
                _logger.warning("%s: %s", path, self.fault)
                _said.add(path)
        elif not np.array_equal(flown, fresh[0], equal_nan=True):
            self.works = True
