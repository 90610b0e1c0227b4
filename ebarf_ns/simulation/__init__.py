"""Event camera simulator for tests and demos."""
