"""Campaigns on the open rigs: excitation, hidden effects, lost samples, and their files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.open_rigs.rigs import RIGS, SCALES, Course, FloatArray, Rig, Truth, entry

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
LEFT = ("push", "loose", "law")
GAPS = (10.0, 50.0)
SHARES = (0.03, 0.10)
ALONE = (2.0, 6.0)
SIZES = (1.0, 1.5, 1.2)
"""Of what drives in each trial; the last is held out."""
SAMPLES = 128
NOISE_SAMPLES = 400
STEP = 8
TONES = (0.5, 0.9, 1.6)
"""Lowest and highest frequency that drives bodies [Hz]; stores are driven 200 times slower."""
ZERO = 5.0
"""Deviation of a zero over the noise."""
COLOUR = 0.5
"""Correlation of the noise with that one sample later, where it is coloured."""
OFFSET = 0.05
"""Deviation of a constant of the drive over the amplitude of a tone."""


def course_of(rig: Rig, generator: np.random.Generator, size: float) -> Course:
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
    heights = (
        size * rig.amplitude * generator.uniform(0.6, 1.4, 3) * generator.choice((-1.0, 1.0), 3)
    )
    rest = rig.drive.startswith("displacement")  # 1 - cos: neither place nor speed jumps
    phases = np.full(3, 0.5 * np.pi) if rest else generator.uniform(0.0, 2.0 * np.pi, 3)
    begin = float(heights.sum()) if rest else 0.0

    def value(t: float, order: int) -> float:
        found = heights * tones**order @ np.sin(tones * t + phases + 0.5 * np.pi * order)
        return float(found) - (begin if order == 0 else 0.0)

    return Course(value, push)


def simulate(
    rig: Rig, truth: Truth, courses: Sequence[Course], stamps: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the readings of all trials."""
    return [rig.motion(truth, course, time) for course, time in zip(courses, stamps, strict=True)]


class Bench:
    """A rig with its trials, and what calibration and zeros can do there."""

    def __init__(self, rig: Rig, generator: np.random.Generator, samples: int) -> None:
        self.rig = rig
        self.noise = np.array([channel[3] for channel in rig.channels])
        self.courses = [course_of(rig, generator, size) for size in SIZES]
        self.stamps = [rig.interval * np.arange(float(samples))] * len(SIZES)
        self.factors = {
            name: 1.0 + deviation * float(np.clip(generator.standard_normal(), -2.0, 2.0))
            for name, (_, deviation) in rig.parameters.items()
        }
        self.bare = self.stacked(Truth(self.factors))
        taken = [
            self.stacked(Truth(self.factors | {name: self.factors[name] + deviation})) - self.bare
            for name, (_, deviation) in rig.parameters.items()
        ]
        wide, count = len(self.noise), len(SIZES)
        for number in range(count * wide):
            zero = np.zeros((count, samples, wide))
            zero[number // wide, :, number % wide] = ZERO
            taken.append(zero.ravel())
        self.taken = np.column_stack(taken)

    def stacked(self, truth: Truth) -> FloatArray:
        """Return all readings in units of the noise."""
        parts = simulate(self.rig, truth, self.courses, self.stamps)
        return np.concatenate([(part / self.noise).ravel() for part in parts])

    def left(self, truth: Truth, beside: FloatArray) -> float:
        """Return the rms over the noise of what nuisances within their priors leave of a change."""
        change = self.stacked(truth) - beside
        size = self.taken.shape[1]
        found = np.linalg.lstsq(
            np.vstack((self.taken, np.eye(size))),
            np.concatenate((change, np.zeros(size))),
            rcond=None,
        )[0]
        return float(np.sqrt(np.mean((change - self.taken @ found) ** 2)))

    def sized(
        self, truth: Truth, key: Literal["size", "amount"], wanted: float, largest: float
    ) -> tuple[Truth, float]:
        """Return a truth whose effect leaves about `wanted` unexplained, and what it leaves."""

        def with_value(value: float) -> Truth:
            return replace(truth, size=value) if key == "size" else replace(truth, amount=value)

        beside = self.stacked(with_value(0.0))
        size, found = 0.01, 0.0
        for _ in range(8):
            size = min(size, largest)
            truth = with_value(size)
            found = self.left(truth, beside)
            if abs(found / wanted - 1.0) < 0.1 or (size == largest and found < wanted):
                break
            size *= float(np.clip(wanted / found, 0.1, 10.0))
        return truth, found


def drawn(
    number: int, seed: int, samples: int = SAMPLES, turns: int = 5
) -> tuple[Bench, Truth, dict[str, Any]]:
    """Return the rig of a campaign, its truth, and the truth in words."""
    generator = np.random.default_rng([seed, number])
    kind = KINDS[number % 5]
    turn = number // 5
    hidden = "" if turn >= turns else HIDDEN[kind][turn % len(HIDDEN[kind])]
    name = kind
    if kind == "support":
        name = f"support {('moved', 'shaken')[turn % 2]}"
    if kind == "stores" and (hidden == "natural_convection" or (not hidden and seed % 2)):
        name = "heated"
    bench = Bench(RIGS[name], generator, samples)
    shape = generator.uniform(0.6, 0.85) if hidden == "overflow" else generator.uniform(0.1, 0.4)
    at = 0 if hidden == "overflow" else turn // 2 % 2
    truth = Truth(bench.factors, hidden, 0.0, float(shape), at)
    gap = 0.0
    if hidden:
        wanted = float(np.exp(generator.uniform(*np.log(GAPS))))
        truth, gap = bench.sized(truth, "size", wanted, 0.6)
    if turn > turns:
        return (
            bench,
            truth,
            {"rig": name, "identifiers": [], "gap": 0.0, "left": "", "remainder": 0.0},
        )
    left = LEFT[number % 3]
    pitch = float(np.exp(generator.uniform(*np.log((1.5, 6.0)))))
    wanted = gap * float(generator.uniform(*SHARES)) if hidden else float(generator.uniform(*ALONE))
    truth, rest = bench.sized(replace(truth, left=left, pitch=pitch), "amount", wanted, 0.5)
    effect = {"": [], "natural_convection": ["outflow"]}.get(hidden, [hidden])
    told = {"rig": name, "identifiers": effect, "gap": gap, "left": left, "remainder": rest}
    return bench, truth, told | hidden_values(name, truth)


def hidden_values(name: str, truth: Truth) -> dict[str, Any]:
    """Return the port of what is hidden and its values in SI, laws of powers at unit motion."""
    ports = {"cart": "rail", "damper": "piston", "servo": "bearing", "heated": "surface"}
    if name in ("stores", "heated"):
        size = truth.size * (0.02 if name == "stores" else 80.0 / 40.0**1.25)
        values = {"outflow": {"coefficient": size}, "natural_convection": {"coefficient": size}}
        # the excess is told over the threshold, as the catalogue does
        values["overflow"] = {"level": truth.shape}
        port = ("upper outlet", "lower outlet")[truth.at] if name == "stores" else ports[name]
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
    known = values.get(truth.law, {})
    identifier = "outflow" if truth.law == "natural_convection" else truth.law
    return {
        "place": port if truth.law else "",
        "values": {f"{identifier}.{key}": value for key, value in known.items()},
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
                tuple(one.value(float(t), 0) for t in time), tuple(time[1:].tolist()), one.push
            )
            for one, time in zip(courses, stamps, strict=True)
        ]
    if variant in ("jitter", "all"):
        interval = bench.rig.interval
        stamps = [
            time + interval * np.clip(0.02 * generator.standard_normal(len(time)), -0.1, 0.1)
            for time in stamps
        ]
        stamps = [time - time[0] for time in stamps]
        courses = [
            Course.stepped(one.steps, tuple(time[STEP::STEP].tolist()), one.push)
            if one.steps
            else one
            for one, time in zip(courses, stamps, strict=True)
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
    names = [channel[0] for channel in rig.channels]
    quantity, unit, hold = rig.drive.split()
    hold = "zero_order" if courses[0].steps else hold
    text = f'format = 1\nname = "{folder.name}"\n\n[noise]\nfile = "rest.csv"\n'
    for name, of, in_unit, deviation in rig.channels:
        text += entry(
            "channel",
            name=name,
            quantity=of,
            unit=in_unit,
            output=name,
            offset_deviation=ZERO * deviation,
        )
    more: dict[str, bool | float] = {"reference": True} if "[[controller]]" in rig.model else {}
    more |= {"offset_deviation": offset} if offset else {}
    text += entry("input", name="drive", quantity=quantity, unit=unit, hold=hold, **more)
    folder.mkdir(parents=True)
    colour = COLOUR if variant == "colour" else 0.0
    rest = bench.noise * noise_of(noise, (NOISE_SAMPLES, len(names)), colour)
    table(
        folder / "rest.csv",
        ["time", *names],
        np.column_stack((rig.interval * np.arange(NOISE_SAMPLES), rest)),
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
