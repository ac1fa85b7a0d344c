"""Names of a binding found in an FMU: where their values stand in a block, what is refused, what is read."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby
from typing import Any, NamedTuple

import numpy as np

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuFileError, FmuInputError, said
from fmu_asset.instances.plan import Settings, VariableGroup
from reporting.arrays import Float

from .binding import Binding
from .units import IDENTITY, Conversion

_CAUSALITY: Mapping[str, tuple[str, ...]] = {
    "input": ("input",),
    "parameter": ("parameter",),
    "structuralParameter": ("structuralParameter",),
    "output": ("output", "local", "calculatedParameter", "none"),
}
_ELEMENT = re.compile(r"(.+)\[(\d+(?:,\s*\d+)*)\]", re.DOTALL)
# Reals come first, so that they stand together in the block and need no conversion.
_KIND_ORDER = ("Real", "Float64", "Integer", "Boolean")


class VariableElements(NamedTuple):
    """A variable, and which of its values are meant: one, or all."""

    variable: VariableInfo
    elements: range


def find_variable(
    description: FmuDescription, name: str, label: str, causality: str
) -> VariableElements:
    """Return what a name of a binding means in an FMU.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    name : str
        A variable, or an element of an array such as `p[3]`.
    label : str
        Place in the binding, for the error.
    causality : {"input", "parameter", "structuralParameter", "output"}
        What it must be; everything that is neither input nor parameter can be read, a tunable parameter can
        be sent at every step like an input (co-simulation), and a start value be set like a parameter.

    Raises
    ------
    BindingError
        If there is none, or one of another causality or type.
    """
    variable = description.variable(name)
    place = (
        _element(description, name, label)
        if variable is None
        else VariableElements(variable, range(variable.size))
    )
    if place is None:
        unknown = f"{label} names {name!r}, which is not a variable of {description.label}"
        raise BindingError(unknown + description.hint(name))
    variable = place.variable
    sent = (
        causality == "input"
        and (variable.causality, variable.variability) == ("parameter", "tunable")
        and description.interface == "co-simulation"
    )
    started = causality == "parameter" and variable.startable
    if variable.causality not in _CAUSALITY[causality] and not sent and not started:
        wanted = f"{label} must be of causality {causality}, but {name!r}"
        raise BindingError(
            said("binding.causality", wanted=wanted, variable=variable, fmu=description)
        )
    if not variable.numeric:
        raise BindingError(said("binding.numbers_only", label=label, name=name, variable=variable))
    if variable.clocked:
        raise BindingError(
            f"{label} names {name!r}, which changes with a clock; clocks are not supported."
        )
    return place


def _element(description: FmuDescription, name: str, label: str) -> VariableElements | None:
    found = _ELEMENT.fullmatch(name)
    variable = description.variable(found.group(1)) if found else None
    if found is None or variable is None or not variable.shape:
        return None
    index = [int(number) - 1 for number in found.group(2).split(",")]
    try:
        element = int(np.ravel_multi_index(index, variable.shape))
    except (TypeError, ValueError):
        shape = " x ".join(map(str, variable.shape))
        raise BindingError(
            said("binding.element", label=label, name=name, variable=variable, shape=shape)
        ) from None
    return VariableElements(variable, range(element, element + 1))


class BlockLayout:
    """Where variables stand in a block: by base type, and within one in the order of the binding.

    An array stands there with all its elements, since FMI 3 sets and reads arrays as a whole.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    variables : sequence of VariableInfo
        What is exchanged; a variable that is there twice stands once in the block.
    begin : int
        Position of the first value.
    linear : bool
        Whether continuous inputs move in straight lines; these come first.
    """

    def __init__(
        self,
        description: FmuDescription,
        variables: Sequence[VariableInfo],
        begin: int,
        *,
        linear: bool = False,
    ) -> None:
        def kind(variable: VariableInfo) -> tuple[bool, int, str]:
            """Return whether a variable is held, and its base type after the place of that in the order."""
            name = description.exchange_kind(variable)
            held = not (linear and variable.continuous and variable.causality == "input")
            return held, (*_KIND_ORDER, name).index(name), name

        unique = {variable.name: variable for variable in variables if variable.size}
        self.variables = tuple(sorted(unique.values(), key=kind))
        begins = accumulate((variable.size for variable in self.variables), initial=begin)
        self._begins = dict(
            zip((variable.name for variable in self.variables), begins, strict=False)
        )
        groups = [(key, list(members)) for key, members in groupby(self.variables, kind)]
        self.groups = tuple(
            VariableGroup(
                name, tuple(v.reference for v in members), sum(v.size for v in members), not held
            )
            for (held, _, name), members in groups
        )

    def positions(self, place: VariableElements) -> list[int]:
        """Return where the values of a place stand."""
        return [self._begins[place.variable.name] + element for element in place.elements]

    def names(self) -> list[str]:
        """Return the names of all values in the order of the block."""
        return [name for variable in self.variables for name in variable.elements]


def start_values(
    description: FmuDescription, variable: VariableInfo, *, given: bool = False
) -> list[float]:
    """Return the declared start values; one value stands for all elements of an array.

    Parameters
    ----------
    description : FmuDescription
        The FMU, for the error.
    variable : VariableInfo
        The variable, with the shape that it has now.
    given : bool
        Whether all of its values are given: then zeros only keep their place.

    Raises
    ------
    FmuFileError
        If they are no numbers, or not as many as the array has elements.
    """
    words = ("" if given else variable.start or "0").lower().split() or ["0"]
    try:
        values = [float({"true": "1", "false": "0"}.get(word, word)) for word in words]
    except ValueError as error:
        why = said("archive.start_value", variable=variable, fmu=description, error=error)
        raise FmuFileError(why) from error
    if len(values) == 1:
        values *= variable.size
    if len(values) != variable.size:
        raise FmuFileError(
            said("archive.start_values", variable=variable, fmu=description, came=len(values))
        )
    return values


class InputSlot(NamedTuple):
    """Where an input goes: positions in the request block, range in the FMU's unit, conversion."""

    label: str
    positions: Sequence[int]
    low: float
    high: float
    conversion: Conversion
    variable: VariableInfo

    @property
    def whole(self) -> bool:
        """Whether it takes whole numbers only."""
        return self.variable.kind not in FLOAT_KINDS

    def numbers(self, given: Any, *, history: bool = False) -> Float:
        """Return values in the FMU's unit, all of them checked.

        Parameters
        ----------
        given : float or array_like
            As many values as the slot takes; of a history either these for all steps, or for each.
        history : bool
            Whether it is a history.

        Returns
        -------
        (n,) or (N, n) ndarray
            The latter for a history that has values for each of N steps.

        Raises
        ------
        FmuInputError
            If there are others than n values, or one is no number, not finite, not whole or out of range.
        """
        count = len(self.positions)
        given = self._without_names(given)
        try:
            array = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError) as error:
            wanted = "numbers" if history else "a number"
            raise FmuInputError(f"{self.label} must be {wanted}, but is {given!r}.") from error
        cell = () if count == 1 else (count,)
        per_step = history and array.shape != cell
        if per_step and array.shape[1:] not in (cell, (count,)):
            wanted = "a number, or one" if count == 1 else f"{count} values, or as many"
            shape = str(array.shape)
            raise FmuInputError(said("inputs.history_shape", self=self, wanted=wanted, shape=shape))
        if not history and array.size != count:
            wrong = f"takes {count} values, but {array.size} came"
            wrong = f"must be a number, but is {given!r}" if count == 1 else wrong
            raise FmuInputError(f"{self.label} {wrong}.")
        rows = array.reshape(-1, count)
        with np.errstate(all="ignore"):
            # The arithmetic of `Conversion.to_fmu`: the bits are those of a step.
            scale = self.conversion
            values = rows if scale == IDENTITY else scale.factor * rows + scale.offset
            # A conversion of units may round a value at the edge of the range to just outside of it.
            inside = np.clip(values, self.low, self.high)
            near = np.abs(inside - values) <= 1e-12 * np.maximum(np.abs(inside), 1.0)
            whole = np.floor(values) == values if self.whole else True
            items = self.variable.items
            defined = np.isin(values, [*items.values()]) if items else True
            wrong_ones = np.argwhere(~(np.isfinite(values) & near & whole & defined))
        if len(wrong_ones):
            step, element = wrong_ones[0].tolist()
            where = f" It is the value of step {step} of the {len(rows)}." if per_step else ""
            shown = given if isinstance(given, int | float) else rows[step, element].item()
            raise FmuInputError(self._refusal(shown, values[step, element]) + where)
        inside = np.where((self.low <= values) & (values <= self.high), values, inside)
        return inside if per_step else inside[0]

    def _without_names(self, given: Any) -> Any:
        """Return values with the names of an enumeration's items replaced by their numbers."""
        if not self.variable.items:
            return given
        if isinstance(given, str):
            return self._number_of_item(given)
        if isinstance(given, np.ndarray) and given.dtype.kind == "U":
            given = given.tolist()
        if isinstance(given, list | tuple):
            return [self._number_of_item(item) if isinstance(item, str) else item for item in given]
        return given

    def _number_of_item(self, name: str) -> float:
        if name not in self.variable.items:
            raise FmuInputError(
                f"{self.label} must be an item of the enumeration {self.variable.name!r} "
                f"({self.variable.item_list}), but is {name!r}; nothing was sent to the FMU."
            )
        return float(self.variable.items[name])

    def _refusal(self, given: float, number: float) -> str:
        if not math.isfinite(number):
            return f"{self.label} must be finite, but is {given!r}; nothing was sent to the FMU."
        if self.whole and not float(number).is_integer():
            return f"{self.label} must be a whole number, but is {given!r}; nothing was sent to the FMU."
        if self.variable.items:
            return (
                f"{self.label} must be an item of the enumeration {self.variable.name!r} "
                f"({self.variable.item_list}), but is {given!r}; nothing was sent to the FMU."
            )
        return (
            f"{self.label} = {given!r} lies outside the range of {self.variable.name!r}, {self.low:g} to "
            f"{self.high:g}{self.variable.in_unit}; nothing was sent to the FMU."
        )


def with_structural_parameters(
    description: FmuDescription, binding: Binding
) -> tuple[FmuDescription, Settings]:
    """Return what an FMU declares with the structural parameters of a binding, and what is set for them.

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter, or is run by model exchange.
    FmuInputError
        If a value is no whole number or out of range, or makes an array too large.
    """
    found: Settings = []
    lengths: dict[str | None, int] = {}
    for name, value in binding.binding.structural_parameters.items():
        label = f"structural_parameters.{name}"
        where = f"{label} of the binding {binding.name}"
        variable = find_variable(description, name, where, "structuralParameter").variable
        numbers = (
            InputSlot(label, (0,), *variable.bounds, IDENTITY, variable).numbers(value).tolist()
        )
        found.append((variable.kind, variable.reference, numbers))
        lengths[name] = int(numbers[0])
    if not lengths:
        return description, found
    if description.interface == "model-exchange":
        raise BindingError(said("binding.structural", description=description))
    return replace(
        description, variables=tuple(v.resized(lengths) for v in description.variables)
    ), found


class Observation(NamedTuple):
    """What came out of one communication step.

    Attributes
    ----------
    values : (n_obs,) ndarray
        The observations of the binding in their order and units.
    time : float
        Time at the end of the step [s]: start + i * interval.
    extra : dict of str to float
        Monitors, recorded variables and outputs of ports.
    """

    values: Float
    time: float
    extra: dict[str, float]


@dataclass(frozen=True)
class ObservationHistory:
    """What came out of N steps.

    Attributes
    ----------
    time : (N,) ndarray
        Time at the end of each step [s].
    values : (N, n_obs) ndarray
        The observations of the binding in their order and units.
    extra : dict of str to (N,) ndarray
        Monitors, recorded variables and outputs of ports.
    ended : str
        What the FMU did if it ended the simulation by itself: fewer steps were made then than were asked
        for, and the last time is where it ended, within a step perhaps.
    """

    time: Float
    values: Float
    extra: dict[str, Float]
    ended: str = ""


def joined_histories(parts: Sequence[ObservationHistory]) -> ObservationHistory:
    """Return what came out of steps that were made in several parts, one after the other."""
    return ObservationHistory(
        np.concatenate([part.time for part in parts]),
        np.vstack([part.values for part in parts]),
        {name: np.concatenate([part.extra[name] for part in parts]) for name in parts[0].extra},
        parts[-1].ended,
    )


class OutputTable:
    """What is read of a block of outputs: first what is observed, then the extras.

    Parameters
    ----------
    observed : int
        How many are observed.
    extra : sequence of str
        Names of the extras.
    positions : sequence of int
        Where all of them stand in the block.
    conversions : sequence of Conversion
        From the binding's units to the FMU's, one for each.
    """

    def __init__(
        self,
        observed: int,
        extra: Sequence[str],
        positions: Sequence[int],
        conversions: Sequence[Conversion],
    ) -> None:
        self._observed, self._extra = observed, tuple(extra)
        index = np.array(positions, dtype=np.intp)
        first = int(index[0]) if len(index) else 0
        together = np.array_equal(index, np.arange(first, first + len(index)))
        self._index = slice(first, first + len(index)) if together else index
        scales = np.array(conversions).reshape(-1, 2).T
        self._scale = None if all(item == IDENTITY for item in conversions) else scales

    def _converted(self, values: Float) -> Float:
        """Return values in the binding's units; never a view."""
        if self._scale is None:
            return values.copy()
        converted: Float = (values - self._scale[1]) / self._scale[0]
        return converted

    def observation(self, block: Float, time: float) -> Observation:
        """Return what a block (n_outputs,) of a moment [s] holds."""
        values = self._converted(block[self._index])
        # Both are of one table; to compare their lengths would take as long as the rest of the line.
        extra = dict(zip(self._extra, values[self._observed :].tolist()))  # noqa: B905
        return Observation(values[: self._observed], time, extra)

    def history(self, time: Float, blocks: Float, ended: str = "") -> ObservationHistory:
        """Return what the blocks (N, n_outputs) of moments (N,) [s] hold; `ended` as in the history."""
        values = self._converted(blocks[:, self._index])
        extra = np.ascontiguousarray(values[:, self._observed :].T)
        observed = np.ascontiguousarray(values[:, : self._observed])
        return ObservationHistory(time, observed, dict(zip(self._extra, extra, strict=True)), ended)
