"""Backbones: closed forms of four laws, coverage of the error bars, the five real ring-downs."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from discrepancy.errors import FitError
from discrepancy.location.backbone import backbones


def _moved(force):
    """Return x of x'' + w^2 x + force(x, x') = 0 from one, integrated numerically."""
    found = solve_ivp(
        lambda t, y: [y[1], -(OMEGA**2) * y[0] - force(*y)], (0.0, TIME[-1]), [1.0, 0.0], t_eval=TIME,
        rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    return found.y[0]


REFERENCE = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_experimental_calibration"
TIME = 0.005 * np.arange(2000)
OMEGA = 2.0 * np.pi * 5.0


def _curve(signal, **settings):
    return backbones(TIME[: signal.size], signal, (5.1,), **settings)[0]


def _viscous(zeta=0.01, f=5.0, size=1.0):
    w = 2.0 * np.pi * f
    return size * np.exp(-zeta * w * TIME) * np.cos(w * np.sqrt(1.0 - zeta**2) * TIME + 0.4)


def test_viscous_damping_is_flat_and_exact():
    curve = _curve(_viscous() + 0.2 - 0.01 * TIME)
    np.testing.assert_allclose(curve.frequency, 5.0, rtol=1e-7)
    np.testing.assert_allclose(curve.damping_ratio, 0.01, rtol=1e-5)
    np.testing.assert_allclose(curve.amplitude, np.exp(-0.01 * OMEGA * curve.time), rtol=1e-5)
    assert curve.time[0] < 0.5
    assert curve.time[-1] > 9.0


def test_two_modes_are_separated():
    """A mode that dies away is dropped, the other goes on; pure noise gives no points."""
    first, second = backbones(TIME, _viscous() + _viscous(0.006, 7.3, 0.5), (4.9, 7.5))
    np.testing.assert_allclose(first.frequency, 5.0, rtol=1e-5)
    np.testing.assert_allclose(second.frequency, 7.3, rtol=1e-5)
    np.testing.assert_allclose(second.damping_ratio, 0.006, rtol=1e-3)
    noise = np.random.default_rng(3).standard_normal(TIME.size)
    signal = _viscous() + _viscous(0.03, 30.0) + 0.01 * noise
    first, second = backbones(TIME, signal, (5.0, 30.0), noise_deviation=0.01)
    assert second.time[-1] < 3.0 < 8.0 < first.time[-1]
    assert np.all(second.amplitude > 4.0 * second.amplitude_error)
    np.testing.assert_allclose(second.frequency[:2], 30.0, rtol=2e-3)
    assert backbones(TIME[:600], noise[:600], (5.0,), noise_deviation=1.0)[0].time.size == 0
    for periods, words in ((0.1, "at least 12"), (500.0, "the record's length")):
        with pytest.raises(FitError, match=words):
            backbones(TIME, _viscous(), (5.0,), periods=periods)


def test_coulomb_friction_has_a_ratio_that_falls_with_amplitude():
    # Exact motion: half cycles of cosines about +-delta, delta = Fc / k; peaks fall by 2 delta each.
    delta = 0.004
    half = np.floor(TIME * OMEGA / np.pi).astype(int)
    peak = 1.0 - 2.0 * delta * half
    sign = np.where(half % 2 == 0, 1.0, -1.0)
    signal = sign * ((peak - delta) * np.cos(OMEGA * TIME - half * np.pi) + delta)
    keep = int(0.9 / (2.0 * delta) * np.pi / OMEGA / 0.005)
    curve = _curve(signal[:keep])
    exact = 2.0 * delta / (np.pi * curve.amplitude)  # zeta_eq = 2 Fc / (pi k A)
    assert curve.damping_ratio[-1] > 3.0 * curve.damping_ratio[0]
    np.testing.assert_allclose(curve.damping_ratio[:-2], exact[:-2], rtol=0.04)
    np.testing.assert_allclose(curve.frequency[:-2], 5.0, rtol=1e-3)


def test_quadratic_damping_has_a_ratio_proportional_to_amplitude():
    c = 0.1
    curve = _curve(_moved(lambda x, v: c * abs(v) * v), periods=3.0)
    exact = 4.0 * c * curve.amplitude / (3.0 * np.pi)
    assert curve.amplitude[0] > 3.0 * curve.amplitude[-1]
    np.testing.assert_allclose(curve.damping_ratio, exact, rtol=0.03)
    slope = np.polyfit(np.log(curve.amplitude), np.log(curve.damping_ratio), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.02)


def test_cubic_spring_has_a_frequency_shift_with_the_square_of_amplitude():
    # f = f0 (1 + 3 kappa A^2 / 8) to first order
    kappa, zeta = 0.04, 0.008
    curve = _curve(_moved(lambda x, v: 2.0 * zeta * OMEGA * v + OMEGA**2 * kappa * x**3))
    shift = curve.frequency / 5.0 - 1.0
    np.testing.assert_allclose(shift, 0.375 * kappa * curve.amplitude**2, atol=2e-4, rtol=0.04)
    slope = np.polyfit(np.log(curve.amplitude[:6]), np.log(shift[:6]), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_error_bars_cover(known):
    generator = np.random.default_rng(21)
    noise = 0.02
    z_frequency, z_ratio, z_amplitude = [], [], []
    for _ in range(60):
        signal = (_viscous() + noise * generator.standard_normal(TIME.size))[:1200]
        curve = _curve(signal, noise_deviation=noise if known else None)
        z_frequency += ((curve.frequency - 5.0) / curve.frequency_error).tolist()
        z_ratio += ((curve.damping_ratio - 0.01) / curve.damping_ratio_error).tolist()
        exact = np.exp(-0.01 * OMEGA * curve.time)
        z_amplitude += ((curve.amplitude - exact) / curve.amplitude_error).tolist()
    assert len(z_frequency) > 500
    for z in (z_frequency, z_ratio, z_amplitude):
        assert 0.86 < np.mean(np.abs(z) < 1.645) < 0.94
        assert abs(np.mean(z)) < 0.15


def test_the_real_wing_stiffens_and_its_damping_falls_as_it_comes_to_rest():
    if not REFERENCE.is_dir():
        pytest.skip(f"the published ring-downs are not at {REFERENCE}")
    from calibration.dynamics.records import read_records

    curves = []
    for record in read_records(REFERENCE):
        found = backbones(record.time, record.signal, (5.65, 29.97), averaging_width=record.averaging_width)
        curves.append(found[0])
    assert len(curves) == 5
    of_all = np.array([
        [np.interp(np.log((0.6e-3, 6e-3)), np.log(curve.amplitude[::-1]), values[::-1])
         for values in (curve.frequency, curve.damping_ratio)]
        for curve in curves
    ])  # fmt: skip
    small, large = of_all[..., 0], of_all[..., 1]
    assert np.all((small - large) * (1.0, -1.0) > 0.0)
    for rise in ((small - large) * (1.0, -1.0)).T:
        assert rise.mean() > 5.0 * rise.std(ddof=1) / np.sqrt(len(rise))
