"""What the TOML files of models share: how they are read, their tables and kinds of numbers."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, model_validator

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Quantity
from discrepancy.errors import ModelError
from discrepancy.models.interface import Model
from reporting.toml_file import Name, NotNegative, Number, checked, read_toml


class Section(BaseModel):
    """A table of the file; unknown keys are refused, and its values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        if not self.low <= self.mean <= self.high:
            raise ValueError(f"the mean {self.mean:g} is not between low {self.low:g} and high {self.high:g}")
        return self


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
        return checked(cls, content, source, ModelError, what=cls.what)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file; raises `ModelError` if it is not there, not TOML, or its content is no such model."""
        return cls.parse(read_toml(path, ModelError, what=cls.what.partition(" ")[2]), str(path))

    @staticmethod
    def check_unique(kind: str, names: list[str]) -> None:
        """Refuse a name that is there twice; raises `ValueError`."""
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"there are two of {kind} {name!r}")


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
