"""A structure from a mesh or matrices: its file, reduced and packed as the asset, or believed as a model."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from fe.reduction.settings import StructureSettings
from fe.structure.tables import StructureDesign
from fmu_asset.door.binding import Binding
from reporting.files import atomic_write_text
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    Asset,
    AssetBelief,
    AssetSource,
)
from twin_master.assets.fmu_source import FMU_COPY, FmuSection, FmuSource
from twin_master.assets.parameter import (
    SAME_NAMES,
    calibrated_means,
    check_calibration,
)
from twin_master.assets.reduced_model import (
    RecordedStructure,
    ReducedModelSource,
)
from twin_master.errors import MissionInputError, check_names
from twin_master.scenario.asset import BeliefSection, FileSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import ROLE
from twin_master.sentences import said

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel

FLOWN_COPY, MODEL_COPY = "asset/flown/structure.toml", "asset/model/structure.toml"
FIELD_NAME = "structure.vtu"


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

    kept: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "structure": FLOWN_COPY}

    def source(self, scenario: Scenario) -> "StructureFmuSource":
        """Return the FMU of the structure."""
        return StructureFmuSource(scenario, self)


class StructureBelief(StructureFiles, BeliefSection):
    """The reduced model of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str

    kept: ClassVar[Mapping[str, str]] = {"structure": MODEL_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "StructureSource":
        """Return the model of the structure."""
        return StructureSource(scenario, section=self)


class NamedStructure(AssetSource):
    """A structure that a scenario names, and whether the scenario speaks of what it has."""

    section: Any
    advice: ClassVar[Mapping[str, str]] = {
        "calibration": SAME_NAMES,
        "parameter": "give it in a table [[parameter]]",
        "state": "",
        "static_test": "the calibration source `static_test` is for wings: of a structure give `file`, or "
        "`normal` or `fixed` with `mean`.",
    }
    """What to do about names that it does not have, and about a source of calibrations that it cannot."""

    @property
    def file(self) -> Path:
        """Its file, where it is given, or its copy once kept."""
        return self.path(self.section.copies()["structure"])

    @cached_property
    def design(self) -> StructureDesign:
        """By name what can be chosen of it, commanded and read."""
        from fe.structure.design import load_structure

        return load_structure(self.file)

    @property
    def where(self) -> str:
        """What has these names, in words."""
        return f"the structure {self.design.name}"

    @property
    def words(self) -> str:
        """The FMU or model with its name."""
        return f"{self.label} of {self.where}"

    @property
    def hash(self) -> str:
        """SHA-256 of its design."""
        from fe.structure.design import structure_hash

        return structure_hash(self.design, self.file.parent)

    @property
    def parameter_names(self) -> list[str]:
        """What may be calibrated."""
        free = [part.name for part in self.design.mass if part.free]
        return [part.name for part in self.design.parameter] + free

    def reduced(self, progress: Progress) -> "ReducedModel":
        """Return the reduced model, from the cache if it is there."""
        from fe.reduction.model_cache import reduced_structure

        return reduced_structure(self.file, progress=progress)

    def check_model(self) -> None:
        """Look at what the reduced model is made of, as far as that takes no time."""
        from fe.reduction.model_cache import check_structure

        check_structure(self.file)

    def parameters(self) -> dict[str, float]:
        """Return what it is drawn with, by name; what is not among them is nominal."""
        return calibrated_means(self._scenario.calibration) | self._means

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Solve the full structure and write displacement and strain as VTU, if it has a mesh.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written.
        """
        from fe.structure.design import MatrixDesign
        from fe.structure.operators import load_and_assemble, write_structure_vtu

        if isinstance(self.design, MatrixDesign):
            return False
        values = {**self.parameters(), **state, **control}
        write_structure_vtu(path.with_name(FIELD_NAME), load_and_assemble(self.file), values)
        return True

    def _frequencies(self) -> int:
        """Return how many natural frequencies are observed; raises `MissionInputError` for too many."""
        if self._scenario.observation.role != "frequency":
            return 0
        count, most = self._scenario.observation.count, StructureSettings.mode_count
        if count > most:
            raise MissionInputError(said("assets.frequencies", most=most, count=count))
        return count

    def _check_observed(self) -> None:
        """Refuse observations that the structure does not have; raises `MissionInputError`.

        Titles that are its sensors in another order raise `MissionInputError`: they would name the wrong
        ones.
        """
        design, observation = self.design, self._scenario.observation
        where, role, modes = self.where, observation.role, observation.modes
        names = {
            "strain": [part.name for part in design.gauge],
            "displacement": [part.name for part in design.displacement],
        }
        known = {name: len(sensors) for name, sensors in names.items()}
        known |= {"frequency": self._frequencies() or 1}
        row, table = ("observation", [role], [name for name, count in known.items() if count]), role
        if modes is not None:
            known[ROLE] = observation.count
            there = [part.name for part in design.acceleration]
            row, table = ("accelerometer", [*modes.accelerometers], there), "acceleration"
            most = StructureSettings.mode_count
            if max(modes.places) >= most:
                number = max(modes.places) + 1
                raise MissionInputError(said("assets.modes", most=most, number=number))
        advice = self.advice["state"] or f"give it in a table [[{table}]]"
        check_names("the scenario has the", where, [row], advice=advice)
        if observation.count != known[role]:
            both = {"has": known[role], "count": observation.count}
            raise MissionInputError(said("assets.sensors", where=where, role=role, **both))
        titles, own = [*observation.titles], names.get(role, [])
        if titles != own and sorted(titles) == sorted(own):
            raise MissionInputError(said("assets.titles", titles=titles, where=where, own=own))

    def _check_parameter(self, *, believed: bool) -> None:
        """Refuse a calibration that the structure cannot have; raises `MissionInputError`."""
        calibration, known = self._scenario.calibration, self.parameter_names
        if refusal := self.advice.get(calibration.source):
            raise MissionInputError(refusal)
        check_calibration(
            calibration, known, self.where, ranges=self.design.ranges, advice=self.advice["calibration"],
            design_hash=self.hash if believed else "",
        )  # fmt: skip
        rows = [("parameter", [calibration.parameter], known)]
        check_names("the scenario calibrates the", self.where, rows, advice=self.advice["parameter"])

    def _check_ranges(self, parameters: Mapping[str, float]) -> None:
        """Refuse levels, controls, loads and `parameters` outside the ranges; raises `MissionInputError`.

        A name that the structure does not have is passed over.
        """
        scenario, ranges = self._scenario, self.design.ranges
        given = [(f"parameter {name}", name, value) for name, value in parameters.items()]
        given += [(f"load {name}", name, value) for name, value in scenario.asset.constant_load.items()]
        if (mean := scenario.calibration.mean) is not None:
            given.append(("mean of the calibration", scenario.calibration.parameter, mean))
        given += [(f"level of {f.name}", f.name, level) for f in scenario.state for level in f.levels]
        given += [
            (f"{name} of the control {control.name}", name, value)
            for control in scenario.control
            for name, value in control.values.items()
        ]
        if scenario.truth.kind == "scripted":
            given += [
                (f"{name} that `truth.gains` give in {scenario.mission.step_name} {step}", name, value)
                for step, state in enumerate(scenario.scripted_history().tolist())
                for name, value in zip(scenario.state_names, state, strict=True)
            ]
        for what, name, value in given:
            low, high = ranges.get(name, (value, value))
            if not low <= value <= high:
                what, ends = f"{what} is {value:.6g}, but {self.where}", (low, high)
                raise MissionInputError(said("assets.outside", what=what, name=name, ends=ends))


class StructureFmuSource(NamedStructure, FmuSource):
    """The FMU that is packed of a structure."""

    parameters = FmuSource.parameters

    def binding(self) -> Binding:
        """Return the binding: one of its own, or that which follows from the structure."""
        from fmu_asset.structures.binding import structure_binding

        if self._folder is not None or self.section.binding:
            return super().binding()
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
        if "binding" not in self.section.own_files():  # whose names may be others
            self._check_ranges(self.section.parameters)
        self.check_model()
        return binding

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU."""
        from fmu_asset.structures.binding import structure_binding_text

        self.model = self.reduced(progress)
        if not self.path(BINDING_COPY).exists():
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


class StructureSource(NamedStructure, ReducedModelSource):
    """The reduced model of a structure as what is believed."""

    label = "reduced model"

    def check(self) -> None:
        """Read the file without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError
            A file cannot be read or is wrong, or the mesh does not hold what the structure names; or the
            scenario's states, controls, sensors or calibrated parameter are not those of the structure.
        """
        self.files()
        design, scenario = self.design, self._scenario
        self._check_parameter(believed=True)
        rows = (
            ("state", scenario.state_names, [part.name for part in design.damage]),
            ("control input", scenario.control[0].values, [part.name for part in design.control]),
        )
        check_names("the scenario has the", self.where, rows, advice=self.advice["state"])
        self._check_observed()
        self._check_ranges({})
        self.check_model()

    def _make(self, progress: Progress) -> dict[str, str]:
        self.model = self.reduced(progress)
        return super()._make(progress)
