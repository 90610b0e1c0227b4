"""An initial trajectory from events alone: event images, feature tracks, and structure from motion."""
