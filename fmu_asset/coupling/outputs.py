"""Selecting some of the outputs of a system, in the units of their reader."""

from collections.abc import Iterable, Mapping

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.client.units import IDENTITY

from .structure import Endpoint
from .wiring import ConnectedVariable


class OutputSelection:
    """Selects some of all outputs of a system, and converts them to the units of their reader.

    Parameters
    ----------
    ports : iterable of ConnectedVariable
        The selected outputs, in order.
    position : mapping of Endpoint to int
        The position of each output among all outputs that are read.
    """

    def __init__(
        self, ports: Iterable[ConnectedVariable], position: Mapping[Endpoint, int]
    ) -> None:
        # Delayed outputs are taken from a second copy of all outputs, behind the first.
        output_count = len(position)
        indices = []
        factors = []
        offsets = []
        is_identity = True
        for port in ports:
            index = position[port.end]
            indices.append(index + output_count if port.delayed else index)
            factors.append(port.conversion.factor)
            offsets.append(port.conversion.offset)
            is_identity = is_identity and port.conversion == IDENTITY
        self._indices = np.array(indices, np.intp)
        self._factors = np.array(factors)
        self._offsets = np.array(offsets)
        self._is_identity = is_identity

    def values(self, outputs: FloatArray, outputs_before: FloatArray) -> FloatArray:
        """Return the selected outputs in the reader's units.

        Parameters
        ----------
        outputs, outputs_before : (O,) array
            All outputs, now and at the beginning of the step.
        """
        values: FloatArray = np.concatenate((outputs, outputs_before))[self._indices]
        if self._is_identity:
            return values
        converted: FloatArray = self._factors * values + self._offsets
        return converted
