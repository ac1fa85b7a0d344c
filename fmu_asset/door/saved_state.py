"""The state of an asset as bytes: what a mission's checkpoint keeps of an FMU, or of several."""

import struct
from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from fmu_asset.errors import FmuStateError
from fmu_asset.sentences import said

StateMethod = Literal["serialised", "replay"]
"""How a state is kept: serialised by the FMU, or as the inputs of all steps, to be replayed."""
_HEADER = struct.Struct("<8sI")


class PackedState(BaseModel):
    """What is kept of an asset: a head, in JSON, and a body of bytes.

    Attributes
    ----------
    index : int
        Number of steps made.
    body : bytes
        What the FMUs themselves remember.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, ser_json_bytes="hex", val_json_bytes="hex"
    )
    magic: ClassVar[bytes]
    what: ClassVar[str]

    body: bytes = Field(b"", exclude=True)

    def to_bytes(self) -> bytes:
        """Return the state as bytes; equal states give equal bytes."""
        text = self.model_dump_json().encode()
        return _HEADER.pack(self.magic, len(text)) + text + self.body

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
            if magic != cls.magic:
                raise ValueError(magic)
            head = cls.model_validate_json(content[_HEADER.size : begin])
        except (struct.error, ValueError, TypeError) as error:
            raise FmuStateError(f"What was given is not a state of {cls.what}, or it is damaged.") from error
        return head.model_copy(update={"body": content[begin:]})


class SavedState(PackedState):
    """A saved state of one FMU; its body is the FMU's serialised state, or the inputs of each step.

    Attributes
    ----------
    method : {"serialised", "replay"}
        What `body` is.
    fmu : str
        SHA-256 of the FMU file.
    step_size, start_time : float
        Time between observations and start of the binding [s].
    parameters : dict of str to float, or to a list for an array
        As the caller gave them.
    start_inputs : bytes
        Inputs during initialisation, as doubles; empty if the FMU's start values held.
    inputs : bytes
        The last inputs, as doubles.
    outputs : bytes
        The outputs at that moment, as doubles; the FMU must give them again.
    """

    magic = b"UAVASSET"
    what = "an FMI asset"

    index: int = Field(ge=0)
    method: StateMethod
    fmu: str
    step_size: float
    start_time: float
    parameters: dict[str, float | list[float]]
    start_inputs: bytes
    inputs: bytes
    outputs: bytes

    def refuse_other_outputs(self, outputs: bytes, names: Sequence[str]) -> None:
        """Refuse a restored FMU that does not give the outputs that it gave when it was saved.

        Parameters
        ----------
        outputs : bytes
            What it gives now, as doubles.
        names : sequence of str
            Names of the outputs.

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
        values = float(now[which]), float(then[which])
        raise FmuStateError(said("state.differs", name=names[which], values=values, cause=cause))
