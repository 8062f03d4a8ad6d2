"""The report: trackers side by side on one page, with tables and plots."""
