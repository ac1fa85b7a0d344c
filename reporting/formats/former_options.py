"""Options of commands that had other names in earlier versions, and warnings about former names.

An option is still accepted under the name that it had, but not listed: a hidden parameter of the
command takes it, which `accepts_former_options` adds.
"""

import functools
import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, ParamSpec, TextIO, TypeVar, get_args

import typer
from typer.models import OptionInfo

from reporting.formats.former_names import FormerNameWarning, warn_of_former_names

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_FORMER = "former_"
"""Begins the name of the hidden parameter that takes an option under its former name."""


def accepts_former_options(
    **former_flags: str,
) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """Return a decorator for a command whose options had other names in earlier versions.

    The default of such an option must be None, since None means that it was not given. A value
    under the former name is passed on with a warning; both names together are refused.

    Parameters
    ----------
    **former_flags : str
        The former name of an option, such as "--turns", by the name of its parameter.
    """

    def decorate(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        @functools.wraps(function)
        def command(*arguments: _Parameters.args, **options: _Parameters.kwargs) -> _Result:
            move_former_options(options, former_flags)
            return function(*arguments, **options)

        # Typer reads the options of a command from its signature
        signature = inspect.signature(function)
        hidden_parameters = [
            _hidden_parameter(signature.parameters[name], former_flag)
            for name, former_flag in former_flags.items()
        ]
        parameters = [*signature.parameters.values(), *hidden_parameters]
        vars(command)["__signature__"] = signature.replace(parameters=parameters)
        return command

    return decorate


def _hidden_parameter(parameter: inspect.Parameter, former_flag: str) -> inspect.Parameter:
    """Return a parameter that takes an option under its former flag, such as "--turns".

    It has the type and the limits of the option, and does not appear in the help.
    """
    value_type, *metadata = get_args(parameter.annotation)
    (present_option,) = [entry for entry in metadata if isinstance(entry, OptionInfo)]
    option = typer.Option(former_flag, hidden=True, min=present_option.min, max=present_option.max)
    return parameter.replace(
        name=_FORMER + parameter.name, annotation=Annotated[value_type, option], default=None
    )


def move_former_options(options: dict[str, object], former_flags: Mapping[str, str]) -> None:
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
        if options.get(name) is not None:
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
