"""Errors of FMUs, named by cause, and the lookup of long messages."""

from collections.abc import Sequence

from reporting.errors import StandsForOthersError
from reporting.sentences import Sentences

said = Sentences(__file__).said
"""A sentence by "table.name" with its values."""


_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(9), *range(11, 32), *range(127, 160))}


def visible(text: str) -> str:
    r"""Return a text with its control characters, which a terminal would obey, written as `\x1b`."""
    return text.translate(_CONTROLS)


class FmuError(StandsForOthersError):
    """Any error that this package raises on purpose.

    Attributes
    ----------
    messages : tuple of str
        What the FMU itself had logged since the last call that succeeded, oldest first.
    time : float or None
        Where the FMU ended its simulation [s], if it did.
    """

    def __init__(self, sentence: str, messages: Sequence[str] = (), time: float | None = None) -> None:
        self.time = time
        self.messages = tuple(visible(message) for message in messages)
        self.sentence = sentence = visible(sentence)
        log = "".join(f"\n  the FMU says: {message}" for message in self.messages)
        super().__init__(sentence + log)


class FmuBuildError(FmuError, ValueError):
    """An FMU cannot be made from what was given."""


class PatchFileError(FmuBuildError):
    """A patch file cannot be read, or holds an effect that the FMU cannot carry."""


class FmuFileError(FmuError, ValueError):
    """An FMU file is missing, damaged or unsafe to extract."""


class FmuUnsupportedError(FmuError, ValueError):
    """An FMU is sound but of a kind that cannot be flown: version, interface or platform."""


class BindingError(FmuError, ValueError):
    """A binding file is wrong, or does not fit the FMU or the call."""


class CouplingError(FmuError, ValueError):
    """FMUs cannot be connected as they were told to: an end is unknown, taken twice, or of another type."""


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
    """A saved state cannot be made or restored, or a call came in the wrong phase."""


class FmuWorkerError(FmuError, RuntimeError):
    """The worker process of an FMU died, or its instance was lost to a fatal error."""


class FmuTimeoutError(FmuError, TimeoutError):
    """An FMI call took longer than the wall-clock limit; the worker was stopped."""


class FmuMemoryError(FmuError, RuntimeError):
    """An FMU took more memory than its limit; the worker was stopped."""
