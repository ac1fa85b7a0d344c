"""What the TOML files of models share: how they are read, their tables and kinds of numbers."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import ConfigDict

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Quantity
from discrepancy.errors import ModelError
from discrepancy.system.interface import Model
from reporting import toml_file
from reporting.toml_file import Fault, Name, NotNegative, Number, read_toml, validate


class Section(toml_file.Section):
    """A table of the file; unknown keys are refused, and its values cannot be changed."""

    model_config = ConfigDict(strict=False)


class NamedSection(Section):
    """A table with a name."""

    name: Name


class ParameterSection(NamedSection):
    """`[[parameter]]`: a calibrated parameter with its posterior as prior."""

    mean: Number
    deviation: NotNegative
    low: Number
    high: Number
    unit: str = "1"

    def faults(self) -> Iterator[Fault]:
        """Yield a mean out of its range."""
        where = f"low {self.low:g} and high {self.high:g}"
        yield not self.low <= self.mean <= self.high, f"the mean {self.mean:g} is not between {where}"


class ModelDescription(Section):
    """What every description of a model has: version of the format, name for people, parameters, ports."""

    what: ClassVar[str]
    """What it is, with its article, for sentences."""
    format: Literal[1]
    name: Name
    parameter: tuple[ParameterSection, ...] = ()
    port: tuple[NamedSection, ...] = ()

    @classmethod
    def parse(cls, content: object, source: str = "the model") -> Self:
        """Check the content of a file.

        Raises
        ------
        ModelError
            One sentence that names `source`, the place, what came and what was expected.
        """
        return validate(cls, content, source, ModelError, what=cls.what)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file; raises `ModelError` if it is not there, not TOML, or its content is no such model."""
        return cls.parse(read_toml(path, ModelError, what=cls.what.partition(" ")[2]), str(path))

    @staticmethod
    def repeated(kind: str, names: list[str]) -> Iterator[Fault]:
        """Yield the names that are there twice."""
        yield from ((names.count(name) > 1, f"there are two of {kind} {name!r}") for name in names)


class DescribedModel(Model):
    """What models of a file know of themselves.

    Parameters
    ----------
    description : ModelDescription
        Content of the file.
    quantities : mapping of str to Quantity
        What each output is.
    """

    def __init__(self, description: ModelDescription, quantities: Mapping[str, Quantity]) -> None:
        self.name, self.quantities = description.name, quantities
        self.parameters = tuple(
            ParameterPrior(item.name, item.unit, item.mean, item.deviation, item.low, item.high)
            for item in description.parameter
        )
        self.ports = tuple(item.name for item in description.port)
