"""The tables of a scenario about its observations: sensors, or modes identified from a record."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from reporting.arrays import Float, Index
from reporting.formats.toml_file import Check, NotNegative, Positive
from twin_master.scenario.section import Count, Name, PerSensor, Section, Table, value_count_check

MODES_ROLE = "modes"
"""The role of an observation whose values are features of modes."""
FeatureKind = Literal["frequency", "damping_ratio", "shape"]


class ModalFeature(NamedTuple):
    """A feature of a mode: its frequency, damping ratio, or relative shape at one accelerometer.

    Attributes
    ----------
    name : str
        The kind; of a shape the name of the accelerometer.
    kind : FeatureKind
        Which of the three it is.
    """

    name: str
    kind: FeatureKind


def row_width(sensors: int) -> int:
    """Return the length of a row with n values and the lower triangle of their covariance.

    The triangle includes the diagonal, and so has n (n + 1) / 2 entries.
    """
    return sensors + sensors * (sensors + 1) // 2


class ModesSection(Section):
    """The observed modes, and which of their features are observed.

    A value is observed for each mode and each feature that has a standard deviation. The features
    are the frequency, the damping ratio, and the shape at each accelerometer but the first, divided
    by the shape at the first.
    """

    accelerometers: Annotated[tuple[Name, ...], Field(min_length=1)]
    """Acceleration outputs of the model; shapes are relative to the first."""
    bands: Annotated[tuple[tuple[Positive, Positive], ...], Field(min_length=1)]
    """Lowest and highest frequency of each mode; the mode is the strongest one in its band [Hz]."""
    numbers: tuple[Count, ...] = ()
    """Number of each mode in the model, in rising order; 1, 2, ... by default."""
    standard_deviation: dict[FeatureKind, Positive]
    """Standard deviation of each kind of feature, in addition to that of the identification: for
    changes between records and the error of the model [Hz for frequencies and 1 for the others]."""

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on bands, numbers and features of modes."""
        has_empty_band = any(high <= low for low, high in self.bands)
        yield (
            has_empty_band,
            "each of `observation.modes.bands` is its least and then its largest frequency",
        )
        has_overlap = False
        for band, next_band in pairwise(sorted(self.bands)):
            has_overlap = has_overlap or next_band[0] < band[1]
        yield (
            has_overlap,
            "`observation.modes.bands` overlap: a mode in both would be observed twice",
        )
        number_count = len(self.numbers or self.bands)
        yield (
            number_count != len(self.bands),
            f"`observation.modes.numbers` gives {number_count} modes, and there are "
            f"{len(self.bands)} bands",
        )
        yield (
            not self.feature_indices,
            "`observation.modes.standard_deviation` names what is observed: one or more of "
            "frequency, damping_ratio and, with two accelerometers or more, shape",
        )

    @property
    def mode_indices(self) -> Index:
        """The indices (M,) of the observed modes among the modes of the model, from 0."""
        return np.array(self.numbers or range(1, len(self.bands) + 1)) - 1

    @property
    def features(self) -> list[ModalFeature]:
        """All features of a mode: frequency, damping ratio, and A - 1 relative shapes."""
        shapes = [ModalFeature(name, "shape") for name in self.accelerometers[1:]]
        frequency = ModalFeature("frequency", "frequency")
        damping_ratio = ModalFeature("damping_ratio", "damping_ratio")
        return [frequency, damping_ratio, *shapes]

    @property
    def feature_indices(self) -> list[int]:
        """The indices of the observed features among `features`."""
        return [
            index
            for index, feature in enumerate(self.features)
            if feature.kind in self.standard_deviation
        ]

    def observation_keys(self) -> Table:
        """Return the keys of `[observation]` that follow from the modes.

        They are `count`, `titles`, `unit` and `standard_deviation`.
        """
        titles = []
        units = []
        deviations = []
        for mode in self.mode_indices:
            for index in self.feature_indices:
                feature = self.features[index]
                titles.append(f"{feature.name}_{mode + 1}")
                units.append("Hz" if feature.kind == "frequency" else "1")
                deviations.append(self.standard_deviation[feature.kind])
        return {
            "count": len(titles),
            "titles": tuple(titles),
            "unit": tuple(units),
            "standard_deviation": tuple(deviations),
        }

    def observed_features(self, values: Float) -> Float:
        """Select the observed features of all modes, and put them in one row, mode by mode.

        Parameters
        ----------
        values : (..., M, 1 + A) array
            All features of the M modes, in the order of `features`.

        Returns
        -------
        (..., G) array
            The G observed features.
        """
        leading_axes = values.shape[:-2]
        observed_by_mode = values[..., self.feature_indices]  # (..., M, observed features)
        return observed_by_mode.reshape(*leading_axes, -1)

    def observed_covariance(self, mode_covariances: Float) -> Float:
        """Return the covariance (G, G) of the G observed features of all modes.

        It is block diagonal, since the errors of different modes are taken as uncorrelated.

        Parameters
        ----------
        mode_covariances : (M, 1 + A, 1 + A) array
            The covariance of all features of each of the M modes.
        """
        features_per_mode = len(self.feature_indices)
        feature_count = len(mode_covariances) * features_per_mode  # G
        covariance = np.zeros((feature_count, feature_count))
        observed_block = np.ix_(self.feature_indices, self.feature_indices)
        for mode, mode_covariance in enumerate(mode_covariances):
            mode_block = slice(mode * features_per_mode, (mode + 1) * features_per_mode)
            covariance[mode_block, mode_block] = mode_covariance[observed_block]
        return covariance


class RecordSection(Section):
    """The record of each step of a simulated asset."""

    kind: Literal["ambient", "decay"]
    """`ambient`: white noise excites the input; `decay`: the input is held and then released."""
    input: Name
    """The control input that is excited or released."""
    amplitude: Positive
    """Root mean square of the noise, or the value before the release [unit of the input]."""
    duration: Positive
    """Length of the record [s]."""
    sampling_rate: Positive
    """Sampling rate of the record [Hz]."""
    noise: NotNegative = 0.0
    """Standard deviation of the noise of the accelerometers [m/s^2]."""


class ObservationSection(Section):
    """The observed quantity (a role of the binding), and the sensor noise that the twin assumes."""

    units: ClassVar[Mapping[str, str]] = {
        "standard_deviation": "microstrain",
        "model_error": "percent",
    }
    filled_in: ClassVar[tuple[str, ...]] = ("count", "standard_deviation")

    role: Name = "strain"
    """The observed quantity: an observation of the binding, or `modes`."""
    count: Count
    """Number of sensors; it follows from the modes if the role is `modes`."""
    titles: tuple[str, ...] = ()
    """The name of each sensor in the report; by default the sensors have numbers."""
    unit: str | tuple[str, ...] = "1"
    """Unit of the observed values, one for all sensors or one for each; a strain without unit is
    printed in microstrain."""
    standard_deviation: PerSensor
    """Standard deviation of the noise that the twin assumes, one for all sensors or for each [unit
    of the sensors]."""
    model_error: NotNegative | tuple[NotNegative, ...] = 0.0
    """Standard deviation of the predicted value as a fraction of it, one for all sensors or one for
    each; added to the noise in quadrature [1]."""
    between_levels: bool = True
    """Whether the truth may lie between the levels of the states, which then stand for
    intervals."""
    average_over_draws: Literal["outside", "inside"] = "outside"
    """Whether the average over the draws of the parameter is taken outside the product over the
    sensors, as in the integral (30), or inside it, as eq. (32) is printed."""
    modes: ModesSection | None = None
    """The observed modes, if the role is `modes`; count, titles, unit and standard deviation follow
    from it."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in_keys_of_modes(cls, table: object) -> object:
        """Return the table with the keys that follow from the observed modes."""
        if not isinstance(table, Mapping):
            return table
        has_modes = table.get("modes") is not None
        if (table.get("role") == MODES_ROLE) != has_modes:
            raise ValueError(
                f"the role `{MODES_ROLE}` and the table `observation.modes` belong together: give "
                "both, or neither of them"
            )
        if not has_modes:
            return table
        modes = ModesSection.model_validate(table["modes"])
        implied = modes.observation_keys()
        for key, value in table.items():
            field, _unit = cls.split_unit(key)
            comparable = tuple(value) if isinstance(value, list) else value
            if field in implied and comparable != implied[field]:
                raise ValueError(f"`{key}` follows from `observation.modes`: leave it out")
        return {**table, **implied, "modes": modes}

    @property
    def width(self) -> int:
        """The length of a step's row: the values, and the covariance of features of modes."""
        return self.count if self.modes is None else row_width(self.count)

    @property
    def sensor_units(self) -> tuple[str, ...]:
        """The unit of each sensor."""
        return (self.unit,) * self.count if isinstance(self.unit, str) else self.unit

    @property
    def word(self) -> str:
        """The word for one sensor."""
        return "gauge" if self.role == "strain" else "sensor"

    @property
    def printed(self) -> tuple[float, tuple[str, ...]]:
        """The factor from stored to printed values, and the printed unit of each sensor."""
        has_no_units = set(self.sensor_units) <= {"1", ""}
        if self.role == "strain" and has_no_units:
            return 1e6, ("microstrain",) * self.count
        return 1.0, self.sensor_units

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on numbers of values."""
        for key in ("unit", "standard_deviation", "titles"):
            value = getattr(self, key)
            # Without titles the tuple is empty, which is allowed and not a wrong number of titles.
            yield value_count_check(f"observation.{key}", value or None, self.count)
        yield value_count_check("observation.model_error_percent", self.model_error, self.count)
