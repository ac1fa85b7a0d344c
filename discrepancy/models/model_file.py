"""What the TOML files of models share: strict tables, kinds of numbers, one sentence for what is wrong."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from discrepancy.errors import ModelError

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, ge=0.0)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0.0)]


class Section(BaseModel):
    """A table of the file; unknown keys are refused, and its values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


_Description = TypeVar("_Description", bound=Section)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the content of a TOML file.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What it is to be, for the error: "lumped model".

    Raises
    ------
    ModelError
        If there is no such file, it cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(f"The {what} {path} cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"The {what} {path} is not valid TOML: {error}.") from None


def checked(description: type[_Description], content: dict[str, Any], source: str, what: str) -> _Description:
    """Return the content of a file as its description.

    Parameters
    ----------
    description : type of Section
        What the file may hold.
    content : dict
        What it holds.
    source : str
        Where it comes from, for the error.
    what : str
        What it is, with its article, for the error: "a lumped model".

    Raises
    ------
    ModelError
        One sentence that names `source`, the place, what came and what was expected.
    """
    try:
        return description.model_validate(content)
    except ValidationError as error:
        raise ModelError(f"{source}: {_sentence(error, what)}.") from None


def check_unique(kind: str, names: list[str]) -> None:
    """Refuse a name that is there twice; raises `ValueError`."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"there are two of {kind} {name!r}")


def _sentence(error: ValidationError, what: str) -> str:
    details = error.errors()
    # Of a matrix that may also be a diagonal both readings are reported; the other one says too little.
    first = next((detail for detail in details if detail["type"] != "tuple_type"), details[0])
    place = ".".join(str(part) for part in first["loc"] if "tuple[" not in str(part))
    if first["type"] == "extra_forbidden":
        return f"{place!r} is not a key of {what}; remove it or correct its spelling"
    if first["type"] == "missing":
        return f"{place!r} is missing"
    message = first["msg"].removeprefix("Value error, ")
    return f"{place + ': ' if place else ''}{message[0].lower() + message[1:]}"
