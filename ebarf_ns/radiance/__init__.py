"""The radiance field and its rendering: hash grid, ray sampling, volume rendering."""
