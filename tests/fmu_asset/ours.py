"""Our own FMUs by name, each packed once and kept between runs where that takes a compiler."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.companions.build import companion_bytes
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.patch_file import PatchFile, parse_patch
from fmu_asset.packing.script import build_script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.files import atomic_write_bytes
from scenarios import asset_scripts
from tests.fmu_asset.chain import chain_arrays, chain_model
from tests.kept import compiled_wing, packed

HERE = Path(__file__).parent
REGIONS = ("z1", "z2", "tip_panel")
LOST = DigitalState(stiffness_loss=(0.0, 0.0, 0.3))


def patch_of(name: str) -> PatchFile:
    """Return a patch file of the tests: missing effects of sensors, or of the wing."""
    return parse_patch((HERE / "packing" / name).read_bytes())


EXCHANGE = {"interface": "model-exchange"}
STRUCTURES: dict[str, tuple[str, dict[str, Any]]] = {
    "python": ("chain", {}),
    "compiled": ("chain", {"kind": "compiled"}),
    "source": ("chain", {"kind": "source"}),
    "fmi3": ("chain", {"kind": "compiled", "fmi": 3}),
    "exchange": ("chain", {"kind": "compiled", **EXCHANGE}),
    "exchange3": ("chain", {"kind": "compiled", "fmi": 3, **EXCHANGE}),
    "sensing": ("chain", {"patch": patch_of("sensors.json")}),
    "patched": ("chain", {"patch": patch_of("wing.json"), "arrays": chain_arrays(chain_model())}),
    "regions": ("regions", {"state": LOST}),
    "compiled_regions": ("regions", {"kind": "compiled", "state": LOST}),
    "beam": ("beam", {}),
    "compiled_beam": ("beam", {"kind": "compiled"}),
    "source3_beam": ("beam", {"kind": "source", "fmi": 3}),
}
"""Of each FMU of a structure its model and the options of `build_fmu`."""
EXPORTED = {
    "spring_mass": (HERE / "spring_mass.py", "SpringMass", ()),
    "linear": (
        HERE / "coupling" / "linear_system.py",
        "LinearSystem",
        ("--handle-state", "--serialize-state"),
    ),
}
"""FMUs of other makers in Python, as pythonfmu's own builder exports them."""
NAMES = (*STRUCTURES, *EXPORTED, *COMPANION_NAMES, *asset_scripts())


class OurFmus:
    """Packs each FMU once; what took a compiler or another program is kept between runs.

    Parameters
    ----------
    folder : Path
        Where the FMUs are put.
    beam : callable
        Returns the reduced beam.
    """

    def __init__(self, folder: Path, beam: Callable[[], ReducedModel]) -> None:
        self._folder = folder
        self._models = {"chain": chain_model, "regions": partial(chain_model, regions=REGIONS), "beam": beam}

    def __call__(self, name: str) -> Path:
        """Return the FMU of a name."""
        path = self._folder / f"{name}.fmu"
        return path if path.exists() else self.write(name, path)

    def write(self, name: str, path: Path) -> Path:
        """Pack it anew."""
        if name in STRUCTURES:
            options = STRUCTURES[name][1]
            if options.get("kind") != "compiled":
                return build_fmu(self.model(name), path, **options).path
            try:
                find_compiler()
            except FmuBuildError as error:
                pytest.skip(f"no C compiler: {error}")
            return compiled_wing(self.model(name), path, **options)
        if name in EXPORTED:
            return packed(path, lambda: exported(path, *EXPORTED[name]), EXPORTED[name][:1], name)
        if name in COMPANION_NAMES:
            return atomic_write_bytes(path, companion_bytes(name))
        return build_script_fmu(asset_scripts()[name], path).path

    def model(self, name: str) -> ReducedModel:
        """Return the reduced model of a structure's FMU."""
        return self._models[STRUCTURES[name][0]]()


def exported(path: Path, script: Path, class_name: str, options: tuple[str, ...]) -> None:
    """Let pythonfmu pack a script."""
    folder = path.with_suffix("")
    folder.mkdir()
    shutil.copy(script, folder / f"{class_name}.py")
    words = [sys.executable, "-m", "pythonfmu", "build", "-f", f"{class_name}.py", *options]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    (folder / f"{class_name}.fmu").rename(path)
