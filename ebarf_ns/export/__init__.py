"""Exports of a finished run for other programs: pictures, video, events, mesh, points and poses."""
