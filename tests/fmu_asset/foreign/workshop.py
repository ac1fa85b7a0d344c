"""Builds small FMUs of FMI 1, 2 and 3 from C sources, as other people's tools export them."""

import re
import shutil
import subprocess
from pathlib import Path

import fmpy
import pytest

from tests.fmu_asset.making import DESCRIPTION, archive_of, edited
from tests.kept import packed

HERE = Path(__file__).parent
MODELS = ["lag1", "room2", "fixed2", "array3", "ball2", "decay1", "swing3", "hostile2"]
"""One of each version and interface."""
HEADERS = Path(fmpy.__file__).parent / "c-code"


class Workshop:
    """Compiles each model once.

    Parameters
    ----------
    folder : Path
        Where the FMUs are put.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._built: dict[tuple[str, tuple[str, ...]], Path] = {}

    def __call__(self, model: str, *defines: str) -> Path:
        """Return the FMU of a model, such as `ball2`, compiled with preprocessor definitions."""
        key = (model, defines)
        if key not in self._built:
            path = self._folder / f"{'_'.join([model, *defines]).lower()}.fmu"
            self._built[key] = packed(path, lambda: self._build(path, model, defines), (HERE,), defines)
        return self._built[key]

    def _build(self, path: Path, model: str, defines: tuple[str, ...]) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            pytest.skip("there is no C compiler (gcc or cc), which the foreign FMUs are built with")
        version = re.fullmatch(r"[a-z]+(\d)", model)
        assert version is not None
        description = (HERE / f"{model}.xml").read_text(encoding="utf-8")
        exchange = ["-DMODEL_EXCHANGE"] if "<Implementation>" not in description else []
        library = path.with_suffix(".so")
        subprocess.run(
            [
                compiler, "-shared", "-fPIC", "-O1", "-w", f"-I{HEADERS}", f"-I{HERE}", *exchange,
                f"-DIDENTIFIER={model}", *(f"-D{define}" for define in defines),
                str(HERE / f"{model}.c"), str(HERE / f"frame{version[1]}.c"), "-o", str(library), "-lm",
            ],
            check=True,
        )  # fmt: skip
        platform = fmpy.platform_tuple if version[1] == "3" else fmpy.platform
        binary = f"binaries/{platform}/{model}.so"
        archive_of(path, {DESCRIPTION: description, binary: library.read_bytes()})

    def changed(self, model: str, name: str, *changes: tuple[str, str]) -> Path:
        """Return a copy of a model's FMU with texts of its model description replaced."""
        return edited(self(model), self._folder / f"{name}.fmu", *changes)
