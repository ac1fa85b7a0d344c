"""Several FMUs as the asset of a mission: joined in the scenario, or read from an SSP file."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from fe.cache import reduced_model
from fe.design import SHIPPED_DESIGN, load_design
from fmu_asset.archive import plain_folder
from fmu_asset.binding import Binding, expand, load_binding
from fmu_asset.build import build_fmu
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.companions.build import companion_bytes
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    Connector,
    Setting,
    SettingValue,
    SystemStructure,
    expand_connection,
)
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.ssp.check import join_ssp
from fmu_asset.ssp.reader import read_ssp
from reporting.files import atomic_write_bytes
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.asset_source import (
    BINDING_COPY,
    CALIBRATED_DESIGN_NAME,
    CALIBRATION_COPY,
    COMPONENT_FOLDER,
    DESIGN_COPY,
    SHIPPED_DESIGN_NAME,
    SSP_COPY,
    Origin,
    check_wing_scenario,
    component_copies,
)
from twin_master.design_source import read_calibration, read_content, read_design
from twin_master.errors import MissionInputError
from twin_master.fmu_source import FmuSource, Session
from twin_master.scenario import Scenario
from twin_master.scenario_asset import ComponentSection


class CoupledSource(FmuSource):
    """Several FMUs, joined as the scenario or an SSP file says.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    binding : Path
        Binding file; its variables are connectors of the system, or `component.variable`.
    design : Path or None
        Wing design: the twin's model.
    ssp : Path or None
        SSP file; without it, the components and connections of the scenario are joined.
    calibration : Path or None
        Calibration file of the wing.
    tailored : bool
        Whether the design is that of the calibration file; components may be packed of it as well.
    """

    def __init__(
        self,
        scenario: Scenario,
        binding: Path,
        design: Path | None,
        ssp: Path | None,
        *,
        calibration: Path | None = None,
        tailored: bool = False,
    ) -> None:
        super().__init__(scenario, binding, design, None, calibration=calibration, tailored=tailored)
        self._ssp = ssp

    @property
    def origin(self) -> Origin:
        """The FMUs together, and the model of the design or the FMUs themselves."""
        count = len(self._scenario.asset.component)
        asset = f"{count} coupled FMUs" if count else "system of an SSP file"
        model = super().origin.model
        return Origin(asset, asset if model == "FMU" else model)

    def check(self) -> None:
        """Read what is given where it is; join what needs no packing first.

        Raises
        ------
        MissionInputError, SspError, CouplingError, FmuError, InvalidDesignError
            Something cannot be read or does not fit.
        """
        self.files()
        binding, asset = load_binding(self._binding), self._scenario.asset
        self._observed(binding)
        self._inner_roles(binding)
        self._check_names(binding)
        calibration = read_calibration(self._given[CALIBRATION_COPY], self._scenario)
        design = read_design(self._given[DESIGN_COPY], calibration, tailored=self._tailored)
        if design is not None and asset.observation_model != "asset":
            check_wing_scenario(self._scenario, len(design.gauges.positions))
        for component in asset.component:
            if component.design not in (None, CALIBRATED_DESIGN_NAME):
                load_design(_design(component))
        folder = plain_folder()
        try:
            if self._ssp is not None:
                self._join(join_ssp(read_ssp(self._ssp, folder)), binding)
            elif all(component.design is None for component in asset.component):
                files = {c.name: self._fmu_of(c, folder) for c in asset.component}
                self._join(Wiring(self._structure(files)), binding)
            else:
                self._structure({component.name: folder for component in asset.component})
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def files(self) -> dict[str, bytes]:
        """Return binding, design, and the SSP file or the files of the components, as they are given."""
        files = super().files()
        if self._ssp is not None:
            files[SSP_COPY] = read_content(self._ssp)
        for component in self._scenario.asset.component:
            for key, copy in component_copies(component).items():
                files[copy] = read_content(Path(getattr(component, key)))
        return files

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder, pack what is not an FMU yet; return the hashes.

        Raises
        ------
        MissionInputError, SspError, CouplingError, FmuError, InvalidDesignError
            Something cannot be read or does not fit.
        """
        for name, content in self.files().items():
            if not (folder / name).exists():
                atomic_write_bytes(folder / name, content)
        self._folder = folder
        hashes = {"binding": hash_file(self._path(BINDING_COPY))}
        hashes |= self._prepare_model(progress)
        if self._ssp is not None:
            hashes["ssp"] = hash_file(self._path(SSP_COPY))
        else:
            with progress.stage("Packing the FMUs"):
                for component in self._scenario.asset.component:
                    hashes[f"fmu_{component.name}"] = hash_file(self._packed(component, progress))
        self._session().close()  # what does not fit is said before anything is flown
        return hashes

    def _packed(self, component: ComponentSection, progress: Progress) -> Path:
        """Return the FMU of a component in the run folder; packed if it is not there."""
        target = self._path(f"{COMPONENT_FOLDER}/{component.name}.fmu")
        if target.exists():
            return target
        if component.design == CALIBRATED_DESIGN_NAME and self._tailored and self._wing is not None:
            self._pack(self._wing, target, tailored=True)
            return target
        if component.design is not None:
            copy = component_copies(component).get("design")
            design = load_design(self._path(copy) if copy else _design(component))
            build_fmu(reduced_model(design, progress=progress), target, replace=True)
            return target
        return self._fmu_of(component, target.parent)

    def _fmu_of(self, component: ComponentSection, folder: Path) -> Path:
        """Return the FMU of a component that is a file or a companion, packed in the folder."""
        assert component.fmu is not None
        if component.fmu not in COMPANION_NAMES:
            return Path(component.fmu)
        content, _ = companion_bytes(component.fmu)
        return atomic_write_bytes(folder / f"{component.name}.fmu", content)

    def wiring(self) -> Wiring:
        """Return the system as it is flown, once prepared."""
        if self._ssp is not None:
            return join_ssp(read_ssp(self._path(SSP_COPY), self._path(COMPONENT_FOLDER)))
        names = [component.name for component in self._scenario.asset.component]
        return Wiring(self._structure({name: self._path(f"{COMPONENT_FOLDER}/{name}.fmu") for name in names}))

    def _structure(self, fmus: Mapping[str, Path]) -> SystemStructure:
        """Return the system of the scenario's components and connections."""
        asset = self._scenario.asset
        names = [component.name for component in asset.component]
        connections = tuple(
            connection
            for entry in asset.connection
            for connection in expand_connection(
                entry.source,
                entry.target,
                names,
                factor=entry.factor,
                offset=entry.offset,
                delayed=entry.delayed,
            )
        )
        # A connector of the system is an output where something comes to it, and an input where it gives.
        connectors = dict.fromkeys(
            [Connector(c.target.variable, "output") for c in connections if not c.target.component]
            + [Connector(c.source.variable, "input") for c in connections if not c.source.component]
        )
        components = tuple(Component(c.name, fmus[c.name], _settings(c), c.substeps) for c in asset.component)
        return SystemStructure(self._scenario.mission.name, components, tuple(connectors), connections)

    def _join(self, wiring: Wiring, binding: Binding) -> CoupledAsset:
        asset = self._scenario.asset
        return CoupledAsset(
            wiring,
            binding,
            algorithm=asset.algorithm,
            iterations=asset.iterations,
            tolerance=asset.tolerance,
            isolated=asset.isolated,
            step_timeout=asset.step_timeout,
            parameters=self.parameters(),
        )

    def _session(self) -> Session:
        return self._join(self.wiring(), self.binding())


def _design(component: ComponentSection) -> Path:
    return SHIPPED_DESIGN if component.design == SHIPPED_DESIGN_NAME else Path(component.design or "")


def _settings(component: ComponentSection) -> dict[str, Setting]:
    settings: dict[str, Setting] = {}
    values: Mapping[str, SettingValue] = component.parameters
    for pattern, value in values.items():
        try:
            names = expand(pattern)
        except ValueError as error:
            raise MissionInputError(
                f"the parameters of the component `{component.name}` cannot be read: {error}."
            ) from error
        for name in names:
            if name in settings:
                raise MissionInputError(
                    f"the component `{component.name}` is given `{name}` twice: keep one of the two."
                )
            settings[name] = Setting(value)
    return settings
