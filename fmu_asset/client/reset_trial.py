"""Tests whether an FMU returns to its start, by comparison with its first start.

Some FMUs return OK from their reset but continue from where they were, or keep a clock whose effect
appears only later. Therefore the first step of the first instance is recorded. At every later start
that step is made again and its outputs are compared. After a difference a slower method is used
from then on: first another instance in the same process, then another process.
"""

from array import array
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from fmu_asset.instances.plan import InitialValues, Instance
from reporting.arrays import Float
from reporting.system.log import module_logger

_logger = module_logger(__name__)
_logged: set[tuple[str, "RestartMethod"]] = set()
"""FMUs and methods that a warning was given about."""


@dataclass(frozen=True)
class InstanceStart:
    """How an instance is initialised.

    Attributes
    ----------
    time : float
        The start time [s].
    settings : list of InitialValue
        Values that are set before the initialisation.
    request : list of float
        The request block: time, step size, inputs.
    with_inputs : bool
        Whether the inputs of the request are sent during the initialisation.
    """

    time: float
    settings: InitialValues
    request: list[float]
    with_inputs: bool

    def initialise(self, instance: Instance) -> None:
        """Initialise an instance that has just been instantiated or reset.

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
    request : bytes
        Request block of the step.
    reply : (n,) ndarray
        Outputs after it.
    """

    start: InstanceStart
    request: bytes
    reply: Float

    def repeat(self, instance: Instance) -> Float:
        """Return the outputs (n,) of another instance after the same start and the same step.

        The instance must have just been instantiated or reset.
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
"""The fault of a restart method, if the first step after it differs from that of a new instance."""
_RENEWED_AT_START = {RestartMethod.RESET: "instance", RestartMethod.RENEWAL: "process"}
"""What is made anew at every start, once a restart method has failed."""


@dataclass
class ResetTrial:
    """What is known about restarts of an FMU; shared by all assets of one extracted FMU.

    Attributes
    ----------
    comparable : bool
        Whether restarts can be verified by comparison: several instances are possible, and new ones
        give equal outputs.
    works : bool or None
        Whether the FMU's own reset works; None if this is not known yet.
    fault : str
        A sentence on the fault of its restart; empty if none is known.
    reports_false_success : bool
        Whether a restart reported success although it did not work.
    method : RestartMethod
        The fastest method without a known fault.
    first_step : FirstStep or None
        None until the first instance has made a step.
    """

    comparable: bool = True
    works: bool | None = None
    fault: str = ""
    reports_false_success: bool = False
    method: RestartMethod = RestartMethod.RESET
    first_step: FirstStep | None = field(default=None, repr=False)

    def record_refused_reset(self) -> None:
        """Record that the FMU refuses to be reset."""
        self.works = False
        self.method = RestartMethod.RENEWAL
        self.fault = "It cannot be reset; every start takes a new instance."

    def accepts(
        self, label: str, method: RestartMethod, first_step: FirstStep, reply: Float
    ) -> bool:
        """Return whether the first step after a restart agrees with the recorded one.

        If it does not, a warning is logged once, and a slower method is used from now on. If even a
        new process gives other outputs, the restart is accepted and no more comparisons are made.

        Parameters
        ----------
        label : str
            The name of the FMU, for the warning.
        method : RestartMethod
            The method by which the instance was restarted.
        first_step : FirstStep
            The recorded step.
        reply : (n,) ndarray
            The outputs after the same step.
        """
        expected_reply = first_step.reply
        is_equal = (reply == expected_reply) | (np.isnan(reply) & np.isnan(expected_reply))
        if is_equal.all():
            if method == RestartMethod.RESET:
                self.works = True
            return True
        if method == RestartMethod.LOADING:
            # even new processes give different outputs, so no comparison can show a fault
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
            f"{expected_reply[output]:.9g}); every start takes a new {_RENEWED_AT_START[method]} "
            f"instead.{doubt}"
        )
        self.works = False
        self.reports_false_success = True
        self.method = RestartMethod(method + 1)
        if (label, method) not in _logged:
            _logger.warning("%s: %s", label, self.fault)
            _logged.add((label, method))
        return False
