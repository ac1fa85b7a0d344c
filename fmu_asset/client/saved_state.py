"""The state of an asset as bytes, for the checkpoints of a mission."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from fmu_asset.errors import FmuStateError

from .values import PlainValue

StateMethod = Literal["serialised", "replay"]
"""How a state is kept: serialised by the FMU, or as the inputs of all steps, to be replayed."""
_HEADER = struct.Struct("<8sI")


class PackedState(BaseModel):
    """A state of an asset: a header, written as JSON, and a body of bytes.

    Attributes
    ----------
    body : bytes
        States of the FMUs themselves.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        ser_json_bytes="hex",
        val_json_bytes="hex",
    )
    magic: ClassVar[bytes]
    """First bytes of such a state."""
    what: ClassVar[str]
    """Name of the asset's kind, for messages."""

    body: bytes = Field(b"", exclude=True)

    def to_bytes(self) -> bytes:
        """Return the state as bytes; equal states give equal bytes."""
        head = self.model_dump_json().encode()
        return _HEADER.pack(self.magic, len(head)) + head + self.body

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Return the state that `to_bytes` packed.

        Raises
        ------
        FmuStateError
            If the bytes are something else, or damaged.
        """
        try:
            magic, length = _HEADER.unpack_from(content)
            begin_of_body = _HEADER.size + length
            if magic != cls.magic:
                raise ValueError(magic)
            state = cls.model_validate_json(content[_HEADER.size : begin_of_body])
        except (struct.error, ValueError, TypeError) as error:
            raise FmuStateError(
                f"What was given is not a state of {cls.what}, or it is damaged."
            ) from error
        return state.model_copy(update={"body": content[begin_of_body:]})


@dataclass(frozen=True)
class AssetStart:
    """How an asset was started.

    Attributes
    ----------
    parameters : dict of str to float, str or list
        Parameters by the binding's names.
    health : dict of str to float or list
        Health that was set before the initialisation.
    index : int
        Number of steps before the start.
    inputs : bytes
        Inputs during the initialisation, as doubles; empty if there were none.
    """

    parameters: dict[str, PlainValue]
    health: dict[str, PlainValue]
    index: int
    inputs: bytes


class SavedState(PackedState):
    """A saved state of one FMU.

    The body is the FMU's serialised state, or the inputs of each step.

    Attributes
    ----------
    index : int
        Number of steps made.
    method : {"serialised", "replay"}
        How the state is kept in the body.
    fmu : str
        SHA-256 of the FMU file.
    step_size, start_time : float
        Time between observations and start of the binding [s].
    parameters : dict of str to float, str or list
        Parameters of the last start, by the binding's names.
    health : dict of str to float or list
        Health that was set at the last start.
    first_index : int
        Number of steps before the last start.
    start_inputs : bytes
        Inputs during the initialisation, as doubles; empty if there were none.
    inputs : bytes
        Inputs at the time of the state, as doubles.
    outputs : bytes
        Outputs at that time, as doubles; the restored FMU must give the same.
    """

    magic = b"UAVASSET"
    what = "an FMI asset"

    index: int = Field(ge=0)
    method: StateMethod
    fmu: str
    step_size: float
    start_time: float
    parameters: dict[str, PlainValue]
    health: dict[str, PlainValue] = Field(default_factory=dict)
    first_index: int = Field(0, ge=0)
    start_inputs: bytes
    inputs: bytes
    outputs: bytes

    @property
    def start(self) -> AssetStart:
        """The last start before the state."""
        return AssetStart(self.parameters, self.health, self.first_index, self.start_inputs)

    @property
    def steps_since_start(self) -> int:
        """Number of steps since the last start."""
        return self.index - self.first_index

    def is_sound(self, method: StateMethod, bytes_of_inputs: int) -> bool:
        """Return whether the parts have the lengths that a method and a size of inputs require."""
        return (
            self.method == method
            and len(self.inputs) == bytes_of_inputs
            and len(self.start_inputs) in (0, bytes_of_inputs)
            and self.first_index <= self.index
            and not (
                method == "replay" and len(self.body) != bytes_of_inputs * self.steps_since_start
            )
        )

    def check_outputs(self, outputs: bytes, names: Sequence[str]) -> None:
        """Raise an error if a restored FMU gives other outputs than at the time of saving.

        Parameters
        ----------
        outputs : bytes
            The present outputs, as doubles.
        names : sequence of str
            The names of the outputs.

        Raises
        ------
        FmuStateError
            If a bit differs: the FMU cannot restore its state, though it declares so, or cannot
            repeat it.
        """
        if outputs == self.outputs:
            return
        if len(outputs) != len(self.outputs):
            raise FmuStateError("The state was saved with another binding; use that one.")
        saved_outputs = np.frombuffer(self.outputs)
        present_outputs = np.frombuffer(outputs)
        # compare bits: 0.0 and -0.0 are equal numbers
        has_other_bits = present_outputs.view(np.int64) != saved_outputs.view(np.int64)
        output = int(np.flatnonzero(has_other_bits)[0])
        cause = "it does not give equal outputs for equal inputs, so that it cannot be resumed"
        if self.method == "serialised":
            cause = partial_state_sentence("does not restore all of its state")
        raise FmuStateError(
            f"After the state was restored the FMU gives {names[output]} = "
            f"{float(present_outputs[output])!r} instead of {float(saved_outputs[output])!r}: "
            f"{cause}."
        )


def partial_state_sentence(fault: str) -> str:
    """Return the end of a sentence about an FMU that saves or restores its state in part.

    Parameters
    ----------
    fault : str
        What the FMU does, such as "does not restore all of its state".
    """
    return (
        f'it declares canGetAndSetFMUstate but {fault}; write `state = "replay"` into the table '
        "[binding] of its binding"
    )
