"""What the TOML files of models share: strict tables, kinds of numbers, one sentence for what is wrong."""

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from discrepancy.errors import ModelError

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, ge=0.0)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0.0)]

_SHOWN_LENGTH = 60
_EXPECTED = {
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "string_type": "a text in quotes",
    "string_too_short": "a text that is not empty",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
}
"""What is expected, by pydantic's type of error, where its own words are those of Python."""


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


def shown(value: object) -> str:
    """Return a value as it can stand in a sentence, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= _SHOWN_LENGTH else f"{text[: _SHOWN_LENGTH - 3]}..."


def check_unique(kind: str, names: list[str]) -> None:
    """Refuse a name that is there twice; raises `ValueError`."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"there are two of {kind} {name!r}")


def _sentence(error: ValidationError, what: str) -> str:
    first = error.errors()[0]
    place = _written(first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{place!r} is not a key of {what}; remove it or correct its spelling"
    if first["type"] == "missing":
        return f"{place!r} is missing"
    if first["type"] == "value_error":
        return f"{place + ': ' if place else ''}{first['ctx']['error']}"
    if first["type"] == "tuple_type" and isinstance(first["input"], dict):
        return f"there can be several of {place!r}, so write [[{place}]] for each, not [{place}]"
    if first["type"] in _EXPECTED:
        message = f"{_EXPECTED[first['type']]} is expected"
    else:
        message = first["msg"][0].lower() + first["msg"][1:]
    return f"{place + ': ' if place else ''}{message}, but {shown(first['input'])} came"


def _written(location: tuple[int | str, ...]) -> str:
    """Return a place as people count, from one, without pydantic's names of types."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part + 1}]"
        elif not re.search(r"[^\w]|^constrained", part):
            text += f".{part}" if text else part
    return text
