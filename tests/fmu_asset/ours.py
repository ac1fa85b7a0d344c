"""Our own FMUs by name, each packed once, and the small wing of springs and masses in most of them."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.patch_arrays import PatchArrays
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
from tests.kept import compiled_wing, packed

NODES = 16
GAUGES = 24
PLACES = (slice(3, 6), slice(9, 12), slice(6, 8), slice(13, 15))
"""Springs of the chain that may lose stiffness."""


def chain_model(stiffness: float = 9.0e4, regions: tuple[str, ...] = ("z1", "z2")) -> ReducedModel:
    """Return a chain of 16 springs and masses as a reduced model: exact, so its error bound is zero."""
    difference = np.eye(NODES) - np.eye(NODES, k=-1)
    count = len(regions)
    region = np.zeros((count + 2, NODES))
    for number, place in enumerate(PLACES[:count], start=1):
        region[number, place] = 1.0
    region[0] = 1.0 - region[1:-1].sum(axis=0)
    region[-1] = 0.05
    terms = np.stack([difference.T @ np.diag(stiffness * row) @ difference for row in region])
    mass = np.stack([0.06 * np.eye(NODES), np.zeros((NODES, NODES)), np.zeros((NODES, NODES))])
    mass[1, 10, 10] = mass[1, 14, 14] = mass[2, 15, 15] = 1.0
    load = np.stack([np.linspace(12.0, 2.0, NODES), np.eye(NODES)[-2]])
    gauge = difference[np.arange(GAUGES) % NODES] * np.linspace(0.3, 0.6, GAUGES)[:, np.newaxis]
    output = np.vstack((gauge, np.eye(NODES)[-1]))
    outputs = GAUGES + 1
    _, shapes = np.linalg.eigh(terms.sum(axis=0))
    # The chain is exact: whatever the model allows for rounding and truncation is zero.
    allowances = {item.name: 0.0 for item in fields(ReducedModel) if item.name.endswith("_allowance")}
    return ReducedModel(
        design_hash="chain",
        name="uav_wing",
        regions=tuple(regions),
        parameters=("young_modulus_factor",),
        masses=("servo_mass", "pitot_mass"),
        controls=("load_factor", "tip_force"),
        control_units=("1", "N"),
        gauges=tuple(f"gauge_{number}" for number in range(1, GAUGES + 1)),
        displacements=("tip",),
        accelerations=(),
        nominal=np.array((1.0, *(0.0,) * count, 0.169, 0.134, 1.0, 0.0)),
        damping=np.array((1.0735, 7.3124e-4)),
        stiffness_factors=np.array([(1, 0), *((0, number + 1) for number in range(count)), (0, 0)]),
        load_factors=np.array([(1, 0), (2, 0)]),
        validity_box=np.array(
            [[0.85, 1.15], *[[0.0, 0.85]] * count, [0.1, 0.25], [0.1, 0.2], [-1.0, 4.0], [-20.0, 20.0]]
        ),
        static_stiffness=terms,
        static_load=load,
        static_output=output,
        bound_reference=np.ones(count + 1),
        residual_load=np.zeros((16, 2)),
        residual_stiffness=np.zeros((16, count + 1, NODES)),
        dual_counts=np.full(count, 2),
        dual_split=np.full(count, 0.4),
        dual_correction=np.zeros((2**count, 1, outputs, 16)),
        dual_residual=np.zeros((2**count, outputs, count + 3, count + 3)),
        dual_stiffness=np.ones((2**count, outputs, count + 2, 1, 1)),
        dual_output=np.ones((2**count, outputs, 1)),
        modal_stiffness=terms,
        modal_mass=mass,
        modal_load=load,
        modal_output=output,
        cross_mass=mass,
        followed_shapes=shapes[:, :2].T.copy(),
        mode_count=8,
        **allowances,
    )


def chain_arrays(model: ReducedModel, span: float = 1.6) -> PatchArrays:
    """Return the same chain in the form that carries patches, exact: its basis is the chain itself."""
    stations = span * np.arange(NODES + 1) / NODES
    place = np.vstack((np.zeros(NODES), np.eye(NODES)))
    difference = np.eye(NODES) - np.eye(NODES, k=-1)
    spring = float(model.static_stiffness[-1, -1, -1]) / 0.05
    region = np.zeros(NODES, dtype=int)
    for number, place_of in enumerate(PLACES[: len(model.regions)], start=1):
        region[place_of] = number
    parts, strip_of, term_of = [], [], []
    for strip in range(4):
        for term in range(len(model.regions) + 1):
            inside = (np.arange(NODES) // 4 == strip) & (region == term)
            if inside.any():
                matrix = difference.T @ np.diag(spring * inside) @ difference
                parts.append(matrix[np.tril_indices(NODES)])
                strip_of.append(strip)
                term_of.append(term)
    gauges = model.static_output[:-1]
    bending = np.diff(gauges, axis=1, append=0.0)
    zero = np.zeros_like(place)
    weight = -9.81 * model.modal_mass[0].diagonal()
    shares = np.arange(NODES + 1, 0.0, -1.0)
    return PatchArrays(
        design_hash=model.design_hash,
        regions=model.regions,
        validity_box=model.validity_box,
        largest_loss=0.7,
        largest_compliance=1e-3,
        largest_mass=0.5,
        stiffness=model.static_stiffness,
        mass=model.modal_mass,
        strip_lines=np.linspace(0.0, span, 5),
        strip_stiffness=np.array(parts, dtype=np.float32),
        strip_of=np.array(strip_of),
        term_of=np.array(term_of),
        flap_row=np.eye(NODES)[0],
        flap_spring=0.05 * spring,
        semi_span=span,
        root_chord=0.4,
        tip_chord=0.3,
        straight_chord_line=0.25,
        load_place=float(stations[-2]),
        stations=stations,
        line_chord=np.array([0.25, 0.6]),
        line_rows=np.stack((zero, zero, place, 0.9 * place)),
        station_weights=shares / shares.sum(),
        load_tip=model.static_load[1],
        load_lift=model.static_load[0],
        lift_rows=place * (model.static_load[0] - weight),
        weight=weight,
        strain_rows=np.stack((gauges, -0.3 * gauges, bending)),
        gauge_stations=span * np.abs(gauges).argmax(axis=1) / NODES,
        gauge_length=0.0,
        tip_row=model.static_output[-1],
        start_shapes=np.linalg.eigh(model.static_stiffness.sum(axis=0))[1][:, :8].copy(),
    )


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
