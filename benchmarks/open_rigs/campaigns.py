"""Campaigns on the open rigs: excitation, hidden effects, lost samples, and their files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.open_rigs.rigs import RIGS, SCALES, Course, FloatArray, Rig, Truth, entry
from benchmarks.sizing import size_leaving, unexplained_rms

KINDS = ("cart", "damper", "servo", "support", "stores")
LAWS = (
    "coulomb_friction",
    "quadratic_damping",
    "cubic_stiffness",
    "free_play",
    "bouc_wen_hysteresis",
)
HIDDEN = {
    "cart": LAWS[:3],
    "damper": LAWS,
    "servo": LAWS[:3],
    "support": LAWS,
    "stores": ("outflow", "overflow", "outflow", "natural_convection"),
}
"""Natural convection is an outflow of the exponent 5/4: its family."""
DISTURBANCES = ("push", "loose", "law")
GAPS = (10.0, 50.0)
SHARES = (0.03, 0.10)
ALONE = (2.0, 6.0)
SIZES = (1.0, 1.5, 1.2)
"""Size of the excitation in each trial; the last trial is held out."""
SAMPLES = 128
NOISE_SAMPLES = 400
STEP = 8
TONES = (0.5, 0.9, 1.6)
"""Frequencies of the tones that drive bodies [Hz]; stores are driven 200 times slower."""
ZERO = 5.0
"""Deviation of a zero over the noise."""
COLOUR = 0.5
"""Correlation of the noise with that one sample later, where it is coloured."""
OFFSET = 0.05
"""Deviation of a constant of the drive over the amplitude of a tone."""


def draw_course(rig: Rig, generator: np.random.Generator, size: float) -> Course:
    """Return the excitation of a trial: tones (from rest if a motion), or steps of a pump."""
    slow = 200.0 if rig.drive.endswith("zero_order") else 1.0
    f = np.exp(generator.uniform(np.log(0.1), np.log(4.0), 12)) / slow
    weight = generator.standard_normal(12) / np.sqrt(1.0 + (f * slow) ** 2)
    turn = generator.uniform(0.0, 2.0 * np.pi, 12)
    w = 2.0 * np.pi * f

    def push(t: float) -> float:
        return float(weight @ np.sin(w * t + turn))

    if slow > 1.0:
        count = SAMPLES // STEP
        steps = generator.uniform(0.2, 1.4, count) * size * rig.amplitude
        breaks = rig.interval * STEP * np.arange(1.0, count)
        return Course.stepped(tuple(steps.tolist()), tuple(breaks.tolist()), push)
    tones = 2.0 * np.pi * np.array(TONES)
    amplitudes = (
        size * rig.amplitude * generator.uniform(0.6, 1.4, 3) * generator.choice((-1.0, 1.0), 3)
    )
    # A prescribed motion is a sum of 1 - cos, so that neither position nor speed jumps at the start
    from_rest = rig.drive.startswith("displacement")
    phases = np.full(3, 0.5 * np.pi) if from_rest else generator.uniform(0.0, 2.0 * np.pi, 3)
    begin = float(amplitudes.sum()) if from_rest else 0.0

    def value(t: float, order: int) -> float:
        derivative = amplitudes * tones**order @ np.sin(tones * t + phases + 0.5 * np.pi * order)
        return float(derivative) - (begin if order == 0 else 0.0)

    return Course(value, push)


def simulate(
    rig: Rig, truth: Truth, courses: Sequence[Course], stamps: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the readings of all trials."""
    return [rig.motion(truth, course, time) for course, time in zip(courses, stamps, strict=True)]


class Bench:
    """A rig with trials and true parameters, which sizes effects by what they leave unexplained.

    Parameters
    ----------
    rig : Rig
        The rig.
    generator : numpy.random.Generator
        Random numbers.
    samples : int
        Samples of a trial.

    Attributes
    ----------
    noise : (C,) array
        Standard deviations of the channels.
    courses, stamps : list
        Excitation and sample times of each trial.
    factors : dict of str to float
        True parameters over nominal ones.
    bare : (N,) array
        Readings without a hidden effect, over the noise.
    nuisances : (N, K) array
        Changes of the readings by one prior deviation of each parameter and each zero.
    """

    def __init__(self, rig: Rig, generator: np.random.Generator, samples: int) -> None:
        self.rig = rig
        self.noise = np.array([channel.noise for channel in rig.channels])
        self.courses = [draw_course(rig, generator, size) for size in SIZES]
        self.stamps = [rig.interval * np.arange(float(samples))] * len(SIZES)
        self.factors = {
            name: 1.0 + deviation * float(np.clip(generator.standard_normal(), -2.0, 2.0))
            for name, (_, deviation) in rig.parameters.items()
        }
        self.bare = self.readings_over_noise(Truth(self.factors))
        self.nuisances = np.column_stack([*self._parameter_changes(), *self._zeros(samples)])

    def _parameter_changes(self) -> list[FloatArray]:
        """Return the changes of the readings by one prior deviation of each parameter."""
        changes = []
        for name, (_, deviation) in self.rig.parameters.items():
            moved = self.factors | {name: self.factors[name] + deviation}
            changes.append(self.readings_over_noise(Truth(moved)) - self.bare)
        return changes

    def _zeros(self, samples: int) -> list[FloatArray]:
        """Return the changes of the readings by one prior deviation of each zero."""
        trials = len(SIZES)
        channels = len(self.noise)
        zeros = []
        for trial in range(trials):
            for channel in range(channels):
                change = np.zeros((trials, samples, channels))
                change[trial, :, channel] = ZERO
                zeros.append(change.ravel())
        return zeros

    def readings_over_noise(self, truth: Truth) -> FloatArray:
        """Return the readings (N,) of all trials without errors, in units of the noise."""
        readings = simulate(self.rig, truth, self.courses, self.stamps)
        return np.concatenate([(values / self.noise).ravel() for values in readings])

    def unexplained(self, truth: Truth, reference: FloatArray) -> float:
        """Return the rms over the noise of a change that nuisances within their priors leave.

        Parameters
        ----------
        truth : Truth
            The rig with the change.
        reference : (N,) array
            Readings over the noise without it.
        """
        return unexplained_rms(self.readings_over_noise(truth) - reference, self.nuisances)

    def size_effect(
        self, truth: Truth, key: Literal["size", "amount"], wanted: float, largest: float
    ) -> tuple[Truth, float]:
        """Return a truth with an effect that leaves about `wanted` unexplained, and what it leaves.

        Parameters
        ----------
        truth : Truth
            The truth with an effect of any size.
        key : str
            The size to choose: that of the law, or the amount of the disturbance.
        wanted : float
            Rms over the noise.
        largest : float
            Largest size.
        """

        def with_size(value: float) -> Truth:
            return replace(truth, size=value) if key == "size" else replace(truth, amount=value)

        reference = self.readings_over_noise(with_size(0.0))

        def unexplained_of_size(value: float) -> float:
            return self.unexplained(with_size(value), reference)

        size, unexplained = size_leaving(wanted, largest, unexplained_of_size)
        return with_size(size), unexplained


def rig_name(kind: str, turn: int, seed: int, hidden: str) -> str:
    """Return the rig of a kind in a turn of the kinds."""
    if kind == "support":
        return f"support {('moved', 'shaken')[turn % 2]}"
    if kind == "stores" and (hidden == "natural_convection" or (not hidden and seed % 2)):
        return "heated"
    return kind


def drawn(
    number: int, seed: int, samples: int = SAMPLES, turns: int = 5
) -> tuple[Bench, Truth, dict[str, Any]]:
    """Draw a campaign and return its rig, its truth, and the facts for scoring.

    Parameters
    ----------
    number : int
        Number of the campaign: kinds of rigs alternate, and effects within a kind.
    seed : int
        Seed of the set of campaigns.
    samples : int
        Samples of a trial.
    turns : int
        Turns of the kinds with a hidden effect; the next turn has a disturbance alone, and all
        later ones have nothing.
    """
    generator = np.random.default_rng([seed, number])
    kind = KINDS[number % 5]
    turn = number // 5
    hidden = "" if turn >= turns else HIDDEN[kind][turn % len(HIDDEN[kind])]
    name = rig_name(kind, turn, seed, hidden)
    bench = Bench(RIGS[name], generator, samples)

    # The hidden effect
    shape = generator.uniform(0.6, 0.85) if hidden == "overflow" else generator.uniform(0.1, 0.4)
    store = 0 if hidden == "overflow" else turn // 2 % 2
    truth = Truth(bench.factors, hidden, 0.0, float(shape), store)
    gap = 0.0
    if hidden:
        wanted = float(np.exp(generator.uniform(*np.log(GAPS))))
        truth, gap = bench.size_effect(truth, "size", wanted, 0.6)
    if turn > turns:
        facts = {"rig": name, "identifiers": [], "gap": 0.0, "left": "", "remainder": 0.0}
        return bench, truth, facts

    # The disturbance
    disturbance = DISTURBANCES[number % 3]
    pitch = float(np.exp(generator.uniform(*np.log((1.5, 6.0)))))
    wanted = gap * float(generator.uniform(*SHARES)) if hidden else float(generator.uniform(*ALONE))
    disturbed = replace(truth, disturbance=disturbance, pitch=pitch)
    truth, remainder = bench.size_effect(disturbed, "amount", wanted, 0.5)
    named = "outflow" if hidden == "natural_convection" else hidden
    facts = {
        "rig": name,
        "identifiers": [named] if named else [],
        "gap": gap,
        "left": disturbance,
        "remainder": remainder,
    }
    return bench, truth, facts | hidden_values(name, truth)


def hidden_values(name: str, truth: Truth) -> dict[str, Any]:
    """Return the port of what is hidden and its values in SI, laws of powers at unit motion."""
    ports = {"cart": "rail", "damper": "piston", "servo": "bearing", "heated": "surface"}
    if name in ("stores", "heated"):
        size = truth.size * (0.02 if name == "stores" else 80.0 / 40.0**1.25)
        values = {"outflow": {"coefficient": size}, "natural_convection": {"coefficient": size}}
        # the excess is told over the threshold, as the catalogue does
        values["overflow"] = {"level": truth.shape}
        port = ("upper outlet", "lower outlet")[truth.store] if name == "stores" else ports[name]
    else:
        force, length, speed = SCALES[name.split()[0]]
        size = truth.size * force
        port = ports.get(name, "mount")
        yields = {"stiffness": size / length, "yield_displacement": truth.shape * length}
        values = {
            "coulomb_friction": {"coefficient": size},
            "quadratic_damping": {"coefficient": size / speed**2},
            "cubic_stiffness": {"coefficient": size / length**3},
            "free_play": {"stiffness": size / length, "half_width": truth.shape * length},
            "bouc_wen_hysteresis": yields,
        }
    true_values = values.get(truth.law, {})
    identifier = "outflow" if truth.law == "natural_convection" else truth.law
    return {
        "place": port if truth.law else "",
        "values": {f"{identifier}.{key}": value for key, value in true_values.items()},
    }


def varied(
    bench: Bench, variant: str, generator: np.random.Generator
) -> tuple[list[Course], list[FloatArray], float]:
    """Return courses and stamps of a variant, and how well the constant of the drive is known."""
    courses = list(bench.courses)
    stamps = list(bench.stamps)
    offset = 0.0
    if variant == "held" and bench.rig.drive.startswith(("force", "angle", "acceleration")):
        courses = [
            Course.stepped(
                tuple(course.value(float(t), 0) for t in time),
                tuple(time[1:].tolist()),
                course.push,
            )
            for course, time in zip(courses, stamps, strict=True)
        ]
    if variant in ("jitter", "all"):
        interval = bench.rig.interval
        stamps = [
            time + interval * np.clip(0.02 * generator.standard_normal(len(time)), -0.1, 0.1)
            for time in stamps
        ]
        stamps = [time - time[0] for time in stamps]
        courses = [
            Course.stepped(course.steps, tuple(time[STEP::STEP].tolist()), course.push)
            if course.steps
            else course
            for course, time in zip(courses, stamps, strict=True)
        ]
    return courses, stamps, OFFSET * bench.rig.amplitude if variant in ("offset", "all") else offset


def shifted(course: Course, constant: float) -> Course:
    """Return a course with a constant that its record lacks."""
    return replace(
        course, value=lambda t, order: course.value(t, order) + (constant if order == 0 else 0.0)
    )


def blanks(count: int, variant: str, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Return which of the readings of a trial were lost."""
    lost = np.zeros(count, dtype=bool)
    if variant in ("blanks", "all"):
        lost[: count // 5] = True
    if variant in ("gaps", "all"):
        for begin in generator.uniform(0.2, 0.9, 2):
            lost[int(begin * count) : int((begin + 0.06) * count)] = True
    return lost


def noise_of(generator: np.random.Generator, shape: tuple[int, ...], colour: float) -> FloatArray:
    """Return noise (n, C) of unit deviation whose samples have a correlation with the next ones."""
    white = generator.standard_normal(shape)
    if not colour:
        return white
    before = lfilter([1.0], [1.0, -colour], np.sqrt(1.0 - colour**2) * white, axis=0)
    begin = generator.standard_normal(shape[1:]) * colour ** np.arange(1.0, shape[0] + 1.0)[:, None]
    return np.asarray(before + begin, dtype=np.float64)


def write(folder: Path, bench: Bench, truth: Truth, variant: str, seed: Sequence[int]) -> None:
    """Write a campaign and its model as their user would."""
    noise, change = np.random.default_rng([*seed, 1]), np.random.default_rng([*seed, 2])
    rig = bench.rig
    courses, stamps, offset = varied(bench, variant, change)
    driven = [
        shifted(course, offset * float(change.standard_normal())) if offset else course
        for course in courses
    ]
    names = [channel.name for channel in rig.channels]
    quantity, unit, hold = rig.drive.split()
    hold = "zero_order" if courses[0].steps else hold
    text = f'format = 1\nname = "{folder.name}"\n\n[noise]\nfile = "rest.csv"\n'
    for name, channel_quantity, in_unit, deviation in rig.channels:
        text += entry(
            "channel",
            name=name,
            quantity=channel_quantity,
            unit=in_unit,
            output=name,
            offset_deviation=ZERO * deviation,
        )
    drive_keys: dict[str, bool | float] = (
        {"reference": True} if "[[controller]]" in rig.model else {}
    )
    drive_keys |= {"offset_deviation": offset} if offset else {}
    text += entry("input", name="drive", quantity=quantity, unit=unit, hold=hold, **drive_keys)
    folder.mkdir(parents=True)
    colour = COLOUR if variant == "colour" else 0.0
    noise_record = bench.noise * noise_of(noise, (NOISE_SAMPLES, len(names)), colour)
    table(
        folder / "rest.csv",
        ["time", *names],
        np.column_stack((rig.interval * np.arange(NOISE_SAMPLES), noise_record)),
    )
    readings = simulate(rig, truth, driven, stamps)
    for number, (course, time_, values) in enumerate(
        zip(courses, stamps, readings, strict=True), start=1
    ):
        zeros = ZERO * bench.noise * noise.standard_normal(len(names))
        values = values + zeros + bench.noise * noise_of(noise, values.shape, colour)
        values[blanks(len(values), variant, change)] = np.nan
        drive = [course.value(float(t), 0) for t in time_]
        table(
            folder / f"{number}.csv",
            ["time", "drive", *names],
            np.column_stack((time_, drive, values)),
        )
        held_out = {"held_out": True} if number == len(SIZES) else {}
        text += entry(
            "trial",
            name=f"trial {number}",
            kind="driven",
            file=f"{number}.csv",
            begins="still",
            **held_out,
        )
    parameters = "".join(
        entry("parameter", name=name, terms=terms, deviation=deviation, low=0.4, high=2.5)
        for name, (terms, deviation) in rig.parameters.items()
    )
    (folder / "model.toml").write_text(
        f'format = 1\nname = "{folder.name}"\n{rig.model}{parameters}', "utf-8"
    )
    (folder / "campaign.toml").write_text(text, "utf-8")


def table(path: Path, head: list[str], rows: FloatArray) -> None:
    """Write a table; readings that were lost are empty."""
    lines = [",".join("" if np.isnan(value) else f"{value:.9g}" for value in row) for row in rows]
    path.write_text("\n".join([",".join(head), *lines]) + "\n", "utf-8")
