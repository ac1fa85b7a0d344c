"""The one reader of TOML: whatever is wrong with a file becomes one sentence of the caller's exception."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from reporting.text_file import check_nesting, decoded, read_text, too_deep

_LONGEST_KEY = re.compile(r"""(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){1000}""", re.ASCII)
"""A dotted key of so many parts; `tomllib` takes a time that grows with their square."""


def read_toml(
    path: Path | str,
    error: type[Exception],
    *,
    what: str = "file",
    parse_float: Callable[[str], Any] = float,
) -> dict[str, Any]:
    """Return the content of a TOML file.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    error : type of Exception
        What is raised, with one sentence.
    what : str
        What the file is to be, for the sentence: "wing design".
    parse_float : callable
        What becomes of decimal numbers, as in `tomllib`; `str` keeps them as printed.

    Raises
    ------
    error
        The file is not there, cannot be read, is not UTF-8 or not TOML, is nested too deeply, or holds an
        integer that 64 bits cannot.
    """
    text = read_text(path, error, what=what)
    return _parsed(text, f"The {what} {path}", error, parse_float)


def parse_toml(
    content: bytes | str,
    source: str,
    error: type[Exception],
    *,
    parse_float: Callable[[str], Any] = float,
) -> dict[str, Any]:
    """Return the content of TOML that was read elsewhere; `source` names it in the sentence of `error`."""
    text = decoded(content, source, error) if isinstance(content, bytes) else content
    return _parsed(text, source, error, parse_float)


def _parsed(
    text: str, subject: str, error: type[Exception], parse_float: Callable[[str], Any]
) -> dict[str, Any]:
    if _LONGEST_KEY.search(text):
        raise error(too_deep(subject))
    try:
        content = tomllib.loads(text, parse_float=parse_float)
    except tomllib.TOMLDecodeError as cause:
        raise error(f"{subject} is not valid TOML: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(subject)) from None
    except ValueError:  # Python turns no text of more than 4,300 digits into an integer
        raise error(
            f"{subject} holds an integer of thousands of digits; 64 bits are what TOML allows."
        ) from None
    check_nesting(content, subject, error)
    _check_integers(content, (), subject, error)
    return content


def _check_integers(node: object, place: tuple[str, ...], subject: str, error: type[Exception]) -> None:
    """Refuse what TOML refuses (its specification, "Integer") and `tomllib` lets through."""
    if isinstance(node, dict):
        for key, item in node.items():
            _check_integers(item, (*place, key), subject, error)
    elif isinstance(node, list):
        for number, item in enumerate(node, start=1):
            _check_integers(item, (*place[:-1], f"{place[-1]}[{number}]"), subject, error)
    elif isinstance(node, int) and not -(2**63) <= node < 2**63:
        raise error(
            f"{subject}: `{'.'.join(place)}` is an integer of {node.bit_length()} bits, and 63 beside the "
            "sign are what TOML allows."
        )
