"""Options of commands that had other names in earlier versions, and warnings about former names.

An option is still accepted under the name that it had, but not listed: a hidden parameter of the
command takes it. `reporting.terminal.as_command` adds these parameters.
"""

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, TextIO

import typer

from reporting.former_names import FormerNameWarning, warn_of_former_names

_FORMER = "former_"
"""Begins the name of the hidden parameter that takes an option under its former name."""


def former_option(parameter: inspect.Parameter, settings: Mapping[str, Any]) -> inspect.Parameter:
    """Return the hidden parameter of a command that takes an option under its former name.

    Parameters
    ----------
    parameter : inspect.Parameter
        The parameter of the option.
    settings : dict of str to object
        Its entry in `commands.toml`; `former` is the former name, such as "--turns".
    """
    limits = {key: settings[key] for key in ("min", "max") if key in settings}
    option = typer.Option(settings["former"], hidden=True, **limits)
    return parameter.replace(
        name=_FORMER + parameter.name,
        annotation=Annotated[parameter.annotation, option],
        default=None,
    )


def move_former_options(options: dict[str, Any], former_flags: Mapping[str, str]) -> None:
    """Move the values of options that were given under their former names to the present names.

    Parameters
    ----------
    options : dict of str to object
        The values of all parameters of a command; changed in place.
    former_flags : dict of str to str
        The former name of an option, such as "--turns", by its parameter.

    Raises
    ------
    typer.BadParameter
        If an option is given under both names.
    """
    for name, former_flag in former_flags.items():
        value = options.pop(_FORMER + name, None)
        if value is None:
            continue
        flag = "--" + name.replace("_", "-")
        if options[name] is not None:
            raise typer.BadParameter(
                f"is now called {flag}, and both are given.", param_hint=former_flag
            )
        warn_of_former_names(f"The option {former_flag}", {former_flag: flag})
        options[name] = value


@contextmanager
def former_names_as_lines(is_quiet: Callable[[], bool]) -> Iterator[None]:
    """Return a context in which a warning about a former name is a line of the error stream.

    Parameters
    ----------
    is_quiet : callable
        Returns whether nothing is to be printed, as with `--quiet`.
    """
    with warnings.catch_warnings():
        show_other_warnings = warnings.showwarning

        def show_warning(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, FormerNameWarning):
                show_other_warnings(message, category, filename, lineno, file, line)
            elif not is_quiet():
                typer.secho(str(message), fg="yellow", err=True)

        warnings.filterwarnings("always", category=FormerNameWarning)
        warnings.showwarning = show_warning
        yield
