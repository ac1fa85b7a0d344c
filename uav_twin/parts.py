"""What commands take from the other packages, imported when it is used; `--help` needs none."""

from reporting.lazy import lazy_getattr

__getattr__ = lazy_getattr(__name__, __file__)
