"""Pages that need no network: the report of a study with its files for papers, maps of bounds, of fixes and tracks."""

from optloc.report.fix_page import fix_page, track_page
from optloc.report.make import Tell, write_report
from optloc.report.map_page import map_page

__all__ = ["Tell", "fix_page", "map_page", "track_page", "write_report"]
