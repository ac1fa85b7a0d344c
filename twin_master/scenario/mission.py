"""The tables of a scenario about the mission, its states and controls, and the calibration."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from reporting.formats.toml_file import Check, NotNegative, Number
from twin_master.scenario.kinds import FileSection
from twin_master.scenario.section import Count, Name, Probability, Section, Seed
from twin_master.scenario.tables import ROW_SUM_TOLERANCE


class Mission(Section):
    """The name of the mission, its length, first control and seed."""

    name: Name
    """Name of the mission, of letters, digits, `_`, `.` and `-`."""
    title: str = ""
    """Title in the report; by default the name."""
    description: str = ""
    """Purpose of the mission, in words."""
    steps: Count
    """Number of steps of the mission."""
    prediction_steps: Count = 10
    """Number of steps that the twin predicts ahead."""
    first_control: Name
    """The control of the first step."""
    seed: Seed = 0
    """Seed of all random numbers of the mission."""
    step_name: Name = "step"
    """The word for a step of the mission in the report."""


class StateFactor(Section):
    """One factor of the hidden state: its levels, and the belief before the first observation."""

    units: ClassVar[Mapping[str, str]] = {"levels": "percent"}
    name: Name
    """Name of the factor, such as that of a damage region."""
    title: str = ""
    """Name of the factor in the report; by default the name."""
    unit: str = "1"
    """Unit of the levels; a dimensionless level is a fraction, printed in percent."""
    levels: Annotated[tuple[Number, ...], Field(min_length=1)]
    """Levels that the factor can have, in rising order [unit of the factor]."""
    prior: Annotated[tuple[Probability, ...], Field(min_length=1)]
    """Probability of each level before the first observation [1]."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on levels and prior."""
        does_not_increase = any(second <= first for first, second in pairwise(self.levels))
        listed = ", ".join(str(level) for level in self.levels)
        yield (
            does_not_increase,
            f"`levels` of state `{self.name}` must increase, but {listed} was given",
        )
        yield (
            len(self.prior) != len(self.levels),
            f"`prior` of state `{self.name}` must hold one probability for each of its "
            f"{len(self.levels)} levels, but {len(self.prior)} were given",
        )
        total = sum(self.prior)
        yield (
            abs(total - 1.0) > ROW_SUM_TOLERANCE,
            f"`prior` of state `{self.name}` must sum to 1, and sums to {total:.12g}",
        )

    @property
    def initial_level(self) -> float:
        """The most probable level before the first observation."""
        return self.levels[self.prior.index(max(self.prior))]


class Control(Section):
    """One choice of the twin, with the value of each control input of the asset, SI."""

    name: Name
    """Name of the control."""
    title: str = ""
    """Name of the control in the report; by default the name."""
    values: dict[str, Number]
    """Value of each control input of the asset, by its name; `{}` if there is none [SI]."""


class Reference(Section):
    """A reference value for an entry of the summary, and its source."""

    figure: Name
    """Key of an entry of the summary."""
    value: Number | str
    """The value to compare with, in the unit of the entry [unit of the figure]."""
    source: str
    """Source of the value."""


CALIBRATION_COPY = "asset/calibration.nc"
"""Path of the calibration file inside a run folder."""


class Calibration(FileSection):
    """The uncertain parameter of the model, and its distribution."""

    parameter: Name
    """Name of the uncertain parameter."""
    source: Literal["static_test", "normal", "fixed", "file"]
    """Source of the distribution of the parameter: a static test of the wing, a normal
    distribution, one fixed value, or a calibration file."""
    file: str | None = None
    """A calibration (`calibration.nc`). If `mean` and `standard_deviation` are given, the file is
    used for everything else in it."""
    curve: Literal["published", "design"] = "published"
    """Stiffness curve of the static test: as published, or computed from the design."""
    draws: Count = 100
    """Number of draws of the parameter."""
    mean: Number | None = None
    """Mean of the parameter [unit of the parameter]."""
    standard_deviation: NotNegative | None = None
    """Standard deviation of the parameter [unit of the parameter]."""

    copy_paths: ClassVar[Mapping[str, str]] = {"file": CALIBRATION_COPY}

    @property
    def draw_count(self) -> int:
        """The number of draws of the parameter; a fixed parameter has one."""
        return 1 if self.source == "fixed" else self.draws

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on the keys that each source needs."""
        has_file = bool(self.file)
        yield (
            self.source == "file" and not has_file,
            "calibration source `file` needs `file`, the path of a calibration.nc",
        )
        yield (
            has_file and self.source not in ("file", "normal"),
            "`file` belongs to the calibration sources `file` and `normal`, and the source is "
            f"`{self.source}`",
        )
        needs_mean = self.source in ("normal", "fixed")
        yield (
            needs_mean and self.mean is None,
            f"calibration source `{self.source}` needs `mean`",
        )
        needs_deviation = self.source == "normal"
        yield (
            needs_deviation and self.standard_deviation is None,
            f"calibration source `{self.source}` needs `standard_deviation`",
        )
