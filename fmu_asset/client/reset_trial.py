"""Whether an FMU can be brought back to its start, found out by comparison with its first start.

Some FMUs return OK from their reset and go on from where they were, or keep a clock that shows
later only. The first step of the first instance is therefore kept. At every later start that step
is made again and its outputs are compared: after a difference a slower method is used for good,
first another instance in the same process and then another process.
"""

import logging
from array import array
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from fmu_asset.instances.plan import InitialValues, Instance
from reporting.arrays import Float

_logger = logging.getLogger(__name__)
_logged: set[tuple[str, "RestartMethod"]] = set()
"""FMUs and methods that a warning was given about."""


@dataclass(frozen=True)
class InstanceStart:
    """The state in which an instance is initialised.

    Attributes
    ----------
    time : float
        Start time [s].
    settings : list of InitialValue
        Values that are set before the initialisation.
    request : list of float
        The request block: time, step size, inputs.
    with_inputs : bool
        Whether the inputs of the block hold already during the initialisation.
    """

    time: float
    settings: InitialValues
    request: list[float]
    with_inputs: bool

    def initialise(self, instance: Instance) -> None:
        """Initialise an instance that has just been instantiated or reset.

        Parameters
        ----------
        instance : Instance
            The instance.

        Raises
        ------
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        block = memoryview(instance.request).cast("B").cast("d")
        block[:] = array("d", self.request)
        instance.initialise(self.time, self.settings, with_inputs=self.with_inputs)


class RestartMethod(IntEnum):
    """Methods to bring an FMU back to its start, the fastest first.

    They are its own reset, another instance in the same process, and another process.
    """

    RESET = 0
    RENEWAL = 1
    LOADING = 2


@dataclass(frozen=True)
class FirstStep:
    """The first step of the first instance, with which later starts are compared.

    Attributes
    ----------
    start : InstanceStart
        How the instance was started.
    request : bytes
        Request block of the step.
    reply : (n,) ndarray
        Outputs after it.
    """

    start: InstanceStart
    request: bytes
    reply: Float

    def repeat(self, instance: Instance) -> Float:
        """Return the outputs (n,) of another instance that is started and stepped in the same way.

        Parameters
        ----------
        instance : Instance
            An instance that has just been instantiated or reset.
        """
        self.start.initialise(instance)
        memoryview(instance.request).cast("B")[:] = self.request
        instance.step()
        return np.array(instance.reply)


_FAULTS = {
    RestartMethod.RESET: "Its reset returns OK and does not bring it back to its start",
    RestartMethod.RENEWAL: (
        "Another instance in the same process does not begin as the first one did"
    ),
}
"""Fault of a method whose first step differs."""
_NEXT_PLACES = {RestartMethod.RESET: "instance", RestartMethod.RENEWAL: "process"}
"""Thing that is made anew at every start after a method has failed."""


@dataclass
class ResetTrial:
    """Findings about the restart of an FMU; shared by all assets of one opening.

    Attributes
    ----------
    comparable : bool
        Whether there are other instances to compare one with, and they begin alike.
    works : bool or None
        Whether the FMU's reset works; None as long as nothing has shown it.
    fault : str
        Sentence on its fault; empty as long as none is known.
    lies : bool
        Whether it returns OK and does nothing useful.
    method : RestartMethod
        The fastest method that has shown no difference.
    first_step : FirstStep or None
        The first step of the first instance, once it has been made.
    """

    comparable: bool = True
    works: bool | None = None
    fault: str = ""
    lies: bool = False
    method: RestartMethod = RestartMethod.RESET
    first_step: FirstStep | None = field(default=None, repr=False)

    def record_refused_reset(self) -> None:
        """Record that the FMU has no reset."""
        self.works = False
        self.method = RestartMethod.RENEWAL
        self.fault = "It cannot be reset; every start takes a new instance."

    def accepts(
        self, label: str, method: RestartMethod, first_step: FirstStep, reply: Float
    ) -> bool:
        """Return whether a first step shows that a method has worked.

        If it does not, a warning is logged once and a slower method is used from now on.

        Parameters
        ----------
        label : str
            Name of the FMU, for the warning.
        method : RestartMethod
            Method by which the instance was brought to its start.
        first_step : FirstStep
            The step with which it is compared.
        reply : (n,) ndarray
            Outputs after the same step.
        """
        expected = first_step.reply
        is_equal = (reply == expected) | (np.isnan(reply) & np.isnan(expected))
        if is_equal.all():
            if method == RestartMethod.RESET:
                self.works = True
            return True
        if method == RestartMethod.LOADING:
            # not even a new process begins alike: nothing can be compared
            self.comparable = False
            self.first_step = None
            self.method = RestartMethod.RENEWAL
            return True
        output = np.flatnonzero(~is_equal)[0]
        doubt = ""
        if self.works:
            doubt = " Flights that began by a reset before may be wrong."
        self.fault = (
            f"{_FAULTS[method]} (an output is {reply[output]:.9g} where that of a new instance is "
            f"{expected[output]:.9g}); every start takes a new {_NEXT_PLACES[method]} instead."
            f"{doubt}"
        )
        self.works = False
        self.lies = True
        self.method = RestartMethod(method + 1)
        if (label, method) not in _logged:
            _logger.warning("%s: %s", label, self.fault)
            _logged.add((label, method))
        return False
