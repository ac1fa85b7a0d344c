"""Samples of named figures, as every calibration leaves them."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.static.posterior import Seed, check_count, child_seed

Float = NDArray[np.float64]

LONGEST_NAME = 80


@dataclass(frozen=True)
class CalibratedFigure:
    """Name, unit (SI) and meaning of a calibrated figure."""

    name: str
    unit: str
    title: str


@dataclass(frozen=True)
class SampleTable:
    """Samples of some figures: `samples` (N, F) of the posterior and `prior` (M, F), SI."""

    figures: tuple[CalibratedFigure, ...]
    samples: Float
    prior: Float


class SampledCalibration(ABC):
    """What a twin asks of a calibration: equally weighted samples by name."""

    asset: str
    procedure: str
    seed: int

    @property
    @abstractmethod
    def calibrated(self) -> SampleTable:
        """The calibrated figures; row n of the samples is one draw of all of them together."""

    @property
    def derived(self) -> SampleTable | None:
        """Figures that follow from the calibrated ones, at the same samples; None without any."""
        return None

    def mean(self, name: str) -> float:
        """Return the posterior mean of a figure, SI."""
        return float(np.mean(self.draws_of(name)))

    def standard_deviation(self, name: str) -> float:
        """Return the posterior standard deviation of a figure, SI; zero where it does not vary."""
        values = self.draws_of(name)
        return float(np.std(values, ddof=1)) if values.size > 1 else 0.0

    def draws_of(self, name: str, *, prior: bool = False) -> Float:
        """Return all samples of one figure; (N,), SI.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name.
        """
        tables = [table for table in (self.calibrated, self.derived) if table is not None]
        for table in tables:
            for index, figure in enumerate(table.figures):
                if figure.name == name:
                    return (table.prior if prior else table.samples)[:, index]
        known = ", ".join(figure.name for table in tables for figure in table.figures)
        raise CalibrationRecordError(
            f"the calibration of {self.asset} has no samples of `{name}`; it has {known}."
        )

    def stratified_rows(self, name: str, count: int, seed: Seed) -> NDArray[np.int64]:
        """Return which `count` samples to take, one from each of as many strata of one figure; (count,).

        Strata are of equal probability and in shuffled order: means of functions of this figure scatter far
        less than with independent draws. Other figures of the same rows keep their correlation with it.

        Raises
        ------
        CalibrationRecordError
            If the calibration has no figure of this name, or `count` is not 1 to `MOST_SAMPLES`.
        """
        order = np.argsort(self.draws_of(name), kind="stable")
        check_count(count, CalibrationRecordError)
        generator = np.random.default_rng(child_seed(seed, 0))
        probability = (np.arange(count) + generator.random(count)) / count
        drawn = order[np.minimum((probability * len(order)).astype(np.int64), len(order) - 1)]
        return generator.permutation(drawn)

    def stratified_draws(self, name: str, count: int, seed: Seed) -> Float:
        """Return `count` draws of one figure, one from each of as many strata; (count,), SI.

        Raises
        ------
        CalibrationRecordError
            As `stratified_rows`.
        """
        return self.draws_of(name)[self.stratified_rows(name, count, seed)]


def check_name(asset: str) -> str:
    """Return the name of an asset if it can be printed.

    Raises
    ------
    CalibrationRecordError
        If it is empty, too long or holds control characters.
    """
    if not (0 < len(asset) <= LONGEST_NAME and asset.isprintable() and asset.strip()):
        raise CalibrationRecordError(
            f"the name of the asset must be 1 to {LONGEST_NAME} printable characters, and {asset!r} came."
        )
    return asset


def frozen_samples(which: str, given: object, columns: int) -> Float:
    """Return samples (N, `columns`) as an array that cannot be changed.

    Raises
    ------
    CalibrationRecordError
        If they have another shape or hold values that are not finite.
    """
    values = np.array(given, dtype=np.float64, order="C")
    values.setflags(write=False)
    if values.ndim != 2 or not len(values) or values.shape[1] != columns:
        raise CalibrationRecordError(f"{which} must have the shape (N, {columns}), and {values.shape} came.")
    if not np.all(np.isfinite(values)):
        raise CalibrationRecordError(f"{which} hold a value that is not finite.")
    return values
