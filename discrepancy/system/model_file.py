"""Common parts of the TOML files of models: how they are read, and their tables."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import ConfigDict

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Quantity
from discrepancy.errors import ModelError
from discrepancy.system.interface import Model
from reporting.formats import toml_file
from reporting.formats.toml_file import Check, Name, NotNegative, Number, read_toml, validate


class Section(toml_file.Section):
    """A table of the file; unknown keys are refused, and its values cannot be changed."""

    model_config = ConfigDict(strict=False)


class NamedSection(Section):
    """A table with a name."""

    name: Name
    """Name, which is unique among tables of this kind."""


class ParameterSection(NamedSection):
    """`[[parameter]]`: a calibrated parameter with its posterior as prior."""

    mean: Number
    """Mean of the posterior [unit of the parameter]."""
    deviation: NotNegative
    """Standard deviation of the posterior [unit of the parameter]."""
    low: Number
    """Least possible value [unit of the parameter]."""
    high: Number
    """Largest possible value [unit of the parameter]."""
    unit: str = "1"
    """Unit of the parameter."""

    def checks(self) -> Iterator[Check]:
        """Yield the fault of a mean that is not between its limits."""
        where = f"low {self.low:g} and high {self.high:g}"
        yield (
            not self.low <= self.mean <= self.high,
            f"the mean {self.mean:g} is not between {where}",
        )


class ModelDescription(Section):
    """The keys of every model file: version of the format, name, parameters and ports."""

    what: ClassVar[str]
    """The model with its article, for sentences."""
    format: Literal[1]
    """Version of the format."""
    name: Name
    """Name of the model."""
    parameter: tuple[ParameterSection, ...] = ()
    """Calibrated parameters."""
    port: tuple[NamedSection, ...] = ()
    """Where an internal force can act."""

    @classmethod
    def parse(cls, content: object, source: str = "the model") -> Self:
        """Check the content of a model file, and return its description.

        Raises
        ------
        ModelError
            One sentence that names `source`, the place, what was given and what was expected.
        """
        return validate(cls, content, source, ModelError, what=cls.what)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file; raises `ModelError` if it is missing, not TOML, or not such a model."""
        _, _, noun = cls.what.partition(" ")
        return cls.parse(read_toml(path, ModelError, what=noun), str(path))

    @staticmethod
    def repeated_name_checks(kind: str, names: list[str]) -> Iterator[Check]:
        """Yield a fault for each name that occurs twice."""
        for name in names:
            yield names.count(name) > 1, f"there is more than one {kind} named {name!r}"


class DescribedModel(Model):
    """A model that is described by a file: its name, outputs, parameters and ports.

    Parameters
    ----------
    description : ModelDescription
        The content of its TOML file.
    quantities : mapping of str to Quantity
        The physical quantity of each output, by its name.
    """

    def __init__(self, description: ModelDescription, quantities: Mapping[str, Quantity]) -> None:
        self.name = description.name
        self.quantities = quantities
        self.parameters = tuple(
            ParameterPrior(
                section.name,
                section.unit,
                section.mean,
                section.deviation,
                section.low,
                section.high,
            )
            for section in description.parameter
        )
        self.ports = tuple(port.name for port in description.port)
