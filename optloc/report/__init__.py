"""Pages that need no network: the report of a study with its files for papers, maps of bounds, of fixes and tracks."""

from optloc.report.page import fix_page, live_page, map_page, track_page
from optloc.report.study_page import Tell, write_report

__all__ = ["Tell", "fix_page", "live_page", "map_page", "track_page", "write_report"]
