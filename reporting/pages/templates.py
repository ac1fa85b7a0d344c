"""Jinja2 templates, for plain text and for pages in HTML."""

import re
from collections.abc import Callable
from functools import cache

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup, escape

from reporting import words

_UNIT_SPACE = re.compile(r"(?<=\d) (?=(%|µε|s|ms|µs|Hz|mm|m|kg|N)(?!\w))")
"""The blank between a number and its unit, where no line may break."""


def fill_template(template: str, /, **values: object) -> str:
    """Return a Jinja2 template filled with values, as one line."""
    return words.in_one_line(_text_template(template).render(**values))


@cache
def _text_template(template: str) -> Template:
    return _text_environment().from_string(template)


@cache
def _text_environment() -> Environment:
    """Return the environment of templates for plain text, which is not escaped."""
    environment = Environment(undefined=StrictUndefined)
    _add_filters(environment)
    return environment


@cache
def html_environment() -> Environment:
    """Return the environment of templates for HTML, where text is escaped."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    _add_filters(environment)
    return environment


def _add_filters(environment: Environment) -> None:
    text_filters: tuple[Callable[..., str], ...] = (
        words.listing,
        words.counted,
        words.number,
        words.capital,
    )
    for function in text_filters:
        environment.filters[function.__name__] = function
    environment.filters["spaced"] = _with_fixed_unit_spaces
    environment.globals["plus_minus"] = words.plus_minus
    environment.globals["between"] = words.between


def _with_fixed_unit_spaces(text: object) -> Markup:
    """Return escaped text whose lines do not break between a number and its unit."""
    return Markup(_UNIT_SPACE.sub("\u00a0", str(escape(text))))
