"""A structure from a mesh: its file, reduced and packed as the asset, or believed as a model."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from fe.reduction.settings import StructureSettings
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
from twin_master.assets.fmu_source import FmuSection, FmuSource
from twin_master.assets.parameter import calibrated_means, check_calibration
from twin_master.assets.reduced_model import RecordedStructure, ReducedModelSource
from twin_master.errors import MissingObservationModelError, MissionInputError, check_names
from twin_master.scenario.asset import BeliefSection, FileSection
from twin_master.scenario.observation import ROLE
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.structure.tables import StructureDesign

FLOWN_COPY = "asset/flown/structure.toml"
MODEL_COPY = "asset/model/structure.toml"
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
                raise MissionInputError(
                    f"the {design.what} {inner} of {file} does not lie beside it, and a run keeps copies of "
                    f"both: move the {design.what} into the folder of the structure file, and name it without"
                    " its folder."
                )
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

    @property
    def binding_path(self) -> Path:
        """The binding, where there is one.

        Raises
        ------
        MissionInputError
            There is none.
        """
        if not self.binding:
            raise MissionInputError(
                "the binding of the structure is needed as a file here: write it by `uav-twin structure fmu "
                "FILE --binding NAME`, and name it as `asset.binding`."
            )
        return super().binding_path

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


class _Structure(AssetSource):
    """A structure that a scenario names, and whether the scenario speaks of what it has."""

    copy: ClassVar[str]
    """Where the copy of its file stands in a run folder."""

    @property
    def file(self) -> Path:
        """Its file, where it is given, or its copy once kept."""
        return self.path(self.copy)

    @cached_property
    def design(self) -> "StructureDesign":
        """Its description."""
        from fe.structure.design import load_structure

        return load_structure(self.file)

    @property
    def words(self) -> str:
        """The FMU or model with its name."""
        return f"{self.label} of the structure {self.design.name}"

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
            raise MissionInputError(
                f"a structure tells its first {most} frequencies, and {count} are observed."
            )
        return count

    def _check_observed(self) -> None:
        """Refuse observations that the structure does not have; raises `MissingObservationModelError`.

        Titles that are its sensors in another order raise `MissionInputError`: they would name the wrong
        ones.
        """
        design, observation = self.design, self._scenario.observation
        where, role, modes = f"the structure {design.name}", observation.role, observation.modes
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
                raise MissingObservationModelError(
                    f"a structure tells its first {most} modes, and mode {max(modes.places) + 1} is observed."
                )
        advice = f"give it in a table [[{table}]]"
        check_names("the scenario has the", where, [row], MissingObservationModelError, advice)
        if observation.count != known[role]:
            raise MissingObservationModelError(
                f"{where} has {known[role]} sensors of `{role}`, and the scenario expects "
                f"{observation.count}."
            )
        titles, own = [*observation.titles], names.get(role, [])
        if titles != own and sorted(titles) == sorted(own):
            raise MissionInputError(
                f"`observation.titles` are {', '.join(titles)}, and {where} has these sensors in the order "
                f"{', '.join(own)}: give the titles in that order."
            )

    def _check_parameter(self, *, believed: bool) -> None:
        """Refuse a calibration that the structure cannot have; raises `MissionInputError`."""
        from fe.structure.design import structure_hash

        calibration, design = self._scenario.calibration, self.design
        if calibration.source == "static_test":
            raise MissionInputError(
                "the calibration source `static_test` is for wings: of a structure give `file`, or `normal` "
                "or `fixed` with `mean`."
            )
        known = [part.name for part in design.parameter]
        known += [part.name for part in design.mass if part.free]
        ranges = {part.name: part.range for part in (*design.parameter, *design.mass)}
        found = structure_hash(design, self.file.parent) if believed else ""
        where = f"the structure {design.name}"
        check_calibration(calibration, known, where, ranges=ranges, design_hash=found)
        rows = [("parameter", [calibration.parameter], known)]
        check_names("the scenario calibrates the", where, rows, advice="give it in a table [[parameter]]")

    def _check_ranges(self, parameters: Mapping[str, float]) -> None:
        """Refuse levels, controls and `parameters` outside the ranges; raises `MissionInputError`.

        A name that the structure does not have is passed over.
        """
        scenario, design = self._scenario, self.design
        ranges = {part.name: part.range for part in (*design.parameter, *design.mass, *design.control)}
        ranges |= {part.name: (0.0, part.largest_loss) for part in design.damage}
        given = [(f"parameter {name}", name, value) for name, value in parameters.items()]
        given += [(f"level of {f.name}", f.name, level) for f in scenario.state for level in f.levels]
        given += [
            (f"{name} of the control {control.name}", name, value)
            for control in scenario.control
            for name, value in control.values.items()
        ]
        for what, name, value in given:
            low, high = ranges.get(name, (value, value))
            if not low <= value <= high:
                raise MissionInputError(
                    f"the {what} is {value:g}, but the structure {design.name} gives {name} the range "
                    f"{low:g} to {high:g}; give a value inside, or widen the range in the structure file."
                )


class StructureFmuSource(_Structure, FmuSource):
    """The FMU that is packed of a structure."""

    section: StructureSection
    copy = FLOWN_COPY
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
        from fe.reduction.model_cache import check_structure

        if not self.section.binding:  # under a binding of one's own the names may be others
            self._check_ranges(self.section.parameters)
            self._check_history()
        check_structure(self.file)
        return binding

    def _check_history(self) -> None:
        """Refuse a scripted truth beyond the ranges of the damage regions; raises `MissionInputError`."""
        scenario, history = self._scenario, self._scenario.scripted_history()
        largest = {part.name: part.largest_loss for part in self.design.damage}
        for name, loss in zip(scenario.state_names, history.T, strict=True):  # each is a region
            outside = np.flatnonzero((loss < -1e-9) | (loss > largest[name] + 1e-9))
            if outside.size:
                raise MissionInputError(
                    f"`truth.gains` bring {name} to {loss[outside[0]]:.6g} in {scenario.mission.step_name} "
                    f"{outside[0]}, but the structure {self.design.name} gives it the range 0 to "
                    f"{largest[name]:g}; give smaller gains, or another `largest_loss` in its file."
                )

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU."""
        from fe.reduction.model_cache import reduced_structure
        from fmu_asset.packing.structure_fmu import build_fmu
        from fmu_asset.structures.binding import structure_binding_text

        self.model = reduced_structure(self.file, progress=progress)
        if not self.path(BINDING_COPY).exists():
            text = structure_binding_text(self.design, self._frequencies())
            atomic_write_text(self.path(BINDING_COPY), text)
        with progress.stage("Packing the FMU"):
            build_fmu(self.model, self.fmu_path(), kind=self.section.packed, replace=True)
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": hash_file(self.fmu_path())}

    def open(self) -> Asset:
        """Return the FMU at its start; where modes are observed, in motion with an identification behind."""
        if self._scenario.observation.modes is None:
            return super().open()
        assert self.model is not None
        return RecordedStructure(self._scenario, self.model, self._session, self.binding(), self.parameters())


class StructureSource(_Structure, ReducedModelSource):
    """The reduced model of a structure as what is believed."""

    label = "reduced model"
    copy = MODEL_COPY

    def check(self) -> None:
        """Read the structure file without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError
            A file cannot be read or is wrong, or the mesh does not hold what the structure names.
        MissingObservationModelError
            The scenario's states, controls or sensors are not those of the structure.
        """
        from fe.reduction.model_cache import check_structure

        self.files()
        design, scenario = self.design, self._scenario
        self._check_parameter(believed=True)
        rows = (
            ("state", scenario.state_names, [part.name for part in design.damage]),
            ("control input", scenario.control[0].values, [part.name for part in design.control]),
        )
        where = f"the model of the structure {design.name}"
        check_names("the scenario has the", where, rows, MissingObservationModelError)
        self._check_observed()
        self._check_ranges({})
        check_structure(self.file)

    def _make(self, progress: Progress) -> dict[str, str]:
        from fe.reduction.model_cache import reduced_structure

        self.model = reduced_structure(self.file, progress=progress)
        return super()._make(progress)

    @property
    def _true_values(self) -> dict[str, float]:
        means = calibrated_means(self._scenario.calibration)
        known = {name: value for name, value in means.items() if name in self.wing.chosen}
        return known | super()._true_values

    @property
    def _outputs(self) -> slice:
        gauges = self.wing.gauge_count
        return slice(0, gauges) if self._scenario.observation.role == "strain" else slice(gauges, None)
