"""The state of coupled FMUs as bytes: the states of the components, and what they had exchanged."""

import hashlib
import json
from itertools import accumulate, pairwise

from fmu_asset.door.binding import Binding
from fmu_asset.door.saved_state import PackedState
from fmu_asset.errors import FmuStateError

from .wiring import Wiring


class CoupledState(PackedState):
    """A saved state of coupled FMUs; its body holds the states of the components, one behind the other.

    Attributes
    ----------
    system : str
        Hash of the system; see `wiring_hash`.
    parameters : dict of str to float
        As the caller gave them.
    held : dict of str to dict of str to float
        The last inputs of each component.
    outputs, before : list of float
        The outputs that are read, now and at the beginning of the last step.
    sizes : list of int
        Bytes of each component's state.
    """

    magic = b"UAVSYSTM"
    what = "coupled FMUs"

    system: str
    parameters: dict[str, float]
    held: dict[str, dict[str, float]]
    outputs: list[float]
    before: list[float]
    sizes: list[int]

    @property
    def components(self) -> list[bytes]:
        """States of the components; raises `FmuStateError` if the body is damaged."""
        ends = list(accumulate(self.sizes, initial=0))
        if ends[-1] != len(self.body):
            raise FmuStateError(f"What was given is not a state of {self.what}, or it is damaged.")
        return [self.body[begin:end] for begin, end in pairwise(ends)]


def wiring_hash(wiring: Wiring, binding: Binding, algorithm: str, iterations: int, tolerance: float) -> str:
    """Return the SHA-256 of all that the meaning of a state depends on; places of files do not count."""
    record = {
        "components": [
            [c.name, wiring.declared[c.name].sha256, wiring.settings[c.name], c.substeps]
            + ([] if c.interface is None else [c.interface])
            for c in wiring.structure.components
        ],
        "feeds": [
            [str(port.end), str(target), *port.conversion, port.delayed]
            for target, port in wiring.feeds.items()
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
