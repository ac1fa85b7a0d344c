"""The state of coupled FMUs as bytes: the states of the components, and what they had exchanged."""

import hashlib
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from fmu_asset.door.binding import Binding
from fmu_asset.errors import FmuStateError

from .wiring import Wiring

_MAGIC = b"UAVSYSTM"
_HEADER = struct.Struct("<8sI")


@dataclass(frozen=True)
class CoupledState:
    """A saved state of coupled FMUs.

    Attributes
    ----------
    system : str
        Hash of the system; see `wiring_hash`.
    index : int
        Number of steps made.
    parameters : mapping of str to float
        As the caller gave them.
    held : sequence of dict of str to float
        The last inputs of each component.
    outputs, before : sequence of float
        The outputs that are read, now and at the beginning of the last step.
    components : sequence of bytes
        The states of the components.
    """

    system: str
    index: int
    parameters: Mapping[str, float]
    held: Sequence[Mapping[str, float]]
    outputs: Sequence[float]
    before: Sequence[float]
    components: Sequence[bytes]

    def to_bytes(self) -> bytes:
        """Return the state as bytes; equal states give equal bytes."""
        head = {
            "system": self.system,
            "index": self.index,
            "parameters": dict(self.parameters),
            "held": [dict(held) for held in self.held],
            "outputs": list(self.outputs),
            "before": list(self.before),
            "sizes": [len(state) for state in self.components],
        }
        text = json.dumps(head, sort_keys=True, allow_nan=False).encode()  # doubles survive JSON to the bit
        return _HEADER.pack(_MAGIC, len(text)) + text + b"".join(self.components)

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
            sizes = [int(size) for size in head["sizes"]]
            if magic != _MAGIC or begin + sum(sizes) != len(content):
                raise ValueError(magic)
            components = []
            for size in sizes:
                components.append(content[begin : begin + size])
                begin += size
            return cls(
                system=str(head["system"]),
                index=int(head["index"]),
                parameters={str(k): float(v) for k, v in head["parameters"].items()},
                held=[{str(k): float(v) for k, v in held.items()} for held in head["held"]],
                outputs=[float(value) for value in head["outputs"]],
                before=[float(value) for value in head["before"]],
                components=components,
            )
        except (struct.error, ValueError, TypeError, KeyError, AttributeError) as error:
            raise FmuStateError("What was given is not a state of coupled FMUs, or it is damaged.") from error


def wiring_hash(wiring: Wiring, binding: Binding, algorithm: str, iterations: int, tolerance: float) -> str:
    """Return the SHA-256 of all that the meaning of a state depends on; places of files do not count."""
    record = {
        "components": [
            [c.name, wiring.declared[c.name].sha256, wiring.settings[c.name], c.substeps]
            + ([] if c.interface is None else [c.interface])
            for c in wiring.structure.components
        ],
        "feeds": [
            [str(feed.source), str(feed.target), *feed.conversion, feed.delayed] for feed in wiring.feeds
        ],
        "inward": {
            name: [[str(port.end), *port.conversion] for port in ports]
            for name, ports in wiring.inward.items()
        },
        "outward": {
            name: [str(port.end), *port.conversion, port.delayed] for name, port in wiring.outward.items()
        },
        "binding": binding.model_dump(mode="json", exclude={"limits"}),
        "algorithm": [algorithm, iterations, tolerance],
    }
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
