"""Pages that need no network, and what a fix says: reports of studies, maps of bounds, fixes and tracks, words."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optloc.show.page import fix_page, live_page, map_page, track_page

__all__ = ["fix_page", "live_page", "map_page", "track_page"]


def __getattr__(name: str) -> Any:
    # Pages bring templates and drawings with them; words of a fix need neither.
    from importlib import import_module

    for place in ("page", "study_page"):
        if name in __all__ and hasattr(module := import_module(f"optloc.show.{place}"), name):
            return getattr(module, name)
    raise AttributeError(f"module 'optloc.show' has no attribute {name!r}")
