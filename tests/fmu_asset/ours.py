"""Our own FMUs by name, each packed once; most are of the shipped wing on a coarse mesh."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from fe.reduction.model_cache import build_patch_arrays
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fe.wing.design import load_design
from fe.wing.operators import assemble
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.companions.build import companion_bytes
from fmu_asset.packing.patch_file import load_patch
from fmu_asset.packing.script import build_script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.files import atomic_write_bytes
from scenarios import asset_scripts
from tests.costs import once
from tests.fmu_asset.making import tables
from tests.kept import FE, ROOT, compiled_wing, exported, kept

HERE = Path(__file__).parent
SPRING_MASS = HERE / "spring_mass.py"
COARSE, NAMED = {"refinement": 0.25}, {"name": "tip_panel"}
FEW_CELLS = {**COARSE, "edge_size": None, "span_size": 0.2, "chord_size": 0.2}
THREE = load_design(ROOT / "fe" / "designs" / "uav_wing_three_regions.toml")
LAST = THREE.defects[2].model_copy(update=NAMED)
DESIGNS = {
    "wing": load_design().changed(mesh=COARSE),
    "regions": THREE.changed(mesh=FEW_CELLS, defects=[*THREE.defects[:2], LAST]),
}
STRUCTURES = tables(__file__, "ours")
NAMES = (*STRUCTURES, "spring_mass", *COMPANION_NAMES, *asset_scripts())


@once
def wing_model(name: str = "wing") -> ReducedModel:
    """Return the reduced model of a design."""
    design = DESIGNS[name]
    with threadpool_limits(1):
        return kept(
            "coarse-reduction", lambda: reduce_structure(assemble(design)), FE, design.hash
        ).model


@once
def wing_arrays() -> PatchArrays:
    """Return that wing for patches."""
    return kept(
        "coarse-patches", lambda: build_patch_arrays(DESIGNS["wing"]), FE, DESIGNS["wing"].hash
    )


class OurFmus:
    """Packs each FMU once into a folder; compiled and exported ones are kept between runs."""

    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self._folder = folder
        self._fixture = fixture

    def __call__(self, name: str) -> Path:
        """Return the FMU of a name."""
        path = self._folder / f"{name}.fmu"
        return path if path.exists() else self.write(name, path)

    def write(self, name: str, path: Path) -> Path:
        """Pack it anew."""
        if name in COMPANION_NAMES:
            return atomic_write_bytes(path, companion_bytes(name))
        if name in asset_scripts():
            return build_script_fmu(asset_scripts()[name], path).path
        if name == "spring_mass":
            return exported(shutil.copy(SPRING_MASS, self._folder / "SpringMass.py")).rename(path)
        options = self.options(name)
        if options.get("kind") != "compiled":
            return build_fmu(self.model(name), path, **options).path
        self._fixture("compiler")  # skips where there is none
        return compiled_wing(self.model(name), path, **options)

    def model(self, name: str) -> ReducedModel:
        """Return the reduced model of a structure's FMU."""
        which = STRUCTURES[name]["model"]
        if which in DESIGNS:
            return wing_model(which)
        return self._fixture("beam_reduction").model

    def options(self, name: str) -> dict[str, Any]:
        """Return the options of `build_fmu` for a structure's FMU."""
        options = {key: value for key, value in STRUCTURES[name].items() if key != "model"}
        if name == "patched":
            options["arrays"] = wing_arrays()
        if "patch" in options:
            options["patch"] = load_patch(HERE / "packing" / options["patch"])
        if "state" in options:
            options["state"] = DigitalState(**options["state"])
        return options
