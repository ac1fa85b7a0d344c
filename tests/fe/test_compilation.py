from __future__ import annotations

import numba

from fe.compilation import compiled


def double(value):
    return 2.0 * value


def test_compiled_functions_run():
    assert compiled(double)(3.0) == 6.0


def test_without_a_folder_for_the_cache_it_still_compiles(monkeypatch):
    njit, asked = numba.njit, []

    def no_folder(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_folder)
    assert compiled(double)(3.0) == 6.0
    assert [options.get("cache", False) for options in asked] == [True, False]
