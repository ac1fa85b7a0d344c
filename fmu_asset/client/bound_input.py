"""An input or parameter of a binding, which checks and converts its values for the FMU."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fmu_asset.archive.declared import FLOAT_KINDS, VariableInfo
from fmu_asset.errors import FmuInputError
from reporting.arrays import Float

from .units import IDENTITY, Conversion


class BoundInput(NamedTuple):
    """An input or parameter of a binding: range, unit, and positions of its n values.

    Attributes
    ----------
    label : str
        Role and name in the binding, for messages.
    positions : sequence of int
        Positions in the request, or among the elements of a parameter.
    low, high : float
        Range in the FMU's unit.
    conversion : Conversion
        Conversion from the binding's unit to the FMU's.
    """

    label: str
    positions: Sequence[int]
    low: float
    high: float
    conversion: Conversion
    variable: VariableInfo

    @property
    def takes_whole_numbers(self) -> bool:
        """Whether it takes whole numbers only."""
        return self.variable.kind not in FLOAT_KINDS

    def numbers(self, values: npt.ArrayLike, *, history: bool = False) -> Float:
        """Check the values of an input, and return them in the FMU's unit.

        Parameters
        ----------
        values : float, str or array_like
            The n values in the binding's unit. A history has (N, n) values for N steps, or n values
            that hold for all steps.
        history : bool
            Whether the values may differ from step to step.

        Returns
        -------
        (n,) or (N, n) ndarray
            The latter for a history with values for each of N steps.

        Raises
        ------
        FmuInputError
            If there are not n values, or one is not a number, not finite, not whole or out of
            range.
        """
        values = self._with_item_numbers(values)
        array = self._float_array(values, history=history)
        varies = self._varies(array) if history else False
        if not history:
            self._check_count(array, values)
        rows_of_steps = array.reshape(-1, len(self.positions))
        with np.errstate(all="ignore"):
            converted = self._converted(rows_of_steps)
            clipped = np.clip(converted, self.low, self.high)
            refused_positions = np.argwhere(~self._acceptable(converted, clipped))
        if len(refused_positions):
            # name the first value that is refused, as the caller gave it
            step, element = refused_positions[0].tolist()
            value = (
                values if isinstance(values, int | float) else rows_of_steps[step, element].item()
            )
            sentence = self._refusal(value, converted[step, element])
            if varies:
                sentence += f" It is the value of step {step} of the {len(rows_of_steps)}."
            raise FmuInputError(sentence)
        # a value that the conversion of units has rounded out of the range is set to its limit
        is_inside = (self.low <= converted) & (converted <= self.high)
        checked = np.where(is_inside, converted, clipped)
        return checked if varies else checked[0]

    # ------------------------------------------------------------------ reading

    def _with_item_numbers(self, values: npt.ArrayLike) -> npt.ArrayLike:
        """Return values with names of an enumeration's items replaced by their numbers."""
        if not self.variable.items:
            return values
        if isinstance(values, str):
            return self._number_of_item(values)
        if isinstance(values, np.ndarray) and values.dtype.kind == "U":
            values = values.tolist()
        if isinstance(values, list | tuple):
            return [
                self._number_of_item(entry) if isinstance(entry, str) else entry for entry in values
            ]
        return values

    def _number_of_item(self, name: str) -> float:
        """Return the number of an enumeration's item; raise an error for an unknown name."""
        if name not in self.variable.items:
            raise FmuInputError(
                f"{self.label} must be an item of the enumeration {self.variable.name!r} "
                f"({self.variable.item_list}), but is {name!r}; nothing was sent to the FMU."
            )
        return float(self.variable.items[name])

    def _float_array(self, values: npt.ArrayLike, *, history: bool) -> Float:
        """Return values as an array of floats; raise an error for anything but numbers."""
        try:
            return np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            expected_value = "numbers" if history else "a number"
            raise FmuInputError(
                f"{self.label} must be {expected_value}, but is {values!r}."
            ) from error

    def _varies(self, history: Float) -> bool:
        """Return whether a history (N, n), or (N,) for one value, has values for each step.

        A history of another shape raises an error.
        """
        count = len(self.positions)
        shape_of_one_step = () if count == 1 else (count,)
        if history.shape == shape_of_one_step:
            return False
        if history.shape[1:] not in (shape_of_one_step, (count,)):
            expected_values = "a number, or one" if count == 1 else f"{count} values, or as many"
            raise FmuInputError(
                f"{self.label} must be {expected_values} for each step, but has the shape "
                f"{history.shape}."
            )
        return True

    def _check_count(self, array: Float, values: npt.ArrayLike) -> None:
        """Raise an error if an array does not have as many values as the input."""
        count = len(self.positions)
        if array.size == count:
            return
        if count == 1:
            raise FmuInputError(f"{self.label} must be a number, but is {values!r}.")
        raise FmuInputError(f"{self.label} takes {count} values, but {array.size} were given.")

    # ------------------------------------------------------------------ checking

    def _converted(self, rows: Float) -> Float:
        """Return values in the FMU's unit.

        The operations are those of `Conversion.to_fmu`, so that the results are equal bit by bit.
        """
        if self.conversion == IDENTITY:
            return rows
        return self.conversion.factor * rows + self.conversion.offset

    def _acceptable(self, values: Float, clipped: Float) -> npt.NDArray[np.bool_]:
        """Return which of the values (N, n) may be sent to the FMU.

        A value that differs from `clipped`, the same values limited to the range, by no more than
        the rounding error of a unit conversion is accepted.
        """
        rounding_error = 1e-12 * np.maximum(np.abs(clipped), 1.0)
        is_near_range = np.abs(clipped - values) <= rounding_error
        acceptable = np.isfinite(values) & is_near_range
        if self.takes_whole_numbers:
            acceptable &= np.floor(values) == values
        if self.variable.items:
            acceptable &= np.isin(values, [*self.variable.items.values()])
        return acceptable

    def _refusal(self, value: float, number: float) -> str:
        """Return the sentence that refuses a value, given also as a number in the FMU's unit."""
        if not math.isfinite(number):
            return f"{self.label} must be finite, but is {value!r}; nothing was sent to the FMU."
        if self.takes_whole_numbers and not float(number).is_integer():
            return (
                f"{self.label} must be a whole number, but is {value!r}; nothing was sent to the "
                "FMU."
            )
        if self.variable.items:
            return (
                f"{self.label} must be an item of the enumeration {self.variable.name!r} "
                f"({self.variable.item_list}), but is {value!r}; nothing was sent to the FMU."
            )
        return (
            f"{self.label} = {value!r} lies outside the range of {self.variable.name!r}, "
            f"{self.low:g} to {self.high:g}{self.variable.in_unit}; nothing was sent to the FMU."
        )
