"""A structure from a mesh or matrices: its file, reduced and packed as the asset, or believed as a model."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from fmu_asset.client.binding import Binding
from reporting.files import atomic_write_text, hash_file
from reporting.progress import Progress
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    Asset,
    AssetBelief,
    AssetSource,
)
from twin_master.assets.fmu_source import FMU_COPY, FmuSection, FmuSource
from twin_master.assets.reduced_model import NamedStructure, RecordedStructure, ReducedModelSource
from twin_master.errors import MissionInputError, said
from twin_master.scenario.kinds import BeliefSection, FileSection
from twin_master.scenario.schema import Scenario

FLOWN_COPY, MODEL_COPY = "asset/flown/structure.toml", "asset/model/structure.toml"


class StructureFiles(FileSection):
    """A table that names a structure file, and with it the mesh or the matrices beside that."""

    def all_files(self) -> dict[str, Path]:
        """Return all files by the places of their copies, those that the structure names among them.

        Raises
        ------
        InvalidDesignError
            The structure file cannot be read or is wrong.
        MissionInputError
            One of its files does not lie beside it.
        """
        from fe.structure.design import load_structure

        found = super().all_files()
        copy = self.copies()["structure"]
        file = found[copy]
        design = load_structure(file)
        for inner in map(PurePosixPath, design.files):
            if inner.is_absolute() or ".." in inner.parts:
                raise MissionInputError(said("assets.beside", what=design.what, inner=inner, file=file))
            found[f"{PurePosixPath(copy).parent}/{inner}"] = file.parent / inner
        return found


class StructureSection(StructureFiles, FmuSection):
    """The FMU that is packed of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str
    binding: str = ""
    """A binding of one's own; without one it follows from the structure file."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C compiled here."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "structure": FLOWN_COPY}

    def source(self, scenario: Scenario) -> "StructureFmuSource":
        """Return the FMU of the structure."""
        return StructureFmuSource(scenario, self)


class StructureBelief(StructureFiles, BeliefSection):
    """The reduced model of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str

    copy_paths: ClassVar[Mapping[str, str]] = {"structure": MODEL_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "ReducedModelSource":
        """Return the model of the structure."""
        return ReducedModelSource(scenario, section=self)


class StructureFmuSource(NamedStructure, FmuSource):
    """The FMU that is packed of a structure."""

    parameters = FmuSource.parameters

    def binding(self) -> Binding:
        """Return the binding: one of its own, or that which follows from the structure."""
        if self._folder is not None or self.section.binding:
            return super().binding()
        from fmu_asset.structures import structure_binding

        return structure_binding(self.design, self._frequencies())

    def _check_calibration(self, binding: Binding) -> tuple[str, ...]:
        from fmu_asset.packing.structure_fmu import check_form

        check_form(self.section.packed)
        self._check_parameter(believed=isinstance(self._scenario.belief, AssetBelief))
        return ()

    def _observed(self, binding: Binding, role: str = "") -> slice:
        if self._scenario.observation.modes is None:
            return super()._observed(binding, role)
        self._check_observed()
        return slice(0)

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        if "binding" not in self.section.user_files():  # whose names may be others
            self._check_ranges(self.section.parameters)
        self.check_model()
        return binding

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU."""
        self.model = self.reduced(progress)
        if not self.path(BINDING_COPY).exists():
            from fmu_asset.structures import structure_binding_text

            text = structure_binding_text(self.design, self._frequencies())
            atomic_write_text(self.path(BINDING_COPY), text)
        with progress.stage("Packing the FMU"):
            self._pack(progress)
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": hash_file(self.path(FMU_COPY))}

    def _pack(self, progress: Progress) -> None:
        from fmu_asset.packing.structure_fmu import build_fmu

        assert self.model is not None
        build_fmu(self.model, self.path(FMU_COPY), kind=self.section.packed, replace=True)

    def open(self) -> Asset:
        """Return the FMU at its start; where modes are observed, in motion with an identification behind."""
        if self._scenario.observation.modes is None:
            return super().open()
        assert self.model is not None
        return RecordedStructure(self._scenario, self.model, self._session, self.binding(), self.parameters())
