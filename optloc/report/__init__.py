"""The report of a study: one HTML file, and its tables and figures as files for papers."""

from optloc.report.make import Tell, write_report
from optloc.report.map_page import map_page

__all__ = ["Tell", "map_page", "write_report"]
