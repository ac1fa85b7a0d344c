"""A uniform cantilever as a quick `Model`, for the pictures of docs/effects and for tests.

Euler-Bernoulli elements on a root that turns in a spring; shear strain of the skin follows the
torque of a load behind the elastic line. About the size of the wing that this project flies.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calibration.result.record import ParameterPrior
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.system.excitation import Excitation, Load, ReleasePoint
from discrepancy.system.interface import Model
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.load_change import require_release
from discrepancy.system.motion import simulate_motion
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.response import ACROSS, Conditions, Outputs, Response
from discrepancy.system.scales import PortScale, Scales
from discrepancy.system.sensing import observe
from discrepancy.system.time_history import RecordedHistory
from fe.runtime.patch import (
    INTERNAL_FORCES,
    GaugeOffset,
    InertiaRelief,
    InterfaceCompliance,
    LoadGain,
    LoadOffset,
    LoadPlace,
    LoadTilt,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PlaceMass,
    PointMass,
    Primitive,
    RegionStiffnessLoss,
    SupportCompliance,
    Washout,
)
from fe.runtime.port_laws import port_laws

FloatArray = NDArray[np.float64]

LENGTH, ELEMENTS = 1.8, 18  # m
BENDING_STIFFNESS = 1350.0  # N m^2
MASS_PER_LENGTH = 1.25  # kg/m
ROOT_STIFFNESS = 12000.0  # N m/rad
TORSIONAL_STIFFNESS = 900.0  # N m^2
SKIN = 0.018  # m from the elastic line
POISSON = 0.3
GRAVITY = 9.80665
LOAD_STATION = 1.65  # m, of the place "tip_load"
DAMPING_RATIO = 0.006
REGIONS = {"inner": (0.2, 0.4), "outer": (0.8, 1.1)}
"""First and last station [m] of the damage regions of `CantileverWithRegions`."""
GAUGES = {"strain[0]": 0.25, "strain[1]": 0.85, "strain[2]": 1.35}  # m
STEP = LENGTH / ELEMENTS
JOINT_ELEMENT = ELEMENTS // 4
"""Element with the joint of `CantileverWithRegions`."""
SIZE = 2 * ELEMENTS + 1  # root rotation, then displacement and rotation of each node


def _degrees(element: int) -> list[int | None]:
    """Return the unknowns of an element's ends: displacement, rotation; the root does not move."""
    first: list[int | None] = [None, 0] if element == 0 else [2 * element - 1, 2 * element]
    return [*first, 2 * element + 1, 2 * element + 2]


def displacement_row(station: float) -> FloatArray:
    """Return the row (n,) of the upward displacement at a station [m]."""
    element = min(int(station / STEP), ELEMENTS - 1)
    s = station / STEP - element
    shape = (
        1 - 3 * s**2 + 2 * s**3,
        STEP * (s - 2 * s**2 + s**3),
        3 * s**2 - 2 * s**3,
        STEP * (s**3 - s**2),
    )
    row = np.zeros(SIZE)
    for degree, value in zip(_degrees(element), shape, strict=True):
        if degree is not None:
            row[degree] = value
    return row


def curvature_row(station: float) -> FloatArray:
    """Return the row (n,) of w'' at a station [1/m]."""
    element = min(int(station / STEP), ELEMENTS - 1)
    s = station / STEP - element
    shape = ((12 * s - 6) / STEP**2, (6 * s - 4) / STEP, (6 - 12 * s) / STEP**2, (6 * s - 2) / STEP)
    row = np.zeros(SIZE)
    for degree, value in zip(_degrees(element), shape, strict=True):
        if degree is not None:
            row[degree] = value
    return row


POINTS = (np.arange(10 * ELEMENTS) + 0.5) * LENGTH / (10 * ELEMENTS)
SHARES = np.array([displacement_row(y) for y in POINTS])  # (P, n)
SPAN = SHARES.mean(axis=0)
ROOT = np.eye(SIZE)[0]
TIP = displacement_row(LENGTH)
MASS_PLACES = {"tip": LENGTH, "middle": 0.5 * LENGTH}
"""Distance of places of masses from the root [m]."""
PORTS = {"root": ROOT, "tip": TIP, "span": SPAN}


@cache
def _system(modulus: float, structural: ModelPatch) -> LinearSystem:
    """Return the structure with its modulus scaled and masses, root and losses of a patch."""
    loss = np.zeros(ELEMENTS)
    mass = np.zeros((SIZE, SIZE))
    extra = np.zeros((SIZE, SIZE))
    compliance = 1.0 / ROOT_STIFFNESS
    ends = np.arange(ELEMENTS) * STEP
    for primitive in structural:
        if isinstance(primitive, LocalStiffnessLoss):
            inner = np.clip(
                np.minimum(ends + STEP, primitive.start + primitive.length)
                - np.maximum(ends, primitive.start),
                0,
                None,
            )
            loss += primitive.loss * inner / STEP
        elif isinstance(primitive, PointMass):
            row = displacement_row(primitive.station)
            extra += primitive.mass * np.outer(row, row)
        elif isinstance(primitive, PlaceMass):
            row = displacement_row(MASS_PLACES[primitive.place])
            extra += primitive.mass * np.outer(row, row)
        elif isinstance(primitive, SupportCompliance):
            compliance += primitive.compliance
        elif isinstance(primitive, InterfaceCompliance):
            # a hinge in series with the bending compliance of the element in which it lies
            softness = primitive.compliance * BENDING_STIFFNESS / STEP
            loss[JOINT_ELEMENT] = 1.0 - 1.0 / (1.0 / (1.0 - loss[JOINT_ELEMENT]) + softness)
    stiffness = np.zeros((SIZE, SIZE))
    h = STEP
    k = (
        np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h**2, -6 * h, 4 * h**2],
            ]
        )
        / h**3
    )
    m = (
        np.array(
            [
                [156, 22 * h, 54, -13 * h],
                [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                [54, 13 * h, 156, -22 * h],
                [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
            ]
        )
        * h
        / 420
    )
    for element in range(ELEMENTS):
        pairs = [(i, d) for i, d in enumerate(_degrees(element)) if d is not None]
        for i, a in pairs:
            for j, b in pairs:
                stiffness[a, b] += modulus * BENDING_STIFFNESS * (1.0 - loss[element]) * k[i, j]
                mass[a, b] += MASS_PER_LENGTH * m[i, j]
    stiffness[0, 0] += 1.0 / compliance
    mass += extra
    damping = (
        2.0 * DAMPING_RATIO / 30.0 * stiffness
    )  # ratio as stated at 30 rad/s, in proportion to frequency
    return LinearSystem(mass, damping, stiffness, PORTS, 5)


class Cantilever(Model):
    """A cantilever with outputs of tip displacement and three strains; ports root, tip and span."""

    name = "cantilever"
    ports = tuple(PORTS)
    shows_ports = False
    stations: tuple[float, float] | None = (0.0, LENGTH)
    support_motions = (("root", "rx"),)
    mass_places = tuple(MASS_PLACES)
    load_changes = (("tip_load", "offset", "y"), ("tip_load", "tilt", "y"))
    gauge_shifts = tuple((name, "along") for name in GAUGES)
    parameters = (ParameterPrior("young_modulus_factor", "1", 1.0, 0.01, 0.5, 2.0),)

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is."""
        if output.removesuffix(ACROSS[0]).removesuffix(ACROSS[1]) in GAUGES:
            return Quantity.STRAIN
        return Quantity.DISPLACEMENT if output == "tip_displacement" else None

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the cantilever can carry a primitive: it can carry all."""
        return True

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""
        system = _system(1.0, ModelPatch())
        w = float(system.angular_frequency[0])
        ports = {}
        for name, row in PORTS.items():
            largest = 0.0
            for trial in campaign.fitted:
                values = _motion(trial, row[None], ModelPatch(), Conditions(np.ones(1)))[0]
                largest = max(largest, float(np.max(np.abs(values))))
            ports[name] = PortScale(
                largest,
                float(w**2 / (row @ system.shapes[:, 0]) ** 2),
                w,
                float(1.0 / (row @ system.apply_flexibility(row))),
            )
        dynamic = [trial for trial in campaign.fitted if trial.is_dynamic]
        return Scales(
            length=LENGTH,
            tip_stiffness=float(1.0 / (TIP @ system.apply_flexibility(TIP))),
            modal_mass=float(1.0 / (TIP @ system.shapes[:, 0]) ** 2),
            angular_frequency=w,
            force=max(float(np.max(np.abs(trial.force))) for trial in campaign.fitted),
            load_factor=max(float(np.max(np.abs(trial.load_factor))) for trial in campaign.fitted),
            duration=max((float(trial.time[-1]) for trial in dynamic), default=1.0),
            campaign_time=max(
                float(trial.time[-1]) + (trial.start if trial.is_dynamic else 0.0)
                for trial in campaign.fitted
            ),
            ports=ports,
        )

    def _respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the response of a trial."""
        across = ACROSS[0]
        places = dict(GAUGES)
        for primitive in patch:
            if isinstance(primitive, GaugeOffset):
                places[primitive.gauge] += primitive.distance
        along = {name: SKIN * curvature_row(place) for name, place in places.items()}
        rows = along | {name + across: -POISSON * row for name, row in along.items()}
        chosen = np.array([rows.get(name, TIP) for name, _ in outputs])
        values, rates, torque = _motion(trial, chosen, patch, conditions)
        sheared = [name.endswith(ACROSS[1]) for name, _ in outputs]
        values[:, sheared] = torque[:, None] * 2.0 * SKIN / TORSIONAL_STIFFNESS
        return Response(values, rates)


class CantileverWithRegions(Cantilever):
    """The cantilever with a joint, as a structure that loses stiffness in damage regions alone."""

    name = "cantilever with regions"
    regions = tuple(REGIONS)
    interface_motions = (("joint", "rs"),)
    stations = None

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the structure can carry a primitive: all but a loss anywhere along its length."""
        return primitive is not LocalStiffnessLoss

    def _respond(
        self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions
    ) -> Response:
        """Return the response of a trial, with losses of regions as losses over their stretches."""
        primitives: list[Primitive] = []
        for primitive in patch:
            if isinstance(primitive, RegionStiffnessLoss):
                begin, end = REGIONS[primitive.region]
                primitive = LocalStiffnessLoss(primitive.loss, begin, end - begin)
            primitives.append(primitive)
        return super()._respond(trial, outputs, ModelPatch(tuple(primitives)), conditions)


def _motion(
    trial: Trial, rows: FloatArray, patch: ModelPatch, conditions: Conditions
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Return values and rates (N, C) of rows (C, n), and the torque (N,) of the load."""
    structural = patch.of(
        PointMass, PlaceMass, SupportCompliance, InterfaceCompliance, LocalStiffnessLoss
    )
    softening = sum(
        primitive.coefficient for primitive in patch if isinstance(primitive, ModulusTemperature)
    )
    modulus = float(conditions.parameters[0]) * (1.0 - softening * trial.temperature)
    place = LOAD_STATION if isinstance(trial.load_place, str) else trial.load_place[0]
    gain = 1.0
    tare = 0.0
    chord_offset = 0.05
    washout = np.zeros(len(POINTS))
    relief = 0.0
    for primitive in patch:
        if isinstance(primitive, LoadPlace):
            place, chord_offset = place + primitive.along_span, chord_offset + primitive.along_chord
        elif isinstance(primitive, LoadOffset):
            place = place + primitive.distance
        elif isinstance(primitive, LoadTilt):
            gain = gain * (np.cos(primitive.angle) + np.sin(primitive.angle))
        elif isinstance(primitive, LoadGain):
            gain, tare = gain * (1.0 + primitive.gain), tare + primitive.tare
        elif isinstance(primitive, Washout):
            washout = washout + primitive.coefficient * (POINTS / LENGTH) ** primitive.exponent
        elif isinstance(primitive, InertiaRelief):
            relief += primitive.fraction
    row = displacement_row(min(place, LENGTH))
    force = np.where(trial.force != 0.0, gain * trial.force + tare, 0.0)
    laws = port_laws(patch.of(*INTERNAL_FORCES), PORTS)
    if trial.is_dynamic:
        system = _system(float(modulus[0]), structural)
        excitation = Excitation(trial.time, conditions.motion_times(trial.time))
        if trial.kind is TrialKind.RINGDOWN:
            point = ReleasePoint(TIP, TIP, require_release(trial))
            excitation = replace(excitation, release=point, initial=conditions.initial)
        else:
            history = RecordedHistory(trial.time, force, trial.hold)
            excitation = replace(excitation, loads=[Load(row, history)])
        motion = simulate_motion(system, excitation, laws, conditions.refinement)
        response = motion.response([OutputEquation.from_row(row) for row in rows])
        return response.values, response.rates, chord_offset * force
    loads = np.outer(force, row)
    for n in range(len(force)):
        factor = trial.load_factor[n]
        lift = 20.0 * factor * (1.0 - washout * factor)  # N/m: about the aircraft's weight
        loads[n] += ((lift - relief * factor * MASS_PER_LENGTH * GRAVITY)[:, None] * SHARES).sum(
            axis=0
        ) * (LENGTH / len(POINTS))
    values = np.empty((len(force), len(rows)))
    for level in np.unique(modulus):
        chosen = modulus == level
        values[chosen] = (
            _system(float(level), structural).static_path(loads, laws).values @ rows.T
        )[chosen]
    return values, None, chord_offset * force


def channel_list() -> dict[str, Channel]:
    """Return four channels: the tip's displacement and three gauges."""
    noise = {Quantity.DISPLACEMENT: 2e-4, Quantity.STRAIN: 2e-6}
    rows = [("tip", Quantity.DISPLACEMENT, "tip_displacement")]
    rows += [(f"g{n}", Quantity.STRAIN, name) for n, name in enumerate(GAUGES)]
    return {
        name: Channel(
            name, quantity, output, NoiseRecord(noise[quantity], 200.0), 0.005, noise[quantity]
        )
        for name, quantity, output in rows
    }


def _trial(name: str, kind: TrialKind, time: FloatArray, **given: object) -> Trial:
    return Trial.plain(name, kind, tuple(channel_list()), time, **{"run": "A", **given})


def campaign() -> Campaign:
    """Return a campaign on the cantilever as it is, without noise: every kind of trial, two runs.

    Two ring-downs, one forced trial, three static ones (up, down, warm) and one flight.
    """
    levels = np.array([5.0, 10.0, 20.0, 30.0, 20.0, 10.0, 5.0])
    minutes = 60.0 * np.arange(1, 8, dtype=np.float64)
    samples = np.arange(2000, dtype=np.float64) / 250.0
    trials = (
        _trial("up", TrialKind.STATIC, minutes, force=levels),
        _trial("down", TrialKind.STATIC, 600.0 + minutes, force=-levels, run="B"),
        _trial(
            "warm",
            TrialKind.STATIC,
            1200.0 + minutes,
            force=levels,
            run="B",
            temperature=np.full(7, 15.0),
        ),
        _trial("release", TrialKind.RINGDOWN, samples, start=2000.0, release=Release(0.08)),
        _trial("half", TrialKind.RINGDOWN, samples, start=2100.0, release=Release(0.04)),
        _trial(
            "pushed",
            TrialKind.FORCED,
            samples[:1000],
            start=2200.0,
            force=8.0 * np.sin(2.0 * np.pi * (2.0 + samples[:1000]) * samples[:1000]),
        ),
        _trial("flight", TrialKind.FLIGHT, 3000.0 + minutes, load_factor=np.linspace(1.0, 3.0, 7)),
    )
    bare = Campaign("Cantilever", channel_list(), trials, 20.0, {}, "")
    model = Cantilever()
    for trial in trials:
        conditions = Conditions(np.ones(1))
        trial.values[:] = observe(model, bare, trial, ModelPatch(), conditions).values
    return bare
