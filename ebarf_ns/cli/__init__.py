"""The ``ebarf`` command."""
