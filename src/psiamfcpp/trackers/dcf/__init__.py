"""Correlation filters of the UAV tracking papers, on one shared core, after their authors' code."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

from psiamfcpp.errors import UserError

if TYPE_CHECKING:
    from psiamfcpp.trackers.dcf.tracker import DcfTracker

FILTERS: dict[str, tuple[str, str]] = {
    "kcf": ("kcf", "Kcf"),
    "fdsst": ("fdsst", "Fdsst"),
    "staple-ca": ("staple_ca", "StapleCa"),
    "bacf": ("bacf", "Bacf"),
    "eco-hc": ("eco_hc", "EcoHc"),
    "mcct-h": ("mcct_h", "McctH"),
    "strcf": ("strcf", "Strcf"),
    "arcf-hc": ("arcf_hc", "ArcfHc"),
    "autotrack": ("autotrack", "AutoTrack"),
}
"""name -> its module and class here; the constants are the class with ``Constants`` appended"""


def open_dcf(name: str) -> DcfTracker:
    """A tracker that follows one target with the correlation filter of this name.

    Raises:
        UserError: there is no such filter, or the extra `dcf` is not installed.
    """
    if name not in FILTERS:
        raise UserError(f"correlation filter {name!r} is not known: choose from {', '.join(FILTERS)}")
    try:
        import numba  # noqa: F401
        import scipy  # noqa: F401
    except ImportError as error:
        raise UserError(f"correlation filters need {error.name}: pip install 'psiamfcpp[dcf]'") from None
    from psiamfcpp.trackers.dcf.tracker import DcfTracker

    module, kind = FILTERS[name]
    found = importlib.import_module(f"{__name__}.{module}")
    return DcfTracker(name, getattr(found, kind), getattr(found, f"{kind}Constants")())


def open_tracker(name: str, options: Mapping[str, str]) -> DcfTracker:
    """Open ``dcf:NAME``; correlation filters take no options.

    Raises:
        UserError: see `open_dcf`, or there is an option.
    """
    if options:
        raise UserError(f"tracker dcf:{name} has no option {next(iter(options))!r}: give dcf:{name}")
    return open_dcf(name)
