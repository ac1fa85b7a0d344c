"""What commands import from other modules, each when it is used; `--help` needs none of it."""

from reporting.lazy import lazy_getattr

__getattr__ = lazy_getattr(__name__, __file__)
