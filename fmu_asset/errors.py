"""Errors of FMUs, named by cause."""

from collections.abc import Sequence

from reporting.errors import StandsForOthersError

_CONTROL_CODES = (*range(9), *range(11, 32), *range(127, 160))
"""Codes of control characters, without tabulator and line feed."""
_ESCAPES = {code: f"\\x{code:02x}" for code in _CONTROL_CODES}


def visible(text: str) -> str:
    r"""Return a text with control characters, which a terminal would obey, written as `\x1b`."""
    return text.translate(_ESCAPES)


class FmuError(StandsForOthersError):
    """Any error that this package raises on purpose.

    Parameters
    ----------
    sentence : str
        The message.
    messages : sequence of str
        Messages that the FMU itself has logged since the last call that succeeded, oldest first.
    time : float, optional
        Time at which the FMU ended its simulation [s], if it did.

    Attributes
    ----------
    sentence : str
        The message, without control characters.
    messages : tuple of str
        The messages of the FMU, without control characters.
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
    """An FMU cannot be made from what was given."""


class PatchFileError(FmuBuildError):
    """A patch file cannot be read, or holds an effect that the FMU cannot carry."""


class FmuFileError(FmuError, ValueError):
    """An FMU file is missing, damaged or unsafe to extract."""


class FmuUnsupportedError(FmuError, ValueError):
    """An FMU is sound but cannot be run, because of its version, interface or platform."""


class BindingError(FmuError, ValueError):
    """A binding file is wrong, or does not fit the FMU or the call."""


class CouplingError(FmuError, ValueError):
    """FMUs cannot be connected: an end is unknown, connected twice, or of another type."""


class IterationError(FmuError, RuntimeError):
    """The values of a loop of FMUs did not settle within the iterations that were allowed."""


class SspError(FmuError, ValueError):
    """An SSP file is missing, damaged, unsafe, not valid, or uses what cannot be read."""


class FmuInputError(FmuError, ValueError):
    """A value was refused before it was sent to the FMU: outside its range, or not finite."""


class FmuCallError(FmuError, RuntimeError):
    """An FMI function did not return OK."""


class FmuEndedError(FmuCallError):
    """The FMU has ended its simulation by itself; its outputs of that moment can still be read."""


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
