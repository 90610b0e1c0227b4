"""The field and its rendering: hash grid, samples along rays."""
