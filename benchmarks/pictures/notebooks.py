"""The cells of a notebook of docs/tutorials, run so that picture and notebook show the same."""

import atexit
import contextlib
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib as mpl

from benchmarks.pictures.picture import ROOT

CELL = re.compile(r"^```{code-cell} python\n(.*?)^```", re.MULTILINE | re.DOTALL)

_FOLDERS = contextlib.ExitStack()
atexit.register(_FOLDERS.close)


@dataclass(frozen=True)
class Notebook:
    """What a notebook leaves: its folder, and the names of its cells."""

    folder: Path
    names: dict[str, Any]


def folder_until_exit() -> Path:
    """Return an empty folder that is removed when the process ends."""
    return Path(_FOLDERS.enter_context(TemporaryDirectory(prefix="uav_twin_pictures_")))


@cache
def notebook(name: str, until: str) -> Notebook:
    """Run the cells of a notebook in a folder of its own, up to the first that contains `until`."""
    mpl.use("agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {"__name__": "__main__"}
    folder = folder_until_exit()
    text = (ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    with contextlib.chdir(folder):
        for cell in CELL.findall(text):
            first_line, _, content = cell.partition("\n")
            if first_line.startswith("%%writefile "):
                Path(first_line.split()[1]).write_text(content, encoding="utf-8")
                continue
            exec(compile(cell, name, "exec"), names)
            plt.close("all")
            if until in cell:
                return Notebook(folder, names)
    raise ValueError(f"No cell of docs/tutorials/{name}.md contains {until!r}.")
