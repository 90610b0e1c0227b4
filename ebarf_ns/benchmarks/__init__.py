"""Methods compared, and the engine timed."""
