"""Draws of the uncertain parameter of the model, and the calibration file of a scenario."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonObject, JsonRecord
from twin_master.errors import MissionInputError, check_names
from twin_master.scenario.mission import Calibration
from twin_master.seeds import generator, seed_sequence

if TYPE_CHECKING:
    from calibration.result.record import Calibration as CalibrationRecord
    from calibration.static.posterior import ScalarPosterior
    from fe.runtime.reduced import ReducedModel


SAME_NAMES = "give parameters the same names in the model file of the calibration"
NO_CALIBRATED_DESIGN = (
    "the scenario asks for the design of a calibration, but there is no calibration file of a "
    'wing: give --calibration, or `source = "file"` in the table `calibration`.'
)
WING_CALIBRATION = "give a calibration of the wing's own, which `uav-twin calibrate` makes"


@dataclass(frozen=True)
class ParameterDraws:
    """Equally weighted draws of one parameter of the asset's model.

    Attributes
    ----------
    name : str
        The name of the parameter.
    values : (E,) array
        The E draws, SI.
    mean, standard_deviation : float
        The moments of the distribution from which the draws were taken, SI.
    source : str
        The origin of the distribution, in words.
    record : mapping or None
        The whole calibration as plain data; None if the scenario states the distribution.
    others : mapping of str to (E,) array
        The expectation of each other calibrated parameter at each draw, SI.
    """

    name: str
    values: Float
    mean: float
    standard_deviation: float
    source: str
    record: JsonRecord | None = None
    others: Mapping[str, Float] = field(default_factory=dict)


def draw_parameter(
    calibration: Calibration, seed: int, model: "ReducedModel | None" = None
) -> ParameterDraws:
    """Return draws of the calibrated parameter from the distribution that the scenario names.

    This is step 2 of the calibration in Kapteyn et al. 2021. The distribution comes from a
    calibration file, a fixed value, a normal distribution, or the published load test.

    Parameters
    ----------
    calibration : Calibration
        The table of the scenario.
    seed : int
        The seed of the run.
    model : ReducedModel, optional
        The structural model, whose curve of tip stiffness over Young's modulus is used if
        `calibration.curve` is not `published`.

    Returns
    -------
    ParameterDraws
        The draws, with the moments of their distribution.

    Raises
    ------
    MissionInputError
        If the scenario asks for the stiffness curve of a design, and there is none.
    CalibrationError
        If the measurements do not fit the model, or the calibration file cannot be read.
    """
    record = read_calibration(calibration)
    if calibration.source == "file":
        assert record is not None  # the schema requires the file
        return _draws_of_record(calibration, seed, record)
    if calibration.source == "fixed":
        assert calibration.mean is not None  # the schema requires it
        name = calibration.parameter
        mean = calibration.mean
        return ParameterDraws(name, np.array([mean]), mean, 0.0, "fixed in the scenario")
    if calibration.source == "normal":
        return _draws_of_normal(calibration, seed, record)
    if calibration.curve == "published":
        return _draws_of_load_test(calibration, seed, None)
    if model is None:
        raise MissionInputError(
            "`calibration.curve` asks for the stiffness curve of a design, but the asset has none: "
            "let the twin believe a `design`, or set `calibration.curve` to `published`."
        )
    return _draws_of_load_test(calibration, seed, model)


def _draws_of_record(
    calibration: Calibration, seed: int, record: "CalibrationRecord"
) -> ParameterDraws:
    """Return stratified draws from the posterior samples of a calibration file.

    There are as many strata of equal probability as draws, with one draw from each.
    """
    from calibration.result.file import run_record

    name = calibration.parameter
    seeds = seed_sequence(seed, "calibration")
    values = record.stratified_draws(name, calibration.draws, seeds)
    return ParameterDraws(
        name=name,
        values=values,
        mean=record.mean(name),
        standard_deviation=record.standard_deviation(name),
        source=f"calibration of {record.asset}, {record.procedure}, {len(record.samples)} samples",
        record=run_record(record, name),
        others=record.conditional_means(name, values),
    )


def _draws_of_normal(
    calibration: Calibration, seed: int, record: "CalibrationRecord | None"
) -> ParameterDraws:
    """Return stratified draws from the normal distribution that the scenario states.

    If there is a calibration file, its samples give the expectation of each other parameter at
    each draw.
    """
    from calibration.static.posterior import GaussianPrior, stratified

    assert calibration.mean is not None  # the schema requires it
    deviation = calibration.standard_deviation or 0.0
    probabilities = stratified(generator(seed, "calibration"), calibration.draws)
    values = GaussianPrior(calibration.mean, deviation).quantile(probabilities)
    return ParameterDraws(
        name=calibration.parameter,
        values=values,
        mean=calibration.mean,
        standard_deviation=deviation,
        source="normal distribution of the scenario",
        others={} if record is None else record.conditional_means(calibration.parameter, values),
    )


def _draws_of_load_test(
    calibration: Calibration, seed: int, model: "ReducedModel | None"
) -> ParameterDraws:
    """Return draws of the factor on Young's modulus, given the published static load test.

    The posterior depends on the curve of tip stiffness over that factor: that of the model, or the
    published straight line if the model is None.
    """
    # These modules take a while to load, and a scenario can be read without them.
    from calibration.static.errors_in_variables import exact_posterior
    from calibration.static.experiments import published_measurements
    from calibration.static.posterior import (
        PUBLISHED_LINE,
        GaussianPrior,
        push_forward,
        stiffness_curve_of,
    )
    from reporting.json_file import plain

    seeds = seed_sequence(seed, "calibration")
    measurements = published_measurements()
    curve = PUBLISHED_LINE
    if model is not None:
        validity = model.validity["young_modulus_factor"]
        curve = stiffness_curve_of(model.tip_stiffness, validity)
    posterior = exact_posterior(measurements, curve=curve)
    # The distribution of the tip stiffness that follows from that of the factor, for the record.
    stiffness = push_forward(posterior, curve)
    return ParameterDraws(
        name=calibration.parameter,
        values=posterior.samples(seeds, calibration.draws),
        mean=posterior.mean,
        standard_deviation=posterior.standard_deviation,
        source=f"static test of the wing, exact, {curve.name}",
        record={
            "parameter": calibration.parameter,
            "prior": plain(GaussianPrior()),
            "posterior": _plain_density(posterior),
            "tip_stiffness": {
                "unit": "N/m",
                "mean": stiffness.mean,
                "standard_deviation": stiffness.standard_deviation,
            },
            "data": {
                "source": measurements.source,
                "load": measurements.load.tolist(),
                "displacement": measurements.displacement.tolist(),
            },
        },
    )


def _plain_density(posterior: "ScalarPosterior") -> JsonObject:
    """Return the constructor arguments of a posterior as plain data, without derived attributes."""
    from calibration.static.posterior import ScalarPosterior
    from reporting.json_file import plain

    names = [attribute.name for attribute in fields(ScalarPosterior) if attribute.init]
    return {name: plain(getattr(posterior, name)) for name in names}


def read_calibration(calibration: Calibration) -> "CalibrationRecord | None":
    """Return the calibration from the file that a scenario names; None if it names none.

    Raises
    ------
    CalibrationRecordError
        If the file is damaged or of another kind, or has no samples of the parameter.
    """
    if calibration.file is None:
        return None
    from calibration.result.file import load_calibration

    record = load_calibration(Path(calibration.file))
    record.draws_of(calibration.parameter)  # raises an error if there are none
    return record


def check_calibration(
    calibration: Calibration,
    known_names: Collection[str],
    where: str,
    *,
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    design_hash: str = "",
    advice: str = SAME_NAMES,
) -> None:
    """Check that a calibration of parameters fits the asset or the believed model.

    Nothing is checked if the scenario names no calibration file, or if the file is that of a wing,
    which contains its own design.

    Parameters
    ----------
    calibration : Calibration
        The table of the scenario.
    known_names : collection of str
        The parameters of the model, which must contain all parameters of the calibration.
    where : str
        The name of the model or binding with these parameters, for the message.
    ranges : mapping of str to (float, float)
        The least and largest valid value of a parameter, by its name, SI; a parameter without an
        entry has no limits.
    design_hash : str
        The hash of the believed design; empty if it is not known, or if the twin does not believe
        the model.
    advice : str
        The advice to the user about an unknown parameter, for the message.

    Raises
    ------
    CalibrationRecordError
        If the file is damaged or of another kind, or has no samples of the parameter.
    MissionInputError
        If the calibration has an unknown parameter, a posterior mean outside the valid range, or
        another design.
    """
    record = read_calibration(calibration)
    if record is None or record.design is not None:
        return
    names = {prior.name for prior in record.priors}
    names_by_kind = [("parameter", names, known_names)]
    check_names(f"the calibration of {record.asset} has the", where, names_by_kind, advice=advice)
    if design_hash and record.design_hash not in ("", design_hash):
        raise MissionInputError(
            f"the calibration of {record.asset} is of the model {record.model} with the design "
            f"{record.design_hash:.12}, and {where}, which the twin believes, has the design "
            f"{design_hash[:12]}: calibrate the believed model, or let the twin believe the "
            "calibrated one."
        )
    for name, (low, high) in ranges.items():
        if name in names and not low <= record.mean(name) <= high:
            raise MissionInputError(
                f"the calibration of {record.asset} has {name} = {record.mean(name):.6g}, but "
                f"{where} holds from {low:g} to {high:g} of it: give a calibration within this "
                "range, or widen the range if its file has one."
            )


def is_of_parameters(file: Path | str) -> bool:
    """Return whether a calibration file contains parameters only, and no wing design.

    The result is False for a damaged file, whose error is raised when the file is used.
    """
    from calibration.errors import CalibrationRecordError
    from calibration.result.file import load_calibration

    try:
        return load_calibration(file).design is None
    except CalibrationRecordError:
        return False


def calibrated_means(calibration: Calibration) -> dict[str, float]:
    """Return the posterior mean of each parameter of a calibration file, SI.

    The result is empty without a file, and for the calibration of a wing, whose design contains
    its calibrated values.
    """
    record = read_calibration(calibration)
    if record is None or record.design is not None:
        return {}
    return {prior.name: record.mean(prior.name) for prior in record.priors}
