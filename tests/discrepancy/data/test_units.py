"""Units of campaigns: those of old have kept their meaning, and pint knows the others."""

from math import pi

import pytest

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS, conversion, conversion_of, quantities_of

POWERS = {
    Quantity.STRAIN: {"1": 0, "microstrain": -6, "percent": -2},
    Quantity.DISPLACEMENT: {"m": 0, "mm": -3, "um": -6},
    Quantity.VELOCITY: {"m/s": 0, "mm/s": -3},
    Quantity.ACCELERATION: {"m/s2": 0, "mm/s2": -3},
    Quantity.SIGNAL: {"V": 0, "mV": -3, "1": 0},
    Quantity.ANGLE: {"rad": 0, "mrad": -3},
    Quantity.ANGULAR_VELOCITY: {"rad/s": 0},
    Quantity.ANGULAR_ACCELERATION: {"rad/s2": 0},
    Quantity.FORCE: {"N": 0, "mN": -3, "kN": 3},
    Quantity.TORQUE: {"N m": 0, "mN m": -3, "kN m": 3},
    Quantity.PRESSURE: {"Pa": 0, "hPa": 2, "kPa": 3, "bar": 5, "mbar": 2, "MPa": 6},
    Quantity.LEVEL: {"m": 0, "cm": -2, "mm": -3},
    Quantity.FLOW: {"m3/s": 0, "l/s": -3},
    Quantity.TEMPERATURE: {"degC": 0, "K": 0},
    Quantity.HEAT: {"W": 0, "mW": -3, "kW": 3},
    Quantity.VOLTAGE: {"V": 0, "mV": -3, "kV": 3},
    Quantity.CURRENT: {"A": 0, "mA": -3},
    Quantity.CHARGE: {"C": 0, "mC": -3},
}
FACTORS = {
    (Quantity.VELOCITY, "km/h"): 1.0 / 3.6,
    (Quantity.ACCELERATION, "g"): 9.80665,
    (Quantity.ANGLE, "deg"): pi / 180.0,
    (Quantity.ANGULAR_VELOCITY, "deg/s"): pi / 180.0,
    (Quantity.ANGULAR_VELOCITY, "rpm"): 2.0 * pi / 60.0,
    (Quantity.ANGULAR_ACCELERATION, "deg/s2"): pi / 180.0,
    (Quantity.FLOW, "l/min"): 1e-3 / 60.0,
    (Quantity.FLOW, "m3/h"): 1.0 / 3600.0,
    (Quantity.CHARGE, "A h"): 3600.0,
}
"""What the units of campaigns were before pint: written down, for their meaning must not change."""


def test_the_units_of_old_mean_the_same():
    known = {(quantity, unit): power for quantity, row in POWERS.items() for unit, power in row.items()}
    for (quantity, unit), power in known.items():
        assert conversion_of(quantity, unit) == pytest.approx(float(f"1e{power}"), rel=1e-15), unit
    for (quantity, unit), factor in FACTORS.items():
        assert conversion_of(quantity, unit) == pytest.approx(factor, rel=1e-15), unit
    usual = {(quantity, unit) for quantity, row in UNITS.items() for unit in row.usual}
    assert usual == known.keys() | FACTORS.keys()


@pytest.mark.parametrize(
    ("unit", "quantity", "factor"),
    [
        ("kip", Quantity.FORCE, 4448.2216152605),
        ("kgf", Quantity.FORCE, 9.80665),
        ("kp", Quantity.FORCE, 9.80665),
        ("in", Quantity.DISPLACEMENT, 0.0254),
        ("mg", Quantity.ACCELERATION, 9.80665e-3),
        ("m/s²", Quantity.ACCELERATION, 1.0),
        ("m/s^2", Quantity.ACCELERATION, 1.0),
        ("m s-2", Quantity.ACCELERATION, 1.0),
        ("kNm", Quantity.TORQUE, 1e3),
        ("N·mm", Quantity.TORQUE, 1e-3),
        ("N/mm²", Quantity.PRESSURE, 1e6),
        ("µε", Quantity.STRAIN, 1e-6),
        ("µm/m", Quantity.STRAIN, 1e-6),
        ("μm/m", Quantity.STRAIN, 1e-6),  # the Greek letter
        ("‰", Quantity.STRAIN, 1e-3),
        ("U/min", Quantity.ANGULAR_VELOCITY, 2.0 * pi / 60.0),
        ("°", Quantity.ANGLE, pi / 180.0),
        ("mAh", Quantity.CHARGE, 3.6),
    ],
)
def test_units_as_laboratories_write_them(unit, quantity, factor):
    assert quantity in quantities_of(unit)
    assert conversion_of(quantity, unit) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    "unit",
    ["", "kg", "t", "1/min", "Hz", "links", "dB", "2 mm", "9**9**9", "kN/m", "i.O.", "degF", "x", "m" * 9999],
)
def test_what_is_no_unit_of_ours_is_of_no_quantity(unit):
    assert quantities_of(unit) == ()


@pytest.mark.parametrize("unit", ["mV/V", "V/V", "µV/V", "mV/volt"])
def test_a_ratio_of_volts_is_a_signal_and_no_strain(unit):
    assert quantities_of(unit) == (Quantity.SIGNAL,)
    with pytest.raises(ValueError, match=f"strain must have a unit such as .*, and '{unit}' came"):
        conversion_of(Quantity.STRAIN, unit)


def test_a_time_is_converted_and_a_length_is_no_time():
    assert conversion("ms", "s") == pytest.approx(1e-3, rel=1e-15)
    with pytest.raises(ValueError, match="cannot become s"):
        conversion("mm", "s")
