"""A finished run as what other programs read: pictures, video, events, mesh, points, poses."""
