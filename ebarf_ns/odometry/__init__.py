"""An initial trajectory from events alone: event images, feature tracks through them, structure from motion."""
