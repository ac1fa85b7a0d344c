"""Tables of a binding that name variables of an FMU: inputs, parameters, vectors and ports."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Self

from pydantic import BeforeValidator, Field

from reporting.formats.toml_file import Check, Number, Section

from .units import same_dimension

PORT_QUANTITIES = {
    "force": ("N", "N.m"),
    "displacement": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
}
"""Quantities of a mechanical port, with their units for translation and for rotation."""

_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
_LARGEST_PATTERN = 100_000

_Text = Annotated[str, Field(min_length=1)]
_Texts = Annotated[tuple[_Text, ...], Field(strict=False)]


def _with_expanded_patterns(names: object) -> object:
    """Return a name or a list of names with all patterns expanded, see `expand`.

    Anything else is returned unchanged, so that pydantic refuses it.
    """
    if isinstance(names, str):
        return expand(names)
    if not isinstance(names, list):
        return names
    expanded: list[object] = []
    for name in names:
        if isinstance(name, str):
            expanded += expand(name)
        else:
            expanded.append(name)
    return tuple(expanded)


def expand(pattern: str) -> tuple[str, ...]:
    """Return the names that a pattern stands for: a[1], a[2], a[3] for `a[{1..3}]`.

    Parameters
    ----------
    pattern : str
        A name, with at most one range in braces.

    Raises
    ------
    ValueError
        If the range is empty or too long, or there is more than one.
    """
    ranges = _RANGE.findall(pattern)
    if not ranges:
        return (pattern,)
    if len(ranges) > 1:
        raise ValueError(f"the pattern {pattern!r} has more than one range")
    first_text, last_text = ranges[0]
    first = int(first_text)
    last = int(last_text)
    if not first <= last or last - first >= _LARGEST_PATTERN:
        raise ValueError(f"the range of {pattern!r} is empty or longer than {_LARGEST_PATTERN}")
    return tuple(_RANGE.sub(str(number), pattern) for number in range(first, last + 1))


_Names = Annotated[
    tuple[_Text, ...],
    BeforeValidator(_with_expanded_patterns, json_schema_input_type=_Text | tuple[_Text, ...]),
]


class ScalarBinding(Section):
    """One variable: its name in the FMU, and the unit in which the caller sets or reads it.

    The name is that of a scalar, of one element of an FMI 3 array (`p[3]`, `a[2,1]`; from 1), or of
    a whole array, which takes as many values.
    """

    variable: _Text
    """Name of the variable in the FMU."""
    unit: _Text
    """Unit in which the caller sets or reads the value."""


class InputBinding(ScalarBinding):
    """An input with a range of its own, in `unit`, within that of the FMU."""

    minimum: Number | None = None
    """Least value that may be given [unit of the entry]."""
    maximum: Number | None = None
    """Largest value that may be given [unit of the entry]."""

    def checks(self) -> Iterator[Check]:
        """Yield a minimum above the maximum."""
        if self.minimum is not None and self.maximum is not None:
            sentence = f"minimum {self.minimum:g} is larger than maximum {self.maximum:g}"
            yield self.minimum > self.maximum, sentence

    @property
    def limits(self) -> tuple[float, float]:
        """The range in `unit`; infinite on a side without a limit."""
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        return low, high


class ParameterBinding(InputBinding):
    """A parameter, whose `value` (in `unit`) is set at every reset unless the caller gives another.

    The value is a text for a text parameter (of the unit "1"), and may be the name of an item of an
    enumeration.
    """

    value: Number | str | None = None
    """Value that is set at every reset unless the caller gives another; a text for a text
    parameter, or the name of an item of an enumeration [unit of the entry]."""


class VectorBinding(Section):
    """Several variables in order; a text with `{a..b}` stands for all numbers from a to b.

    `unit` is a single unit for all variables, or a list with one unit for each of them.
    """

    variables: Annotated[_Names, Field(min_length=1)]
    """Names of variables in the FMU, in order; `{a..b}` stands for all numbers from a to b."""
    unit: _Text | _Texts
    """Unit of all variables, or a list with the unit of each variable."""

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each variable."""
        if isinstance(self.unit, str):
            return (self.unit,) * len(self.variables)
        return self.unit

    def by_element(self, element_names_of: Callable[[str], Sequence[str]]) -> Self:
        """Return the vector with the name of each array replaced by the names of its elements.

        Each element has the unit of its array.

        Parameters
        ----------
        element_names_of : callable
            Returns the names of the elements of a variable, given its name. For a scalar it returns
            a sequence that contains this name only.
        """
        names: list[str] = []
        units: list[str] = []
        for name, unit in zip(self.variables, self.units, strict=True):
            element_names = element_names_of(name)
            names += element_names
            units += [unit] * len(element_names)
        unit_of_vector = self.unit if isinstance(self.unit, str) else tuple(units)
        return self.model_copy(update={"variables": tuple(names), "unit": unit_of_vector})

    def checks(self) -> Iterator[Check]:
        """Yield the fault that there is neither one unit nor one for each variable."""
        count = len(self.variables)
        unit_count = len(self.units)
        yield (
            unit_count != count,
            f"`unit` must be one text, or one for each of the {count} variables, but {unit_count} "
            "were given",
        )


class PortBinding(Section):
    """A mechanical port, at which another FMU can be coupled.

    One of force and motion is an input of the FMU and the other an output: an FMU takes the force
    and gives displacement or velocity, or the reverse. Inputs are given to `FmiAsset.step` as
    `port={"<name>.force": ...}`; outputs are in `Observation.extra` under the same names.
    """

    force: VectorBinding
    """Force or moment at the port."""
    displacement: VectorBinding | None = None
    """Displacement or angle of the port."""
    velocity: VectorBinding | None = None
    """Velocity or angular velocity of the port."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks that a port has a motion, and units that fit its quantities."""
        has_motion = self.displacement is not None or self.velocity is not None
        yield not has_motion, "a port needs a displacement or a velocity beside its force"
        for name, vector in self.quantities.items():
            unit = vector.unit
            if isinstance(unit, tuple):
                yield True, f"{name} must have one unit, but {len(unit)} were given"
                continue
            units = PORT_QUANTITIES[name]
            # a unit that is not understood (None) is accepted
            is_wrong = all(same_dimension(unit, allowed_unit) is False for allowed_unit in units)
            yield is_wrong, f"{name} is in {unit!r}, but must be in {' or '.join(units)}"

    @property
    def quantities(self) -> dict[str, VectorBinding]:
        """The quantities that the port has, in the order of `PORT_QUANTITIES`."""
        vectors = {
            "force": self.force,
            "displacement": self.displacement,
            "velocity": self.velocity,
        }
        return {name: vector for name, vector in vectors.items() if vector is not None}

    def by_element(self, element_names_of: Callable[[str], Sequence[str]]) -> Self:
        """Return the port with the vectors of its quantities as `VectorBinding.by_element` does."""
        changed_vectors = {}
        for name, vector in self.quantities.items():
            changed_vectors[name] = vector.by_element(element_names_of)
        return self.model_copy(update=changed_vectors)


class RecordBinding(Section):
    """The table `[record]`: further variables to be recorded, in the FMU's own units."""

    variables: _Names = ()
    """Names of variables in the FMU; `{a..b}` stands for all numbers from a to b."""
