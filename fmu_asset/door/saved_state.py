"""The state of an asset as bytes: what a mission's checkpoint keeps of an FMU."""

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from fmu_asset.errors import FmuStateError

StateMethod = Literal["serialised", "replay"]
"""How a state is kept: serialised by the FMU, or as the inputs of all steps, to be replayed."""

_MAGIC = b"UAVASSET"
_HEADER = struct.Struct("<8sI")


@dataclass(frozen=True)
class SavedState:
    """A saved state.

    Attributes
    ----------
    method : {"serialised", "replay"}
        What `body` is.
    fmu : str
        SHA-256 of the FMU file.
    index : int
        Number of steps made.
    step_size, start_time : float
        Time between observations and start of the binding [s].
    parameters : mapping of str to float, or to a sequence for an array
        As the caller gave them.
    start_inputs : bytes
        Inputs during initialisation, as doubles; empty if the FMU's start values held.
    inputs : bytes
        The last inputs, as doubles.
    outputs : bytes
        The outputs at that moment, as doubles; the FMU must give them again.
    body : bytes
        The FMU's serialised state, or the inputs of each step.
    """

    method: StateMethod
    fmu: str
    index: int
    step_size: float
    start_time: float
    parameters: Mapping[str, float | list[float]]
    start_inputs: bytes
    inputs: bytes
    outputs: bytes
    body: bytes

    def to_bytes(self) -> bytes:
        """Return the state as bytes; equal states give equal bytes."""
        head = {
            "method": self.method,
            "fmu": self.fmu,
            "index": self.index,
            "step_size": self.step_size,
            "start_time": self.start_time,
            "parameters": dict(self.parameters),
            "start_inputs": self.start_inputs.hex(),
            "inputs": self.inputs.hex(),
            "outputs": self.outputs.hex(),
        }
        text = json.dumps(head, sort_keys=True).encode()
        return _HEADER.pack(_MAGIC, len(text)) + text + self.body

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Return the state that `to_bytes` packed.

        Raises
        ------
        FmuStateError
            If it is something else, or damaged.
        """
        try:
            magic, length = _HEADER.unpack_from(content)
            begin = _HEADER.size + length
            head: dict[str, Any] = json.loads(content[_HEADER.size : begin])
            if magic != _MAGIC or head["method"] not in ("serialised", "replay"):
                raise ValueError(magic)
            return cls(
                method=head["method"],
                fmu=str(head["fmu"]),
                index=int(head["index"]),
                step_size=float(head["step_size"]),
                start_time=float(head["start_time"]),
                parameters={
                    str(name): [*map(float, value)] if isinstance(value, list) else float(value)
                    for name, value in head["parameters"].items()
                },
                start_inputs=bytes.fromhex(head["start_inputs"]),
                inputs=bytes.fromhex(head["inputs"]),
                outputs=bytes.fromhex(head["outputs"]),
                body=content[begin:],
            )
        except (struct.error, ValueError, TypeError, KeyError, AttributeError) as error:
            raise FmuStateError("What was given is not a state of an FMI asset, or it is damaged.") from error

    def refuse_if_foreign(
        self,
        *,
        path: Path,
        fmu: str,
        interval: float,
        start_time: float,
        method: StateMethod,
        width: int,
    ) -> None:
        """Refuse a state of another FMU or binding.

        Parameters
        ----------
        path : Path
            The FMU file, for the error.
        fmu : str
            Its SHA-256.
        interval, start_time : float
            Of the binding [s].
        method : {"serialised", "replay"}
            How the asset keeps its state.
        width : int
            Bytes of the inputs of one step.

        Raises
        ------
        FmuStateError
            If something differs.
        """
        if self.fmu != fmu:
            raise FmuStateError(
                f"The state was saved with another FMU than {path} (its hash differs); use that one."
            )
        if (self.step_size, self.start_time) != (interval, start_time):
            raise FmuStateError("The state was saved with another step size or start time; use that binding.")
        if (
            self.method != method
            or len(self.inputs) != width
            or len(self.start_inputs) not in (0, width)
            or (self.method == "replay" and len(self.body) != width * self.index)
        ):
            raise FmuStateError(
                "The saved state is damaged, or another binding was in use; use that binding."
            )

    def refuse_other_outputs(self, outputs: bytes, name_of: Callable[[int], str]) -> None:
        """Refuse a restored FMU that does not give the outputs that it gave when it was saved.

        Parameters
        ----------
        outputs : bytes
            What it gives now, as doubles.
        name_of : callable
            Name of an output by its position.

        Raises
        ------
        FmuStateError
            If a bit differs: the FMU declares a capability that it does not have.
        """
        if outputs == self.outputs:
            return
        if len(outputs) != len(self.outputs):
            raise FmuStateError("The state was saved with another binding; use that one.")
        then, now = np.frombuffer(self.outputs), np.frombuffer(outputs)
        which = int(np.flatnonzero(now.view(np.int64) != then.view(np.int64))[0])
        if self.method == "replay":
            cause = "it does not give equal outputs for equal inputs, so that it cannot be resumed"
        else:
            cause = (
                "it declares canGetAndSetFMUstate but does not restore all of its state; write "
                '`state = "replay"` into the table [binding] of its binding'
            )
        raise FmuStateError(
            f"After the state was restored the FMU gives {name_of(which)} = {float(now[which])!r} instead of "
            f"{float(then[which])!r}: {cause}."
        )
