"""A wing in air whose temperature swings: two FMUs that are flown as one asset."""

from collections.abc import Sequence
from pathlib import Path

from fe.reduction.model_cache import reduced_model
from fe.runtime.patch import Primitive
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.script import script_fmu
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.files import atomic_write_bytes, atomic_write_text

AIR = Path(__file__).with_name("swinging_air.py")

_BINDING = """[binding]
name = "wing_in_air"
step_size = 1.0 # s, one step
description = "A wing in air of changing temperature: load factor as control, 24 strain gauges."

[control.load_factor]
variable = "load_factor"
unit = "1"

[health.z1]
variable = "z1"
unit = "1"

[health.z2]
variable = "z2"
unit = "1"

[observation.strain]
variables = "strain[{1..24}]"
unit = "1"

[parameter.young_modulus_factor]
variable = "wing.young_modulus_factor"
unit = "1"

[monitor.temperature_difference]
variable = "temperature_difference"
unit = "K"
"""
_CONNECTIONS = (
    ("air.temperature_difference", "wing.temperature_difference"),
    ("air.temperature_difference", "temperature_difference"),
    ("load_factor", "wing.load_factor"),
    ("z1", "wing.health.z1"),
    ("z2", "wing.health.z2"),
    ("wing.strain[{1..24}]", "strain[{1..24}]"),
)


def scenario_in_air(text: str, folder: Path, name: str, patch: str) -> str:
    """Return a scenario of the wing, flown in air of changing temperature.

    Parameters
    ----------
    text : str
        The scenario; its table `[asset]` is replaced.
    folder : Path
        Where the FMUs and the binding are written.
    name : str
        Of the FMU of the wing.
    patch : str
        Content of the patch file that the wing carries; its effects must depend on the temperature.
    """
    atomic_write_bytes(folder / "air.fmu", script_fmu(AIR)[0])
    atomic_write_text(folder / "wing_in_air.toml", _BINDING)
    build_fmu(
        reduced_model(),
        folder / f"{name}.fmu",
        patch=parse_patch(patch.encode()),
        activate=True,
        replace=True,
    )
    asset = [
        "[asset]",
        'kind = "coupled"',
        'binding = "wing_in_air.toml"',
        "parameters = { young_modulus_factor = 1.0073 }",
        "[[asset.component]]",
        'name = "air"',
        'fmu = "air.fmu"',
        "[[asset.component]]",
        'name = "wing"',
        f'fmu = "{name}.fmu"',
    ]
    for source, target in _CONNECTIONS:
        asset += ["[[asset.connection]]", f'source = "{source}"', f'target = "{target}"']
    begin, end = text.index("[asset]"), text.index("[belief]")
    return text[:begin] + "\n".join(asset) + "\n\n" + text[end:]


def depends_on_temperature(primitives: Sequence[Primitive]) -> bool:
    """Return whether one of the primitives depends on the temperature."""
    return any(primitive.kind == "thermal_strain" for primitive in primitives)
