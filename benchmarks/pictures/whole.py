"""The picture of the whole, `whole.svg`: `python -m benchmarks.pictures whole`.

The picture has a light ground of its own, so that it reads alike on light and dark pages.
"""

from __future__ import annotations

from html import escape

NAME = "whole"
WIDTH, HEIGHT = 1100, 600
INK = "#1f2933"
QUIET = "#52606d"
GROUND = "#ffffff"
BLUE = "#0072b2"
GREEN = "#007a5a"
ORANGE = "#b35900"
PURPLE = "#8e4585"
"""Colours of the lanes model, calibration, flight and discrepancy (darker Okabe-Ito colours)."""
TINTS = {BLUE: "#eaf4fb", GREEN: "#e8f6f1", ORANGE: "#fdf1e3", PURPLE: "#f7eef6"}


def text(x: float, y: float, words: str, size: int = 14, colour: str = INK, **style: str) -> str:
    """Return words, centred unless told otherwise; `style` holds SVG attributes, `_` for `-`."""
    attributes = {"text_anchor": "middle", **style}
    attribute_text = "".join(
        f' {name.replace("_", "-")}="{value}"' for name, value in attributes.items()
    )
    position = f'x="{x:g}" y="{y:g}" font-size="{size}" fill="{colour}"'
    return f"<text {position}{attribute_text}>{escape(words)}</text>"


def lane(x: float, y: float, width: float, height: float, colour: str) -> str:
    """Return a tinted field."""
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="12" '
        f'fill="{TINTS[colour]}"/>'
    )


def heading(x: float, y: float, title: str, command_x: float, command: str, colour: str) -> str:
    """Return the title of a field and the command that works in it."""
    style = {"text_anchor": "start", "font_family": "ui-monospace, monospace"}
    return "\n".join(
        (
            text(x, y, title, 16, colour, text_anchor="start", font_weight="600"),
            text(command_x, y, command, 13, QUIET, **style),
        )
    )


def box(x: float, y: float, width: float, title: str, lines: tuple[str, ...], colour: str) -> str:
    """Return a box of 78 units' height with a title and two lines."""
    middle = x + width / 2.0
    parts = [
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="78" rx="8" fill="{GROUND}" '
        f'stroke="{colour}" '
        'stroke-width="1.5"/>',
        text(middle, y + 24, title, 15, INK, font_weight="600"),
    ]
    parts += [text(middle, y + 45 + 18 * row, line, 13, QUIET) for row, line in enumerate(lines)]
    return "\n".join(parts)


def arrow(*points: tuple[float, float], colour: str = QUIET) -> str:
    """Return a line through points that ends in a head."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return (
        f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2" '
        'marker-end="url(#head)"/>'
    )


def label(x: float, y: float, words: str, **style: str) -> str:
    """Return what travels along an arrow."""
    return text(x, y, words, 13, INK, font_style="italic", **style)


def model_lane() -> list[str]:
    """From a design to an FMU."""
    row = 70
    return [
        lane(20, 20, 1020, 148, BLUE),
        heading(38, 45, "Model", 108, "uav-twin wing, uav-twin fmu", BLUE),
        box(44, row, 200, "Design", ("planform, materials,", "gauges: one TOML file"), BLUE),
        box(
            300,
            row,
            200,
            "Finite elements",
            ("stiffness, mass, loads,", "affine in e, z1, z2"),
            BLUE,
        ),
        box(
            556, row, 200, "Reduced model", ("microseconds, with a", "certified error bound"), BLUE
        ),
        box(812, row, 204, "FMU", ("ours, or any other", "of FMI 1, 2 or 3"), BLUE),
        arrow((244, 109), (298, 109)),
        arrow((500, 109), (554, 109)),
        arrow((756, 109), (810, 109)),
    ]


def calibration_lane() -> list[str]:
    """From the laboratory to this one wing."""
    row = 274
    return [
        lane(20, 222, 500, 154, GREEN),
        heading(38, 247, "Calibration", 154, "uav-twin calibrate", GREEN),
        box(44, row, 200, "Laboratory", ("tape measure, load test,", "ring-down records"), GREEN),
        box(300, row, 200, "Posterior", ("of stiffness e, masses", "and damping"), GREEN),
        arrow((244, 313), (298, 313)),
        arrow((400, 274), (400, 150)),
        label(392, 200, "measured planform", text_anchor="end"),
        arrow((500, 313), (566, 313)),
    ]


def flight_lane() -> list[str]:
    """Asset and twin."""
    row = 274
    return [
        lane(544, 222, 496, 154, ORANGE),
        heading(562, 247, "Flight", 740, "uav-twin run", ORANGE),
        box(568, row, 176, "Twin", ("belief of the damage:", "filter, predict, decide"), ORANGE),
        box(852, row, 164, "Asset", ("the FMU, in a", "process of its own"), ORANGE),
        arrow((852, 296), (746, 296)),
        label(799, 289, "24 strains"),
        arrow((744, 332), (850, 332)),
        label(797, 350, "load factor"),
        arrow((656, 148), (656, 272)),
        label(664, 200, "what the twin believes", text_anchor="start"),
        arrow((934, 148), (934, 272)),
        label(942, 200, "what flies", text_anchor="start"),
    ]


def discrepancy_lane() -> list[str]:
    """From measured data to what the model lacks."""
    row = 480
    steps = (
        ("Measured data", ("records, or the", "run of a mission")),
        ("Locate", ("sensor, trial, load,", "amplitude, time")),
        ("Name", ("an effect with its", "probability, or not")),
        ("Add", ("a patch of model,", "FMU and twin")),
        ("Prove", ("the gap closes on", "data not used")),
    )
    parts = [
        lane(20, 428, 1020, 152, PURPLE),
        heading(44, 453, "What the model lacks", 258, "uav-twin discrepancy run", PURPLE),
    ]
    for number, (title, lines) in enumerate(steps):
        x = 44 + 202 * number
        parts.append(box(x, row, 164, title, lines, PURPLE))
        if number:
            parts.append(arrow((x - 38, row + 39), (x - 2, row + 39)))
    return [
        *parts,
        arrow((656, 352), (656, 403), (31, 403), (31, 519), (42, 519)),
        label(392, 396, "run folder, report"),
        arrow((1016, 519), (1066, 519), (1066, 109), (1018, 109)),
        label(1084, 330, "patch", transform="rotate(-90 1084 330)"),
    ]


def draw() -> str:
    """Return the picture as SVG."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" '
        f'height="{HEIGHT}" '
        'font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif" '
        'role="img">\n'
        "<title>From a design and measurements to a twin that flies, "
        "and to what its model lacks</title>\n"
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" '
        'markerWidth="7" markerHeight="7" '
        f'orient="auto-start-reverse"><path d="M0,0 L10,5 L0,10 z" fill="{QUIET}"/>'
        "</marker></defs>\n"
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="16" fill="{GROUND}"/>\n'
    )
    lanes = [*model_lane(), *calibration_lane(), *flight_lane(), *discrepancy_lane()]
    # Fields first, so that no arrow between lanes is covered.
    fields = [part for part in lanes if 'rx="12"' in part]
    shapes = [part for part in lanes if 'rx="12"' not in part]
    return head + "\n".join([*fields, *shapes]) + "\n</svg>\n"
