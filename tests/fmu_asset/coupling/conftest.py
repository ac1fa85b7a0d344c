"""A linear system as an FMU, with and without direct feedthrough."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.companions.build import companion_bytes
from fmu_asset.coupling.structure import (
    Component,
    Connection,
    Connector,
    Setting,
    SystemStructure,
    expand_connection,
)
from fmu_asset.door.binding import Binding, parse_binding
from reporting.files import atomic_write_bytes


@pytest.fixture(scope="session")
def linear_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The linear system as pythonfmu exports it: it declares no dependencies, so all outputs have all."""
    folder = tmp_path_factory.mktemp("linear")
    shutil.copy(Path(__file__).with_name("linear_system.py"), folder / "LinearSystem.py")
    words = ["pythonfmu", "build", "-f", "LinearSystem.py", "--handle-state", "--serialize-state"]
    subprocess.run([sys.executable, "-m", *words], cwd=folder, check=True, capture_output=True)
    return folder / "LinearSystem.fmu"


def with_dependencies(fmu: Path, target: Path, dependencies: Mapping[str, Sequence[str]]) -> Path:
    """Copy an FMU and write which inputs each of its outputs depends on."""
    with zipfile.ZipFile(fmu) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = members["modelDescription.xml"].decode()
    names = re.findall(r'<ScalarVariable[^>]*?\bname="([^"]+)"', text)
    for output, inputs in dependencies.items():
        index = names.index(output) + 1
        value = " ".join(str(names.index(name) + 1) for name in inputs)
        begin, end = text.index("<Outputs>"), text.index("</Outputs>")
        part, count = re.subn(
            rf'<Unknown index="{index}"', f'<Unknown index="{index}" dependencies="{value}"', text[begin:end]
        )
        assert count == 1
        text = text[:begin] + part + text[end:]
    members["modelDescription.xml"] = text.encode()
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return target


@pytest.fixture(scope="session")
def state_fmu(linear_fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, declaring that no output depends on an input directly."""
    target = tmp_path_factory.mktemp("state") / "State.fmu"
    return with_dependencies(linear_fmu, target, {"y1": [], "y2": []})


@pytest.fixture(scope="session")
def crossed_fmu(linear_fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, declaring that y1 depends on u1 and y2 on u2."""
    target = tmp_path_factory.mktemp("crossed") / "Crossed.fmu"
    return with_dependencies(linear_fmu, target, {"y1": ["u1"], "y2": ["u2"]})


def linear(name: str, fmu: Path, substeps: int = 1, **values: object) -> Component:
    """Return a linear component; matrices as nested lists, `initial` as a pair."""
    settings = {}
    for key, value in values.items():
        if key == "initial":
            settings |= {f"initial{i + 1}": Setting(float(x)) for i, x in enumerate(value)}  # type: ignore[arg-type]
        else:
            for (i, j), x in np.ndenumerate(np.array(value, dtype=float)):
                settings[f"{key}{i + 1}{j + 1}"] = Setting(float(x))
    return Component(name, fmu, settings, substeps)


def system(
    components: Sequence[Component], connections: Sequence[tuple[str, str]], **options: object
) -> SystemStructure:
    """Return a system; ends without a dot become connectors."""
    names = [component.name for component in components]
    joined: list[Connection] = []
    for source, target in connections:
        joined += expand_connection(source, target, names, **options)  # type: ignore[arg-type]
    connectors = dict.fromkeys(
        [Connector(c.target.variable, "output") for c in joined if not c.target.component]
        + [Connector(c.source.variable, "input") for c in joined if not c.source.component]
    )
    return SystemStructure("test", tuple(components), tuple(connectors), tuple(joined))


def watch(*names: str, step_size: float = 1.0, inputs: Sequence[str] = ()) -> Binding:
    """Return a binding that observes ends of a system, all without unit."""
    return parse_binding(
        {
            "binding": {"name": "watch", "step_size": step_size},
            "control": {name: {"variable": name, "unit": "1"} for name in inputs},
            "observation": {"all": {"variables": list(names), "unit": "1"}},
        }
    )


@pytest.fixture(scope="session")
def companions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The companion FMUs."""
    folder = tmp_path_factory.mktemp("companions")
    names = ("damage_growth", "strain_gauges")
    return {name: atomic_write_bytes(folder / f"{name}.fmu", companion_bytes(name)) for name in names}
