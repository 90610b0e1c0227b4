"""The project's own event camera, for tests and demos."""
