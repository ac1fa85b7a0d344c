"""The usage lines of every command, with all its arguments and options.

``python -m benchmarks.command_page`` writes them anew from the commands themselves.
"""

from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from textwrap import fill
from typing import Any, Literal, get_args, get_origin

from typer.main import get_command

from reporting.files import atomic_write_text
from uav_twin.cli import app

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "command_line.md"
BEGIN, END = "<!-- usage -->\n```\n", "```\n<!-- end of usage -->"
EVERYWHERE = {"help", "install_completion", "show_completion"}
WIDTH = 120
VALUES = {Path: "PATH", int: "N", float: "X"}


def usage(name: str, command: Any) -> Iterator[str]:
    """Yield the usage of a command, or of all commands of a group, one text each."""
    inner = getattr(command, "commands", {})
    if not inner or command.invoke_without_command:
        words = [
            f"uav-twin{name}",
            *(word for parameter in command.params if (word := _shown(parameter))),
        ]
        unbroken = " ".join(word.replace(" ", "\N{NO-BREAK SPACE}") for word in words[1:])
        text = f"{words[0]} {unbroken}".rstrip()
        yield fill(
            text, WIDTH, subsequent_indent=" " * 9, break_long_words=False, break_on_hyphens=False
        ).replace("\N{NO-BREAK SPACE}", " ")
    for own_name, subcommand in inner.items():
        yield from usage(f"{name} {own_name}", subcommand)


def _shown(item: Any) -> str:
    """Return an argument or option as it is written; an optional one stands in brackets."""
    if item.name in EVERYWHERE or getattr(item, "hidden", False):  # a former name of an option
        return ""
    if item.param_type_name == "argument":
        text = (item.metavar or item.name.upper()).strip("[]")
        text += "..." if item.nargs == -1 else ""
    else:
        text = "|".join((*item.opts[-1:], *item.secondary_opts))
        value = item.metavar or _value(item.type_descriptor.annotation) or item.name.upper()
        text += "" if item.is_flag else f" {value}"
        text += " ..." if item.multiple else ""
    return text if item.required else f"[{text}]"


def _value(annotation: Any) -> str:
    """Return what stands for the value of an option: its choices, or its kind."""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return "|".join(member.value for member in annotation)
    if get_origin(annotation) is Literal:
        return "|".join(map(str, get_args(annotation)))
    return VALUES.get(annotation, "")


def page(text: str) -> str:
    """Return the text of the page with the present usage of all commands."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    lines = "\n".join(usage("", get_command(app)))
    return f"{before}{BEGIN}{lines}\n{END}{after}"


if __name__ == "__main__":
    atomic_write_text(PAGE, page(PAGE.read_text(encoding="utf-8")))
