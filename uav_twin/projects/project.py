"""A new project: its files, written from templates, and its README."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from reporting.files import refuse_filled, write_members
from reporting.folders import whole_folder
from uav_twin.formats import schema_line

CHECK_MISSION = (
    "uav-twin scenario check mission.toml",
    "Check the mission: what flies, and what the twin knows.",
)
FLY_MISSION = (
    "uav-twin run mission.toml --out runs/first",
    "Fly the mission; the report is runs/first/report.html.",
)
VIEW_FLIGHT = (
    "uav-twin view runs/first",
    "Look at the flight step by step in the browser; Ctrl-C ends it.",
)
"""Commands of every project with a mission, each with what it does."""


@dataclass(frozen=True)
class Project:
    """The content of a new folder.

    Attributes
    ----------
    title : str
        What the project is, for the heading of its README.
    texts : dict of str to str
        The content of each file that is written, by its name.
    contents : dict of str to bytes
        The content of each file that is not a text, and of the user's file, by its name.
    files : dict of str to str
        What each file of the folder is for, by its name, for the README.
    commands : tuple of (str, str)
        Five commands to run in the folder, each with what it does.
    """

    title: str
    texts: dict[str, str] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    commands: tuple[tuple[str, str], ...] = ()

    def write(self, folder: Path) -> None:
        """Write the folder, which appears complete or not at all.

        Raises
        ------
        FileNotWrittenError
            If the folder exists and is not empty, or cannot be written.
        """
        refuse_filled(folder)
        readme = filled_in("README.md", project=self, name=folder.resolve().name)
        with whole_folder(folder) as fresh:
            contents = dict(self.contents)
            for name, text in {**self.texts, "README.md": readme}.items():
                contents[name] = text.encode("utf-8")
            write_members(fresh, contents)


@cache
def _templates() -> Environment:
    """Return the templates of this package."""
    return Environment(
        loader=PackageLoader("uav_twin.projects"),
        autoescape=False,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def filled_in(template: str, /, *, schema: str | None = None, **values: object) -> str:
    """Return the text of a template with values filled in.

    Parameters
    ----------
    template : str
        The name of a file in `templates`, without `.jinja`.
    schema : str, optional
        The file format whose JSON Schema the first line names for editors.
    """
    text = _templates().get_template(f"{template}.jinja").render(**values)
    return text if schema is None else schema_line(schema) + text


def rounded_to(value: float, digits: int = 2) -> float:
    """Return a number with a few significant digits, for a file that is read by people."""
    return float(f"{value:.{digits}g}")
