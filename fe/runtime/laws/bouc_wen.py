"""Hysteresis of Bouc and Wen: F = k (z - x), z' = v (1 - (1 + sgn(v z)) / 2 |z / z_y|^n).

Parameters: k, z_y, n. Memory: z. NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

from .interface import HEAD, FloatArray, PortForce, power


class BoucWen(PortForce):
    """Bouc-Wen hysteresis: F = stiffness (z - x), z' = v (1 - (1 + sgn(v z)) / 2 |z / z_y|^order).

    z_y is `yield_displacement` [m or rad].

    `stiffness` is the part of the port's stiffness that is hysteretic ((1 - alpha) k); below yield F is zero.
    """

    hysteretic: ClassVar[bool] = True
    proportional: ClassVar[tuple[str, ...]] = ("stiffness",)
    positive: ClassVar[tuple[str, ...]] = ("yield_displacement", "order")
    stiffness: Annotated[float, "N/m or N m/rad"]
    yield_displacement: Annotated[float, "m or rad"]
    order: Annotated[float, "1"]


def advance(law: FloatArray, memory: FloatArray, x: float, least: int) -> None:
    """Follow z to `x`."""
    change = x - memory[1]
    memory[1] = x
    memory[HEAD] = _path(law, memory[HEAD], change, least)


def parts(law: FloatArray, way: float) -> int:
    """Return how many parts hold the path at rest: the more, the sharper the yield."""
    return int(min(way / law[1] * law[2] * 20.0, 2000.0)) + 4


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`."""
    z = _path(law, memory[HEAD], x - memory[1], least)
    loading = z * (x - memory[1]) > 0.0
    gradient = -law[0] * power(min(abs(z) / law[1], 1.0), law[2]) if loading else 0.0
    return law[0] * (z - x), gradient


def _path(law: FloatArray, begin: float, change: float, least: int) -> float:
    """Return z after a way from its value at the begin, in `least` parts or more."""
    width, order = law[1], law[2]
    z, rest = begin / width, change / width
    if z * rest < 0.0:  # unloading: dz = dx until z is zero
        part = rest if abs(rest) <= abs(z) else -z
        z += part
        rest -= part
    if rest != 0.0:  # loading: dz/dx = 1 - |z|^order, by the midpoint rule
        way = min(abs(rest), 2.0 + 40.0 / order)  # by then it yields to the last bit
        count = max(int(way * order / 0.2) + 1, least)
        h = way / count
        size = abs(z)
        for _ in range(count):
            middle = min(size + 0.5 * h * (1.0 - power(size, order)), 1.0)
            size = min(size + h * (1.0 - power(middle, order)), 1.0)
        z = size if rest > 0.0 else -size
    return float(z * width)
