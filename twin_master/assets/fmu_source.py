"""An FMU as the asset of a mission: any FMU with a binding, given or packed of a model script."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from fmu_asset.archive.fmu_file import packed_design_hash
from fmu_asset.errors import FmuInputError
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import BINDING_COPY, FLOWN_DESIGN_HASH, AssetBelief, Source, read_files
from twin_master.assets.flown_fmu import FmuAsset, InnerRoles
from twin_master.assets.interface import Asset, asked_table
from twin_master.assets.parameter import (
    ParameterDraws,
    calibrated_means,
    check_calibration,
    read_calibration,
)
from twin_master.errors import MissionInputError, check_names
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import AssetSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Flag, Name, Number, Positive
from twin_master.seeds import generator

if TYPE_CHECKING:
    from fmu_asset.door.binding import Binding
    from fmu_asset.door.session import FmiAsset
    from twin_master.assets.flown_fmu import Session

Float = NDArray[np.float64]

FMU_COPY = "asset/asset.fmu"
LARGEST_SEED = 2**31 - 1
"""Of an FMU's integer parameter."""


class FmuSection(AssetSection):
    """What is said of any asset that is an FMU, or several."""

    is_fmu: ClassVar[bool] = True
    binding: str
    isolated: Flag = True
    step_timeout: Positive | None = None
    """Wall-clock limit of a step [s]; otherwise that of the binding."""
    parameters: dict[str, Number] = Field(default_factory=dict)
    load: dict[str, Number] = Field(default_factory=dict)
    seeds: tuple[Name, ...] = ()
    """Parameters of the binding that are given a number drawn from the seed of the run."""

    kept: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY}

    @property
    def true_parameters(self) -> Mapping[str, float]:
        """Parameters of the true asset by the binding's names, SI."""
        return self.parameters

    @property
    def constant_load(self) -> Mapping[str, float]:
        """Load inputs, the same in every step, SI."""
        return self.load

    @property
    def binding_path(self) -> Path:
        """The binding, shipped or not."""
        return self.all_files()[BINDING_COPY]

    @model_validator(mode="after")
    def _check_seeds(self) -> Self:
        for name in self.seeds:
            if name in self.parameters:
                raise ValueError(f"`{name}` is both in `parameters` and in `seeds`: keep one of them")
        return self


class FmuFileSection(FmuSection):
    """An FMU, made by whatever tool."""

    kind: Literal["fmu"] = "fmu"
    file: str

    kept: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "file": FMU_COPY}

    def source(self, scenario: Scenario) -> "FmuSource":
        """Return the FMU."""
        return FmuSource(scenario, self)


class ScriptSection(FmuSection):
    """A pythonfmu script that is packed as the FMU: a shipped one, or a file."""

    kind: Literal["script"] = "script"
    script: str

    kept: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "script": FMU_COPY}

    def portable(self) -> FmuFileSection:
        """Return the FMU that was packed: from then on it is what is flown."""
        common = {name: getattr(self, name) for name in FmuSection.model_fields if name != "kind"}
        binding = super().portable().model_dump()["binding"]
        return FmuFileSection.model_validate(common | {"binding": binding, "file": FMU_COPY})

    def source(self, scenario: Scenario) -> "ScriptSource":
        """Return the FMU of the script."""
        return ScriptSource(scenario, self)


class FmuSource(Source):
    """An FMU from a file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : FmuSection
        Its table `asset`.
    """

    label = "FMU"  # it may hold any model, also that of a design: whether they differ is not known

    def __init__(self, scenario: Scenario, section: FmuSection) -> None:
        super().__init__(scenario, section)
        self._section = section

    @property
    def step_timeout(self) -> float | None:
        """Wall-clock limit of a step [s], where the scenario sets one."""
        return self._section.step_timeout

    def binding(self) -> "Binding":
        """Return the binding: where it is given, or its copy once prepared."""
        from fmu_asset.door.binding import load_binding

        return load_binding(self._section.binding_path if self._folder is None else self.path(BINDING_COPY))

    def fmu_path(self) -> Path:
        """Return the FMU, once prepared."""
        return self.path(FMU_COPY)

    def check(self) -> None:
        """Read what is given where it is, without copying or starting anything.

        Raises
        ------
        MissionInputError
            A file cannot be read, or the binding observes another number of values than the scenario.
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        FmuError, FiniteElementError
            Binding, FMU, script, design or structure is wrong, or the binding does not fit the FMU.
        """
        read_calibration(self._scenario.calibration)
        self.files()
        binding, effects = self.binding(), self._effects()
        self._check_calibration(binding, effects)
        self._check_names(binding, effects)
        with TemporaryDirectory(prefix="uav_twin_") as folder, self._told_of_means():
            binding = self._fitted(binding, Path(folder))
        self._check_sensors(binding)
        self._inner_roles(binding)

    def _effects(self) -> tuple[str, ...]:
        """Return what parameters by the FMU's own names there are beside those of the binding."""
        return ()

    def _check_calibration(self, binding: "Binding", effects: tuple[str, ...]) -> None:
        believed = isinstance(self._scenario.belief, AssetBelief)
        design_hash = packed_design_hash(self.path(FMU_COPY)) if believed and FMU_COPY in self.places else ""
        known = (*binding.parameter, *effects)
        where = f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, known, where, design_hash=design_hash)

    def _check_sensors(self, binding: "Binding") -> None:
        self._observed(binding)

    @contextmanager
    def _told_of_means(self) -> Iterator[None]:
        """Tell of a parameter that the FMU refuses that it may be one of the calibration."""
        try:
            yield
        except FmuInputError as error:
            means = calibrated_means(self._scenario.calibration)
            given = self._section.parameters
            own = [f"{name} = {value:.6g}" for name, value in means.items() if name not in given]
            if not own:
                raise
            raise MissionInputError(
                f"{error} The calibration has {', '.join(own)}: give one of what is flown, or name the "
                "parameter in `asset.parameters`."
            ) from error

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        """Return the binding as the FMU fits it: only with that it is known how many values an array has."""
        from fmu_asset.door.session import FmiAsset

        return FmiAsset(self.path(FMU_COPY), binding, parameters=self.parameters()).binding

    def _check_names(self, binding: "Binding", effects: tuple[str, ...]) -> None:
        scenario, section = self._scenario, self._section
        check_names(
            "the scenario has the",
            f"the binding {binding.name}",
            (
                ("control input", scenario.control[0].values, binding.control),
                ("state", () if scenario.truth.kind == "asset" else scenario.state_names, binding.health),
                ("load", section.load, binding.load),
                ("parameter", (*section.parameters, *section.seeds), [*binding.parameter, *effects]),
            ),
        )

    def _make(self, progress: Progress) -> dict[str, str]:
        packed = packed_design_hash(self.fmu_path())
        return ({FLOWN_DESIGN_HASH: packed} if packed else {}) | {"fmu": hash_file(self.fmu_path())}

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Ask the FMU for its observation (E, S, U, G) at every draw, state and control.

        That holds for assets without memory.
        """
        scenario, load, rows = self._scenario, self._section.load, []
        controls = [control.values for control in scenario.control]
        with self._session() as session:
            chosen = self._observed(session.binding)
            for row, value in enumerate(draws.values):
                others = {name: float(values[row]) for name, values in draws.others.items()}
                session.reset({**self.parameters(), **others, draws.name: float(value)})
                rows.append(
                    asked_table(
                        scenario.state_names,
                        model.states.coordinates,
                        controls,
                        lambda control, health: session.step(control, health, load).values[chosen],
                    )
                )
        return np.array(rows)

    def _observed(self, binding: "Binding", role: str = "") -> slice:
        """Return where a role stands among the observations of the binding, in the units of the scenario."""
        role = role or self._scenario.observation.role
        chosen = self._slice(binding, role)
        bound, said = binding.observation[role].units, self._scenario.observation.sensor_units
        for number, (there, here) in enumerate(zip(bound, said, strict=True), 1):
            if there != here != "1":
                raise MissionInputError(
                    f"the binding {binding.name} gives value {number} of `{role}` in {there}, and "
                    f"`observation.unit` of the scenario says {here}: write the same unit in both."
                )
        return chosen

    def _slice(self, binding: "Binding", role: str) -> slice:
        expected = self._scenario.observation.count
        chosen = binding.observation_slice(role)
        if chosen.stop - chosen.start != expected:
            raise MissionInputError(
                f"the binding {binding.name} observes {chosen.stop - chosen.start} values of `{role}`, and "
                f"the scenario expects {expected}."
            )
        return chosen

    def _inner_roles(self, binding: "Binding") -> InnerRoles | None:
        """Return where the asset tells of its own damage and sensors; None where the truth is the scenario's.

        Raises
        ------
        MissionInputError
            The binding has no such monitor or observation.
        """
        truth = self._scenario.truth
        if truth.kind != "asset":
            return None
        if isinstance(self._scenario.belief, AssetBelief):
            raise MissionInputError(
                "an asset that carries its own damage cannot be asked what the twin should expect of each "
                "state: name a model for the twin in the table `belief`."
            )
        rows = [("monitor", truth.state.values(), binding.monitor)]
        check_names("`truth.state` names the", f"the binding {binding.name}", rows)
        return InnerRoles(
            state=truth.state,
            observation=self._observed(binding, truth.observation or ""),
            received=None if truth.received is None else self._slice(binding, truth.received),
        )

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the scenario, and the numbers drawn for its seeds.

        What was calibrated from a campaign and the scenario does not name is at its posterior mean.
        """
        section, seed = self._section, self._scenario.mission.seed
        drawn = generator(seed, "asset").integers(LARGEST_SEED, size=len(section.seeds))
        seeds = {name: float(value) for name, value in zip(section.seeds, drawn, strict=True)}
        return calibrated_means(self._scenario.calibration) | section.parameters | seeds

    def _session(self) -> "Session":
        return self._opened(self.binding(), self.parameters())

    def _opened(self, binding: "Binding", parameters: Mapping[str, float]) -> "FmiAsset":
        from fmu_asset.door.session import FmiAsset

        section = self._section
        return FmiAsset(
            self.fmu_path(), binding, isolated=section.isolated, step_timeout=section.step_timeout,
            parameters=parameters,
        )  # fmt: skip

    def open(self) -> Asset:
        """Return the FMU at its start, with the parameters of the scenario.

        Raises
        ------
        FmuError
            The FMU cannot be flown, or the binding does not fit it.
        MissionInputError
            The FMU observes another number of values than the scenario.
        """
        session = self._session()
        chosen, inner = self._observed(session.binding), self._inner_roles(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, chosen, self._section.load, inner)


class ScriptSource(FmuSource):
    """An FMU that is packed of a model script."""

    def files(self) -> dict[str, bytes]:
        """Return the binding, and the FMU made of the script.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        FmuBuildError
            The script cannot be packed.
        """
        from fmu_asset.packing.script import script_fmu

        given = dict(self.places)
        script = given.pop(FMU_COPY)
        return {**read_files(given), FMU_COPY: script_fmu(script)[0]}

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        from fmu_asset.door.session import FmiAsset

        packed = folder / "asset.fmu"
        packed.write_bytes(self.files()[FMU_COPY])
        return FmiAsset(packed, binding, parameters=self.parameters()).binding
