"""Log brightness, sensor response and event losses."""
