"""Errors of FMUs, named by cause."""

from collections.abc import Sequence

from reporting.errors import StandsForOthersError

_CONTROL_CODES = (*range(9), *range(11, 32), *range(127, 160))
"""Codes of control characters, without tabulator and line feed."""
_ESCAPES = {code: f"\\x{code:02x}" for code in _CONTROL_CODES}


def visible(text: str) -> str:
    r"""Return a text with control characters, which a terminal would execute, written as `\x1b`."""
    return text.translate(_ESCAPES)


class FmuError(StandsForOthersError):
    """Any error that this package raises on purpose.

    Parameters
    ----------
    messages : sequence of str
        Messages that the FMU itself has logged since the last successful call, oldest first.
    time : float, optional
        Time at which the FMU ended its simulation [s], if it did.

    Attributes
    ----------
    messages : tuple of str
        Messages that the FMU itself has logged since the last successful call, oldest first.
    time : float or None
        As given.
    """

    def __init__(
        self, sentence: str, messages: Sequence[str] = (), time: float | None = None
    ) -> None:
        self.sentence = visible(sentence)
        self.messages = tuple(visible(message) for message in messages)
        self.time = time
        log = "".join(f"\n  the FMU says: {message}" for message in self.messages)
        super().__init__(self.sentence + log)


class FmuBuildError(FmuError, ValueError):
    """An FMU cannot be made from this input."""


class PatchFileError(FmuBuildError):
    """A patch file cannot be read, or has an effect that the FMU cannot contain."""


class FmuFileError(FmuError, ValueError):
    """An FMU file is missing, damaged or unsafe to extract."""


class FmuUnsupportedError(FmuError, ValueError):
    """An FMU is valid but cannot be run, because of its version, interface or platform."""


class BindingError(FmuError, ValueError):
    """A binding file is wrong, or does not fit the FMU or the call."""


class CouplingError(FmuError, ValueError):
    """FMUs cannot be connected: an end is unknown, connected twice, or of another type."""


class IterationError(FmuError, RuntimeError):
    """The values in a cycle of FMUs did not converge within the allowed iterations."""


class SspError(FmuError, ValueError):
    """An SSP file is missing, damaged, unsafe or invalid, or uses unsupported features."""


class FmuInputError(FmuError, ValueError):
    """A value was refused before it was sent to the FMU: outside its range, or not finite."""


class FmuCallError(FmuError, RuntimeError):
    """An FMI function did not return OK."""


class FmuEndedError(FmuCallError):
    """The FMU has ended its simulation by itself; its last outputs can still be read."""


class FmuOutputError(FmuError, RuntimeError):
    """The FMU gave an output that is not finite."""


class FmuStateError(FmuError, RuntimeError):
    """A state cannot be saved or restored, or a call was made in the wrong phase."""


class FmuWorkerError(FmuError, RuntimeError):
    """The worker process of an FMU died, or its instance was lost to a fatal error."""


class FmuTimeoutError(FmuError, TimeoutError):
    """An FMI call took longer than the wall-clock limit; the worker was stopped."""


class FmuMemoryError(FmuError, RuntimeError):
    """An FMU took more memory than its limit; the worker was stopped."""
